"""A process that makes solids in gmsh's OpenCASCADE kernel or reads CAD files, and meshes them.

`python -m ast_sim.simulate.shapes.cad_worker` reads a request as JSON from its standard input and writes an .npz to its
standard output. On an error it exits with code 3, and the last line of its standard error says what is wrong. gmsh
crashes and hangs on bad geometry and is under the GPL, so no other process of this package loads it.

A request: {"parts": [...], "nodes": wanted number of nodes of all parts, "seconds": limit on the processor time}. Each
part is {"solid": steps of the grammar (see `cad.py`)}, {"step": path} or {"stl": path}.
The answer: position_i and elements_i of each part, scale_i (the length by which the coordinates of the file were
divided), and the version of gmsh.
"""

from __future__ import annotations

import io
import json
import math
import os
import resource
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np

CREASE_ANGLE = math.radians(40)  # edges of an STL surface sharper than this are edges of the part
MESHES = 5  # at most this many meshes are made to find the element size
NODE_TOLERANCE = 0.1  # a mesh whose number of nodes is this near to the wanted one is good enough


class BadPart(Exception):
    """What is wrong with a part, in words."""


@dataclass(frozen=True)
class Model:
    """A part in gmsh.

    Attributes:
        name: name of the gmsh model that holds the part.
        request: the request that it was made from.
        volume, area: of the part and of its surface, at a diagonal of about one.
        scale: lengths of the file were divided by this.
        unit: lengths in gmsh over lengths of the part.
    """

    name: str
    request: dict[str, Any]
    volume: float
    area: float
    scale: float = 1.0
    unit: float = 1.0


def main() -> None:
    """Answer one request."""
    request = json.loads(sys.stdin.read())
    resource.setrlimit(resource.RLIMIT_CPU, (request["seconds"], request["seconds"] + 5))  # SIGXCPU, then SIGKILL
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what gmsh prints must not mix with the answer
    import gmsh

    gmsh.initialize(interruptible=False)
    for name, value in (
        ("General.Terminal", 0),
        ("General.NumThreads", 1),
        ("Mesh.RandomSeed", 1),
        ("Mesh.MeshSizeFromPoints", 0),
        ("Mesh.MeshSizeExtendFromBoundary", 0),
        ("Geometry.OCCFixDegenerated", 1),
        ("Geometry.OCCFixSmallEdges", 1),
        ("Geometry.OCCFixSmallFaces", 1),
    ):
        gmsh.option.setNumber(name, value)
    arrays = {"version": np.array(gmsh.option.getString("General.Version"))}
    try:
        models = [_load(gmsh, f"part {i}", part) for i, part in enumerate(request["parts"])]
        meshes = _mesh_all(gmsh, models, request["nodes"]) if models else []
    except BadPart as error:
        sys.exit(_refuse(str(error)))
    except Exception as error:  # gmsh raises Exception itself
        sys.exit(_refuse(str(error).strip() or "gmsh stopped without a message"))
    for i, (model, (position, elements)) in enumerate(zip(models, meshes, strict=True)):
        arrays |= {f"position_{i}": position, f"elements_{i}": elements, f"scale_{i}": np.array(model.scale)}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    answer.write(buffer.getvalue())
    answer.close()


def _refuse(text: str) -> int:
    print("\n" + " ".join(text.split()), file=sys.stderr)
    return 3


def _load(gmsh, name: str, part: dict[str, Any]) -> Model:
    gmsh.model.add(name)
    if "stl" in part:
        return _load_stl(gmsh, name, part)
    occ, scale = gmsh.model.occ, 1.0
    if "step" in part:
        _import_step(gmsh, part["step"])
        scale = _to_unit_diagonal(gmsh)
    else:
        _build(occ, part["solid"])
    occ.synchronize()
    volumes = gmsh.model.getEntities(3)
    if not volumes:
        raise BadPart(f"it holds no closed solid{_open_edge(gmsh, scale)}")
    if len(volumes) > 1:
        boxes = [[scale * x for x in occ.getCenterOfMass(*volume)] for volume in volumes[:2]]
        raise BadPart(
            f"it holds {len(volumes)} separate solids (the first two around {_point(boxes[0])} and"
            f" {_point(boxes[1])}); a part is one solid: export each to a file of its own"
        )
    volume = occ.getMass(*volumes[0])
    area = sum(occ.getMass(*surface) for surface in gmsh.model.getEntities(2))
    if not volume > 1e-6:
        raise BadPart(f"its volume is {volume * scale**3:.3g}, as good as zero for its size")
    return Model(name, part, volume, area, scale)


def _import_step(gmsh, path: str) -> None:
    """Import all shapes. If there is no solid among them, sew their faces together and make one solid of them."""
    for heal in (0, 1):
        gmsh.option.setNumber("Geometry.OCCSewFaces", heal)
        gmsh.option.setNumber("Geometry.OCCMakeSolids", heal)
        gmsh.model.occ.importShapes(path, highestDimOnly=False)
        gmsh.model.occ.synchronize()
        if gmsh.model.getEntities(3):
            return
        if not heal:
            gmsh.model.occ.remove(gmsh.model.occ.getEntities(), recursive=True)
            gmsh.model.occ.synchronize()


def _to_unit_diagonal(gmsh) -> float:
    """Scale all imported shapes to a diagonal of one; return the length by which they were divided."""
    occ = gmsh.model.occ
    low, high = np.split(np.array(gmsh.model.getBoundingBox(-1, -1)), 2)
    diagonal = float(np.linalg.norm(high - low))
    if not gmsh.model.getEntities(2):
        raise BadPart("it holds no surface at all")
    if not (math.isfinite(diagonal) and diagonal > 0):
        raise BadPart(f"its size is {diagonal}")
    occ.dilate([entity for entity in occ.getEntities() if _is_top(gmsh, entity)], 0, 0, 0, *[1 / diagonal] * 3)
    return diagonal


def _is_top(gmsh, entity: tuple[int, int]) -> bool:
    """Whether this shape is not the boundary of another. Scaling a shape scales its boundary, too."""
    return entity[0] == 3 or not len(gmsh.model.getAdjacencies(*entity)[0])


def _open_edge(gmsh, scale: float) -> str:
    """Where a shell is open: a point of an edge that bounds only one face. (A seam bounds its face twice.)"""
    uses: dict[int, int] = {}
    for surface in gmsh.model.getEntities(2):
        for _, curve in gmsh.model.getBoundary([surface], combined=False, oriented=False):
            uses[abs(curve)] = uses.get(abs(curve), 0) + 1
    single = [curve for curve, count in uses.items() if count == 1]
    if not single:
        return ""
    low, high = gmsh.model.getParametrizationBounds(1, single[0])
    where = [scale * x for x in gmsh.model.getValue(1, single[0], [(low[0] + high[0]) / 2])]
    return f": its shell is open, {len(single)} edges bound only one face, the first at {_point(where)}"


def _point(x) -> str:
    return "(" + ", ".join(f"{value:.6g}" for value in x) + ")"


def _build(occ, steps: list[dict[str, Any]]) -> None:
    """Make the solid that the steps of the grammar describe."""
    make = {
        "box": lambda at, size: occ.addBox(*at, *size),
        "cylinder": lambda at, axis, radius: occ.addCylinder(*at, *axis, radius),
        "cone": lambda at, axis, radius, radius_end: occ.addCone(*at, *axis, radius, radius_end),
        "sphere": lambda at, radius: occ.addSphere(*at, radius),
        "torus": lambda at, radius, radius_tube: occ.addTorus(*at, radius, radius_tube),
        "slab": lambda at, size, corner: _slab(occ, at, size, corner),
    }
    whole: list[tuple[int, int]] = []
    for step in steps:
        arguments = {key: value for key, value in step.items() if key not in ("do", "shape")}
        tool = [(3, make[step["shape"]](**arguments))]
        if not whole:
            whole = tool
        elif step["do"] == "add":
            whole, _ = occ.fuse(whole, tool)
        elif step["do"] == "cut":
            whole, _ = occ.cut(whole, tool)
        else:
            whole, _ = occ.intersect(whole, tool)


def _slab(occ, at: list[float], size: list[float], corner: float) -> int:
    """A box whose edges along z are rounded with the radius `corner`."""
    face = occ.addRectangle(*at, size[0], size[1], roundedRadius=corner)
    return next(tag for dimension, tag in occ.extrude([(2, face)], 0, 0, size[2]) if dimension == 3)


def _load_stl(gmsh, name: str, part: dict[str, Any]) -> Model:
    """A closed surface of triangles, cut along its creases into faces. gmsh meshes these faces anew."""
    gmsh.merge(part["stl"])
    mesh = gmsh.model.mesh
    triangles = _triangles(gmsh)
    if not len(triangles):
        raise BadPart("it holds no triangles")
    scale = float(np.linalg.norm(np.ptp(triangles.reshape(-1, 3), axis=0)))
    mesh.classifySurfaces(CREASE_ANGLE, True, True, math.pi)
    mesh.createGeometry()
    loop = gmsh.model.geo.addSurfaceLoop([tag for _, tag in gmsh.model.getEntities(2)])
    gmsh.model.geo.addVolume([loop])
    gmsh.model.geo.synchronize()
    a, b, c = np.moveaxis(triangles / scale, 1, 0)
    normal = np.cross(b - a, c - a)
    volume = float(np.einsum("ij,ij->", a, normal)) / 6
    area = float(np.linalg.norm(normal, axis=1).sum()) / 2
    return Model(name, part, abs(volume), area, scale, unit=scale)


def _triangles(gmsh) -> np.ndarray:
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    index = np.zeros(int(tags.max(initial=0)) + 1, int)
    index[tags] = np.arange(len(tags))
    _, nodes = gmsh.model.mesh.getElementsByType(2)
    return coordinates.reshape(-1, 3)[index[nodes]].reshape(-1, 3, 3)


def _mesh_all(gmsh, models: list[Model], nodes: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Meshes of all parts with one element size, which is sought until they have about `nodes` nodes together."""
    correction, best = 1.0, None
    for _ in range(MESHES):
        size = _element_size(models, nodes / correction)
        meshes = [_mesh(gmsh, model, size) for model in models]
        count = sum(len(position) for position, _ in meshes)
        if best is None or abs(count - nodes) < abs(best[0] - nodes):
            best = count, meshes
        if abs(count - nodes) <= NODE_TOLERANCE * nodes:
            break
        correction = count / _expected(models, size)
    return best[1]


def _expected(models: list[Model], size: float) -> float:
    """About how many nodes meshes of this element size have: 0.72 per size^3 of volume, 1.4 per size^2 of surface."""
    return sum(0.72 * model.volume / size**3 + 1.4 * model.area / size**2 for model in models)


def _element_size(models: list[Model], nodes: float) -> float:
    low, high = 1e-4, 2.0
    for _ in range(60):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if _expected(models, middle) > nodes else (low, middle)
    return low


def _mesh(gmsh, model: Model, size: float) -> tuple[np.ndarray, np.ndarray]:
    gmsh.model.setCurrent(model.name)
    if "stl" in model.request:  # clearing its mesh would remove the surface itself
        gmsh.model.remove()
        _load(gmsh, model.name, model.request)
    else:
        gmsh.model.mesh.clear()
    gmsh.option.setNumber("Mesh.MeshSizeMin", size * model.unit)
    gmsh.option.setNumber("Mesh.MeshSizeMax", size * model.unit)
    gmsh.model.mesh.generate(3)
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    _, elements = gmsh.model.mesh.getElementsByType(4)
    if not len(elements):
        raise BadPart("no tetrahedra came out: its surface does not enclose a volume")
    used, elements = np.unique(elements, return_inverse=True)
    index = np.zeros(int(tags.max()) + 1, int)
    index[tags] = np.arange(len(tags))
    return coordinates.reshape(-1, 3)[index[used]] / model.unit, elements.reshape(-1, 4)


if __name__ == "__main__":
    main()

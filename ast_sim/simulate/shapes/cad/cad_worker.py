"""A process that makes solids in gmsh's OpenCASCADE kernel or reads CAD files, and meshes them.

`python -m ast_sim.simulate.shapes.cad.cad_worker` reads a request as JSON from its standard input and writes an .npz to
its standard output. On an error it exits with code 3, and the last line of its standard error says what is wrong. gmsh
crashes and hangs on bad geometry and is under the GPL, so no other process of this package loads it.

A request: {"parts": [...], "nodes": wanted number of nodes of all parts, "seconds": limit on the processor time}. Each
part is {"solid": steps of the grammar (see `grammar`)}, {"step": path} or {"stl": path}.
The answer: position_i and elements_i of each part, scale_i (the length by which the coordinates of the file were
divided), and the version of gmsh. Parts that keep their own scale stand under "own": see `own_scale`.
"""

from __future__ import annotations

import io
import json
import math
import os
import resource
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim.importers.formats.stl_file import BadSurface
from ast_sim.simulate.shapes.cad import own_scale
from ast_sim.simulate.shapes.cad.cad_import import (
    BadPart,
    import_step,
    is_top,
    one_solid,
    solid_of_surface,
    start,
    tetrahedra,
)
from ast_sim.simulate.shapes.cad.surface_mend import stl_surface

MESHES = 5  # at most this many meshes are made to find the element size
NODE_TOLERANCE = 0.1  # a mesh whose number of nodes is this near to the wanted one is good enough


@dataclass(frozen=True)
class PartModel:
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
    _limit_seconds(request["seconds"])
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what gmsh prints must not mix with the answer
    import gmsh

    start(gmsh)
    arrays = {"version": np.array(gmsh.option.getString("General.Version"))}
    try:
        arrays |= own_scale.answer(gmsh, request.get("own", []))
        models = [_load(gmsh, f"part {i}", part) for i, part in enumerate(request["parts"])]
        meshes = _mesh_all(gmsh, models, request["nodes"]) if models else []
    except (BadPart, BadSurface) as error:
        sys.exit(_refuse(str(error)))
    except Exception as error:  # gmsh raises Exception itself
        sys.exit(_refuse(str(error).strip() or "gmsh stopped without a message"))
    for i, (model, (position, elements)) in enumerate(zip(models, meshes, strict=True)):
        arrays |= {f"position_{i}": position, f"elements_{i}": elements, f"scale_{i}": np.array(model.scale)}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # pyright: ignore[reportArgumentType], allow_pickle is no name of theirs
    answer.write(buffer.getvalue())
    answer.close()


def _limit_seconds(seconds: int) -> None:
    """Limit the processor time: SIGXCPU, then SIGKILL. A limit that is lower already (`ulimit -t`) stays."""
    _, most = resource.getrlimit(resource.RLIMIT_CPU)
    wanted = (seconds, seconds + 5)
    if most != resource.RLIM_INFINITY:
        wanted = (min(seconds, max(1, most - 5)), min(seconds + 5, most))
    resource.setrlimit(resource.RLIMIT_CPU, wanted)


def _refuse(text: str) -> int:
    print("\n" + " ".join(text.split()), file=sys.stderr)
    return 3


def _load(gmsh, name: str, part: dict[str, Any]) -> PartModel:
    gmsh.model.add(name)
    if "stl" in part:
        return _load_stl(gmsh, name, part)
    occ = gmsh.model.occ
    scale = 1.0
    if "step" in part:
        import_step(gmsh, part["step"])
        scale = _to_unit_diagonal(gmsh)
    else:
        _build(occ, part["solid"])
    occ.synchronize()
    one_solid(gmsh, scale)
    volume = occ.getMass(*gmsh.model.getEntities(3)[0])
    area = sum(occ.getMass(*surface) for surface in gmsh.model.getEntities(2))
    if not volume > 1e-6:
        raise BadPart(f"its volume is {volume * scale**3:.3g}, as good as zero for its size")
    return PartModel(name, part, volume, area, scale)


def _to_unit_diagonal(gmsh) -> float:
    """Scale all imported shapes to a diagonal of one; return the length by which they were divided."""
    occ = gmsh.model.occ
    low, high = np.split(np.array(gmsh.model.getBoundingBox(-1, -1)), 2)
    diagonal = float(np.linalg.norm(high - low))
    if not gmsh.model.getEntities(2):
        raise BadPart("it holds no surface at all")
    if not (math.isfinite(diagonal) and diagonal > 0):
        raise BadPart(f"its size is {diagonal}")
    occ.dilate([entity for entity in occ.getEntities() if is_top(gmsh, entity)], 0, 0, 0, *[1 / diagonal] * 3)
    return diagonal


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


def _load_stl(gmsh, name: str, part: dict[str, Any]) -> PartModel:
    """A closed surface of triangles, cut along its creases into faces. gmsh meshes these faces again."""
    surface = stl_surface(Path(part["stl"]))
    scale = surface.diagonal
    solid_of_surface(gmsh, surface)
    a, b, c = np.moveaxis(surface.position[surface.triangles] / scale, 1, 0)
    normal = np.cross(b - a, c - a)
    volume = float(np.einsum("ij,ij->", a, normal)) / 6
    area = float(np.linalg.norm(normal, axis=1).sum()) / 2
    return PartModel(name, part, abs(volume), area, scale, unit=scale)


def _mesh_all(gmsh, models: list[PartModel], nodes: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Meshes of all parts with one element size, which is sought until they have about `nodes` nodes together."""
    correction = 1.0
    nearest = math.inf
    best: list[tuple[np.ndarray, np.ndarray]] = []
    for _ in range(MESHES):
        size = _element_size(models, nodes / correction)
        meshes = [_mesh(gmsh, model, size) for model in models]
        count = sum(len(position) for position, _ in meshes)
        off = abs(count - nodes)
        if off < nearest:
            nearest = off
            best = meshes
        if off <= NODE_TOLERANCE * nodes:
            break
        correction = count / _expected(models, size)
    return best


def _expected(models: list[PartModel], size: float) -> float:
    """About how many nodes meshes of this element size have: 0.72 per size^3 of volume, 1.4 per size^2 of surface."""
    return sum(0.72 * model.volume / size**3 + 1.4 * model.area / size**2 for model in models)


def _element_size(models: list[PartModel], nodes: float) -> float:
    low, high = 1e-4, 2.0
    for _ in range(60):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if _expected(models, middle) > nodes else (low, middle)
    return low


def _mesh(gmsh, model: PartModel, size: float) -> tuple[np.ndarray, np.ndarray]:
    gmsh.model.setCurrent(model.name)
    if "stl" in model.request:  # clearing its mesh would remove the surface itself
        gmsh.model.remove()
        _load(gmsh, model.name, model.request)
    else:
        gmsh.model.mesh.clear()
    gmsh.option.setNumber("Mesh.MeshSizeMin", size * model.unit)
    gmsh.option.setNumber("Mesh.MeshSizeMax", size * model.unit)
    gmsh.model.mesh.generate(3)
    position, elements, _ = tetrahedra(gmsh)
    return position / model.unit, elements


if __name__ == "__main__":
    main()

"""What a gmsh process does to make one solid of a CAD file or of a surface, and to read the mesh of it."""

from __future__ import annotations

import math

import numpy as np

from ast_sim.number_arrays import point
from ast_sim.simulate.shapes.cad.surface_mend import TriangleSurface, several_solids
from ast_sim.support.errors import counted

MENDED = ("Degenerated", "SmallEdges", "SmallFaces")
VTK_ORDER = [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]  # of the nodes of a second-order tetrahedron, in gmsh's
CREASE_ANGLE = math.radians(40)  # edges of an STL surface sharper than this are edges of the part


# Of every gmsh session. The seed makes meshes repeatable; sizes come from `MeshSizeMin` and `MeshSizeMax` alone.
OPTIONS = (
    ("General.Terminal", 0),
    ("General.NumThreads", 1),
    ("Mesh.RandomSeed", 1),
    ("Mesh.MeshSizeFromPoints", 0),
    ("Mesh.MeshSizeExtendFromBoundary", 0),
)


class BadPart(Exception):
    """What is wrong with a part, in words."""


def start(gmsh) -> None:
    """Start gmsh again (6 ms), without models, options and constants of scripts and without settings of the user."""
    if gmsh.isInitialized():
        gmsh.finalize()
    gmsh.initialize(readConfigFiles=False, interruptible=False)
    for name, value in OPTIONS:
        gmsh.option.setNumber(name, value)


def import_step(gmsh, path: str, mend: bool = True) -> None:
    """Import all shapes. If there is no solid among them, sew their faces together and make one solid of them.

    To mend is to remove degenerate and very small edges. The pole of a sphere is such an edge: without
    it, gmsh cannot mesh the sphere.
    """
    for name in MENDED:
        gmsh.option.setNumber(f"Geometry.OCCFix{name}", int(mend))
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


def is_top(gmsh, entity: tuple[int, int]) -> bool:
    """Whether this shape is not the boundary of another. Scaling a shape scales its boundary, too."""
    return entity[0] == 3 or not len(gmsh.model.getAdjacencies(*entity)[0])


def one_solid(gmsh, scale: float = 1.0) -> None:
    """Raise BadPart unless the model holds one solid; `scale` is the length by which its coordinates were divided."""
    volumes = gmsh.model.getEntities(3)
    if not volumes:
        raise BadPart(f"it holds no closed solid{_open_edge(gmsh, scale)}")
    if len(volumes) > 1:
        boxes = [[scale * x for x in gmsh.model.occ.getCenterOfMass(*volume)] for volume in volumes[:2]]
        raise BadPart(
            f"it holds {len(volumes)} separate solids (the first two around {point(boxes[0])} and"
            f" {point(boxes[1])}); a part is one solid: export each to a file of its own"
        )


def pick_solid(gmsh, solid: str | int | None) -> None:
    """Leave one solid in the model: the one with this name or number (from 1); None: there must be one only.

    The name is the path of the solid in the CAD file, such as "Shapes/frame/BOLT::1/bolt", or a part of this path
    between two "/"; case does not matter.

    Raises:
        BadPart: there is no such solid, or several and none is chosen; the text describes the solids that there are.
    """
    volumes = gmsh.model.getEntities(3)
    if not volumes or (solid is None and len(volumes) == 1):
        one_solid(gmsh)
        return
    boxes = [np.split(np.array(gmsh.model.getBoundingBox(*volume)), 2) for volume in volumes]
    names = [gmsh.model.getEntityName(*volume) for volume in volumes]
    told = several_solids(
        [(name.rpartition("/")[2], low, high) for name, (low, high) in zip(names, boxes, strict=True)]
    )
    if solid is None:
        raise BadPart(told)
    if isinstance(solid, int):
        chosen = [solid - 1] if 1 <= solid <= len(volumes) else []
    else:
        chosen = [i for i, name in enumerate(names) if f"/{solid}/".lower() in f"/{name}/".lower()]
    if len(chosen) != 1:
        held = counted(len(chosen), "solid") if chosen else "no solid"
        raise BadPart(f"it holds {held} {solid!r}; {told}")
    others = [volume for i, volume in enumerate(volumes) if i != chosen[0]]
    gmsh.model.occ.remove(others, recursive=True)
    gmsh.model.occ.synchronize()
    gmsh.model.removeEntities([one for one in gmsh.model.getEntities(3) if one in others], recursive=True)


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
    return (
        f": its shell is open, {counted(len(single), 'edge bounds', 'edges bound')} only one face, the first at"
        f" {point(where)}"
    )


def solid_of_surface(gmsh, surface: TriangleSurface, crease_angle: float = CREASE_ANGLE) -> None:
    """Make a solid of a closed surface of triangles, cut along its creases into faces. Of an open one, faces only."""
    mesh = gmsh.model.mesh
    gmsh.model.addDiscreteEntity(2, 1)
    mesh.addNodes(2, 1, np.arange(1, len(surface.position) + 1), surface.position.ravel())
    mesh.addElementsByType(1, 2, [], surface.triangles.ravel() + 1)
    mesh.classifySurfaces(crease_angle, True, True, math.pi)
    mesh.createGeometry()
    if surface.is_closed:
        loops = [gmsh.model.geo.addSurfaceLoop(faces) for faces in _joined_faces(gmsh)]
        gmsh.model.geo.addVolume(loops)
    gmsh.model.geo.synchronize()


def _joined_faces(gmsh) -> list[list[int]]:
    """The faces of the model in groups that share edges: first the largest group, then the groups in its cavities."""
    groups: list[tuple[set[int], list[int]]] = []
    for _, face in gmsh.model.getEntities(2):
        curves = {abs(curve) for _, curve in gmsh.model.getBoundary([(2, face)], combined=False)}
        touched = [group for group in groups if group[0] & curves]
        groups = [group for group in groups if group not in touched]
        joined = curves.union(*(group[0] for group in touched))
        groups.append((joined, [*(one for group in touched for one in group[1]), face]))

    def extent(faces: list[int]) -> float:
        boxes = np.array([gmsh.model.getBoundingBox(2, face) for face in faces])
        return float(np.linalg.norm(boxes[:, 3:].max(axis=0) - boxes[:, :3].min(axis=0)))

    return sorted((sorted(faces) for _, faces in groups), key=extent, reverse=True)


def tetrahedra(gmsh, order: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The mesh of the model: positions [N,3] in its units, tetrahedra [E,4], or [E,10] of the order 2, and gmsh's tags
    of the nodes [N]."""
    if order == 2:
        gmsh.model.mesh.setOrder(2)
    kind, nodes = {1: (4, 4), 2: (11, 10)}[order]
    elements = gmsh.model.mesh.getElementsByType(kind)[1]
    if not len(elements):
        raise BadPart("no tetrahedra came out: its surface does not enclose a volume")
    position, elements, tags = _used(gmsh, elements, nodes)
    return position, elements if order == 1 else elements[:, VTK_ORDER], tags


def triangles(gmsh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The surface mesh of the model: positions [N,3], triangles [F,3] and gmsh's tags of the nodes [N]."""
    elements = gmsh.model.mesh.getElementsByType(2)[1]
    if not len(elements):
        raise BadPart("it holds no surface at all")
    return _used(gmsh, elements, 3)


def _used(gmsh, elements: np.ndarray, corners: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    used, elements = np.unique(elements, return_inverse=True)
    index = np.zeros(int(tags.max()) + 1, int)
    index[tags] = np.arange(len(tags))
    return coordinates.reshape(-1, 3)[index[used]], elements.reshape(-1, corners), used

"""What a gmsh process does to make one solid of a CAD file or of a surface, and to read the mesh of it."""

from __future__ import annotations

import math

import numpy as np

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
    """Start gmsh anew (6 ms), with no models, options or constants of scripts, and without the settings of the user."""
    if gmsh.isInitialized():
        gmsh.finalize()
    gmsh.initialize(readConfigFiles=False, interruptible=False)
    for name, value in OPTIONS:
        gmsh.option.setNumber(name, value)


def import_step(gmsh, path: str, mend: bool = True) -> None:
    """Import all shapes. If there is no solid among them, sew their faces together and make one solid of them.

    To mend is to remove degenerate edges and those that are very small. The pole of a sphere is such an edge: without
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
            f"it holds {len(volumes)} separate solids (the first two around {_point(boxes[0])} and"
            f" {_point(boxes[1])}); a part is one solid: export each to a file of its own"
        )


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


def solid_of_surface(gmsh) -> None:
    """Make a solid of the closed surface of triangles that the model holds, cut along its creases into faces."""
    mesh = gmsh.model.mesh
    mesh.classifySurfaces(CREASE_ANGLE, True, True, math.pi)
    mesh.createGeometry()
    loop = gmsh.model.geo.addSurfaceLoop([tag for _, tag in gmsh.model.getEntities(2)])
    gmsh.model.geo.addVolume([loop])
    gmsh.model.geo.synchronize()


def surface_triangles(gmsh) -> np.ndarray:
    """[F,3,3]: the corners of the triangles of a surface that was read."""
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    index = np.zeros(int(tags.max(initial=0)) + 1, int)
    index[tags] = np.arange(len(tags))
    _, nodes = gmsh.model.mesh.getElementsByType(2)
    return coordinates.reshape(-1, 3)[index[nodes]].reshape(-1, 3, 3)


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

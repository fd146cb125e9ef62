"""Hexahedra, prisms and pyramids cut into tetrahedra, so that the cuts of neighbours agree; quadrilaterals cut into
triangles.

A cell is cut from its lowest node to all of its faces that do not hold this node; a face with four nodes is cut by the
diagonal from its own lowest node. The diagonal of a face depends on the numbers of its nodes alone, so both cells at
the face make the same one (Dompierre, Labbé, Vallet, Camarero: How to subdivide pyramids, prisms, and hexahedra into
tetrahedra, 1999).
"""

from __future__ import annotations

import numpy as np

# The faces of each shape, as the places of their nodes, in VTK's order of nodes; seen from outside they run
# counter-clockwise where the cell has a positive volume.
FACES = {
    "tetra": ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)),
    "pyramid": ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
    "wedge": ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "hexahedron": ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
}


def tetrahedra_of(shape: str, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The tetrahedra of cells of one shape.

    Args:
        cells: [c, corners] numbers of nodes. A cell may name a node twice, as codes do that have hexahedra alone; the
            tetrahedra that would be flat for that reason are left out.

    Returns:
        [t, 4] the tetrahedra, ordered by cell; [t] the cell that each belongs to.
    """
    if shape == "tetra":
        return cells, np.arange(len(cells))
    lowest = np.argmin(cells, axis=1)
    tetrahedra, owners = [], []
    for corner in range(cells.shape[1]):
        rows = np.flatnonzero(lowest == corner)
        for face in FACES[shape]:
            if corner in face:
                continue
            for triangle, chosen in _triangles(cells[rows][:, face]):
                tetrahedra.append(np.column_stack([triangle, cells[rows[chosen], corner]]))
                owners.append(rows[chosen])
    # A face runs counter-clockwise seen from outside: turned, it makes a positive volume with a node inside.
    return _proper(np.concatenate(tetrahedra)[:, [0, 2, 1, 3]], np.concatenate(owners))


def triangles_of(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """As `tetrahedra_of`: the triangles [t, 3] of quadrilaterals [c, 4], which keep the side that they look to."""
    triangles, owners = zip(*_triangles(cells), strict=True)
    return _proper(np.concatenate(triangles), np.concatenate(owners))


def _proper(elements: np.ndarray, owner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The elements that name no node twice, ordered by the cell that owns them."""
    ordered = np.sort(elements, axis=1)
    proper = (ordered[:, 1:] != ordered[:, :-1]).all(axis=1)
    order = np.argsort(owner[proper], kind="stable")
    return elements[proper][order], owner[proper][order]


def _triangles(faces: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """([t, 3] triangles, their rows) of faces [f, 3] or [f, 4]."""
    everyone = np.arange(len(faces))
    if faces.shape[1] == 3:
        return [(faces, everyone)]
    lowest = np.argmin(faces, axis=1)
    # A face that names its lowest node twice is a triangle; the cut from either place gives it and a flat one.
    turned = faces[everyone[:, None], (lowest[:, None] + np.arange(4)) % 4]
    return [(turned[:, [0, 1, 2]], everyone), (turned[:, [0, 2, 3]], everyone)]


def faces_of(shape: str, cells: np.ndarray) -> list[np.ndarray]:
    """The faces of cells of one shape, [c, 3] or [c, 4] for each face of the shape."""
    if shape in ("triangle", "quad"):
        return [cells]
    return [cells[:, face] for face in FACES[shape]]

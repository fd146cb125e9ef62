"""Faces and edges of elements, as local numbers of their nodes, by the number of nodes: 3, 4 or 10.

A second-order tetrahedron has ten nodes: four corners, then the middles of its edges in VTK's order.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

# The faces of a tetrahedron with positive volume; their normals point outward.
LOCAL_FACES = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))

# The corners between which the nodes 4, 5, ... of a second-order tetrahedron lie.
MIDDLES = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))


def _middle(a: int, b: int) -> int:
    """The local number of the node between two corners."""
    return 4 + MIDDLES.index((min(a, b), max(a, b)))


def _cut_face(a: int, b: int, c: int) -> tuple[tuple[int, int, int], ...]:
    """The four triangles of a face of a second-order tetrahedron: one at each corner, and the one between."""
    ab, bc, ca = _middle(a, b), _middle(b, c), _middle(c, a)
    return (a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)


# The triangles of each face of a tetrahedron.
FACE_TRIANGLES = {4: tuple((face,) for face in LOCAL_FACES), 10: tuple(_cut_face(*face) for face in LOCAL_FACES)}

# The edges of an element. In a second-order tetrahedron they join the corners with the middles beside them, and the
# middles of each face.
LOCAL_EDGES = {
    3: ((0, 1), (0, 2), (1, 2)),
    4: ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)),
    10: tuple(
        sorted(
            {(corner, 4 + number) for number, edge in enumerate(MIDDLES) for corner in edge}
            | {pair for *_, (a, b, c) in FACE_TRIANGLES[10] for pair in combinations(sorted((a, b, c)), 2)}
        )
    ),
}

# A second-order tetrahedron as eight linear ones: one at each corner, and four around the diagonal of the octahedron
# between them, which joins the middles of the edges 01 and 23.
_AT_CORNERS = ((0, 4, 6, 7), (4, 1, 5, 8), (6, 5, 2, 9), (7, 8, 9, 3))
_EIGHTH = (*_AT_CORNERS, (4, 9, 6, 7), (4, 9, 5, 6), (4, 9, 8, 5), (4, 9, 7, 8))


def linear_elements(elements: np.ndarray) -> np.ndarray:
    """The elements [E,3] or [E,4] as they are; second-order ones [E,10] cut into [8 E,4], element by element."""
    return elements[:, np.array(_EIGHTH)].reshape(-1, 4) if elements.shape[1] == 10 else elements

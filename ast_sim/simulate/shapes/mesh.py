"""Structured tetrahedral meshes: a plate with holes and the rigid obstacles that press on it.

All are grids of hexahedral cells, each cut into six tetrahedra (Kuhn's subdivision), so no mesh generator is needed.
Legend: N nodes, E tetrahedra; lengths in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

import numpy as np

from ast_sim.element_topology import MIDDLES
from ast_sim.mechanics.elements.second_order import points_at_rest
from ast_sim.plausibility.curved_elements import partly_inside_out

STRAIGHTENED_BELOW = 0.3  # least volume of a quarter of a curved element, relative to a straight one


def kuhn_tetrahedra() -> np.ndarray:
    """The six tetrahedra of a cell as corners [6,4,3] in {0,1}^3, all of positive volume.

    Each is a monotone path along the axes from one end of a diagonal to the other. The diagonal runs from (0,1,1) to
    (1,0,0). In a grid numbered with x slowest, no edge then spans more than one layer of nodes. This keeps the band of
    the stiffness matrix as narrow as it can be.
    """
    paths = []
    for axes in permutations(range(3)):
        path = [np.array([0, 1, 1])]
        for axis in axes:
            corner = path[-1].copy()
            corner[axis] = 1 - corner[axis]
            path.append(corner)
        if np.linalg.det(np.diff(path, axis=0)) < 0:
            path[2], path[3] = path[3], path[2]
        paths.append(path)
    return np.array(paths)


def hexahedral_grid(shape: Sequence[int], keep: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Grid of shape[0] x shape[1] x shape[2] cells cut into tetrahedra.

    Args:
        shape: number of cells along x, y, z.
        keep: which cells exist, bool [shape]; all if None.

    Returns:
        Integer grid coordinates [N,3] of the nodes that a kept cell uses, ordered by x, then y, then z, and the
        tetrahedra [E,4] over them.
    """
    cells = np.argwhere(np.ones(shape, bool) if keep is None else keep)
    corners = (cells[:, None, None, :] + kuhn_tetrahedra()).reshape(-1, 3)
    index = np.ravel_multi_index(corners.T, [n + 1 for n in shape])
    used, elements = np.unique(index, return_inverse=True)
    coordinates = np.stack(np.unravel_index(used, [n + 1 for n in shape]), axis=1)
    return coordinates, elements.reshape(-1, 4)


def plate(size: Sequence[float], cells: Sequence[int], holes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Plate centred at the origin, its long side along x, with round holes through its thickness.

    Args:
        size: length, width, thickness.
        cells: cells along length, width and thickness.
        holes: [H,3] centre x, centre y, radius; a cell whose centre lies in a hole is left out.

    Returns:
        Positions [N,3] ordered along x, tetrahedra [E,4].
    """
    x, y = [(np.arange(n) + 0.5) * (length / n) - length / 2 for n, length in zip(cells[:2], size[:2], strict=True)]
    solid = np.ones(cells[:2], bool)
    for centre_x, centre_y, radius in np.reshape(holes, (-1, 3)):
        solid &= np.hypot(x[:, None] - centre_x, y[None, :] - centre_y) >= radius
    coordinates, elements = hexahedral_grid(cells, np.repeat(solid[:, :, None], cells[2], axis=2))
    return (coordinates / np.asarray(cells) - 0.5) * np.asarray(size), elements


def _cube(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """The cube [-1,1]^3. Its cells are mirrored about its middle, so that their diagonals run outwards.

    No tetrahedron then has two faces on the surface. Such a tetrahedron would become flat where the cube's edges are
    rounded.
    """
    index = np.argwhere(np.ones((cells,) * 3, bool))
    outwards = kuhn_tetrahedra() ^ np.array([0, 1, 1])  # from (0,0,0) to (1,1,1)
    upper = (index >= cells // 2)[:, None, None, :]
    corners = index[:, None, None, :] + np.where(upper, outwards, 1 - outwards)
    elements = np.ravel_multi_index(np.moveaxis(corners, -1, 0), (cells + 1,) * 3).reshape(-1, 4)
    x = 2 * np.argwhere(np.ones((cells + 1,) * 3, bool)) / cells - 1
    inverted = np.linalg.det(x[elements[:, 1:]] - x[elements[:, :1]]) < 0
    elements[inverted] = elements[inverted][:, [1, 0, 2, 3]]
    return x, elements


def rounded(x: np.ndarray) -> np.ndarray:
    """Map the square or cube [-1,1]^d onto the unit disc or ball, keeping directions: x |x|_max / |x|_2."""
    length = np.linalg.norm(x, axis=1, keepdims=True)
    return x * np.divide(np.abs(x).max(1, keepdims=True), length, out=np.zeros_like(length), where=length > 0)


def block(half_size: tuple[float, float, float], cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Block centred at the origin: positions [N,3], tetrahedra [E,4]; cells along each side."""
    x, elements = _cube(cells)
    return x * np.asarray(half_size), elements


def ball(radius: float, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Ball centred at the origin: positions [N,3], tetrahedra [E,4]; cells across the diameter."""
    x, elements = _cube(cells)
    return rounded(x) * radius, elements


def cylinder(radius: float, half_length: float, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Cylinder along x centred at the origin: positions [N,3], tetrahedra [E,4]; cells along each direction."""
    x, elements = _cube(cells)
    return np.concatenate([x[:, :1] * half_length, rounded(x[:, 1:]) * radius], axis=1), elements


def second_order(position: np.ndarray, elements: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same tetrahedra with nodes in the middles of their straight edges: positions [N+M,3], elements [E,10].

    The N nodes keep their numbers; the middles follow.
    """
    edges = np.sort(elements[:, np.array(MIDDLES)], axis=2)  # [E, 6, 2]
    unique, middle = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
    position = np.concatenate([position, position[unique].mean(axis=1)])
    return position, np.concatenate([elements, len(position) - len(unique) + middle.reshape(-1, 6)], axis=1)


def straightened(position: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """The positions [N,3] where no curved edge turns a part of its element [E,10] over, nor nearly so.

    A mesh may be too coarse for its curved surface. There, the edges of the element become straight.
    """
    position = position.copy()
    wanted = STRAIGHTENED_BELOW * np.abs(np.linalg.det(position[elements[:, 1:4]] - position[elements[:, :1]])) / 24
    for _ in range(len(elements)):
        thin = (points_at_rest(position, elements)[0] < wanted).any(axis=0)
        bad = elements[thin | partly_inside_out(position, elements)]
        ends = bad[:, np.array(MIDDLES)]
        middles = position[ends].mean(axis=2)
        if np.allclose(position[bad[:, 4:]], middles, rtol=0, atol=1e-12 * np.ptp(position, axis=0).max()):
            break
        position[bad[:, 4:]] = middles
    return position

"""Displacements of one mesh of a body at the points of another mesh of it."""

from __future__ import annotations

import numpy as np

from ast_sim.mechanics.elements.second_order import shape_functions

_NEAREST = 32  # elements that are tried for a point outside of all: the elements with the nearest centres


def transferred(rest: np.ndarray, elements: np.ndarray, displacement: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Displacements [n,3] at points: by the shape functions in each element, continued beyond the nearest one outside.

    A curved surface has no element at some points of a finer mesh of it. There, the element counts whose faces the
    point passes by the smallest distance. Second-order elements are searched as if their edges were straight.

    Args:
        rest: [N,3] rest positions of a mesh.
        elements: [E,4] or [E,10] its tetrahedra, none of them flat.
        displacement: [N,3] displacements of its nodes.
        points: [n,3] rest positions of the points.
    """
    corners = elements[:, :4].astype(np.int64)
    owner = _owners(rest, corners, points)
    weights = _barycentric(rest[corners[owner]], points)
    if elements.shape[1] == 10:
        weights = shape_functions(weights)
    return np.einsum("nk,nkd->nd", weights, displacement[elements[owner]])


def _owners(rest: np.ndarray, corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[n] the element that each point is in or nearest to."""
    import igl  # takes 0.2 s
    from scipy.spatial import KDTree

    tree = igl.AABB()
    tree.init(rest, corners)
    owner = np.array(igl.in_element(rest, corners, points, tree))
    outside = np.flatnonzero(owner < 0)
    if not len(outside):
        return owner
    count = min(_NEAREST, len(corners))
    _, tried = KDTree(rest[corners].mean(axis=1)).query(points[outside], k=count)
    tried = tried.reshape(-1, count)  # also of one
    weights = _barycentric(rest[corners[tried]].reshape(-1, 4, 3), np.repeat(points[outside], count, axis=0))
    depth = (weights * _heights(rest[corners])[tried.ravel()]).min(axis=1).reshape(-1, count)
    owner[outside] = np.take_along_axis(tried, depth.argmax(axis=1)[:, None], axis=1)[:, 0]
    return owner


def _barycentric(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[n,4] barycentric coordinates of points [n,3], each in the tetrahedron with its corners [n,4,3]."""
    edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    last = np.linalg.solve(edges, (points - corners[:, 0])[:, :, None])[:, :, 0]
    return np.concatenate([1 - last.sum(axis=1, keepdims=True), last], axis=1)


def _heights(corners: np.ndarray) -> np.ndarray:
    """[E,4] how far each corner of the tetrahedra [E,4,3] is from the face opposite to it."""
    gradients = np.linalg.inv(corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    gradients = np.concatenate([-gradients.sum(axis=1, keepdims=True), gradients], axis=1)
    return 1 / np.linalg.norm(gradients, axis=2)

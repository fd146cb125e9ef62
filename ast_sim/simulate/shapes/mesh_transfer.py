"""Displacements of one mesh of a body at the points of another mesh of it."""

from __future__ import annotations

import numpy as np

_NUMBERS_AT_ONCE = 20_000_000  # of distances between points and faces, which limits the memory to some 200 MB


def transferred(rest: np.ndarray, elements: np.ndarray, displacement: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Displacements [n,3] at points: linear in each element, and continued beyond the nearest element outside.

    A curved surface has no element at some points of a finer mesh of it. There, the element counts whose faces the
    point passes by the smallest distance.

    Args:
        rest: [N,3] rest positions of a mesh.
        elements: [E,4] its tetrahedra, none of them flat.
        displacement: [N,3] displacements of its nodes.
        points: [n,3] rest positions of the points.
    """
    start = rest[elements[:, 0]]
    edges = rest[elements[:, 1:]] - start[:, None]
    gradients = np.linalg.inv(edges).transpose(0, 2, 1)  # of the last three barycentric coordinates
    gradients = np.concatenate([-gradients.sum(axis=1, keepdims=True), gradients], axis=1)  # [E,4,3]
    offsets = np.array([1.0, 0.0, 0.0, 0.0]) - np.einsum("ekd,ed->ek", gradients, start)
    heights = 1 / np.linalg.norm(gradients, axis=2)  # of each corner above the face opposite to it
    normals, shifts = (gradients * heights[..., None]).reshape(-1, 3).T, (offsets * heights).ravel()
    owner = np.empty(len(points), int)
    rows = max(1, _NUMBERS_AT_ONCE // (4 * len(elements)))
    for first in range(0, len(points), rows):
        inside = points[first : first + rows] @ normals + shifts  # distances from the faces, positive inside
        owner[first : first + rows] = inside.reshape(-1, len(elements), 4).min(axis=2).argmax(axis=1)
    weights = np.einsum("nkd,nd->nk", gradients[owner], points) + offsets[owner]
    return np.einsum("nk,nkd->nd", weights, displacement[elements[owner]])

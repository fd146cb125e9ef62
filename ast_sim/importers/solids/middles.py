"""The nodes in the middles of the edges of second-order tetrahedra.

A mesh has elements of one order. Where a file also holds elements that have corners only (linear tetrahedra, cut
hexahedra, shells of rigid tools), these get nodes in the middles of their straight edges, which say the same.
"""

from __future__ import annotations

import numpy as np

from ast_sim.element_topology import MIDDLES
from ast_sim.importers.formats.source_mesh import CellBlock, SourceMesh
from ast_sim.support.errors import DatasetError

NO_NODE = -1

# The middle of an edge lies within this share of its length around the point halfway.
_FARTHEST = 0.5


def middles_of(block: CellBlock, point_of: np.ndarray) -> np.ndarray:
    """[c, 6]: the points in the middles of the edges of a block's cells, `NO_NODE` where cells have none."""
    if not block.has_middles:
        return np.full((len(block.nodes), len(MIDDLES)), NO_NODE)
    return point_of[block.nodes[:, 4:]]


def require_near(mesh: SourceMesh, corners: np.ndarray, middles: np.ndarray, rows: np.ndarray) -> None:
    """Check that middles [E, 6] lie at the middles of the edges of tetrahedra [E, 4].

    Raises:
        DatasetError: one does not, so the order of the nodes is another one; the text names the file and the element.
    """
    known = (middles != NO_NODE).any(axis=1)
    corners, middles, rows = corners[known], middles[known], rows[known]
    one, other = np.moveaxis(mesh.points[corners[:, np.array(MIDDLES)]], 2, 0)
    away = np.linalg.norm(mesh.points[middles][:, :, None] - (one + other)[:, None] / 2, axis=3)  # [E, middle, edge]
    own = np.einsum("emm->em", away)
    astray = ~(own <= _FARTHEST * np.linalg.norm(one - other, axis=2))
    # In another order, most elements have a node of another edge there; a curved edge may come near another one.
    nearer = own > away.min(axis=2)
    wrong = astray | (nearer & (nearer.mean(axis=0) > 0.5))
    if wrong.any():
        element, edge = np.argwhere(wrong)[0]
        raise DatasetError(
            f"{mesh.path}: element {rows[element]} has its node {middles[element, edge]} far from the middle of the"
            f" edge from {corners[element, MIDDLES[edge][0]]} to {corners[element, MIDDLES[edge][1]]}: are its nodes"
            " in the order of VTK? With corners=True (--corners), only the corners are taken"
        )


def completed(corners: np.ndarray, middles: np.ndarray, num_points: int) -> tuple[np.ndarray, np.ndarray]:
    """Tetrahedra of the second order from corners [E, 4] and middles [E, 6], some of which are `NO_NODE`.

    Returns:
        [E, 10] the elements. [M, 2] the points between which the new points `num_points`, `num_points` + 1, ... lie. An
        edge for which another element has a node takes that one.
    """
    edges = np.sort(corners[:, np.array(MIDDLES)], axis=2)
    keys = edges[:, :, 0] * num_points + edges[:, :, 1]
    lacking = middles == NO_NODE
    middles = middles.copy()
    known, first = np.unique(keys[~lacking], return_index=True)
    row = np.minimum(np.searchsorted(known, keys[lacking]), max(len(known) - 1, 0))
    there = known[row] == keys[lacking]
    middles[lacking] = np.where(there, middles[~lacking][first][row], NO_NODE)
    lacking = middles == NO_NODE
    new, number = np.unique(keys[lacking], return_inverse=True)
    middles[lacking] = num_points + number
    return np.concatenate([corners, middles], axis=1), np.stack([new // num_points, new % num_points], axis=1)

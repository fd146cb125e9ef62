"""Which points of a simulation the nodes of a scene are.

A node of a file is one point. Beside elements of ten nodes, elements that have corners only get nodes in the middles of
their edges: such a node is a pair of points, the ends of its edge, and what is known of it is the mean of both.

Legend: N nodes of the scene, E elements, n points of the simulation.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial import KDTree

from ast_sim.element_topology import MIDDLES as EDGES
from ast_sim.scene import Scene
from benchmarks.robustness.dialects.random_simulation import MIDDLES, Simulation

# What was read may differ by this share of the largest value: files have six digits, scenes are float32.
SAME = 2e-5


class Wrong(Exception):
    """What was read is not what was written."""


def pairs_of(scene: Scene, points: np.ndarray, simulation: Simulation) -> np.ndarray:
    """[N, 2]: the two points that each node of the scene lies between; twice the same if it is a point itself.

    Args:
        points: [N, 3] float64, the nodes at rest.

    Raises:
        Wrong: a node lies elsewhere, is missing or stands twice, or a middle belongs to another edge.
    """
    wanted = 10 if simulation.ten_nodes else 4
    if scene.elements.shape[1] != wanted:
        raise Wrong(f"elements have {scene.elements.shape[1]} nodes, not {wanted}")
    corners = np.unique(scene.elements[:, :4])
    if len(corners) != len(simulation.corners):
        raise Wrong(f"{len(corners)} corners, not {len(simulation.corners)}")
    row = KDTree(simulation.points[simulation.corners]).query(points[corners])[1]
    pairs = np.full((len(points), 2), -1)
    pairs[corners] = simulation.corners[row][:, None]
    if simulation.ten_nodes:
        _add_middles(pairs, scene.elements, simulation)
    if (pairs < 0).any():
        raise Wrong(f"{(pairs[:, 0] < 0).sum()} nodes belong to no element")
    if len(np.unique(pairs, axis=0)) != len(pairs):
        raise Wrong("two nodes are at one place")
    distance = np.abs(points - simulation.points[pairs].mean(axis=1)).max()
    if distance > SAME * max(np.abs(simulation.points).max(), simulation.size):
        raise Wrong(f"nodes are off by {distance:g} of {simulation.size:g}")
    return pairs


def _add_middles(pairs: np.ndarray, elements: np.ndarray, simulation: Simulation) -> None:
    """The points of the middles of all edges: the one that the file has there, or the ends of an edge without one."""
    known = dict(_middles(simulation))
    ends = np.sort(pairs[elements[:, np.array(EDGES)], 0], axis=2)
    for node, edge in zip(elements[:, 4:].ravel().tolist(), ends.reshape(-1, 2).tolist(), strict=True):
        middle = known.get(tuple(edge))
        pair = edge if middle is None else [middle, middle]
        if pairs[node, 0] >= 0 and pairs[node].tolist() != pair:
            raise Wrong(f"the node {node} is the middle of two edges")
        pairs[node] = pair


def _middles(simulation: Simulation) -> Iterator[tuple[tuple[int, int], int]]:
    """The points at the ends of each edge of tetrahedra of ten nodes, and the point in its middle."""
    for _, kind, cells in simulation.blocks:
        if kind == "tetra10":
            ends = np.sort(cells[:, MIDDLES[kind]], axis=2).reshape(-1, 2)
            yield from zip(map(tuple, ends.tolist()), cells[:, 4:].ravel().tolist(), strict=True)

"""World edges join nodes that are close in space but not neighbours on the mesh (MeshGraphNets, section 3.1)."""

from __future__ import annotations

import warnings

import numpy as np
import torch
from scipy.spatial import KDTree

from ast_sim.batches.batch_builder import Batch
from ast_sim.ops import EdgeSet, mesh_edges


def world_edges(batch: Batch, radius: float, most: int | None) -> EdgeSet:
    """Edges in both directions between all nodes of a scene that are at most `radius` apart and share no mesh edge.

    They are found for the positions of the batch in O(N log N + pairs). The edges of a scene do not depend on other
    scenes.

    Args:
        batch: its positions, and the mesh edges of its graph.
        radius: in the unit of length; 0 gives no edges.
        most: the most pairs of a scene. The shortest pairs are kept; of equally long pairs, the pairs with the lowest
            node numbers. A warning says so once. None keeps all.
    """
    graph = batch.graph
    offsets = graph.node_offsets.tolist()
    position = batch.position.detach().double().numpy()
    # Mesh edges lie in both directions, sorted by receiver and sender.
    mesh = _keys(graph.edges.receivers.numpy(), graph.edges.senders.numpy(), len(position))
    near = [start + _pairs(position[start:end], radius) for start, end in zip(offsets[:-1], offsets[1:], strict=True)]
    kept = [_shortest(_without(pairs, mesh, len(position)), position, most) for pairs in near]
    pairs = np.concatenate(kept) if kept else np.zeros((0, 2), np.int64)
    return mesh_edges(torch.from_numpy(pairs), len(position))


def _pairs(position: np.ndarray, radius: float) -> np.ndarray:
    """[P, 2] int64: pairs (i, j), i < j, at most `radius` apart, in ascending order."""
    if radius <= 0 or len(position) < 2:
        return np.zeros((0, 2), np.int64)
    pairs = KDTree(position).query_pairs(radius, output_type="ndarray").astype(np.int64)
    return pairs[np.argsort(_keys(pairs[:, 0], pairs[:, 1], len(position)))]


def _keys(first: np.ndarray, second: np.ndarray, num: int) -> np.ndarray:
    return first * num + second


def _without(pairs: np.ndarray, mesh: np.ndarray, num: int) -> np.ndarray:
    """The pairs that are no mesh edges. `mesh` holds the sorted keys of the mesh edges."""
    keys = _keys(pairs[:, 0], pairs[:, 1], num)
    place = np.minimum(np.searchsorted(mesh, keys), len(mesh) - 1)
    return pairs[mesh[place] != keys] if len(mesh) else pairs


def _shortest(pairs: np.ndarray, position: np.ndarray, most: int | None) -> np.ndarray:
    if most is None or len(pairs) <= most:
        return pairs
    # The text is the same for all scenes, so Python shows it once.
    warnings.warn(
        f"more world edges than model.most_world_edges = {most}: the shortest of a scene are kept", stacklevel=3
    )
    lengths = np.linalg.norm(position[pairs[:, 0]] - position[pairs[:, 1]], axis=1)
    return pairs[np.sort(np.argsort(lengths, kind="stable")[:most])]

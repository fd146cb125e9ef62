"""Coarser and coarser meshes by bi-stride pooling (Cao et al. 2023, arXiv 2210.02573), made once for each mesh.

In each connected component a breadth-first search starts near the middle. It gives every node a depth. The nodes of
even depth are kept or the nodes of odd depth, whichever are fewer. Two kept nodes are joined if a path of at most two
edges joins them, so that a component stays connected:

    A' = (A + I)^2, rows and columns of kept nodes, without the diagonal.

Features of the finer mesh are pooled with weights. Each node i of the finest mesh has w_i = 1, and on every mesh it
sends the share w_i / deg_i along each of its edges:

    weight_ij = share_i / sum_i share_i,    pooled_j = sum_i weight_ij x_i,    w'_j = sum_i share_i

The sums are over the neighbours i of a kept node j, without j. A node without neighbours counts as its own neighbour.

Legend: N nodes of a mesh, C of them kept, M edges, P edges of a pooling, L levels below the mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np
import torch
from scipy.sparse import csr_array, diags_array, eye_array, tril, triu
from scipy.sparse.csgraph import connected_components, dijkstra
from torch import Tensor

from ast_sim.batches.graph import Graph, edge_vectors
from ast_sim.batches.mirror_and_shift import Placement
from ast_sim.ops import EdgeSet, join_indices, offsets_of, segment_spread, segment_sum
from ast_sim.ops.spec import segment_of

NEAR_CENTRE = 1.2  # nodes up to this multiple of the least distance from the centroid may start the search
MOST_STARTS = 64  # at most this many of them do: on a sphere all N nodes are equally near


@dataclass(frozen=True, eq=False)
class Pooling:
    """The step from a mesh to the next coarser one.

    Attributes:
        kept: [C] int64, ascending, nodes of the finer mesh.
        edges: P edges, from nodes of the finer mesh to nodes of the coarser mesh.
        weight: [P, 1] float32; the weights of the edges into a node add up to 1.
        moves: whether the positions of kept nodes are pooled like features. Otherwise they stay in place.
    """

    kept: Tensor
    edges: EdgeSet
    weight: Tensor
    moves: bool

    def positions(self, finer: Tensor) -> Tensor:
        """[N, 3] -> [C, 3]: the positions of the coarser mesh."""
        return self.pool(finer) if self.moves else finer.index_select(0, self.kept)

    def pool(self, x: Tensor) -> Tensor:
        """[N, F] -> [C, F]: the weighted mean over the neighbours of each kept node."""
        sent = segment_spread(x, *self.edges.by_sender) * self.weight.to(x.dtype)
        return segment_sum(sent, *self.edges.by_receiver)

    def unpool(self, x: Tensor) -> Tensor:
        """[C, F] -> [N, F], the transpose of `pool`: the weighted sum over the kept neighbours of each node."""
        sent = segment_spread(x, *self.edges.by_receiver) * self.weight.to(x.dtype)
        return segment_sum(sent, *self.edges.by_sender)

    def pool_contacts(self, contacts: EdgeSet) -> EdgeSet:
        """The contact edges of the coarser mesh, from the contact edges of the finer mesh.

        Two kept nodes are in contact if they, or neighbours of theirs, are in contact on the finer mesh. As matrices:
        (A + I) A_c (A + I) of the contacts A_c, rows and columns of kept nodes, without the diagonal.
        """
        if not len(contacts):
            return _edge_set(csr_array((len(self.kept),) * 2, dtype=bool))
        neighbours = _matrix(self.edges)
        itself = (np.ones(len(self.kept), bool), self.kept.numpy(), np.arange(len(self.kept) + 1))
        reach = neighbours + csr_array(itself, shape=neighbours.shape)
        return _edge_set(_without_diagonal(reach @ _matrix(contacts) @ reach.T.tocsr()))


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """A mesh and its L coarser meshes, of one scene or of a batch of scenes.

    Attributes:
        edges: the edges of the L + 1 meshes, the finest first.
        rest_edges: for each mesh [M, 4] float32, `edge_vectors` at rest.
        poolings: the L steps from each mesh to the next.
        component: [N] int64, the connected component of each node of the finest mesh.
    """

    edges: tuple[EdgeSet, ...]
    rest_edges: tuple[Tensor, ...]
    poolings: tuple[Pooling, ...]
    component: Tensor

    @staticmethod
    def of(graph: Graph) -> Hierarchy:
        """What `build_hierarchy` made and the model put into the graph."""
        assert isinstance(graph.own, Hierarchy)
        return graph.own

    @staticmethod
    def concatenate(parts: Sequence[Hierarchy]) -> Hierarchy:
        """The hierarchies of several scenes as one. All have the same number of levels."""
        if len(parts) == 1:
            return parts[0]
        components = [part.component for part in parts]
        return Hierarchy(
            edges=tuple(EdgeSet.concatenate(list(level)) for level in zip(*(p.edges for p in parts), strict=True)),
            rest_edges=tuple(torch.cat(level) for level in zip(*(p.rest_edges for p in parts), strict=True)),
            poolings=tuple(_concatenate(level) for level in zip(*(p.poolings for p in parts), strict=True)),
            component=join_indices(components, [int(component.max()) + 1 for component in components]),
        )

    def placed(self, placement: Placement) -> Hierarchy:
        """The hierarchy of the same scene, mirrored and moved. Distances stay, so the coarser meshes stay too."""
        return replace(self, rest_edges=tuple(placement.vectors(level) for level in self.rest_edges))

    def meshes(self, position: Tensor) -> list[tuple[EdgeSet, Tensor, Tensor]]:
        """The edges of each mesh, their vectors at rest, and the positions of its nodes; `position` [N, 3] is of the
        finest."""
        positions = accumulate(self.poolings, lambda finer, pooling: pooling.positions(finer), initial=position)
        return list(zip(self.edges, self.rest_edges, positions, strict=True))

    def between_components(self, contacts: EdgeSet) -> EdgeSet:
        """The contact edges whose ends lie in different components."""
        apart = self.component[contacts.senders] != self.component[contacts.receivers]
        return subset(contacts, apart)


def build_hierarchy(edges: EdgeSet, rest_position: Tensor, levels: int, pooled: bool, mesh: EdgeSet) -> Hierarchy:
    """The hierarchy of one mesh.

    Args:
        edges: the edges of the finest mesh, in both directions.
        rest_position: [N, 3].
        levels: L; a component of one node stays as it is.
        pooled: whether the positions of a coarser mesh are pooled like features. Otherwise kept nodes stay in place.
        mesh: all mesh edges. Their connected components become `Hierarchy.component`.
    """
    adjacency = _matrix(edges)
    kept_position = rest_position.numpy().astype(np.float64)
    position = rest_position.double()
    weight = np.ones(len(rest_position))
    edge_sets, rest_edges, poolings = [edges], [edge_vectors(edges, rest_position, rest_position)], []
    for _ in range(levels):
        kept = select(adjacency, kept_position)
        pooling, weight = _pooling(adjacency, kept, weight, pooled)
        adjacency = coarsen(adjacency, kept)
        kept_position = kept_position[kept]
        position = pooling.positions(position)
        edge_sets.append(_edge_set(adjacency))
        poolings.append(pooling)
        rest_edges.append(edge_vectors(edge_sets[-1], position, position).float())
    component = connected_components(_matrix(mesh), directed=False)[1]
    return Hierarchy(tuple(edge_sets), tuple(rest_edges), tuple(poolings), torch.from_numpy(component.astype(np.int64)))


def select(adjacency: csr_array, position: np.ndarray) -> np.ndarray:
    """[C] int64, ascending: the nodes that bi-stride pooling keeps.

    In each component the search starts near the centroid (`NEAR_CENTRE`), at the node from which the mean depth of the
    others is least; at the first of several. If there are as many even depths as odd ones, the even ones are kept.

    Args:
        adjacency: [N, N] bool, symmetric.
        position: [N, 3] float64.
    """
    _, label = connected_components(adjacency, directed=False)
    sizes = np.bincount(label)
    kept = [np.flatnonzero(sizes[label] == 1)]
    members = np.split(np.argsort(label, kind="stable"), np.cumsum(sizes)[:-1])
    for nodes in (nodes for nodes in members if len(nodes) > 1):
        within = adjacency[nodes][:, nodes]
        depths = dijkstra(within, unweighted=True, indices=_starts(position[nodes]))
        even = depths[depths.sum(axis=1).argmin()] % 2 == 0
        kept.append(nodes[even if 2 * even.sum() <= len(nodes) else ~even])
    return np.sort(np.concatenate(kept))


def _starts(position: np.ndarray) -> np.ndarray:
    distance = np.linalg.norm(position - position.mean(axis=0), axis=1)
    nearest = np.argsort(distance, kind="stable")[:MOST_STARTS]
    return np.sort(nearest[distance[nearest] <= NEAR_CENTRE * distance.min()])


def coarsen(adjacency: csr_array, kept: np.ndarray) -> csr_array:
    """[C, C] bool: (A + I)^2, rows and columns of kept nodes, without the diagonal."""
    enhanced = (adjacency + eye_array(len(adjacency.indptr) - 1, dtype=bool)).tocsr()
    return _without_diagonal(enhanced[kept] @ enhanced[:, kept])


def _pooling(adjacency: csr_array, kept: np.ndarray, weight: np.ndarray, moves: bool) -> tuple[Pooling, np.ndarray]:
    """The pooling to the kept nodes, and their weights w' [C] from the weights w [N] of all nodes."""
    degree = np.diff(adjacency.indptr)
    alone = diags_array((degree == 0), dtype=bool)
    neighbours = (adjacency + alone).tocsr()[kept].astype(np.float64)
    share = weight / np.maximum(degree, 1)
    total = neighbours @ share
    neighbours.sort_indices()
    edges = _edge_set(neighbours)
    weights = share[neighbours.indices] / total.repeat(np.diff(neighbours.indptr))
    return Pooling(torch.from_numpy(kept), edges, torch.from_numpy(weights).float()[:, None], moves), total


def subset(edges: EdgeSet, wanted: Tensor) -> EdgeSet:
    """The edges where wanted [M] bool is true."""
    receivers = edges.receivers[wanted]
    return EdgeSet(edges.senders[wanted], receivers, offsets_of(receivers, edges.num_receivers), edges.num_senders)


def _concatenate(poolings: Sequence[Pooling]) -> Pooling:
    return Pooling(
        join_indices([pooling.kept for pooling in poolings], [pooling.edges.num_senders for pooling in poolings]),
        EdgeSet.concatenate([pooling.edges for pooling in poolings]),
        torch.cat([pooling.weight for pooling in poolings]),
        poolings[0].moves,
    )


def _matrix(edges: EdgeSet) -> csr_array:
    """[R, S] bool: true at (r, s) if an edge leads from s to r."""
    shape = (edges.num_receivers, edges.num_senders)
    return csr_array((np.ones(len(edges), bool), edges.senders.numpy(), edges.receiver_offsets.numpy()), shape=shape)


def _edge_set(matrix: csr_array) -> EdgeSet:
    """The inverse of `_matrix`."""
    matrix.sort_indices()
    offsets = torch.from_numpy(matrix.indptr.astype(np.int64))
    senders = torch.from_numpy(matrix.indices.astype(np.int64))
    num_senders = matrix.shape[1]  # pyright: ignore[reportOptionalSubscript], of scipy
    return EdgeSet(senders, segment_of(offsets), offsets, num_senders)


def _without_diagonal(matrix: csr_array) -> csr_array:
    return (tril(matrix, -1) + triu(matrix, 1)).tocsr()

"""Coarser and coarser meshes by bi-stride pooling (Cao et al. 2023, arXiv 2210.02573), made once for a mesh.

A breadth-first search from near the middle of each connected component splits its nodes into those of even and of odd
depth; the smaller class is kept. Kept nodes are joined if at most two edges lie between them, so a component stays in
one piece:

    A' = (A + I)^2, rows and columns of kept nodes, without the diagonal.

Features of the finer mesh are pooled with weights. Each node starts with w = 1, sends the share w_i / deg_i along each
of its edges, and

    weight_ij = share_i / sum_i share_i,    pooled_j = sum_i weight_ij x_i,    w'_j = sum_i share_i

over the neighbours i of a kept node j, itself not included. A node without neighbours is its own one.

Legend: N nodes of a mesh, C of them kept, M edges, P edges of a pooling, L levels below the mesh itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np
import torch
from scipy.sparse import coo_array, csr_array, diags_array, eye_array
from scipy.sparse.csgraph import connected_components, dijkstra
from torch import Tensor

from ast_sim.data.graph import edge_vectors
from ast_sim.data.placement import Placement
from ast_sim.ops.edges import EdgeSet, offsets_of
from ast_sim.ops.segment import segment_sum

NEAR_CENTRE = 1.2  # nodes up to so many times the least distance from the centroid may start the search
MOST_STARTS = 64  # of these the nearest, so that a sphere, whose nodes are all equally near, costs no N searches


@dataclass(frozen=True, eq=False)
class Pooling:
    """The step from a mesh to the next coarser one.

    Attributes:
        kept: [C] int64, ascending, nodes of the finer mesh.
        edges: P edges, from nodes of the finer mesh to kept nodes in the numbers of the coarser one.
        weight: [P, 1] float32; those into a node add up to 1.
    """

    kept: Tensor
    edges: EdgeSet
    weight: Tensor

    @property
    def num_nodes(self) -> int:
        """N of the finer mesh."""
        return self.edges.num_senders

    def pool(self, x: Tensor) -> Tensor:
        """[N, F] -> [C, F]: the weighted mean over the neighbours of each kept node."""
        sent = spread(x, *self.edges.by_sender) * self.weight.to(x.dtype)
        return segment_sum(sent, *self.edges.by_receiver)

    def unpool(self, x: Tensor) -> Tensor:
        """[C, F] -> [N, F], the transpose of `pool`: sum over the kept neighbours of each node."""
        sent = spread(x, *self.edges.by_receiver) * self.weight.to(x.dtype)
        return segment_sum(sent, *self.edges.by_sender)

    def pool_contacts(self, contacts: EdgeSet) -> EdgeSet:
        """(A + I) A_c (A + I) of the contact edges A_c among the N nodes: rows and columns of kept nodes, no diagonal.

        Kept nodes are in contact if they or neighbours of theirs are.
        """
        if not len(contacts):
            return _edge_set(csr_array((len(self.kept),) * 2, dtype=bool))
        neighbours = _matrix(self.edges)
        itself = csr_array((np.ones(len(self.kept), bool), self.kept.numpy(), np.arange(len(self.kept) + 1)))
        itself.resize(neighbours.shape)
        reach = neighbours + itself
        return _edge_set(_without_diagonal(reach @ _matrix(contacts) @ reach.T.tocsr()))


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """A mesh and its L coarser ones, of one scene or of a batch of scenes.

    Attributes:
        edges: L + 1 edge sets, the mesh first.
        rest_edges: L + 1 of [M, 4] float32, `edge_vectors` at rest.
        poolings: L steps between them.
        component: [N] int64, the connected component of each node.
    """

    edges: tuple[EdgeSet, ...]
    rest_edges: tuple[Tensor, ...]
    poolings: tuple[Pooling, ...]
    component: Tensor

    @staticmethod
    def concatenate(parts: Sequence[Hierarchy]) -> Hierarchy:
        """The hierarchies of several scenes, of equally many levels, as one."""
        if len(parts) == 1:
            return parts[0]
        shifts = accumulate((int(part.component.max()) + 1 for part in parts), initial=0)
        return Hierarchy(
            edges=tuple(EdgeSet.concatenate(list(level)) for level in zip(*(p.edges for p in parts), strict=True)),
            rest_edges=tuple(torch.cat(level) for level in zip(*(p.rest_edges for p in parts), strict=True)),
            poolings=tuple(_concatenate(level) for level in zip(*(p.poolings for p in parts), strict=True)),
            component=torch.cat([part.component + shift for part, shift in zip(parts, shifts, strict=False)]),
        )

    def placed(self, placement: Placement) -> Hierarchy:
        """That of the scene in another place, where distances are the same and so the coarser meshes."""
        return replace(
            self, rest_edges=tuple(torch.from_numpy(placement.vectors(level.numpy())) for level in self.rest_edges)
        )

    def between_components(self, contacts: EdgeSet) -> EdgeSet:
        """The contact edges whose ends lie in different components."""
        apart = self.component[contacts.senders] != self.component[contacts.receivers]
        return subset(contacts, apart)


def build_hierarchy(edges: EdgeSet, rest_position: Tensor, levels: int, pooled: bool, mesh: EdgeSet) -> Hierarchy:
    """The hierarchy of one mesh.

    Args:
        edges: those that the hierarchy is made of, both directions.
        rest_position: [N, 3].
        levels: L; a component that is down to one node stays as it is.
        pooled: the positions of a coarser mesh are pooled like features, not those of the kept nodes.
        mesh: all mesh edges: their connected components are `Hierarchy.component`.
    """
    adjacency, kept_position = _matrix(edges), rest_position.numpy().astype(np.float64)
    position, weight = rest_position.double(), np.ones(len(rest_position))
    edge_sets, rest_edges, poolings = [edges], [edge_vectors(edges, rest_position, rest_position)], []
    for _ in range(levels):
        kept = select(adjacency, kept_position)
        pooling, weight = _pooling(adjacency, kept, weight)
        adjacency, kept_position = coarsen(adjacency, kept), kept_position[kept]
        position = pooling.pool(position) if pooled else position[pooling.kept]
        edge_sets.append(_edge_set(adjacency))
        poolings.append(pooling)
        rest_edges.append(edge_vectors(edge_sets[-1], position, position).float())
    component = connected_components(_matrix(mesh), directed=False)[1]
    return Hierarchy(tuple(edge_sets), tuple(rest_edges), tuple(poolings), torch.from_numpy(component.astype(np.int64)))


def select(adjacency: csr_array, position: np.ndarray) -> np.ndarray:
    """[C] int64, ascending: the nodes that bi-stride pooling keeps, by component.

    The search starts at the node with the least mean depth of the others, of those near the centroid (`NEAR_CENTRE`);
    at the first of them on a tie. The even class is kept on a tie, and if there is no odd one.

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
    """(A + I)^2 of the kept nodes without the diagonal, [C, C] bool."""
    enhanced = (adjacency + eye_array(adjacency.shape[0], dtype=bool)).tocsr()
    return _without_diagonal(enhanced[kept] @ enhanced[:, kept])


def _pooling(adjacency: csr_array, kept: np.ndarray, weight: np.ndarray) -> tuple[Pooling, np.ndarray]:
    """The pooling to the kept nodes and their w', from the w [N] of all."""
    degree = np.diff(adjacency.indptr)
    alone = diags_array((degree == 0), dtype=bool)
    neighbours = (adjacency + alone).tocsr()[kept].astype(np.float64)
    share = weight / np.maximum(degree, 1)
    total = neighbours @ share
    neighbours.sort_indices()
    edges = _edge_set(neighbours)
    weights = share[neighbours.indices] / total.repeat(np.diff(neighbours.indptr))
    return Pooling(torch.from_numpy(kept), edges, torch.from_numpy(weights).float()[:, None]), total


def spread(x: Tensor, order: Tensor, offsets: Tensor) -> Tensor:
    """Row c of x [C, F] at each place order[j] with j in [offsets[c], offsets[c + 1]): the transpose of `segment_sum`.

    The same as an index_select by the segment of each row, with a gradient that is summed in stored order.
    """
    return torch.ops.ast_sim.segment_spread(x, order, offsets, False)


def subset(edges: EdgeSet, wanted: Tensor) -> EdgeSet:
    """The edges where wanted [M] bool is true."""
    receivers = edges.receivers[wanted]
    return EdgeSet(edges.senders[wanted], receivers, offsets_of(receivers, edges.num_receivers), edges.num_senders)


def _concatenate(poolings: Sequence[Pooling]) -> Pooling:
    shifts = accumulate((pooling.num_nodes for pooling in poolings), initial=0)
    return Pooling(
        torch.cat([pooling.kept + shift for pooling, shift in zip(poolings, shifts, strict=False)]),
        EdgeSet.concatenate([pooling.edges for pooling in poolings]),
        torch.cat([pooling.weight for pooling in poolings]),
    )


def _matrix(edges: EdgeSet) -> csr_array:
    """[R, S] bool: row r holds the senders to r."""
    shape = (edges.num_receivers, edges.num_senders)
    return csr_array((np.ones(len(edges), bool), edges.senders.numpy(), edges.receiver_offsets.numpy()), shape=shape)


def _edge_set(matrix: csr_array) -> EdgeSet:
    """The reverse of `_matrix`, senders ascending."""
    matrix.sort_indices()
    offsets = torch.from_numpy(matrix.indptr.astype(np.int64))
    receivers = torch.arange(matrix.shape[0]).repeat_interleave(offsets.diff())
    return EdgeSet(torch.from_numpy(matrix.indices.astype(np.int64)), receivers, offsets, matrix.shape[1])


def _without_diagonal(matrix: csr_array) -> csr_array:
    pairs = matrix.tocoo()
    row, column = pairs.coords
    apart = row != column
    return coo_array((pairs.data[apart], (row[apart], column[apart])), shape=matrix.shape).tocsr()

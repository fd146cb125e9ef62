"""Sums over segments, in stored order and by a permutation (the gradient of a gather), beside torch's scatters."""

from __future__ import annotations

import torch

from ast_sim.ops.edges import EdgeSet
from ast_sim.ops.segment import segment_sum
from benchmarks.case import Case

SIZES = [(3000, 500, 64), (300_000, 50_000, 128)]  # edges, nodes, channels


def cases() -> list[Case]:
    return [case for size in SIZES for case in (_sum(*size), _gather_gradient(*size))]


def _edges(edges: int, nodes: int) -> EdgeSet:
    g = torch.Generator().manual_seed(0)
    return EdgeSet.from_pairs(*(torch.randint(0, nodes, (edges,), generator=g) for _ in range(2)), nodes, nodes)


def _peers(index: torch.Tensor, x: torch.Tensor, nodes: int) -> dict:
    wide = index[:, None].expand(x.shape)
    return {
        "index_add_": lambda: x.new_zeros(nodes, x.shape[1]).index_add_(0, index, x),
        "scatter_add_": lambda: x.new_zeros(nodes, x.shape[1]).scatter_add_(0, wide, x),
    }


def _case(op: str, ours, peers: dict, edges: int, nodes: int, channels: int) -> Case:
    def check() -> None:
        for peer in peers.values():
            torch.testing.assert_close(ours(), peer(), rtol=1e-5, atol=1e-4)

    return Case(op, f"{edges} edges to {nodes} nodes, {channels} channels", ours, peers, edges, None, check)


def _sum(edges: int, nodes: int, channels: int) -> Case:
    edge_set, x = _edges(edges, nodes), torch.randn(edges, channels)
    peers = _peers(edge_set.receivers, x, nodes)
    return _case("segment_sum", lambda: edge_set.sum_at_receivers(x), peers, edges, nodes, channels)


def _gather_gradient(edges: int, nodes: int, channels: int) -> Case:
    """The gradient of x[senders]: the rows of each sender lie far apart."""
    edge_set, dout = _edges(edges, nodes), torch.randn(edges, channels)
    peers = _peers(edge_set.senders, dout, nodes)

    def ours():
        return segment_sum(dout, edge_set.sender_order, edge_set.sender_offsets)

    return _case("segment_sum by a permutation", ours, peers, edges, nodes, channels)

"""Attention along edges with a weight for each channel and no normalisation (HCMT, Yu et al. 2024, arXiv 2312.12467).

    s_c = clip(k_ic q_jc p_ec / sqrt(d), -2, 2),    out_jc = sum over e: i -> j of v_ic g_ec exp(s_c)

Element by element this is bound by memory, so a few edges at a time pass through all of it, and for the gradient all is
computed again: only the inputs are kept.

Legend: N nodes, M edges, F channels.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ast_sim.ops.edges import EdgeSet, offsets_of
from ast_sim.ops.segment import segment_sum

LIMIT = 2.0  # of a score
CHUNK = 1 << 16  # elements of one array that pass at a time: they stay in the cache


def channel_attention(edges: EdgeSet, of_nodes: Tensor, of_edges: Tensor, head_width: int) -> Tensor:
    """out of the formula above.

    Args:
        edges: M edges among N nodes.
        of_nodes: [N, 3 F], q, k and v side by side.
        of_edges: [M, 2 F], p and g side by side.
        head_width: d.

    Returns:
        [N, F]; 0 for a node without edges.
    """
    return _ChannelAttention.apply(of_nodes, of_edges, edges, 1 / math.sqrt(head_width))


class _ChannelAttention(torch.autograd.Function):
    @staticmethod
    def forward(ctx, of_nodes: Tensor, of_edges: Tensor, edges: EdgeSet, scale: float) -> Tensor:
        ctx.save_for_backward(of_nodes, of_edges)
        ctx.edges, ctx.scale = edges, scale
        messages = of_edges.new_empty(len(edges), of_edges.shape[1] // 2)
        for rows in _chunks(messages):
            q, k, v, p, g = _gather(of_nodes, of_edges, edges, rows)
            weight = k.mul_(q).mul_(p).mul_(scale).clamp_(-LIMIT, LIMIT).exp_()
            torch.mul(v.mul_(g), weight, out=messages[rows])
        return segment_sum(messages, torch.arange(len(edges)), edges.receiver_offsets)

    @staticmethod
    def backward(ctx, dout: Tensor) -> tuple[Tensor, Tensor, None, None]:
        (of_nodes, of_edges), edges, scale = ctx.saved_tensors, ctx.edges, ctx.scale
        width = dout.shape[1]
        of_receivers, of_senders = dout.new_empty(len(edges), width), dout.new_empty(len(edges), 2 * width)
        dof_edges = torch.empty_like(of_edges)
        for rows in _chunks(of_receivers):
            q, k, v, p, g = _gather(of_nodes, of_edges, edges, rows)
            score = (k * q).mul_(p).mul_(scale)
            outside = score.abs() > LIMIT
            dmessage = dout.index_select(0, edges.receivers[rows]).mul_(score.clamp_(-LIMIT, LIMIT).exp_())
            torch.mul(dmessage, g, out=of_senders[rows, width:])  # of v
            torch.mul(dmessage, v, out=dof_edges[rows, width:])  # of g
            dscore = dmessage.mul_(v).mul_(g).mul_(scale).masked_fill_(outside, 0)
            torch.mul(k, q, out=dof_edges[rows, :width]).mul_(dscore)  # of p
            dscore.mul_(p)
            torch.mul(dscore, q, out=of_senders[rows, :width])  # of k
            torch.mul(dscore, k, out=of_receivers[rows])  # of q
        order = torch.argsort(edges.senders, stable=True)
        dof_nodes = (
            segment_sum(of_receivers, torch.arange(len(edges)), edges.receiver_offsets),
            segment_sum(of_senders, order, offsets_of(edges.senders, edges.num_senders)),
        )
        return torch.cat(dof_nodes, dim=1), dof_edges, None, None


def _chunks(x: Tensor) -> list[slice]:
    """The rows of x, some at a time."""
    rows = max(1, CHUNK // max(1, x.shape[1]))
    return [slice(start, min(start + rows, len(x))) for start in range(0, len(x), rows)]


def _gather(of_nodes: Tensor, of_edges: Tensor, edges: EdgeSet, rows: slice) -> tuple[Tensor, ...]:
    """q, k, v, p and g of some edges; q, k and v are copies."""
    width = of_edges.shape[1] // 2
    q = of_nodes[:, :width].index_select(0, edges.receivers[rows])
    k, v = (part.index_select(0, edges.senders[rows]) for part in of_nodes[:, width:].split(width, dim=1))
    return q, k, v, *of_edges[rows].split(width, dim=1)

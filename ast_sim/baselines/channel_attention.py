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

from ast_sim.ops.edges import EdgeSet
from ast_sim.ops.segment import segment_sum

LIMIT = 2.0  # of a score
CHUNK = 1 << 17  # elements of one array that pass at a time: they stay in the cache


def channel_attention(edges: EdgeSet, q: Tensor, k: Tensor, v: Tensor, p: Tensor, g: Tensor, head_width: int) -> Tensor:
    """out of the formula above, [N, F]; 0 for a node without edges.

    Args:
        edges: M edges among N nodes.
        q, k, v: [N, F].
        p, g: [M, F].
        head_width: d.
    """
    return _ChannelAttention.apply(q, k, v, p, g, edges, 1 / math.sqrt(head_width))


class _ChannelAttention(torch.autograd.Function):
    @staticmethod
    def forward(ctx, q, k, v, p, g, edges: EdgeSet, scale: float) -> Tensor:
        ctx.save_for_backward(q, k, v, p, g)
        ctx.edges, ctx.scale = edges, scale
        messages = torch.empty_like(p)
        for rows in _chunks(p):
            q_e, k_e, v_e = _gather(q, k, v, edges, rows)
            weight = k_e.mul_(q_e).mul_(p[rows]).mul_(scale).clamp_(-LIMIT, LIMIT).exp_()
            torch.mul(v_e.mul_(g[rows]), weight, out=messages[rows])
        return segment_sum(messages, *edges.by_receiver)

    @staticmethod
    def backward(ctx, dout: Tensor) -> tuple[Tensor | None, ...]:
        (q, k, v, p, g), edges, scale = ctx.saved_tensors, ctx.edges, ctx.scale
        dq, dk, dv, dp, dg = (torch.empty_like(p) for _ in range(5))  # of each edge
        for rows in _chunks(p):
            q_e, k_e, v_e = _gather(q, k, v, edges, rows)
            kq, p_e, g_e = k_e * q_e, p[rows], g[rows]
            score = (kq * p_e).mul_(scale)
            inside = score.abs().le_(LIMIT)
            dmessage = dout.index_select(0, edges.receivers[rows]).mul_(score.clamp_(-LIMIT, LIMIT).exp_())
            torch.mul(dmessage, g_e, out=dv[rows])
            torch.mul(dmessage, v_e, out=dg[rows])
            dscore = dmessage.mul_(v_e).mul_(g_e).mul_(inside).mul_(scale)
            torch.mul(kq, dscore, out=dp[rows])
            dscore.mul_(p_e)
            torch.mul(dscore, q_e, out=dk[rows])
            torch.mul(dscore, k_e, out=dq[rows])
        by_sender = edges.by_sender
        of_nodes = segment_sum(dq, *edges.by_receiver), segment_sum(dk, *by_sender), segment_sum(dv, *by_sender)
        return *of_nodes, dp, dg, None, None


def _chunks(x: Tensor) -> list[slice]:
    """The rows of x, some at a time."""
    rows = max(1, CHUNK // max(1, x.shape[1]))
    return [slice(start, min(start + rows, len(x))) for start in range(0, len(x), rows)]


def _gather(q: Tensor, k: Tensor, v: Tensor, edges: EdgeSet, rows: slice) -> tuple[Tensor, ...]:
    """q of the receivers, k and v of the senders of some edges, as copies."""
    senders = edges.senders[rows]
    return q.index_select(0, edges.receivers[rows]), k.index_select(0, senders), v.index_select(0, senders)

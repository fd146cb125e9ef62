"""Sums and means over the rows of each segment, such as the nodes of each cell.

Legend: N rows, C segments, F channels.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ast_sim.ops.derivatives import differentiate, differentiate_by_composition
from ast_sim.ops.library import Kernel, Op
from ast_sim.ops.spec import segment_of


def _scale(node_offsets: Tensor, mean: bool, dtype: torch.dtype) -> Tensor:
    counts = node_offsets.diff().clamp(min=1) if mean else torch.ones_like(node_offsets[1:])
    return counts.to(dtype).reciprocal()[:, None]


def _sum_reference(x: Tensor, node_order: Tensor, node_offsets: Tensor, mean: bool) -> Tensor:
    out = x.new_zeros(len(node_offsets) - 1, x.shape[1]).index_add(0, segment_of(node_offsets), x[node_order])
    return out * _scale(node_offsets, mean, x.dtype)


def _spread_reference(dout: Tensor, node_order: Tensor, node_offsets: Tensor, mean: bool) -> Tensor:
    dx = dout.new_empty(len(node_order), dout.shape[1])
    dx[node_order] = (dout * _scale(node_offsets, mean, dout.dtype))[segment_of(node_offsets)]
    return dx


_SEGMENTS = "node_order[N] permutation, node_offsets[C+1] offsets(N), mean flag"
_sum = Op(Kernel("segment_sum", f"x[N,F], {_SEGMENTS} -> out[C,F]"), _sum_reference)
_spread = Op(Kernel("segment_spread", f"dout[C,F], {_SEGMENTS} -> dx[N,F]"), _spread_reference)
_column_sum = Op(Kernel("column_sum", "x[N,F] -> out[F]"), lambda x: x.sum(0))


def _save_segments(ctx, inputs, output) -> None:
    _, node_order, node_offsets, ctx.mean = inputs
    ctx.save_for_backward(node_order, node_offsets)


def _gradient_by(adjoint: Op):
    return lambda ctx, grad: (adjoint(grad, *ctx.saved_tensors, ctx.mean), None, None, None)


differentiate(_sum, _save_segments, _gradient_by(_spread))
differentiate(_spread, _save_segments, _gradient_by(_sum))
differentiate_by_composition(_column_sum)


def segment_sum(x: Tensor, node_order: Tensor, node_offsets: Tensor) -> Tensor:
    """Row c is the sum of x[node_order[j]] over j in [node_offsets[c], node_offsets[c+1]), added in that order.

    More than 256 rows are added by chains of that many, whose sums are added by halves, so that rounding errors do not
    grow with the number of rows.

    Args:
        x: [N, F].
        node_order: [N] int64, a permutation.
        node_offsets: [C + 1] int64, from 0 to N.

    Returns:
        [C, F]; an empty segment is 0.

    Raises:
        ValueError: the offsets fall or do not end at N, or the order is no permutation.
    """
    return _sum(x, node_order, node_offsets, False)


def segment_mean(x: Tensor, node_order: Tensor, node_offsets: Tensor) -> Tensor:
    """`segment_sum` divided by the number of rows of each segment; an empty segment is 0."""
    return _sum(x, node_order, node_offsets, True)


def segment_spread(x: Tensor, node_order: Tensor, node_offsets: Tensor) -> Tensor:
    """[N, F]: row c of x [C, F] at each place node_order[j], j in [node_offsets[c], node_offsets[c+1]); the transpose
    of `segment_sum`.

    It equals an index_select by the segment of each row, but its gradient is summed in stored order.
    """
    return _spread(x, node_order, node_offsets, False)


def column_sum(x: Tensor) -> Tensor:
    """[F]: the sum over the rows of x [N, F]. Its bits do not depend on the number of threads, unlike torch's sum."""
    return _column_sum(x)

"""Sums and means over the rows of each segment, such as the nodes of each cell.

Legend: N rows, C segments, F channels.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ast_sim.ops import library
from ast_sim.ops.library import check_offsets, dense


def _segment_of(node_offsets: Tensor) -> Tensor:
    counts = node_offsets.diff()
    return torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)


def _scale(node_offsets: Tensor, mean: bool, dtype: torch.dtype) -> Tensor:
    counts = node_offsets.diff().clamp(min=1) if mean else torch.ones_like(node_offsets[1:])
    return counts.to(dtype).reciprocal()[:, None]


def _check(op: str, x: Tensor, node_order: Tensor, node_offsets: Tensor) -> None:
    if x.dim() != 2 or node_order.shape != (x.shape[0],):
        raise ValueError(f"{op}: x must be [N, F] and node_order [N], not {list(x.shape)} and {list(node_order.shape)}")
    check_offsets(op, "node_offsets", node_offsets, len(x))
    if not torch.equal(node_order.sort().values, torch.arange(len(x), device=x.device)):
        raise ValueError(f"{op}: node_order must be a permutation")


def _sum_reference(x: Tensor, node_order: Tensor, node_offsets: Tensor, mean: bool) -> Tensor:
    _check("segment_sum", x, node_order, node_offsets)
    out = x.new_zeros(len(node_offsets) - 1, x.shape[1])
    out.index_add_(0, _segment_of(node_offsets), x[node_order])
    return out * _scale(node_offsets, mean, x.dtype)


def _sum_kernel(x: Tensor, node_order: Tensor, node_offsets: Tensor, mean: bool) -> Tensor:
    out = x.new_empty(max(len(node_offsets) - 1, 0), x.shape[-1])
    library._C.segment_sum(dense(x), dense(node_order), dense(node_offsets), mean, out)
    return out


def _sum_fake(x: Tensor, node_order: Tensor, node_offsets: Tensor, mean: bool) -> Tensor:
    return x.new_empty(node_offsets.shape[0] - 1, x.shape[1])


def _spread_reference(dout: Tensor, node_order: Tensor, node_offsets: Tensor, mean: bool) -> Tensor:
    dx = dout.new_empty(len(node_order), dout.shape[1])
    dx[node_order] = (dout * _scale(node_offsets, mean, dout.dtype))[_segment_of(node_offsets)]
    return dx


def _spread_kernel(dout: Tensor, node_order: Tensor, node_offsets: Tensor, mean: bool) -> Tensor:
    dx = dout.new_empty(len(node_order), dout.shape[1])
    library._C.segment_spread(dense(dout), dense(node_order), dense(node_offsets), mean, dx)
    return dx


def _spread_fake(dout: Tensor, node_order: Tensor, node_offsets: Tensor, mean: bool) -> Tensor:
    return dout.new_empty(node_order.shape[0], dout.shape[1])


def _column_sum_reference(x: Tensor) -> Tensor:
    if x.dim() != 2:
        raise ValueError(f"column_sum: x must have shape [*, *], not {tuple(x.shape)}")
    return x.sum(0)


def _column_sum_kernel(x: Tensor) -> Tensor:
    out = x.new_empty(x.shape[-1:])
    library._C.column_sum(dense(x), out)
    return out


def _column_sum_fake(x: Tensor) -> Tensor:
    return x.new_empty(x.shape[1])


_SEGMENTS = "Tensor node_order, Tensor node_offsets, bool mean) -> Tensor"
_sum = library.define(f"segment_sum(Tensor x, {_SEGMENTS}", _sum_kernel, _sum_reference, _sum_fake)
_spread = library.define(f"segment_spread(Tensor dout, {_SEGMENTS}", _spread_kernel, _spread_reference, _spread_fake)
_column_sum = library.define(
    "column_sum(Tensor x) -> Tensor", _column_sum_kernel, _column_sum_reference, _column_sum_fake
)


def _save_segments(ctx, inputs, output) -> None:
    _, node_order, node_offsets, ctx.mean = inputs
    ctx.save_for_backward(node_order, node_offsets)


library.differentiate(
    _sum, _save_segments, lambda ctx, grad: (_spread(grad, *ctx.saved_tensors, ctx.mean), None, None, None)
)
library.differentiate(
    _spread, _save_segments, lambda ctx, grad: (_sum(grad, *ctx.saved_tensors, ctx.mean), None, None, None)
)
library.differentiate(
    _column_sum,
    lambda ctx, inputs, output: setattr(ctx, "rows", inputs[0].shape[0]),
    lambda ctx, grad: grad.expand(ctx.rows, -1),
)


def segment_sum(x: Tensor, node_order: Tensor, node_offsets: Tensor) -> Tensor:
    """Sum of x[node_order[j]] over j in [node_offsets[c], node_offsets[c+1]), in that order.

    Args:
        x: [N, F].
        node_order: [N] int64, a permutation.
        node_offsets: [C + 1] int64, from 0 to N.

    Returns:
        [C, F]; an empty segment is 0.

    Raises:
        ValueError: for offsets that fall or do not end at N, and for an order that is no permutation.
    """
    return _sum(x, node_order, node_offsets, False)


def segment_mean(x: Tensor, node_order: Tensor, node_offsets: Tensor) -> Tensor:
    """`segment_sum` divided by the number of rows of each segment; an empty segment is 0."""
    return _sum(x, node_order, node_offsets, True)


def column_sum(x: Tensor) -> Tensor:
    """Sum over the rows of x [N, F]: [F]. Unlike torch's, its bits do not depend on the number of threads."""
    return _column_sum(x)

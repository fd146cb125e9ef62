"""Convolutions of kernel 3x3x3 and stride 2 between a level of an octree and the next coarser one.

Legend: C_fine and C_coarse cells, I and O channels in and out, P pairs of cells that the kernel connects.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ast_sim.ops._octree import CellMap
from ast_sim.ops._segment import column_sum
from ast_sim.ops.derivatives import differentiate, differentiate_by_composition
from ast_sim.ops.library import Kernel, Op
from ast_sim.support.errors import counted

OFFSETS = 27


# The pairs come twice. (source, destination) are sorted by destination. The gradient with respect to x goes from
# destinations to sources: (back_source, back_destination) are the same pairs exchanged, sorted by source.
_PAIRS = "pair_offsets[28] offsets(P), source[P] index(N)"
_SPEC = (
    f"x[N,I], weight[27,I,O], bias?[O], transposed flag integer(0,0), {_PAIRS}, destination[P] index(R)"
    " rising(pair_offsets); back_source[P] int64, back_destination[P] int64, num_out size(R) -> out[R,O]"
)
_TRANSPOSED_SPEC = _SPEC.replace("I,O", "O,I").replace("(0,0)", "(1,1)")
_WEIGHT_SPEC = f"x[N,I], dout[R,O], {_PAIRS}, destination[P] index(R) -> dweight[27,I,O]"


def _groups(pair_offsets: Tensor, source: Tensor, destination: Tensor):
    """Kernel offset, sources and destinations of each group that has pairs."""
    offsets = pair_offsets.tolist()
    for k in range(OFFSETS):
        if offsets[k] < offsets[k + 1]:
            pairs = slice(offsets[k], offsets[k + 1])
            yield k, source[pairs], destination[pairs]


def _reference(x, weight, bias, transposed, pair_offsets, source, destination, back_source, back_destination, num_out):
    weight = weight.mT if transposed else weight
    out = x.new_zeros(num_out, weight.shape[2])
    for k, i, j in _groups(pair_offsets, source, destination):
        out = out.index_add(0, j, x.index_select(0, i) @ weight[k])
    return out if bias is None else out + bias


def _weight_reference(x, dout, pair_offsets, source, destination):
    groups = _groups(pair_offsets, source, destination)
    gradients = {k: x.index_select(0, i).T @ dout.index_select(0, j) for k, i, j in groups}
    return torch.stack([gradients.get(k, x.new_zeros(x.shape[1], dout.shape[1])) for k in range(OFFSETS)])


_conv = Op(Kernel("sparse_conv", _SPEC), _reference)
_conv_transposed = Op(Kernel("sparse_conv_transposed", _TRANSPOSED_SPEC), _reference)
_conv_weight = Op(Kernel("sparse_conv_weight", _WEIGHT_SPEC), _weight_reference)


def _save(ctx, inputs, output) -> None:
    x, weight, _, ctx.transposed, *pairs, _ = inputs
    ctx.save_for_backward(x, weight, *pairs)


def _gradient(ctx, dout):
    x, weight, pair_offsets, source, destination, back_source, back_destination = ctx.saved_tensors
    dx = dweight = dbias = None
    if ctx.needs_input_grad[0]:
        lists = (back_source, back_destination, source, destination)
        adjoint = _conv if ctx.transposed else _conv_transposed
        dx = adjoint(dout, weight, None, not ctx.transposed, pair_offsets, *lists, x.shape[0])
    if ctx.needs_input_grad[1] and ctx.transposed:
        dweight = _conv_weight(dout, x, pair_offsets, destination, source)
    elif ctx.needs_input_grad[1]:
        dweight = _conv_weight(x, dout, pair_offsets, source, destination)
    if ctx.needs_input_grad[2]:
        dbias = column_sum(dout)
    return dx, dweight, dbias, *[None] * 7


differentiate(_conv, _save, _gradient)
differentiate(_conv_transposed, _save, _gradient)
differentiate_by_composition(_conv_weight)


def sparse_conv(x: Tensor, weight: Tensor, map: CellMap, bias: Tensor | None = None) -> Tensor:
    """Convolution with stride 2: out[X] = bias + sum over (a, b, c) in {-1, 0, 1}^3 of x[2 X + (a, b, c)] W_k.

    Args:
        x: [C_fine, I], features of the cells of a level.
        weight: [27, I, O]; W_k belongs to kernel offset k = 9(a+1) + 3(b+1) + (c+1).
        map: `Octree.coarsen()` of that level.
        bias: [O], or None for 0.

    Returns:
        [C_coarse, O]. A cell that does not exist contributes nothing.

    Raises:
        ValueError: shapes do not fit each other or the map.
    """
    if x.shape[0] != map.num_fine:
        raise ValueError(f"sparse_conv: x has {counted(x.shape[0], 'row')} for {counted(map.num_fine, 'fine cell')}")
    pairs = (map.fine, map.coarse_index, map.coarse_by_fine, map.fine_by_fine)
    return _conv(x, weight, bias, False, map.pair_offsets, *pairs, map.coarse.keys.shape[0])


def sparse_conv_transposed(x: Tensor, weight: Tensor, map: CellMap, bias: Tensor | None = None) -> Tensor:
    """From coarse to fine, by the same pairs: out[2 X + (a, b, c)] = bias + sum over the coarse cells X of x[X] W_k.

    Args:
        x: [C_coarse, I], features of the cells of the coarser level.
        weight: [27, I, O].
        map: `Octree.coarsen()` of the finer level.
        bias: [O], or None for 0.

    Returns:
        [C_fine, O].

    Raises:
        ValueError: shapes do not fit each other or the map.
    """
    if x.shape[0] != map.coarse.keys.shape[0]:
        raise ValueError(
            f"sparse_conv_transposed: x has {counted(x.shape[0], 'row')} for"
            f" {counted(len(map.coarse.keys), 'coarse cell')}"
        )
    pairs = (map.coarse_by_fine, map.fine_by_fine, map.fine, map.coarse_index)
    return _conv(x, weight, bias, False, map.pair_offsets, *pairs, map.num_fine)

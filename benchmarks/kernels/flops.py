"""Useful floating point operations of our ops, for torch's FlopCounterMode: the operations of the formulas.

Recomputation does not count. A multiply and an add count as two. Only products of matrices count: activations, norms
and sums are free.
"""

from __future__ import annotations

import torch
from torch import Tensor

ops = torch.ops.ast_sim


def _product(*sizes: int) -> int:
    count = 2
    for size in sizes:
        count *= size
    return count


def _linear(x: Tensor, weight: Tensor, *_, **__) -> int:
    return _product(len(x), *weight.shape)


def _linear_backward(dout: Tensor, x: Tensor, weight: Tensor, bias, z, activation, wanted, **_) -> int:
    return _product(len(x), *weight.shape) * sum(wanted[:2])


def _mlp(x: Tensor, beside, weight1: Tensor, bias1, weight2: Tensor, *_, **__) -> int:
    return _product(len(x), *weight1.shape) + _product(len(x), *weight2.shape)


def _mlp_backward(dout: Tensor, x: Tensor, beside, weight1: Tensor, bias1, weight2: Tensor, *rest, **_) -> int:
    inputs = x.shape[1] * rest[-1][0] + (0 if beside is None else beside.shape[1]) * rest[-1][1]
    of_weights = _mlp(x, beside, weight1, bias1, weight2)
    return of_weights + _product(len(x), *weight2.shape) + _product(len(x), len(weight1), inputs)


def _message(of_senders, of_receivers, edge_features, A1: Tensor, a1, A2: Tensor, W2: Tensor, *_, **__) -> int:
    edges = len(edge_features)
    return _product(edges, *A1.shape) + _product(edges, *A2.shape) + _product(edges, *W2.shape)


def _message_backward(dsum, dmessages, *inputs, **_) -> int:
    edge_features, A1, wanted = inputs[2], inputs[3], inputs[-1]
    of_edges = 0 if wanted else _product(len(edge_features), *A1.shape)
    return 2 * _message(*inputs) - of_edges


def _of_pairs(q_offsets: Tensor, k_offsets: Tensor, *width: int) -> int:
    """Scores of all pairs of a query and a key of one scene, and sums of as many values."""
    pairs = int((q_offsets.diff() * k_offsets.diff()).sum())
    return 2 * _product(pairs, *width)


def _attention(q: Tensor, k: Tensor, v: Tensor, q_offsets: Tensor, k_offsets: Tensor, *_, **__) -> int:
    return _of_pairs(q_offsets, k_offsets, *q.shape[1:])


def _attention_backward(*inputs, **_) -> int:
    return _attention(*inputs) * 5 // 2


def _block_parts(x: Tensor, context: Tensor, rotations, context_rotations, *rest) -> tuple[int, int]:
    """Of the dense layers, and of attention."""
    q_offsets, k_offsets, *parameters = rest
    query, key_value, weight, first, second = (parameters[place] for place in (4, 5, 6, 10, 12))
    of_layers = sum(_product(len(x), *layer.shape) for layer in (query, weight, first, second))
    of_layers += _product(len(context), *key_value.shape)
    return of_layers, _of_pairs(q_offsets, k_offsets, len(query))


def _block(*inputs, **_) -> int:
    return sum(_block_parts(*inputs))


def _block_backward(dout: Tensor, *inputs, **_) -> int:
    of_layers, of_attention = _block_parts(*inputs)
    return 2 * of_layers + of_attention * 5 // 2


def _sparse_conv(x: Tensor, weight: Tensor, bias, transposed, pair_offsets: Tensor, *_, **__) -> int:
    return _product(int(pair_offsets[-1]), *weight.shape[1:])


def _sparse_conv_weight(x: Tensor, dout: Tensor, pair_offsets: Tensor, *_, **__) -> int:
    return _product(int(pair_offsets[-1]), x.shape[1], dout.shape[1])


def _raw(function):
    """FlopCounterMode then hands over tensors, not their shapes."""
    function._get_raw = True
    return function


FORMULAS = {
    ops.linear: _raw(_linear),
    ops.linear_backward: _raw(_linear_backward),
    ops.linear_geglu: _raw(_linear),
    ops.linear_geglu_backward: _raw(_linear_backward),
    ops.mlp: _raw(_mlp),
    ops.mlp_backward: _raw(_mlp_backward),
    ops.message: _raw(_message),
    ops.message_backward: _raw(_message_backward),
    ops.attention: _raw(_attention),
    ops.attention_backward: _raw(_attention_backward),
    ops.attention_block: _raw(_block),
    ops.attention_block_backward: _raw(_block_backward),
    ops.sparse_conv: _raw(_sparse_conv),
    ops.sparse_conv_transposed: _raw(_sparse_conv),
    ops.sparse_conv_weight: _raw(_sparse_conv_weight),
}

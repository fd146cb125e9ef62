"""Two dense layers with a ReLU between them and a LayerNorm behind them.

Legend: M rows, I and I2 inputs, H hidden units, O outputs.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd import forward_ad

from ast_sim.ops.derivatives import gradient_op
from ast_sim.ops.library import Kernel, Op, is_at_most

EPSILON = 1e-5
SAVED = 1 << 25  # hidden units and outputs with more elements are not kept for the gradient, but computed again


_TENSORS = (
    "x[M,I] rows_apart, beside?[M,J] rows_apart, weight1[H,I+J] filled, bias1?[H], weight2[O,H] filled, bias2?[O],"
    " gamma?[O], beta?[O] with(gamma)"
)
_SPEC = (
    f"{_TENSORS}, residual?[M,O] rows_apart added; save switch"
    " -> out[M,O], hidden[M,H] if(save), normalized[M,O] if(save,gamma), scale[M] if(save,gamma)"
)
_BACKWARD_SPEC = (
    f"dout[M,O] rows_apart late, {_TENSORS}, hidden?[M,H], normalized?[M,O], scale?[M] with(normalized);"
    " wanted wants(x,beside,weight1,bias1,weight2,bias2,gamma,beta)"
    " -> dx[M,I] if(wanted), dbeside[M,J] if(wanted), dweight1[H,I+J] if(wanted), dbias1[H] if(wanted),"
    " dweight2[O,H] if(wanted), dbias2[O] if(wanted), dgamma[O] if(wanted), dbeta[O] if(wanted)"
)


def normalize(y: Tensor) -> tuple[Tensor, Tensor]:
    """Each row of y normalized, and the factors [M] of the rows.

    A shift of a row changes neither, nor any derivative. So the first value is taken off before the mean: of nearly
    equal values the differences are exact.
    """
    shifted = y - y[:, :1].detach()
    centred = shifted - shifted.mean(1, keepdim=True)
    scale = (centred.square().mean(1) + EPSILON).rsqrt()
    return centred * scale[:, None], scale


def layer_norm(y: Tensor, gamma: Tensor, beta: Tensor) -> Tensor:
    """torch's own, or the formula: torch loses terms in the tangent of its tangent."""
    if torch._C._are_functorch_transforms_active() or forward_ad._current_level >= 0:
        return normalize(y)[0] * gamma + beta
    return F.layer_norm(y, y.shape[1:], gamma, beta, EPSILON)


def _reference(x, beside, weight1, bias1, weight2, bias2, gamma, beta, residual, save):
    hidden = F.relu(F.linear(x if beside is None else torch.cat([x, beside], dim=1), weight1, bias1))
    product = F.linear(hidden, weight2, bias2)
    out = product if gamma is None else layer_norm(product, gamma, beta)
    if residual is not None:
        out = out + residual
    if not save:
        return out, None, None, None
    normalized, scale = (None, None) if gamma is None else normalize(product)
    return out, hidden, normalized, scale


_mlp = Op(Kernel("mlp", _SPEC), _reference)
_mlp_backward = gradient_op(_mlp, Kernel("mlp_backward", _BACKWARD_SPEC))


def mlp(
    x: Tensor,
    weight1: Tensor,
    bias1: Tensor | None,
    weight2: Tensor,
    bias2: Tensor | None,
    beside: Tensor | None = None,
    norm: tuple[Tensor, Tensor] | None = None,
    residual: Tensor | None = None,
) -> Tensor:
    """LN(W2 relu(W1 [x, beside] + b1) + b2) + residual in one pass. There is no LN without `norm`.

    A row of the result depends only on that row of the inputs, bit for bit. The gradients have the same bits for any
    number of threads. Hidden units of many rows are not kept for the gradient, but computed again (`SAVED`).

    Args:
        x: [M, I]; rows may lie apart, as in a slice of columns.
        weight1, bias1: [H, I + I2] and [H] or None.
        weight2, bias2: [O, H] and [O] or None.
        beside: [M, I2]: more inputs, as if they were columns of x.
        norm: gamma and beta of the LayerNorm, [O] each (epsilon 1e-5).
        residual: [M, O].

    Returns:
        [M, O].

    Raises:
        ValueError: shapes are not as above.
    """
    tensors = (x, beside, weight1, bias1, weight2, bias2, *(norm or (None, None)))
    small = is_at_most(x.shape[0] * (weight1.shape[0] + weight2.shape[0]), SAVED)
    save = small and torch.is_grad_enabled() and any(y is not None and y.requires_grad for y in tensors)
    return _mlp(*tensors, residual, save)[0]

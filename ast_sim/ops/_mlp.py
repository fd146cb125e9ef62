"""Two dense layers with a ReLU between them and a LayerNorm behind them.

Legend: M rows, I and I2 inputs, H hidden units, O outputs.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd import forward_ad

from ast_sim.ops import library
from ast_sim.ops._linear import _given, _outputs

EPSILON = 1e-5
SAVED = 1 << 25  # hidden units and outputs with more elements are not kept for the gradient, but computed again


_TENSORS = (
    "x[M,I] rows, beside?[M,J] rows, weight1[H,I+J] filled, bias1?[H], weight2[O,H] filled, bias2?[O],"
    " gamma?[O], beta?[O] with(gamma)"
)
_KEPT = "hidden?[M,H], normalized?[M,O], scale?[M] with(normalized)"
_mlp_kernel = library.Kernel("mlp", f"{_TENSORS}, residual?[M,O] rows -> out[M,O], {_KEPT}")
_backward_kernel = library.Kernel(
    "mlp_backward",
    f"{_TENSORS}, dout[M,O] rows, {_KEPT} -> dx?[M,I], dbeside?[M,J], dweight1?[H,I+J], dbias1?[H], dweight2?[O,H],"
    " dbias2?[O], dgamma?[O], dbeta?[O]",
)


def _hidden(x, beside, weight1, bias1) -> Tensor:
    return F.relu(F.linear(x if beside is None else torch.cat([x, beside], dim=1), weight1, bias1))


def normalize(y: Tensor) -> tuple[Tensor, Tensor]:
    """Each row of y normalized, and the factors [M] of the rows."""
    centred = y - y.mean(1, keepdim=True)
    scale = (centred.square().mean(1) + EPSILON).rsqrt()
    return centred * scale[:, None], scale


def layer_norm(y: Tensor, gamma: Tensor, beta: Tensor) -> Tensor:
    """torch's own, or the formula: torch loses terms in the tangent of its tangent."""
    if torch._C._are_functorch_transforms_active() or forward_ad._current_level >= 0:
        return normalize(y)[0] * gamma + beta
    return F.layer_norm(y, y.shape[1:], gamma, beta, EPSILON)


def layer_norm_backward(dout: Tensor, gamma: Tensor, normalized: Tensor, scale: Tensor) -> tuple:
    """The gradients of y, gamma and beta. torch's own loses terms in third derivatives."""
    dn = dout * gamma
    dy = dn - dn.mean(1, keepdim=True) - normalized * (dn * normalized).mean(1, keepdim=True)
    return dy * scale[:, None], (dout * normalized).sum(0), dout.sum(0)


# ---- composition ----


def _reference(x, beside, weight1, bias1, weight2, bias2, gamma, beta, residual, save):
    _mlp_kernel.check(x, beside, weight1, bias1, weight2, bias2, gamma, beta, residual)
    hidden = _hidden(x, beside, weight1, bias1)
    out = F.linear(hidden, weight2, bias2)
    kept = [x.new_empty(0) for _ in range(3)]
    if save:
        kept[0] = hidden
    if gamma is not None:
        if save:
            kept[1:] = normalize(out)
        out = layer_norm(out, gamma, beta)
    return out if residual is None else out + residual, *kept


def _backward_reference(
    dout, x, beside, weight1, bias1, weight2, bias2, gamma, beta, hidden, normalized, scale, wanted
):
    hidden = _hidden(x, beside, weight1, bias1) if hidden is None else hidden
    dgamma = dbeta = dy = dout
    if gamma is not None:
        if normalized is None:
            normalized, scale = normalize(F.linear(hidden, weight2, bias2))
        dy, dgamma, dbeta = layer_norm_backward(dout, gamma, normalized, scale)
    dz = (dy @ weight2).masked_fill(hidden <= 0, 0)
    inputs = x if beside is None else torch.cat([x, beside], dim=1)
    dinputs = dz @ weight1
    gradients = [dinputs[:, : x.shape[1]], dinputs[:, x.shape[1] :], dz.mT @ inputs, dz.sum(0), dy.mT @ hidden]
    gradients += [dy.sum(0), dgamma, dbeta]
    return tuple(g.clone() if want else x.new_empty(0) for g, want in zip(gradients, wanted, strict=True))


# ---- C core ----


def _kept(gamma: Tensor | None, save: bool) -> list[bool]:
    """Whether hidden, normalized and scale are kept for the gradient."""
    norm = save and gamma is not None
    return [save, norm, norm]


def _call(outputs, *inputs):
    *tensors, save = inputs
    out, *kept = outputs
    _mlp_kernel(*tensors, out, *_given(_kept(tensors[6], save), kept))


def _call_backward(outputs, dout, *inputs):
    *tensors, hidden, normalized, scale, wanted = inputs
    _backward_kernel(*tensors, dout, hidden, normalized, scale, *_given(wanted, outputs))


def _new(x, beside, weight1, bias1, weight2, bias2, gamma, beta, residual, save):
    rows, hidden, columns = x.shape[0], weight1.shape[0], weight2.shape[0]
    kept = _outputs(x, _kept(gamma, save), [(rows, hidden), (rows, columns), (rows,)])
    return x.new_empty(rows, columns), *kept


def _new_backward(dout, x, beside, weight1, bias1, weight2, *kept_and_wanted):
    vectors = [weight1.shape[:1], *[weight2.shape[:1]] * 3]
    beside_shape = (0,) if beside is None else beside.shape
    shapes = [x.shape, beside_shape, weight1.shape, vectors[0], weight2.shape, *vectors[1:]]
    return tuple(_outputs(x, kept_and_wanted[-1], shapes))


_LAYERS = "Tensor weight1, Tensor? bias1, Tensor weight2, Tensor? bias2"
_INPUTS = f"Tensor x, Tensor? beside, {_LAYERS}, Tensor? gamma, Tensor? beta"
_mlp = library.define(
    f"mlp({_INPUTS}, Tensor? residual, bool save) -> (Tensor, Tensor, Tensor, Tensor)", _reference, _new, _call
)
_mlp_backward = library.define(
    f"mlp_backward(Tensor dout, {_INPUTS}, Tensor? hidden, Tensor? normalized, Tensor? scale, bool[8] wanted)"
    " -> (Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)",
    _backward_reference,
    _new_backward,
    _call_backward,
)


def _save(ctx, inputs, output) -> None:
    *tensors, _, save = inputs
    ctx.set_materialize_grads(False)  # what is kept has no gradient
    ctx.mark_non_differentiable(*output[1:])
    ctx.save_for_backward(*tensors, *_given(_kept(inputs[6], save), output[1:]))


def _gradient(ctx, dout, *_):
    wanted = list(ctx.needs_input_grad[:8])
    gradients = _mlp_backward(dout, *ctx.saved_tensors, wanted) if any(wanted) else [None] * 8
    return *_given(wanted, gradients), dout if ctx.needs_input_grad[8] else None, None


library.differentiate(_mlp, _save, _gradient)
library.differentiate_by_composition(_mlp_backward, (9, 10, 11))


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
    small = x.shape[0] * (weight1.shape[0] + weight2.shape[0]) <= SAVED
    save = small and torch.is_grad_enabled() and any(y is not None and y.requires_grad for y in tensors)
    return _mlp(*tensors, residual, save)[0]

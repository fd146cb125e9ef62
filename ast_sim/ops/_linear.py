"""One dense layer with its activation and a residual.

Legend: M rows, I inputs, O outputs.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from ast_sim.ops import library

ACTIVATIONS = ("none", "relu", "geglu")
GEGLU = ACTIVATIONS.index("geglu")
SAVED = 1 << 24  # an activation's input with more elements is not kept for the gradient, but computed again


def _outputs(like: Tensor, wanted: list[bool], shapes: list) -> list[Tensor]:
    """A new tensor of each shape. One that is not wanted is empty, because an op cannot return None."""
    return [like.new_empty(tuple(shape) if want else (0,)) for want, shape in zip(wanted, shapes, strict=True)]


def _given(wanted: list[bool], outputs: list[Tensor]) -> list[Tensor | None]:
    return [x if want else None for want, x in zip(wanted, outputs, strict=True)]


_SPECS = (
    "x[M,I] rows, weight[O,I] filled, bias?[O], residual?[M,P] rows, activation integer(0,1) -> out[M,P], z?[M,O]",
    "x[M,I] rows, weight[O,I] filled, bias?[O], z?[M,O], activation integer(0,1), dout[M,P] rows"
    " -> dx?[M,I], dweight?[O,I], dbias?[O]",
)
# By whether the outputs are pairs.
_linear_kernels, _backward_kernels = (
    (
        library.Kernel(name, spec.replace("P", "O")),
        library.Kernel(f"linear_geglu{name[6:]}", spec.replace("O", "2P").replace("(0,1)", "(2,2)")),
    )
    for name, spec in zip(("linear", "linear_backward"), _SPECS, strict=True)
)


def _number_of(activation: str) -> int:
    if activation not in ACTIVATIONS:
        raise ValueError(f"linear: activation {activation!r} is unknown: choose of {', '.join(ACTIVATIONS)}")
    return ACTIVATIONS.index(activation)


def _activated(z: Tensor, activation: str) -> Tensor:
    if activation == "geglu":
        a, b = z.chunk(2, dim=1)
        return a * F.gelu(b)
    return F.relu(z) if activation == "relu" else z


def _linear_reference(x, weight, bias, residual, activation, save):
    kernel = _linear_kernels[_number_of(activation) == GEGLU]
    kernel.check(x, weight, bias, residual)
    z = F.linear(x, weight, bias)
    out = _activated(z, activation)
    out = out if residual is None else out + residual
    return out, (z.clone() if out is z else z) if save else x.new_empty(0)


def _linear_backward_reference(dout, x, weight, bias, z, activation, wanted):
    if activation != "none" and z is None:
        z = F.linear(x, weight, bias)
    if activation == "relu":
        dout = dout.masked_fill(z <= 0, 0)
    elif activation == "geglu":
        a, b = z.chunk(2, dim=1)
        phi = 0.5 * (1 + torch.erf(b * 0.5**0.5))
        density = torch.exp(-0.5 * b.square()) * 0.3989422804014327
        dout = torch.cat([dout * F.gelu(b), dout * a * (phi + b * density)], dim=1)
    else:
        dout = dout.clone()
    empty = x.new_empty(0)
    return (
        dout @ weight if wanted[0] else empty,
        dout.mT @ x if wanted[1] else empty.clone(),
        dout.sum(0) if wanted[2] else empty.clone(),
    )


def _call_linear(outputs, x, weight, bias, residual, activation, save):
    number, (out, z) = _number_of(activation), outputs
    _linear_kernels[number == GEGLU](x, weight, bias, residual, number, out, z if save else None)


def _call_linear_backward(outputs, dout, x, weight, bias, z, activation, wanted):
    number = _number_of(activation)
    _backward_kernels[number == GEGLU](x, weight, bias, z, number, dout, *_given(wanted, outputs))


def _new_linear(x, weight, bias, residual, activation, save):
    out = x.new_empty(x.shape[0], weight.shape[0] // (2 if activation == "geglu" else 1))
    return out, x.new_empty((x.shape[0], weight.shape[0]) if save else (0,))


def _new_linear_backward(dout, x, weight, bias, z, activation, wanted):
    return tuple(_outputs(x, wanted, [x.shape, weight.shape, weight.shape[:1]]))


_linear = library.define(
    "linear(Tensor x, Tensor weight, Tensor? bias, Tensor? residual, str activation, bool save) -> (Tensor, Tensor)",
    _linear_reference,
    _new_linear,
    _call_linear,
)
_linear_backward = library.define(
    "linear_backward(Tensor dout, Tensor x, Tensor weight, Tensor? bias, Tensor? z, str activation, bool[3] wanted)"
    " -> (Tensor, Tensor, Tensor)",
    _linear_backward_reference,
    _new_linear_backward,
    _call_linear_backward,
)


def _save_linear(ctx, inputs, output) -> None:
    x, weight, bias, residual, ctx.activation, save = inputs
    out, z = output
    ctx.set_materialize_grads(False)  # z has no gradient
    ctx.mark_non_differentiable(z)
    if not save:  # the gradient of ReLU needs only its output
        z = out if ctx.activation == "relu" and residual is None else None
    ctx.save_for_backward(x, weight, bias, z)


def _linear_gradient(ctx, dout, _):
    x, weight, bias, z = ctx.saved_tensors
    wanted = list(ctx.needs_input_grad[:3])
    gradients = _linear_backward(dout, x, weight, bias, z, ctx.activation, wanted) if any(wanted) else [None] * 3
    return *_given(wanted, gradients), dout if ctx.needs_input_grad[3] else None, None, None


library.differentiate(_linear, _save_linear, _linear_gradient)
library.differentiate_by_composition(_linear_backward, (4,))


def linear(
    x: Tensor, weight: Tensor, bias: Tensor | None = None, activation: str = "none", residual: Tensor | None = None
) -> Tensor:
    """act(x W^T + b) + residual in one pass.

    A row of the result depends only on that row of x, bit for bit. The gradients have the same bits for any number of
    threads.

    Args:
        x: [M, I]; rows may lie apart, as in a slice of columns.
        weight: [O, I].
        bias: [O].
        activation: "none", "relu", or "geglu": a * gelu(b) with a and b the halves of the O columns.
        residual: [M, O], or [M, O / 2] for "geglu".

    Returns:
        [M, O], or [M, O / 2] for "geglu".

    Raises:
        ValueError: shapes or the activation are not as above.
    """
    save = False
    if activation == "geglu" or (activation == "relu" and residual is not None):
        small = x.shape[0] * weight.shape[0] <= SAVED
        save = small and torch.is_grad_enabled() and any(y is not None and y.requires_grad for y in (x, weight, bias))
    return _linear(x, weight, bias, residual, activation, save)[0]

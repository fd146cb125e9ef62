"""Dense layers with what follows them: one layer, and two of them with a LayerNorm.

Legend: M rows, I inputs, H hidden units, O outputs.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from ast_sim.ops import library
from ast_sim.ops.library import dense, dense_rows

ACTIVATIONS = ("none", "relu", "geglu")
SAVED = 1 << 24  # elements of the input of an activation up to which it is kept for the gradient, not computed again


def _outputs(like: Tensor, wanted: list[bool], shapes: list) -> list[Tensor]:
    """A fresh tensor of each shape, empty where it is not wanted: an op cannot return None."""
    return [like.new_empty(tuple(shape) if want else (0,)) for want, shape in zip(wanted, shapes, strict=True)]


def _given(wanted: list[bool], outputs: list[Tensor]) -> list[Tensor | None]:
    return [x if want else None for want, x in zip(wanted, outputs, strict=True)]


def _check_shapes(op: str, x: Tensor, weight: Tensor, inputs: int | None = None) -> None:
    if x.dim() != 2 or weight.dim() != 2:
        raise ValueError(f"{op}: x and weight must be matrices, not {tuple(x.shape)} and {tuple(weight.shape)}")
    inputs = x.shape[1] if inputs is None else inputs
    if weight.shape[1] != inputs or not weight.numel():
        raise ValueError(f"{op}: weight must have shape [O, {inputs}], not {tuple(weight.shape)}")


def _check_vectors(op: str, vectors: dict[str, Tensor | None], length: int) -> None:
    for name, x in vectors.items():
        if x is not None and x.shape != (length,):
            raise ValueError(f"{op}: {name} must have shape [{length}], not {tuple(x.shape)}")


def _check_rows(op: str, name: str, x: Tensor | None, rows: int, columns: int) -> None:
    if x is not None and x.shape != (rows, columns):
        raise ValueError(f"{op}: {name} must have shape [{rows}, {columns}], not {tuple(x.shape)}")


# ---- one layer ----


def _columns(weight: Tensor, activation: str) -> int:
    return weight.shape[0] // 2 if activation == "geglu" else weight.shape[0]


def _check_linear(x: Tensor, weight: Tensor, bias: Tensor | None, activation: str) -> None:
    if activation not in ACTIVATIONS:
        raise ValueError(f"linear: activation {activation!r} is unknown: choose of {', '.join(ACTIVATIONS)}")
    _check_shapes("linear", x, weight)
    _check_vectors("linear", {"bias": bias}, weight.shape[0])
    if activation == "geglu" and weight.shape[0] % 2:
        raise ValueError(f"linear: geglu takes an even number of outputs, not {weight.shape[0]}")


def _activated(z: Tensor, activation: str) -> Tensor:
    if activation == "geglu":
        a, b = z.chunk(2, dim=1)
        return a * F.gelu(b)
    return F.relu(z) if activation == "relu" else z


def _linear_reference(x, weight, bias, residual, activation, save):
    _check_linear(x, weight, bias, activation)
    z = F.linear(x, weight, bias)
    out = _activated(z, activation)
    _check_rows("linear", "residual", residual, *out.shape)
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


def _linear_kernel(x, weight, bias, residual, activation, save):
    _check_linear(x, weight, bias, activation)
    out, z = _linear_fake(x, weight, bias, residual, activation, save)
    _check_rows("linear", "residual", residual, *out.shape)
    inputs = (dense_rows(x), dense(weight), dense(bias), dense_rows(residual), ACTIVATIONS.index(activation))
    library._C.linear(*inputs, out, z if save else None)
    return out, z


def _linear_backward_kernel(dout, x, weight, bias, z, activation, wanted):
    outputs = _linear_backward_fake(dout, x, weight, bias, z, activation, wanted)
    inputs = (dense_rows(x), dense(weight), dense(bias), dense(z), ACTIVATIONS.index(activation), dense_rows(dout))
    library._C.linear_backward(*inputs, *_given(wanted, outputs))
    return outputs


def _linear_fake(x, weight, bias, residual, activation, save):
    out = x.new_empty(x.shape[0], _columns(weight, activation))
    return out, x.new_empty((x.shape[0], weight.shape[0]) if save else (0,))


def _linear_backward_fake(dout, x, weight, bias, z, activation, wanted):
    return tuple(_outputs(x, wanted, [x.shape, weight.shape, weight.shape[:1]]))


_linear = library.define(
    "linear(Tensor x, Tensor weight, Tensor? bias, Tensor? residual, str activation, bool save) -> (Tensor, Tensor)",
    _linear_kernel,
    _linear_reference,
    _linear_fake,
)
_linear_backward = library.define(
    "linear_backward(Tensor dout, Tensor x, Tensor weight, Tensor? bias, Tensor? z, str activation, bool[3] wanted)"
    " -> (Tensor, Tensor, Tensor)",
    _linear_backward_kernel,
    _linear_backward_reference,
    _linear_backward_fake,
)


def _save_linear(ctx, inputs, output) -> None:
    x, weight, bias, residual, ctx.activation, save = inputs
    out, z = output
    ctx.set_materialize_grads(False)  # nothing comes back through the others
    ctx.mark_non_differentiable(z)
    if not save:  # ReLU alone leaves in its output what its gradient needs
        z = out if ctx.activation == "relu" and residual is None else None
    ctx.save_for_backward(x, weight, bias, z)


def _linear_gradient(ctx, dout, _):
    x, weight, bias, z = ctx.saved_tensors
    wanted = list(ctx.needs_input_grad[:3])
    gradients = [None] * 3
    if any(wanted):
        gradients = _linear_backward(dout, x, weight, bias, z, ctx.activation, wanted)
    gradients = [g if want else None for g, want in zip(gradients, wanted, strict=True)]
    return *gradients, dout if ctx.needs_input_grad[3] else None, None, None


library.differentiate(_linear, _save_linear, _linear_gradient)


def linear(
    x: Tensor, weight: Tensor, bias: Tensor | None = None, activation: str = "none", residual: Tensor | None = None
) -> Tensor:
    """act(x W^T + b) + residual in one pass.

    A row's result depends on that row alone, bit for bit; the gradients are the same for any number of threads.

    Args:
        x: [M, I]; rows may lie apart, as in a slice of columns.
        weight: [O, I].
        bias: [O].
        activation: "none", "relu", or "geglu": a * gelu(b) with a and b the halves of the O columns.
        residual: [M, O], or [M, O / 2] for "geglu".

    Returns:
        [M, O], or [M, O / 2] for "geglu".

    Raises:
        ValueError: for shapes or an activation that are not as above.
    """
    save = False
    if activation == "geglu" or (activation == "relu" and residual is not None):
        small = x.shape[0] * weight.shape[0] <= SAVED
        save = small and torch.is_grad_enabled() and any(y is not None and y.requires_grad for y in (x, weight, bias))
    return _linear(x, weight, bias, residual, activation, save)[0]

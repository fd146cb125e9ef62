"""One dense layer with its activation and a residual, and the precision in which ops multiply.

Legend: M rows, I inputs, O outputs.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
import torch.nn.functional as F
from torch import Tensor

from ast_sim.ops import library
from ast_sim.ops.derivatives import gradient_op
from ast_sim.ops.library import Kernel, Op, is_at_most
from ast_sim.support.errors import warn
from ast_sim.support.precisions import Precision, require_precision

ACTIVATIONS = ("none", "relu", "geglu")
RELU, GEGLU = 1, 2  # as numbers
_FASTER = library.configuration()["bfloat16"] is not None  # in bfloat16
SAVED = 1 << 24  # an activation's input with more elements is not kept for the gradient, but computed again


# What stands behind `linear` and `linear_backward` in a spec; P is O, or O/2 for "geglu".
_INPUTS = "x[M,I] rows_apart, weight[O,I] rows_apart filled, bias?[O]"
_SPEC = f"{_INPUTS}, residual?[M,P] rows_apart added, activation integer(0,1); save switch -> out[M,P], z[M,O] if(save)"
_BACKWARD_SPEC = (
    f"dout[M,P] rows_apart late, {_INPUTS}, z?[M,O], activation integer(0,1); wanted wants(x,weight,bias)"
    " -> dx[M,I] if(wanted), dweight[O,I] if(wanted), dbias[O] if(wanted)"
)


def _plain(name: str, spec: str) -> Kernel:
    return Kernel(name, spec.replace("P", "O"))


def _pairs(name: str, spec: str) -> Kernel:
    return Kernel(name, spec.replace("O", "2P").replace("(0,1)", "(2,2)"))


def _linear_reference(x, weight, bias, residual, activation, save):
    z = out = F.linear(x, weight, bias)
    if activation == GEGLU:
        a, b = z.chunk(2, dim=1)
        out = a * F.gelu(b)
    elif activation == RELU:
        out = F.relu(z)
    if residual is not None:
        out = out + residual
    if not save:
        return out, None
    return out, z.clone() if out is z else z


def _known_z(given: dict):
    """The gradient of ReLU needs only its output."""
    return given["out"] if given["activation"] == RELU and given["residual"] is None else given["z"]


_linear = Op(_plain("linear", _SPEC), _linear_reference)
_linear_backward = gradient_op(_linear, _plain("linear_backward", _BACKWARD_SPEC), {"z": _known_z})
_geglu = Op(_pairs("linear_geglu", _SPEC), _linear_reference)
_geglu_backward = gradient_op(_geglu, _pairs("linear_geglu_backward", _BACKWARD_SPEC))


def linear(
    x: Tensor, weight: Tensor, bias: Tensor | None = None, activation: str = "none", residual: Tensor | None = None
) -> Tensor:
    """act(x W^T + b) + residual in one pass.

    A row of the result depends only on that row of x, bit for bit. The gradients have the same bits for any number of
    threads.

    Args:
        x: [M, I]; rows may lie apart, as in a slice of columns.
        weight: [O, I]; rows may lie apart, too.
        bias: [O].
        activation: "none", "relu", or "geglu": a * gelu(b) with a and b the halves of the O columns.
        residual: [M, O], or [M, O / 2] for "geglu".

    Returns:
        [M, O], or [M, O / 2] for "geglu".

    Raises:
        ValueError: shapes or the activation are not as above.
    """
    if activation not in ACTIVATIONS:
        raise ValueError(f"linear: activation {activation!r} is unknown: choose of {', '.join(ACTIVATIONS)}")
    save = False
    if activation == "geglu" or (activation == "relu" and residual is not None):
        small = is_at_most(x.shape[0] * weight.shape[0], SAVED)
        save = small and torch.is_grad_enabled() and any(y is not None and y.requires_grad for y in (x, weight, bias))
    op = _geglu if activation == "geglu" else _linear
    return op(x, weight, bias, residual, ACTIVATIONS.index(activation), save)[0]


@contextmanager
def products_in(precision: Precision) -> Iterator[None]:
    """The ops of this thread multiply in this precision meanwhile.

    With "bfloat16" `linear`, `mlp`, `message_sum`, `message_edges`, `attention_block`, `sparse_conv`,
    `sparse_conv_transposed` and the gradients of their inputs round both factors of a product of at least 32 inputs to
    8 binary digits, and attention the factors of its scores and of the weighted values. Sums, activations, the
    gradients of weights and of attention stay in float32. All results depend on neither threads nor batch, as in
    float32.

    Warns, and changes nothing, where the processor multiplies no faster in bfloat16 (it has neither AMX nor, from AMD,
    AVX512-BF16), and where AST_SIM_ISA or AST_SIM_BACKEND chooses other kernels.

    Raises:
        ConfigError: there is no such precision.
    """
    require_precision(precision)
    if not _FASTER:
        if precision != "float32":
            warn("this processor is no faster in bfloat16, or its kernels were not chosen: float32 is used")
        yield
        return
    before = library._C.multiply_in_bfloat16(precision == "bfloat16")
    try:
        yield
    finally:
        library._C.multiply_in_bfloat16(before)

"""How a kernel of the C core becomes a torch op.

Every op has two bodies of the same meaning: the C kernel, for float32 on the CPU, and a composition of torch ops, which
is its reference in the tests and runs for any other device or dtype, or everywhere with AST_SIM_BACKEND=torch.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

BACKEND = os.environ.get("AST_SIM_BACKEND", "c")
if BACKEND not in ("c", "torch"):
    raise ImportError(f"AST_SIM_BACKEND={BACKEND} is unknown: choose c or torch")

_library = torch.library.Library("ast_sim", "DEF")


def _share_torch_threads() -> None:
    """Hand torch's thread pool (C symbols of libtorch_cpu since torch 2.10) to the C core; else it is serial."""
    name = {"darwin": "libtorch_cpu.dylib", "win32": "torch_cpu.dll"}.get(sys.platform, "libtorch_cpu.so")
    try:
        library = ctypes.CDLL(str(Path(torch.__file__).parent / "lib" / name))
        pool = [library.torch_parallel_for, library.torch_get_num_threads]
    except (OSError, AttributeError):
        return
    _C.set_pool(*(ctypes.cast(function, ctypes.c_void_p).value for function in pool))


if BACKEND == "c":
    from ast_sim import _C

    _share_torch_threads()


class Op:
    """An op as its users call it; `overload` is what torch knows of it.

    A call goes through torch's dispatcher only where something may stand between the caller and the kernel: tracing, a
    dispatch mode, autocast, functorch, other devices and dtypes. For plain float32 tensors on the CPU the dispatcher
    would cost more than a small kernel takes. With AST_SIM_BACKEND=torch an op is its composition, which torch
    differentiates as it would any other code.
    """

    def __init__(self, name: str, overload: torch._ops.OpOverload, kernel: Callable, reference: Callable) -> None:
        self.name, self.overload, self.kernel, self.reference = name, overload, kernel, reference
        self.function: type[torch.autograd.Function] | None = None  # set by `differentiate`

    def __call__(self, *args):
        if BACKEND == "torch":
            return self.reference(*args)
        if torch.compiler.is_compiling():
            return self.overload(*args)
        wants_gradient = False
        for x in args:
            if isinstance(x, torch.Tensor):
                if type(x) not in _PLAIN_TYPES or x.dtype not in _PLAIN_DTYPES or not x.is_cpu:
                    return self.overload(*args)
                wants_gradient = wants_gradient or x.requires_grad
        if _is_watched():
            return self.overload(*args)
        if wants_gradient and self.function and torch.is_grad_enabled():
            return self.function.apply(*args)
        return self.kernel(*args)


_PLAIN_TYPES = (torch.Tensor, torch.nn.Parameter)
_PLAIN_DTYPES = (torch.float32, torch.int64, torch.int32)


def _is_watched() -> bool:
    """Whether a mode, a transform or a tracer must see the op."""
    return (
        torch._C._len_torch_dispatch_stack() > 0
        or torch._C._are_functorch_transforms_active()
        or torch.is_autocast_enabled("cpu")
        or torch.jit.is_tracing()
    )


def define(schema: str, kernel: Callable, reference: Callable, fake: Callable) -> Op:
    """Register the op `ast_sim::<schema>`.

    Args:
        schema: name and signature in torch's schema language; functional, fresh outputs only.
        kernel: the body over the C core; called with CPU tensors whose floating ones are all float32.
        reference: the same as a composition of torch ops, for any device and dtype.
        fake: the shapes of the outputs, for tracing.
    """
    name = schema.split("(")[0]

    def on_cpu(*args):
        floats = [x for x in args if isinstance(x, torch.Tensor) and x.is_floating_point()]
        if BACKEND == "torch" or any(x.dtype != torch.float32 for x in floats):
            return reference(*args)
        for x in args:
            if isinstance(x, torch.Tensor) and x.device.type != "cpu":
                raise ValueError(f"{name}: all tensors must lie on one device, found {x.device} beside cpu")
        return kernel(*args)

    _library.define(schema)
    _library.impl(name, on_cpu, "CPU")
    _library.impl(name, reference, "CompositeExplicitAutograd")
    torch.library.register_fake(f"ast_sim::{name}", fake, lib=_library)
    torch.library.register_autocast(f"ast_sim::{name}", "cpu", torch.float32, lib=_library)
    return Op(name, getattr(torch.ops.ast_sim, name).default, kernel, reference)


def differentiate(op: Op, setup_context: Callable, backward: Callable) -> None:
    """Register the gradient of an op; `backward` calls ops only, so that it can be traced.

    It is not called where nothing comes back, which happens if `setup_context` turned materialized zeros off.
    """

    def backward_of_some(ctx, *gradients):
        if all(gradient is None for gradient in gradients):
            return (None,) * len(ctx.needs_input_grad)
        return backward(ctx, *gradients)

    torch.library.register_autograd(op.overload.name(), backward_of_some, setup_context=setup_context, lib=_library)

    def forward(ctx, *args):
        output = op.kernel(*args)
        setup_context(ctx, args, output)
        return output

    body = {"forward": staticmethod(forward), "backward": staticmethod(backward_of_some)}
    op.function = type(f"ast_sim_{op.name}", (torch.autograd.Function,), body)


def dense(x: torch.Tensor | None) -> torch.Tensor | None:
    """The tensor as the C core takes it, contiguous and aligned; a copy only where it is not. None stays None."""
    if x is None or x.is_contiguous() and not x.data_ptr() % x.element_size() and not x.is_neg():
        return x
    return x.detach().resolve_neg().clone(memory_format=torch.contiguous_format)


def dense_rows(x: torch.Tensor | None) -> torch.Tensor | None:
    """The same where rows may lie apart, like those of a slice of columns or of a fused projection."""
    if x is None or x.is_contiguous() or x.dim() == 0:
        return dense(x)
    row, *inner = x.stride()
    length = 1
    for n, stride in zip(reversed(x.shape[1:]), reversed(inner), strict=True):
        if stride != length:
            return dense(x)
        length *= n
    return x if row >= length and not x.data_ptr() % x.element_size() and not x.is_neg() else dense(x)


def check_offsets(op: str, name: str, offsets: torch.Tensor, rows: int) -> None:
    """Raise ValueError unless offsets, int64 [B + 1], start with 0, never fall and end at the number of rows."""
    if offsets.dtype != torch.int64:
        raise TypeError(f"{op}: {name} must be int64, not {offsets.dtype}")
    if offsets.dim() != 1:
        raise ValueError(f"{op}: {name} must have shape [*], not {tuple(offsets.shape)}")
    if len(offsets) < 1 or offsets[0] != 0:
        raise ValueError(f"{op}: {name} must start with 0")
    falls = (offsets.diff() < 0).nonzero()
    if len(falls):
        at = int(falls[0]) + 1
        raise ValueError(f"{op}: {name} must never fall, but falls to {int(offsets[at])} at {at}")
    if offsets[-1] != rows:
        raise ValueError(f"{op}: {name} must end at the number of rows {rows}, not {int(offsets[-1])}")


def configuration() -> dict:
    """What runs here: the backend, the instruction set, the threads and the versions."""
    core = _C.configuration() if BACKEND == "c" else {}
    return {
        "backend": BACKEND,
        "instruction_set": core.get("isa", "-"),
        "supported": core.get("supported", []),
        "threads": torch.get_num_threads(),
        "core_threads": core.get("threads", 0),
        "debug": core.get("debug", False),
        "torch": torch.__version__,
        "numpy": np.__version__,
        "python": sys.version.split()[0],
    }


def show_config() -> None:
    """Print what runs here: the backend, the chosen instruction set, the threads and the versions."""
    for name, value in configuration().items():
        print(f"{name:16} {', '.join(value) if isinstance(value, list) else value}")


def keep_memory() -> bool:
    """Let the C library keep large freed blocks instead of giving them back to the system at every free.

    Fresh pages cost more than the arithmetic on them: this can double the speed of training on the CPU, at the price of
    a process that holds its peak memory. Process-wide; returns whether it had an effect (glibc only).
    AST_SIM_KEEP_MEMORY=0 turns it off.
    """
    if BACKEND == "torch" or os.environ.get("AST_SIM_KEEP_MEMORY") == "0":
        return False
    return _C.keep_memory()

"""How a kernel of the C core becomes a torch op.

Every op has two bodies that compute the same: a C kernel for float32 on the CPU, and a composition of torch ops. The
composition is the reference in the tests. It runs for every other device and dtype, and with AST_SIM_BACKEND=torch
everywhere.
"""

from __future__ import annotations

import ctypes
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

BACKEND = os.environ.get("AST_SIM_BACKEND", "c")
if BACKEND not in ("c", "torch"):
    raise ImportError(f"AST_SIM_BACKEND={BACKEND} is unknown: choose c or torch")

_library = torch.library.Library("ast_sim", "DEF")


def _share_torch_threads() -> None:
    """Hand torch's thread pool to the C core. Without it (torch before 2.10) the core runs on one thread, and warns."""
    name = {"darwin": "libtorch_cpu.dylib", "win32": "torch_cpu.dll"}.get(sys.platform, "libtorch_cpu.so")
    try:
        library = ctypes.CDLL(str(Path(torch.__file__).parent / "lib" / name))
        pool = [library.torch_parallel_for, library.torch_get_num_threads]
    except (OSError, AttributeError) as error:
        warnings.warn(
            f"ast_sim's kernels run on one thread, as torch {torch.__version__} does not offer its own ({error}): "
            "install torch 2.10 or later, or set AST_SIM_BACKEND=torch to run torch's ops instead",
            stacklevel=2,
        )
        return
    _C.set_pool(*(ctypes.cast(function, ctypes.c_void_p).value for function in pool))


if BACKEND == "c":
    from ast_sim import _C

    _share_torch_threads()


class Op:
    """An op as its users call it; `overload` is the same op as torch registered it.

    For plain float32 tensors on the CPU a call goes straight to the kernel: torch's dispatcher would take longer than a
    small kernel does. The dispatcher is used for tracing, dispatch modes, autocast, functorch, other devices and other
    dtypes. With AST_SIM_BACKEND=torch an op is its composition, and torch differentiates it like any other code.
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


def define(schema: str, reference: Callable, fake: Callable, kernel: Callable | None = None) -> Op:
    """Register the op `ast_sim::<schema>`.

    Args:
        schema: name and signature in torch's schema language. The op changes no input, and no output is a view of one.
        reference: the body as a composition of torch ops, for any device and dtype.
        fake: makes outputs of the right shapes without values, for tracing.
        kernel: the body over the C core. It gets CPU tensors; those of floating point are float32. None: the function
            of the C core with the op's name, which takes the op's arguments and then the outputs of `fake` to fill.
    """
    name = schema.split("(")[0]

    def fill(*args):
        outputs = fake(*args)
        inputs = (dense(x) if isinstance(x, torch.Tensor) else x for x in args)
        getattr(_C, name)(*inputs, *(outputs if isinstance(outputs, tuple) else (outputs,)))
        return outputs

    kernel = kernel or fill

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
    """Register the gradient of an op. `backward` calls ops only, so that it can be traced.

    `backward` is not called if all gradients of the outputs are None. That happens only where `setup_context` has
    called `set_materialize_grads(False)`.
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
    """The tensor contiguous and aligned, as the C core takes it: copied only if it is not. None stays None."""
    if x is None or x.is_contiguous() and not x.data_ptr() % x.element_size() and not x.is_neg():
        return x
    return x.detach().resolve_neg().clone(memory_format=torch.contiguous_format)


def dense_rows(x: torch.Tensor | None) -> torch.Tensor | None:
    """Like `dense`, but the rows may lie apart in memory, as in a slice of columns or in a fused projection."""
    if x is None or x.is_contiguous() or x.dim() == 0:
        return dense(x)
    row, *inner = x.stride()
    length = 1
    for n, stride in zip(reversed(x.shape[1:]), reversed(inner), strict=True):
        if stride != length:
            return dense(x)
        length *= n
    return x if row >= length and not x.data_ptr() % x.element_size() and not x.is_neg() else dense(x)


def check_shape(op: str, name: str, x: torch.Tensor | None, *shape: int) -> None:
    """Raise ValueError unless x has this shape; -1 stands for any size. None passes."""
    if x is None or x.shape == shape:
        return
    if x.dim() != len(shape) or any(n not in (-1, size) for n, size in zip(shape, x.shape, strict=True)):
        wanted = ", ".join("*" if n < 0 else str(n) for n in shape)
        raise ValueError(f"{op}: {name} must have shape [{wanted}], not {tuple(x.shape)}")


def check_offsets(op: str, name: str, offsets: torch.Tensor, rows: int) -> None:
    """Raise ValueError unless the offsets [B + 1] start with 0, never fall and end at the number of rows.

    Raise TypeError unless they are int64.
    """
    if offsets.dtype != torch.int64:
        raise TypeError(f"{op}: {name} must be int64, not {offsets.dtype}")
    check_shape(op, name, offsets, -1)
    if len(offsets) < 1 or offsets[0] != 0:
        raise ValueError(f"{op}: {name} must start with 0")
    falls = (offsets.diff() < 0).nonzero()
    if len(falls):
        at = int(falls[0]) + 1
        raise ValueError(f"{op}: {name} must never fall, but falls to {int(offsets[at])} at {at}")
    if offsets[-1] != rows:
        raise ValueError(f"{op}: {name} must end at the number of rows {rows}, not {int(offsets[-1])}")


def check_index(op: str, name: str, index: torch.Tensor, bound: int) -> None:
    """Raise ValueError unless all values of an index lie in [0, bound). The message names the first that does not."""
    wrong = ((index < 0) | (index >= bound)).nonzero()
    if len(wrong):
        at = wrong[0].tolist()
        place, value = ", ".join(map(str, at)), int(index[tuple(at)])
        raise ValueError(f"{op}: {name}[{place}] = {value} is not an index below {bound}")


def segment_of(offsets: torch.Tensor) -> torch.Tensor:
    """[N] int64: the segment of each row, from the offsets [C + 1] of the segments."""
    return torch.arange(len(offsets) - 1, device=offsets.device).repeat_interleave(offsets.diff())


def configuration() -> dict:
    """The backend, the instruction sets, the threads and the versions in use, by name."""
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
    """Print the backend, the chosen instruction set, the threads and the versions in use."""
    for name, value in configuration().items():
        print(f"{name:16} {', '.join(value) if isinstance(value, list) else value}")


def keep_memory() -> bool:
    """Let the C library keep large freed blocks of memory instead of giving them back to the system.

    This can double the speed of training on the CPU, because fresh pages cost more than the arithmetic on them. In
    return the process never holds less memory than at its peak. The call acts on the whole process and has an effect
    with glibc only; it does nothing if AST_SIM_KEEP_MEMORY=0 is set.

    Returns:
        Whether it had an effect.
    """
    if BACKEND == "torch" or os.environ.get("AST_SIM_KEEP_MEMORY") == "0":
        return False
    return _C.keep_memory()

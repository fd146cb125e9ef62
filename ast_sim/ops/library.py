"""How a kernel of the C core becomes a torch op.

Every op has two bodies that compute the same: a C kernel for float32 on the CPU, and a composition of torch ops. The
composition is the reference in the tests. It runs for every other device and dtype, and with AST_SIM_BACKEND=torch
everywhere.

Kernels know the first derivative, backwards. All others are those of the composition: higher ones
(`create_graph=True`), tangents (`torch.autograd.forward_ad`) and everything in `torch.func`. With `vmap` the indices of
an op must be the same for every sample.
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
from torch import Tensor
from torch.autograd import forward_ad

from ast_sim.ops import spec as specs

BACKEND = os.environ.get("AST_SIM_BACKEND", "c")
if BACKEND not in ("c", "torch"):
    raise ImportError(f"AST_SIM_BACKEND={BACKEND} is unknown: choose c or torch")

LIBRARY = torch.library.Library("ast_sim", "DEF")


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


class Kernel:
    """A function of the C core and what it takes."""

    def __init__(self, name: str, spec: str) -> None:
        self.name, self.parameters = name, specs.parameters_of(spec)
        inputs = [(i, p) for i, p in enumerate(self.parameters) if p.shape is not None and not p.output]
        self._layouts = [(i, dense_rows if "rows" in p.words else dense) for i, p in inputs]
        self._floats = [i for i, p in inputs if p.dtype.is_floating_point]
        if BACKEND == "c":
            places = {p.name: i for i, p in enumerate(self.parameters)}
            _C.declare(name, tuple(p.numbers(places) for p in self.parameters))

    def __call__(self, *arguments):
        """Call the C core. Inputs are copied if they do not lie in memory as the kernel needs them.

        Nearly all of them do. The core notices where one does not, and says so before it does anything. What it cannot
        see is whether a tensor is the negative of its memory.
        """
        function, failure = getattr(_C, self.name), None
        for i in self._floats:
            if (x := arguments[i]) is not None and x.is_neg():
                break
        else:
            try:
                return function(*arguments)
            except ValueError as error:
                failure = error
        copies = list(arguments)
        for i, layout in self._layouts:
            copies[i] = layout(arguments[i])
        if failure and all(x is y for x, y in zip(arguments, copies, strict=True)):
            raise failure
        return function(*copies)

    def check(self, *first: Tensor | float | None, **given: Tensor | float | None) -> None:
        """Raise what the C core would raise for the first arguments and for those by name, for the composition."""
        names = (p.name for p in self.parameters)
        specs.check(self.name, self.parameters, dict(zip(names, first, strict=False)) | given)


class Op:
    """An op as its users call it; `overload` is the same op as torch registered it.

    For plain float32 tensors on the CPU a call goes straight to the kernel: torch's dispatcher would take longer than a
    small kernel does. The dispatcher is used for tracing, dispatch modes, autocast, functorch, other devices and other
    dtypes. Tangents and functorch take the composition. With AST_SIM_BACKEND=torch an op is its composition, and torch
    differentiates it like any other code.
    """

    def __init__(self, name: str, overload: torch._ops.OpOverload, kernel: Callable, reference: Callable) -> None:
        self.name, self.overload, self.kernel, self.reference = name, overload, kernel, reference
        self.function: type[torch.autograd.Function] | None = None  # set by `derivatives.differentiate`
        self.kept: tuple[int, ...] = ()  # set by `differentiate_by_composition`

    def __call__(self, *args):
        if BACKEND == "torch":
            return self.reference(*args)
        if torch.compiler.is_compiling():
            return self.overload(*args)
        if forward_ad._current_level >= 0 and any(map(_has_tangent, args)):
            return self.compose(*args)
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

    def compose(self, *args):
        """The composition, as a function that torch can differentiate and transform in every way."""
        for argument, x in zip(self.overload._schema.arguments, args, strict=True):
            if _is_batched(x) and not (self.function and x.is_floating_point()):
                raise ValueError(
                    f"{self.name}: vmap over {argument.name} is not possible: give every sample the same, call the op"
                    " for each, or join the samples as scenes of one batch"
                )
        args = [None if i in self.kept else x for i, x in enumerate(args)]
        if not torch.is_autocast_enabled("cpu"):
            return self.reference(*args)
        with torch.autocast("cpu", enabled=False):
            return self.reference(*(x.float() if getattr(x, "dtype", None) in _LOW_DTYPES else x for x in args))


_PLAIN_TYPES = (torch.Tensor, torch.nn.Parameter)
_PLAIN_DTYPES = (torch.float32, torch.int64, torch.int32)
_LOW_DTYPES = (torch.float16, torch.bfloat16)


def _has_tangent(x) -> bool:
    return isinstance(x, torch.Tensor) and forward_ad.unpack_dual(x).tangent is not None


def is_differentiated(x: torch.Tensor) -> bool:
    """Whether x has a gradient or a tangent, or belongs to a transform of torch.func."""
    return x.requires_grad or _has_tangent(x) or torch._C._functorch.is_functorch_wrapped_tensor(x)


def _is_batched(x) -> bool:
    """Whether x is another tensor for each sample of a vmap."""
    functorch = torch._C._functorch
    while isinstance(x, torch.Tensor) and functorch.is_functorch_wrapped_tensor(x):
        if functorch.is_batchedtensor(x):
            return True
        x = functorch.get_unwrapped(x)
    return False


def _is_watched() -> bool:
    """Whether a mode, a transform or a tracer must see the op."""
    return (
        torch._C._len_torch_dispatch_stack() > 0
        or torch._C._are_functorch_transforms_active()
        or torch.is_autocast_enabled("cpu")
        or torch._C._is_tracing()
    )


def define(
    schema: str, reference: Callable, outputs: Callable, call: Kernel | Callable, fake: Callable | None = None
) -> Op:
    """Register the op `ast_sim::<schema>`.

    Args:
        schema: name and signature in torch's schema language. The op changes no input, and no output is a view of one.
        reference: the body as a composition of torch ops, for any device and dtype.
        outputs: makes the outputs without values, a tensor or a tuple, from the op's arguments.
        call: fills them through the C core: call(outputs, *arguments). It gets CPU tensors; those of floating point are
            float32. What it returns stands for the outputs, unless it is None. A kernel takes the op's arguments and
            then the outputs.
        fake: makes outputs of the right shapes for tracing, where `outputs` does not because they depend on values.
    """
    name = schema.split("(")[0]

    def kernel(*args):
        out = outputs(*args)
        result = call(*args, *(out if isinstance(out, tuple) else (out,))) if is_kernel else call(out, *args)
        return out if result is None else result

    is_kernel = isinstance(call, Kernel)

    def on_cpu(*args):
        floats = [x for x in args if isinstance(x, torch.Tensor) and x.is_floating_point()]
        if BACKEND == "torch" or any(x.dtype != torch.float32 for x in floats):
            return reference(*args)
        for x in args:
            if isinstance(x, torch.Tensor) and x.device.type != "cpu":
                raise ValueError(f"{name}: all tensors must lie on one device, found {x.device} beside cpu")
        return kernel(*args)

    LIBRARY.define(schema)
    LIBRARY.impl(name, on_cpu, "CPU")
    LIBRARY.impl(name, reference, "CompositeExplicitAutograd")
    torch.library.register_fake(f"ast_sim::{name}", fake or outputs, lib=LIBRARY)
    torch.library.register_autocast(f"ast_sim::{name}", "cpu", torch.float32, lib=LIBRARY)
    op = Op(name, getattr(torch.ops.ast_sim, name).default, kernel, reference)
    LIBRARY.impl(name, op.compose, "FuncTorchDynamicLayerFrontMode")  # comes first under each transform of torch.func
    return op


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


def frozen(*indices: Tensor) -> tuple[Tensor, ...]:
    """Copies of int64 tensors that the C core trusts: it keeps the values in memory of its own and checks them once.

    So nobody should write to the copies: kernels would not see it. Other tensors are copied and checked in every call.
    """
    if BACKEND == "torch" or torch.compiler.is_compiling() or torch._C._len_torch_dispatch_stack() > 0:
        return indices
    return tuple([x if y is x else torch.from_numpy(y) for x, y in zip(indices, _C.freeze(*indices), strict=True)])


def freeze(record: object, *names: str) -> None:
    """Make these attributes of a frozen dataclass `frozen`, when it is built."""
    values = record.__dict__
    values.update(zip(names, frozen(*[values[name] for name in names]), strict=True))


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

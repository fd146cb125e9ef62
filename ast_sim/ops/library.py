"""How a kernel of the C core becomes a torch op.

Every op has two bodies that compute the same: a C kernel for float32 on the CPU, and a composition of torch ops. The
composition is the reference in the tests. It runs for every other device and dtype, and with AST_SIM_BACKEND=torch
everywhere.

Kernels know the first derivative, backwards. The composition gives all others: higher ones
(`create_graph=True`), tangents (`torch.autograd.forward_ad`) and everything in `torch.func`. With `vmap` the indices of
an op must be the same for every sample.
"""

from __future__ import annotations

import ctypes
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch._C._functorch import get_unwrapped, is_batchedtensor, is_functorch_wrapped_tensor
from torch.autograd import forward_ad
from torch.fx.experimental.proxy_tensor import disable_proxy_modes_tracing

from ast_sim.ops.spec import Argument, Given, Sizes, Spec, check
from ast_sim.support.environment import c_core, check_variables, variable

check_variables()
BACKEND = variable("AST_SIM_BACKEND")

LIBRARY = torch.library.Library("ast_sim", "DEF")
OPS: dict[str, Op] = {}  # by name


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


if TYPE_CHECKING or BACKEND == "c":
    _C = c_core()
    _share_torch_threads()


class Kernel:
    """A function of the C core and what it takes (`spec.py`).

    Args:
        name: of the function.
        spec: what it takes and gives.
        more: raises ValueError for what no word of the spec says: more(name, sizes by letter, arguments by name).
    """

    def __init__(self, name: str, spec: str, more: Callable[[str, Sizes, Given], None] | None = None) -> None:
        self.name = name
        self.spec = Spec(spec)
        self.more = more
        self._num = len(self.spec.taken)
        self._parameters = self.spec.taken + self.spec.outputs
        self._floats = [i for i, p in enumerate(self.spec.taken) if p.shape is not None and p.dtype.is_floating_point]
        if BACKEND == "c":
            places = {p.name: i for i, p in enumerate(self._parameters)}
            numbers = [n for p in self._parameters for n in p.numbers(places, _C.checks.split())]
            _C.declare(name, ", ".join(places), np.array(numbers, np.int64).tobytes())

    def __call__(self, *arguments):
        """Call the C core with what it takes and with outputs. Inputs are copied if they do not lie as it reads them.

        The core sees which do not, before it does anything. It cannot see whether a tensor is the negative of its
        memory. It says what it refuses, but not why: the checks here do.
        """
        function = getattr(_C, self.name)
        try:
            for i in self._floats:
                if (x := arguments[i]) is not None and x.is_neg():
                    raise BufferError
            return function(*arguments)
        except BufferError:
            try:
                return function(*map(contiguous, arguments[: self._num], self._parameters), *arguments[self._num :])
            except ValueError as error:
                refusal = error
        except ValueError as error:
            refusal = error
        # Of copies: another thread may write to the indices meanwhile. If they are right by now, no reason is found.
        seen = [x.clone() if isinstance(x, Tensor) and not x.is_floating_point() else x for x in arguments]
        raise self._reason(self._parameters, seen, exact=True) or refusal

    def check(self, *arguments) -> None:
        """Raise ValueError or TypeError for arguments of the op that do not fit, for the composition."""
        if reason := self._reason(self.spec.inputs, arguments):
            raise reason

    def _reason(self, parameters: list[Argument], arguments: Sequence, exact: bool = False) -> Exception | None:
        given = {p.name: x for p, x in zip(parameters, arguments, strict=False)}
        try:
            sizes = check(self.name, parameters, given, exact)
            if self.more:
                self.more(self.name, sizes, given)
        except (TypeError, ValueError) as error:
            return error
        return None

    def outputs(self, *arguments) -> Any:
        """Call the C core with new outputs, unless it makes them; None stands for one that is not wanted."""
        if self.spec.counts:
            return [torch.from_numpy(x) for x in self(*arguments)]
        try:
            given = self.spec.arguments(*arguments)
        except Exception as error:  # no outputs for such arguments
            raise self._reason(self.spec.inputs, arguments) or error from None
        self(*given)
        outputs = given[self._num :]
        return outputs[0] if len(outputs) == 1 else outputs

    def run(self, *arguments) -> Any:
        """The op: what the C core computes, as an op returns it."""
        outputs = self.outputs(*arguments)
        return self.given(outputs, arguments) if isinstance(outputs, tuple) else outputs

    def fake(self, *arguments):
        """The outputs without values, for tracing."""
        outputs = self.spec.arguments(*arguments)[self._num :]
        return list(outputs) if self.spec.counts else self.given(outputs, arguments)

    @staticmethod
    def given(outputs: Sequence[Tensor | None], arguments: Sequence[Any]) -> Any:
        """The outputs as an op returns them: one that is not wanted is empty, because an op cannot return None."""
        if len(outputs) == 1:
            return outputs[0]
        return tuple([arguments[0].new_empty(0) if x is None else x for x in outputs])


def contiguous(x: Any, p: Argument) -> Any:
    """A tensor aligned and contiguous, but for rows that may lie apart; a copy only if it is not so already."""
    if not isinstance(x, Tensor) or p.shape is None:
        return x
    inside = x[0] if "rows_apart" in p.words and x.dim() and len(x) and x.stride(0) >= x[0].numel() else x
    if inside.is_contiguous() and not x.data_ptr() % x.element_size() and not x.is_neg():
        return x
    return x.detach().resolve_neg().clone(memory_format=torch.contiguous_format)


class Op:
    """An op as its users call it; `overload` is the same op as torch registered it.

    For plain float32 tensors on the CPU a call goes straight to the kernel: torch's dispatcher would take longer than a
    small kernel does, and outputs that are not wanted are None. The dispatcher is used for tracing, dispatch modes,
    autocast, functorch, other devices and other dtypes. Tangents and functorch take the composition. With
    AST_SIM_BACKEND=torch an op is its composition, and torch differentiates it like any other code.

    Args:
        kernel: the function of the core; the op has its name. The op changes no input, and no output is a view of one.
        composition: the body as a composition of torch ops, for any device and dtype. Instead of an output that is not
            wanted it returns None.
        fake: makes outputs of the right shapes for tracing, where they do not follow from the spec.
    """

    def __init__(self, kernel: Kernel, composition: Callable, fake: Callable | None = None) -> None:
        OPS[kernel.name] = self
        self.name = kernel.name
        self.spec = kernel.spec
        self.kernel = kernel
        self.composition = composition
        self.function: type[torch.autograd.Function] | None = None  # set by `derivatives.differentiate`
        LIBRARY.define(self.name + self.spec.schema)
        LIBRARY.impl(self.name, self._on_cpu, "CPU")
        LIBRARY.impl(self.name, self.reference, "CompositeExplicitAutograd")
        LIBRARY.impl(self.name, self.compose, "FuncTorchDynamicLayerFrontMode")  # first under transforms of torch.func
        torch.library.register_fake(f"ast_sim::{self.name}", fake or kernel.fake, lib=LIBRARY)
        torch.library.register_autocast(f"ast_sim::{self.name}", "cpu", torch.float32, lib=LIBRARY)
        self.overload = getattr(torch.ops.ast_sim, self.name).default

    def __call__(self, *args) -> Any:
        if BACKEND == "torch":
            return self.reference(*args)
        if torch.compiler.is_compiling():
            return self.overload(*args)
        if forward_ad._current_level >= 0 and any(map(_has_tangent, args)):
            return self.compose(*args)
        wants_gradient = False
        for x in args:
            kind = type(x)
            if kind is torch.Tensor or kind is torch.nn.Parameter:
                if x.dtype not in _PLAIN_DTYPES or not x.is_cpu:
                    return self.overload(*args)
                wants_gradient = wants_gradient or x.requires_grad
            elif kind not in _NO_TENSORS and isinstance(x, torch.Tensor):
                return self.overload(*args)
        if is_transformed() or torch.is_autocast_enabled("cpu"):  # then a mode, a transform or a tracer must see the op
            return self.overload(*args)
        if wants_gradient and self.function and torch.is_grad_enabled():
            return self.function.apply(*args)
        return self.kernel.outputs(*args)

    def reference(self, *args) -> Any:
        """The composition, after the checks. Both read what kernels read, although torch traces or somebody has
        written to frozen indices."""
        watched = torch._C._len_torch_dispatch_stack() > 0
        with disable_proxy_modes_tracing() if watched else nullcontext():
            args = _values_read(args)
            self.kernel.check(*args)
        result = self.composition(*args)
        return Kernel.given(result, args) if isinstance(result, tuple) else result

    def _on_cpu(self, *args):
        tensors = [x for x in args if isinstance(x, Tensor)]
        if BACKEND == "torch" or any(x.is_floating_point() and x.dtype != torch.float32 for x in tensors):
            return self.reference(*args)
        for x in tensors:
            if x.device.type != "cpu":
                raise ValueError(f"{self.name}: all tensors must lie on one device, found {x.device} beside cpu")
        return self.kernel.run(*args)

    def compose(self, *args) -> Any:
        """The composition, as a function that torch can differentiate and transform in every way."""
        for argument, x in zip(self.overload._schema.arguments, args, strict=True):
            if _is_batched(x) and not (self.function and x.is_floating_point()):
                raise ValueError(
                    f"{self.name}: vmap over {argument.name} is not possible: give every sample the same, call the op"
                    " for each, or join the samples as scenes of one batch"
                )
        if not torch.is_autocast_enabled("cpu"):
            return self.reference(*args)
        with torch.autocast("cpu", enabled=False):
            return self.reference(*(x.float() if getattr(x, "dtype", None) in _LOW_DTYPES else x for x in args))


_NO_TENSORS = (type(None), int, bool, float, list)
_PLAIN_DTYPES = (torch.float32, torch.int64, torch.int32)
_LOW_DTYPES = (torch.float16, torch.bfloat16)


def _has_tangent(x) -> bool:
    return isinstance(x, torch.Tensor) and forward_ad.unpack_dual(x).tangent is not None


def is_differentiated(x: torch.Tensor) -> bool:
    """Whether x has a gradient or a tangent, or belongs to a transform of torch.func."""
    return x.requires_grad or _has_tangent(x) or is_functorch_wrapped_tensor(x)


def _is_batched(x) -> bool:
    """Whether x is another tensor for each sample of a vmap."""
    while isinstance(x, torch.Tensor) and is_functorch_wrapped_tensor(x):
        if is_batchedtensor(x):
            return True
        x = get_unwrapped(x)
    return False


def is_transformed() -> bool:
    """Whether torch traces or transforms, so that tensors made now may have no values afterwards."""
    functorch = torch._C._are_functorch_transforms_active()
    return functorch or torch._C._len_torch_dispatch_stack() > 0 or torch._C._is_tracing()


def is_at_most(size: int, most: int) -> bool:
    """Whether a size is no larger. While torch traces: whether no size that the graph will meet is."""
    if not torch.compiler.is_compiling():
        return size <= most
    from torch.fx.experimental.symbolic_shapes import statically_known_true

    return statically_known_true(size <= most)


def frozen(*indices: Tensor) -> tuple[Tensor, ...]:
    """Copies of int64 tensors that the C core trusts: from the first call on it keeps the values, and checks them once.

    So nobody should write to the copies: no op would see it. Other tensors are copied and checked in every call.
    """
    if BACKEND == "torch" or torch.compiler.is_compiling() or torch._C._len_torch_dispatch_stack() > 0:
        return indices
    return tuple([x if y is x else torch.from_numpy(y) for x, y in zip(indices, _C.freeze(*indices), strict=True)])


def _values_read(args: Sequence) -> Sequence:
    """The arguments; for frozen indices that somebody has written to, what kernels read."""
    if BACKEND == "torch" or torch.compiler.is_compiling() or torch._C._len_torch_dispatch_stack() > 0:
        return args
    values = _C.values_read(*args)
    return [x if y is x else torch.from_numpy(y) for x, y in zip(args, values, strict=True)]


class IndexSet:
    """A frozen dataclass of this kind makes its tensors `frozen` when it is built."""

    def __init_subclass__(cls) -> None:
        cls._tensors = [name for name, kind in cls.__annotations__.items() if kind in ("Tensor", Tensor)]

    def __post_init__(self) -> None:
        values = self.__dict__
        values.update(zip(self._tensors, frozen(*[values[name] for name in self._tensors]), strict=True))


def configuration() -> dict:
    """The backend, the instruction sets, the threads and the versions in use, by name."""
    core = _C.configuration() if BACKEND == "c" else {}
    return {
        "backend": BACKEND,
        "instruction_set": core.get("isa", "-"),
        "supported": core.get("supported", []),
        "bfloat16": core.get("bfloat16"),
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
    if BACKEND == "torch" or variable("AST_SIM_KEEP_MEMORY") == "0":
        return False
    return _C.keep_memory()

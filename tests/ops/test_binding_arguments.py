"""Every function of the C module, called with arguments that do not fit, raises an error or returns: it never crashes.

Valid calls are recorded from the ops themselves; then some of the arguments are spoiled.
"""

import copy
import functools

import every_op
import numpy as np
import pytest
import torch
from checks import run_python
from hypothesis import given, settings
from hypothesis import strategies as st
from torch._subclasses.fake_tensor import FakeTensorMode

from ast_sim.ops import attention, library, linear

ALLOWED = (TypeError, ValueError, BufferError, MemoryError)
NO_KERNEL = {"declare", "set_pool", "keep_memory", "configuration", "multiply_in_bfloat16", "elastic_stiffness"}
FUNCTIONS = sorted(
    n for n in dir(library._C) if callable(getattr(library._C, n)) and n[0] != "_" and n not in NO_KERNEL
)
NOT_IN_AN_OP = {
    "column_sum": (np.ones((5, 3), np.float32), np.empty(3, np.float32)),
    "values_read": (np.arange(3), np.ones(2, np.float32), None),
}
HUGE = (-(2**63), -1, 0, 1, 2, 21, 22, 2**21, 2**31, 2**32, 2**62, 2**63 - 1)


class Recorder:
    """Stands in for the C module and keeps the arguments of the first calls of each function."""

    def __init__(self) -> None:
        self.calls: dict[str, list[tuple]] = {name: [x] for name, x in NOT_IN_AN_OP.items()}
        self._module = library._C

    def __getattr__(self, name):
        if name == "values_read":  # an op gives it all of its arguments, which may be without storage
            return self._module.values_read

        def call(*arguments):
            found = self.calls.setdefault(name, [])
            if len(found) < 2:
                found.append(tuple(x.numpy().copy() if isinstance(x, torch.Tensor) else x for x in arguments))
            return getattr(self._module, name)(*arguments)

        return call


@functools.cache
def calls() -> dict[str, list[tuple]]:
    recorder = Recorder()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(library, "_C", recorder)
        for op in every_op.OPS.values():
            op([1, 4, 2])
        for _ in range(2):
            x, weight = torch.randn(5, 3, requires_grad=True), torch.randn(4, 3)
            linear(x, weight, torch.randn(4), "relu", torch.randn(5, 4)).sum().backward()
            slices = torch.randn(5, 3, 2, 16, requires_grad=True).unbind(1)
            attention(*slices, *[torch.tensor([0, 2, 5])] * 2)[0].sum().backward()
    return recorder.calls


# ---- arguments that do not fit ----


def misaligned(x: np.ndarray) -> np.ndarray:
    y = np.empty(x.nbytes + 1, np.uint8)[1:].view(x.dtype).reshape(x.shape)
    y[...] = x
    return y


def read_only(x: np.ndarray) -> np.ndarray:
    x = x.copy()
    x.setflags(write=False)
    return x


def longer(x: np.ndarray, axis: int, by: int) -> np.ndarray:
    """`by` more copies of the last index along an axis, or fewer indices."""
    if x.ndim == 0 or x.shape[axis % x.ndim] == 0:
        return x
    axis %= x.ndim
    return np.take(x, range(x.shape[axis] + by), axis, mode="clip")


LAYOUTS = [
    lambda x: x.astype(np.float64),
    lambda x: x.astype(np.int32),
    lambda x: x.astype(np.int64),
    lambda x: x.astype(np.float32),
    lambda x: x.astype(bool),
    lambda x: x.astype(x.dtype.newbyteorder()),
    lambda x: x.astype(object),
    lambda x: x[None],
    lambda x: x.reshape(-1),
    lambda x: x[..., None],
    lambda x: np.asfortranarray(x),
    lambda x: x.T,
    lambda x: x[::-1] if x.ndim else x,
    lambda x: x[::2] if x.ndim else x,
    lambda x: np.stack([x, x], -1)[..., 0],
    lambda x: np.broadcast_to(x[:1], x.shape) if x.ndim and len(x) else x,
    lambda x: x[:0] if x.ndim else x,
    lambda x: np.zeros_like(x),
    lambda x: np.sort(x, axis=None).reshape(x.shape),
    lambda x: x[::-1].copy() if x.ndim else x,
    misaligned,
    read_only,
    lambda x: x.view(np.recarray),
    lambda x: x.tolist(),
]
OTHERS = [
    None,
    True,
    1.5,
    float("nan"),
    float("inf"),
    "x",
    b"x",
    [],
    {},
    10**30,
    -(10**30),
    object(),
    np.float32(1),
    *HUGE,
]


def with_values(x: np.ndarray, edits) -> np.ndarray:
    """Single elements replaced: integers near each other and far away, floats of all kinds."""
    x = x.copy()
    for place, value in edits:
        if not x.size:
            break
        if x.dtype.kind == "i":
            info = np.iinfo(x.dtype)
            near = int(x.flat[place % x.size]) + value - 6 if value < 12 else HUGE[value % len(HUGE)]
            x.flat[place % x.size] = min(max(near, info.min), info.max)
        elif x.dtype.kind == "f":
            x.flat[place % x.size] = (np.nan, np.inf, -np.inf, 3e38, 1e-42, -0.0)[value % 6]
    return x


@st.composite
def spoilers(draw):
    """A function that spoils one argument."""
    kind = draw(st.sampled_from(["layout", "other", "length", "values", "values", "length"]))
    if kind == "layout":
        change = draw(st.sampled_from(LAYOUTS))
        return lambda x: change(x) if isinstance(x, np.ndarray) else x
    if kind == "other":
        value = draw(st.sampled_from(OTHERS))
        return lambda x: value
    if kind == "length":
        axis, by = draw(st.integers(0, 2)), draw(st.sampled_from([-1, 1, -1, 1, 7]))
        return lambda x: longer(x, axis, by) if isinstance(x, np.ndarray) else x
    edits = draw(st.lists(st.tuples(st.integers(0, 10000), st.integers(0, 40)), min_size=1, max_size=4))
    return lambda x: with_values(x, edits) if isinstance(x, np.ndarray) else edits[0][1] - 20


def as_tensor(x):
    """The array as a tensor over the same memory, if torch has such a one."""
    try:
        return torch.from_numpy(x) if isinstance(x, np.ndarray) and x.flags.writeable else x
    except (TypeError, ValueError):
        return x


def test_every_function_is_recorded():
    assert set(calls()) == set(FUNCTIONS)


@pytest.mark.parametrize("name", FUNCTIONS)
@settings(deadline=None, max_examples=250, derandomize=True, database=None)
@given(
    which=st.integers(0, 1),
    changes=st.lists(st.tuples(st.integers(0, 40), spoilers()), min_size=1, max_size=3),
    more=st.sampled_from([0] * 20 + [-1, 1]),
)
def test_arguments_that_do_not_fit(name, which, changes, more):
    recorded = calls()[name][which % len(calls()[name])]
    arguments = [x.copy() if isinstance(x, np.ndarray) else x for x in recorded]
    for at, spoil in changes:
        with np.errstate(invalid="ignore", over="ignore"):
            arguments[at % len(arguments)] = spoil(arguments[at % len(arguments)])
    if more:
        arguments = arguments[:-1] if more < 0 else [*arguments, 0]
    try:
        getattr(library._C, name)(*map(as_tensor, arguments))
    except ALLOWED as error:
        assert isinstance(error, MemoryError) or str(error)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_recorded_calls_are_valid(name):
    for recorded in calls()[name]:
        getattr(library._C, name)(*map(as_tensor, copy.deepcopy(recorded)))


class Derived(torch.Tensor):
    pass


@pytest.mark.parametrize(
    "change",
    [
        lambda x: x,
        lambda x: x.requires_grad_(),
        lambda x: torch.nn.Parameter(x),
        lambda x: x.as_subclass(Derived),
        lambda x: torch.cat([x, x])[5:],
    ],
)
def test_tensors_of_all_kinds_are_read(change):
    out = torch.empty(3)
    library._C.column_sum(change(torch.arange(15.0).view(5, 3)), out)
    assert out.tolist() == [30.0, 35.0, 40.0]


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda x: x.to_sparse(), "must be a strided tensor on the CPU"),
        (lambda x: x.to("meta"), "must be a strided tensor on the CPU"),
        (lambda x: FakeTensorMode().from_tensor(x), "must be a strided tensor on the CPU"),
        (lambda x: x.double(), "must be float32, not torch.float64"),
        (lambda x: x.bfloat16(), "must be float32, not torch.bfloat16"),
        (lambda x: x.to(torch.complex64), "must be float32, not torch.complex64"),
        (lambda x: x[0], r"must have shape \[N, F\], not \(3,\)"),
        (lambda x: x.view(1, 1, 1, 5, 3), r"must have shape \[N, F\], not \(1, 1, 1, 5, 3\)"),
    ],
)
def test_tensors_that_do_not_fit_are_refused(change, message):
    """By the core, and for a reason that is told."""
    x, column_sum = change(torch.arange(15.0).view(5, 3)), library.Kernel("column_sum", "x[N,F] -> out[F]")
    with pytest.raises((TypeError, ValueError), match="column_sum: x "):
        library._C.column_sum(x, torch.empty(3))
    with pytest.raises((TypeError, ValueError), match=f"column_sum: x {message}"):
        column_sum(x, torch.empty(3))


@pytest.mark.parametrize("change", [lambda x: x.tolist(), lambda x: x.numpy(), lambda x: None])
def test_what_is_no_tensor_is_refused(change):
    with pytest.raises((TypeError, ValueError), match="column_sum: x must"):
        library._C.column_sum(change(torch.arange(15.0).view(5, 3)), torch.empty(3))


@pytest.mark.parametrize(
    "change",
    [
        lambda x: x.T.contiguous().T,
        lambda x: x[:, :1].expand(5, 3),
        lambda x: torch.from_numpy(misaligned(x.numpy())),
    ],
)
def test_other_layouts_are_copied(change):
    x, out = change(torch.arange(15.0).view(5, 3)), torch.empty(3)
    with pytest.raises(BufferError, match="column_sum: x must be aligned and contiguous"):
        library._C.column_sum(x, out)
    library.Kernel("column_sum", "x[N,F] -> out[F]")(x, out)
    assert torch.equal(out, x.sum(0))


NO_MEMORY = """
import resource
import torch
from ast_sim.ops import library, linear

N = 2_000_000
inputs = (torch.zeros(N, 3), torch.tensor([0, N]), 0.0, 0.0, 0.0, 1.0, 12)
most = resource.getrlimit(resource.RLIMIT_AS)
for room in 8, 80:  # too little for the outputs of 64 MB, and for what the kernel takes beside them
    mapped = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (mapped + (room << 20), most[1]))
    try:
        library._C.octree(*inputs)
    except MemoryError as error:
        print(str(error) or "no outputs")
    resource.setrlimit(resource.RLIMIT_AS, most)
print(*library._C.octree(*inputs)[1])
"""


def test_no_memory_is_an_error_and_the_next_call_works():
    lines = run_python(NO_MEMORY, AST_SIM_DEBUG="0").splitlines()
    assert lines == ["no outputs", "octree: scratch memory could not be had", "0 1"]

"""How the time of a training step divides: kernels of the C core, their binding, torch's ops, autograd, Python."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from torch.profiler import ProfilerActivity
from torch.profiler import profile as torch_profile

from ast_sim.ops import library

WARM_UP = 3  # the first steps fill caches and are not counted
TORCH_OPS = 15  # ops of torch that are listed by name, the slowest first


@dataclass(frozen=True)
class Entry:
    """One part of a step: its calls and its seconds per step. `kind` is kernel, torch, binding, autograd or python."""

    kind: str
    name: str
    calls: float
    seconds: float


@dataclass(frozen=True)
class Profile:
    """The parts of a mean step.

    Steps are measured twice. First only the calls of kernels are timed. Then torch's profiler watches every op as well,
    which slows the step down. So the times of all parts but the kernels are scaled: their sum becomes the time that the
    first measurement leaves beside the kernels.

    Attributes:
        entries: the parts, the slowest first within each kind; their times add up to `seconds`.
        seconds: the time of a step in the first measurement.
        watched_seconds: the time of a step in the second measurement.
    """

    entries: list[Entry]
    seconds: float
    watched_seconds: float

    def share(self, kind: str) -> float:
        """The share of the step's time that all entries of a kind take."""
        return sum(entry.seconds for entry in self.entries if entry.kind == kind) / self.seconds


class _TimedCore:
    """The C core; each call of a kernel is timed."""

    def __init__(self, core: Any) -> None:
        self._core = core
        self.seconds: dict[str, list[float]] = defaultdict(list)  # of each call

    def __getattr__(self, name: str) -> Callable:
        function = getattr(self._core, name)

        def timed(*arguments: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*arguments)
            finally:
                self.seconds[name].append(time.perf_counter() - start)

        setattr(self, name, timed)
        return timed

    def entries(self, steps: int) -> list[Entry]:
        """The kernels, the slowest first."""
        return _sorted([Entry("kernel", name, len(t) / steps, sum(t) / steps) for name, t in self.seconds.items()])


@contextmanager
def _timed_core() -> Iterator[_TimedCore]:
    core = getattr(library, "_C", None)  # none with AST_SIM_BACKEND=torch
    library._C = _TimedCore(core)
    try:
        yield library._C
    finally:
        library._C = core


def profile(step: Callable[[], object], steps: int) -> Profile:
    """Measure `steps` calls of `step` twice, see `Profile`. The effects of these calls remain."""
    for _ in range(WARM_UP):
        step()
    with _timed_core() as core:
        seconds = _seconds_of(step, steps)
    kernels = core.entries(steps)
    with _timed_core() as core, torch_profile(activities=[ProfilerActivity.CPU]) as watched:
        watched_seconds = _seconds_of(step, steps)
    within = sum(entry.seconds for entry in core.entries(steps))
    rest = _beside_kernels(watched, steps, watched_seconds, within)
    scale = (seconds - sum(entry.seconds for entry in kernels)) / (watched_seconds - within)
    rest = [replace(entry, seconds=entry.seconds * scale) for entry in rest]
    return Profile([*kernels, *rest], seconds, watched_seconds)


def _beside_kernels(watched: torch_profile, steps: int, seconds: float, kernels: float) -> list[Entry]:
    """The parts, beside the kernels, of a watched step that takes `seconds`."""
    ops: dict[str, list[Entry]] = {"torch": [], "binding": [], "autograd": []}
    for event in watched.key_averages():
        if event.key.startswith("Optimizer."):
            continue  # it contains ops that are listed themselves
        kind = "binding" if "ast_sim" in event.key else "torch" if event.key.startswith("aten::") else "autograd"
        ops[kind].append(Entry(kind, event.key, event.count / steps, event.self_cpu_time_total * 1e-6 / steps))
    binding = max(sum(entry.seconds for entry in ops["binding"]) - kernels, 0.0)
    entries = [
        *_with_rest(_sorted(ops["torch"]), TORCH_OPS),
        Entry("binding", "around kernels", sum(entry.calls for entry in ops["binding"]), binding),
        *_with_rest(_sorted(ops["autograd"]), 0),
    ]
    python = seconds - kernels - sum(entry.seconds for entry in entries)
    return [*entries, Entry("python", "everything else", 1, max(python, 0.0))]


def _seconds_of(step: Callable[[], object], steps: int) -> float:
    start = time.perf_counter()
    for _ in range(steps):
        step()
    return (time.perf_counter() - start) / steps


def _sorted(entries: list[Entry]) -> list[Entry]:
    return sorted(entries, key=lambda entry: -entry.seconds)


def _with_rest(entries: list[Entry], named: int) -> list[Entry]:
    """The first `named` entries, and the sum of the others as one entry."""
    rest = entries[named:]
    if not rest:
        return entries
    name = "others" if named else "engine"
    return entries[:named] + [Entry(rest[0].kind, name, sum(e.calls for e in rest), sum(e.seconds for e in rest))]


def table(measured: Profile) -> str:
    """The profile as lines of text."""
    lines = [
        f"{1e3 * measured.seconds:.2f} ms a step ({1e3 * measured.watched_seconds:.2f} ms while every op is watched)",
        f"{'':9}{'':42}{'calls':>8}{'ms':>10}{'share':>9}",
    ]
    for e in measured.entries:
        share = e.seconds / measured.seconds
        lines.append(f"{e.kind:9}{e.name:42.42}{e.calls:8.4g}{1e3 * e.seconds:10.3f}{share:9.1%}")
    kinds = ("kernel", "torch", "binding", "autograd", "python")
    lines.append("in all   " + ", ".join(f"{kind} {measured.share(kind):.1%}" for kind in kinds))
    return "\n".join(lines)

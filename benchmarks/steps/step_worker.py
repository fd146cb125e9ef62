"""The process of one backend in `training_step`. It reads requests on stdin and answers on stdout, in lines of JSON."""

from __future__ import annotations

import ctypes
import json
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

import torch
from torch.profiler import ProfilerActivity
from torch.profiler import profile as profiler
from torch.utils.flop_counter import FlopCounterMode

import ast_sim
from ast_sim.batches.batch_builder import Batch, State
from ast_sim.dataset.reader import Dataset
from ast_sim.ops import library, products_in
from ast_sim.runs.folder import RunFolder
from ast_sim.support.stop_signals import StopSignals
from ast_sim.training.configure import configure
from ast_sim.training.data_lengths import measure
from ast_sim.training.defaults_from_data import resolve
from ast_sim.training.loop import Training
from ast_sim.training.profile import profile
from benchmarks.kernels.flops import FORMULAS

KINDS = ("kernel", "torch", "binding", "autograd", "python")
NODE = "autograd::engine::evaluate_function: "  # stands before the name of a node of autograd
M_MMAP_THRESHOLD, M_TRIM_THRESHOLD = -3, -1  # malloc.h of glibc


class Setup(NamedTuple):
    """What a worker trains: a dataset, a model, a preset and its settings; `folder` is for what it writes."""

    data: str
    model: str
    preset: str
    settings: list[str]
    folder: str


def keep_memory() -> None:
    """As the product does it, for both backends."""
    if library.BACKEND == "c":
        ast_sim.keep_memory()
    else:
        libc = ctypes.CDLL(None)
        libc.mallopt(M_MMAP_THRESHOLD, 1 << 30)
        libc.mallopt(M_TRIM_THRESHOLD, 2**31 - 1)


def mean_seconds(step: Callable[[], object], count: int) -> float:
    start = time.perf_counter()
    for _ in range(count):
        step()
    return (time.perf_counter() - start) / count


def shares(step: Callable[[], object], count: int) -> dict[str, float]:
    times = profile(step, count)
    return {kind: times.share(kind) for kind in KINDS}


def rollout_step(training: Training) -> Callable[[], object]:
    """A call that predicts the second frame of the first test scene."""
    truth = training.dataset.load("test", 0)
    graph = training.model.graph(truth.scene)
    first, second = torch.from_numpy(truth.position[:2].copy()).unbind(0)
    stress = None if truth.stress is None else torch.from_numpy(truth.stress[0].copy())

    def step() -> None:
        batch = Batch.build(graph, State(first, None, stress), second, ["test/000000 frame 0"])
        with products_in(training.options.precision):
            training.model.advance(batch, second)

    return step


@contextmanager
def rolling_out(training: Training) -> Iterator[None]:
    """As a rollout has it: the model for prediction, no gradients."""
    training.model.eval()
    with torch.inference_mode():
        yield
    training.model.train()


def events(step: Callable[[], object]) -> dict[str, int]:
    """How often one step runs each event of torch's profiler."""
    with profiler(activities=[ProfilerActivity.CPU]) as watched:
        step()
    return {event.key: event.count for event in watched.key_averages()}


def nodes(counted: dict[str, int]) -> dict[str, int]:
    """The nodes of autograd by name, of what `events` counted."""
    return {key.removeprefix(NODE): count for key, count in counted.items() if key.startswith(NODE)}


def counts(step: Callable[[], object]) -> dict[str, int]:
    """What one step runs: nodes of autograd (without nodes that accumulate gradients), nodes that accumulate, torch's
    ops, and the ops of the C core, forward and backward."""
    counted = events(step)
    of_autograd = nodes(counted)
    sums = sum(count for key, count in of_autograd.items() if "AccumulateGrad" in key)
    ops = {kind: sum(n for key, n in counted.items() if key.startswith(kind)) for kind in ("aten::", "ast_sim")}
    of_nodes = {"nodes": sum(of_autograd.values()) - sums, "accumulating": sums}
    return {**of_nodes, "torch_ops": ops["aten::"], "own_ops": ops["ast_sim"]}


def flops_of(step: Callable[[], object]) -> int:
    """Useful floating point operations: matrix products and what benchmarks.kernels.flops counts of our ops."""
    with FlopCounterMode(display=False, custom_mapping=FORMULAS) as counter:
        step()
    return counter.get_total_flops()


@contextmanager
def training_of(setup: Setup) -> Iterator[Training]:
    """A training that is ready for its first step."""
    with ExitStack() as stack:
        dataset = stack.enter_context(Dataset(Path(setup.data)))
        run = stack.enter_context(tempfile.TemporaryDirectory(dir=setup.folder))
        scales = measure(dataset)
        config = resolve(configure(Path(setup.data), setup.preset, setup.settings, setup.model), dataset, scales)
        training = stack.enter_context(Training(RunFolder(Path(run)), config, dataset, scales, StopSignals()))
        training.prepare()
        yield training


def main() -> None:
    setup = Setup(**json.loads(sys.argv[1]))
    keep_memory()
    out, sys.stdout = sys.stdout, sys.stderr  # what training prints is no answer
    with training_of(setup) as training:
        roll = rollout_step(training)
        rolled_out = rolling_out(training)  # decorates what asks for rollout steps
        answers: dict[str, Callable[[int], object]] = {
            "step": lambda count: mean_seconds(training.advance, count),
            "batch": lambda _: training.options.batch_size * training.options.accumulate,
            "rollout": rolled_out(lambda count: mean_seconds(roll, count)),
            "profile": lambda count: shares(training.advance, count),
            "profile_rollout": rolled_out(lambda count: shares(roll, count)),
            "counts": lambda _: counts(training.advance),
            "flops": lambda count: flops_of(training.advance),
            "resident": lambda count: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
        }
        for line in sys.stdin:
            request = json.loads(line)
            print(json.dumps({"answer": answers[request["what"]](request["count"])}), file=out, flush=True)


if __name__ == "__main__":
    main()

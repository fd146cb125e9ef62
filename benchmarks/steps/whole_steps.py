"""What is measured of whole training steps, predictions and Newton steps, and what was aimed at.

Each measurement makes one record or more. A comparison goes in turns, and its value is the median of the ratios of
neighbours, so that other work on the machine disturbs both sides alike.
"""

from __future__ import annotations

import statistics
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

import ast_sim
from ast_sim.ops.library import configuration
from ast_sim.support.precisions import PRECISIONS
from benchmarks.kernels.targets import GIGABYTE
from benchmarks.steps import before_after, newton, predictions, scenes
from benchmarks.steps.before_after import median_ratio
from benchmarks.steps.step_worker import Setup
from benchmarks.steps.training_step import Worker, growth, in_turns

NOW = Path(__file__).resolve().parents[2]
TOGETHER = 64  # scenes that are predicted as one batch
LIMIT = 600.0  # seconds of a sample of Newton steps
MANY_NODES = (158, 500)  # nodes along a side of two plates, each of two layers: 99,856 and 1,000,000 nodes
PLATES = {**predictions.PLATES, "nodes": 400, "progress": False}


@dataclass(frozen=True)
class Record:
    """A number, and the bound that it should keep.

    Attributes:
        what: what was measured.
        value, unit: the number; None: it could not be measured, and `note` says why.
        least, most: the bound, of which one is given.
        note: what else a reader should know.
    """

    what: str
    value: float | None
    unit: str
    least: float | None = None
    most: float | None = None
    note: str = ""

    @property
    def target(self) -> str:
        return f"at most {self.most:g}" if self.least is None else f"at least {self.least:g}"

    @property
    def reached(self) -> bool:
        if self.value is None:
            return False
        return (self.least is None or self.value >= self.least) and (self.most is None or self.value <= self.most)

    def to_json(self) -> dict[str, Any]:
        told = {"what": self.what, "value": self.value, "unit": self.unit, "target": self.target}
        return {**told, "reached": self.reached, "note": self.note}


@dataclass(frozen=True)
class Place:
    """Where something is measured: the folder of the state before, a folder for files, and samples of each side."""

    before: Path
    folder: Path
    repeats: int


def training(place: Place) -> Iterator[Record]:
    """Steps of `tiny` on 8 plates of 400 nodes, as the demonstration has them."""
    data = ast_sim.generate("deforming_plate", place.folder / "plates.h5", **{**PLATES, "train": 16}).path
    told = before_after.compare(place.before, data, threads=2, repeats=place.repeats, steps=5)
    times = told["median_ms"]
    note = f"a step {times['before']:.0f} -> {times['now']:.0f} ms"
    yield Record(
        "samples a second of `tiny`, two threads, beside the state before", told["ratio"], "times", 2.5, note=note
    )
    yield Record("nodes of autograd in a step of `tiny`", told["counts"]["now"]["nodes"], "", most=60)


def prediction(place: Place) -> Iterator[Record]:
    """One call for a new plate of 400 nodes, alone and in a batch."""
    data = ast_sim.generate("deforming_plate", place.folder / "plates.h5", **{**PLATES, "test": TOGETHER}).path
    told = predictions.compare({"before": place.before, "now": NOW}, data, 0, place.repeats)
    before, now = (told[name]["processor"] for name in ("before", "now"))
    ratio = median_ratio(now, before)
    note = f"{statistics.median(before):.1f} -> {statistics.median(now):.1f} ms of the processor"
    yield Record("time of one call, one thread, beside the state before", ratio, "times", most=0.5, note=note)
    alone, each = _alone_and_together(data, place.repeats)
    note = f"{1e3 * statistics.median(alone):.1f} and {1e3 * statistics.median(each):.1f} ms"
    what = f"time of each of {TOGETHER} scenes in a batch on two threads, beside one scene on one"
    yield Record(what, median_ratio(each, alone), "times", most=0.6, note=note)


def _alone_and_together(data: Path, repeats: int) -> tuple[list[float], list[float]]:
    """Seconds of a scene alone on one thread, and of each scene of a batch on two, in turns."""
    run, threads = ast_sim.example_run("plates"), torch.get_num_threads()
    with ast_sim.Dataset(data) as dataset:
        truths = [dataset["test"][index] for index in range(TOGETHER)]
    alone, each = [], []

    def spent(count: int) -> float:
        torch.set_num_threads(1 if count == 1 else 2)
        # New scenes, which keep nothing of the calls before.
        questions = [(replace(truth.scene), truth.position) for truth in truths[:count]]
        began = time.perf_counter()
        run.predict_scenes(questions, frames=-1, effort=ast_sim.Effort(), throw=False, progress=False)
        return (time.perf_counter() - began) / count

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of scenes outside the training
        for _ in range(repeats + 1):
            alone.append(spent(1))
            each.append(spent(TOGETHER))
    torch.set_num_threads(threads)
    return alone[1:], each[1:]


def threads(place: Place) -> Iterator[Record]:
    """Training steps on one thread and on two."""
    for name, least in (("tiny", 1.6), ("deforming_plate", 1.7), ("abcd_xl_12k", 0.97)):
        steps, one, two = _steps(name, {"one": ("c", 1), "two": ("c", 2)}, place)
        yield Record(f"{steps} on two threads beside one", median_ratio(one, two), "times", least, note=_both(one, two))


def beside_torch(place: Place) -> Iterator[Record]:
    """Training steps of the same model by torch's own ops, without `torch.compile`."""
    for name, least in (("tiny", 3.7), ("deforming_plate", 4.2), ("abcd_xl_12k", 4.2)):
        steps, ours, theirs = _steps(name, {"ours": ("c", 1), "torch": ("torch", 1)}, place)
        what = f"plain torch, not compiled, beside ours: {steps}, one thread"
        yield Record(what, median_ratio(theirs, ours), "times", least, note=_both(ours, theirs))


def _both(one: list[float], other: list[float]) -> str:
    return f"{1e3 * statistics.median(one):.0f} and {1e3 * statistics.median(other):.0f} ms"


def _title(case: scenes.Case) -> str:
    return f"`{case.preset}` ({case.nodes:,} nodes)"


def _steps(name: str, kinds: dict[str, tuple[str, int]], place: Place) -> tuple[str, list[float], list[float]]:
    """What is trained, and the seconds of a step of two backends, each with its number of threads, in turns."""
    case = scenes.make(name, place.folder)
    setup = Setup(str(case.data), "ast", case.preset, case.settings, str(place.folder))
    with ExitStack() as stack:
        workers = {}
        for kind, (backend, count) in kinds.items():
            workers[kind] = Worker(backend, count, setup, place.folder / f"{kind}.log")
            stack.callback(workers[kind].close)
            workers[kind].ask("step", case.steps)  # fills caches
        one, other = in_turns(workers, "step", case.steps, min(place.repeats, case.most_repeats)).values()
    return f"training steps of {_title(case)}", one, other


def newton_steps(place: Place) -> Iterator[Record]:
    """Set-up and steps of Newton's method with contact, in processor time of one thread."""
    for case, unit, scale, setup_most, step_most, repeats in (
        ("plate of 1,302 nodes", "ms", 1e3, 15, 15, place.repeats),
        ("two blocks of 26,450 nodes", "s", 1, None, 8, 1),
    ):
        told = newton.sample(NOW, case, repeats, LIMIT)
        if told is None:
            yield Record(f"a Newton step, {case}", None, unit, most=step_most, note=f"none within {LIMIT:g} s")
            continue
        if setup_most is not None:
            setup = scale * statistics.median(told["setup"])
            yield Record(f"set-up of Newton steps, {case}", setup, unit, most=setup_most)
        steps = [scale * statistics.median(times) for times in zip(*told["steps"], strict=True)]
        note = f"in turn {', '.join(f'{step:.3g}' for step in steps)} {unit}"
        yield Record(f"a Newton step, {case}", max(steps), unit, most=step_most, note=note)


def large_scenes(place: Place) -> Iterator[Record]:
    """A training step of `abcd_xl`, and predictions of up to a million nodes, on two threads."""
    small, large = (scenes.make(name, place.folder) for name in ("abcd_xl_12k", "abcd_xl"))
    quick, _ = _large(small.data, place, "step")
    slow, memory = _large(large.data, place, "step")
    yield Record(f"memory of a training step of {_title(large)}", memory / GIGABYTE, "GB resident", most=8)
    exponent = growth((small.nodes, large.nodes), (quick, slow))
    what = f"growth of a training step of `abcd_xl` from {small.nodes:,} to {large.nodes:,} nodes"
    yield Record(what, exponent, "exponent", most=0.95)
    data = [place.folder / f"plates_{side}.h5" for side in MANY_NODES]
    for path, side in zip(data, MANY_NODES, strict=True):
        scenes.write_plates(path, side)
    quick, _ = _large(data[0], place, "rollout")
    slow, memory = _large(data[1], place, "rollout")
    yield Record("memory of one prediction of 1,000,000 nodes", memory / GIGABYTE, "GB resident", most=20)
    note = f"{quick:.2f} and {slow:.1f} s"
    what = "time of one prediction of 1,000,000 nodes beside 99,856"
    yield Record(what, slow / quick, "times", most=12, note=note)


def _large(data: Path, place: Place, what: str) -> tuple[float, int]:
    """The least seconds of three training steps or predictions on two threads, and the bytes that were resident."""
    settings = ["train.batch_size=1", "train.statistics_pairs=1"]
    worker = Worker("c", 2, Setup(str(data), "ast", "abcd_xl", settings, str(place.folder)), place.folder / "large.log")
    try:
        worker.ask(what)  # fills caches
        return min(worker.ask(what) for _ in range(3)), worker.ask("resident")
    finally:
        worker.close()


def precision(place: Place) -> Iterator[Record]:
    """Calls of a model and training steps in both precisions, on one thread."""
    kernels = configuration()["bfloat16"] or "this processor is no faster"
    for name, what, least in (
        ("abcd_xl_12k", "rollout", 1.3),
        ("abcd_xl_12k", "step", 1),
        ("deforming_plate", "step", 1),
        ("tiny", "step", 1),
    ):
        case = scenes.make(name, place.folder)
        with ExitStack() as stack:
            workers = {}
            for kind in PRECISIONS:
                settings = [*case.settings, f"train.precision={kind}"]
                setup = Setup(str(case.data), "ast", case.preset, settings, str(place.folder))
                workers[kind] = Worker("c", 1, setup, place.folder / f"{kind}.log")
                stack.callback(workers[kind].close)
                workers[kind].ask(what, case.steps)  # fills caches
            plain, low = in_turns(workers, what, case.steps, min(place.repeats, case.most_repeats)).values()
        one = "one call" if what == "rollout" else "training steps"
        told = f"bfloat16 beside float32, {one} of {_title(case)}, one thread"
        yield Record(told, median_ratio(plain, low), "times", least, note=f"{_both(plain, low)}, {kernels}")


MEASUREMENTS: dict[str, Callable[[Place], Iterator[Record]]] = {
    "training": training,
    "prediction": prediction,
    "threads": threads,
    "newton": newton_steps,
    "precision": precision,
    "large": large_scenes,
    "torch": beside_torch,
}

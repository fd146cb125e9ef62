"""Own assemblies: errors of displacement and reaction, the time of an answer, and after how many questions it pays.

`python -m benchmarks.studies.assembly [ROW ...]` generates the scenes of each product of `examples`, trains a run and
measures it on test scenes, which no training has seen: the deepest frame alone, and all frames together. It
writes benchmarks/results/assembly.json and the page of this name in docs/results. Data and runs lie in `--folder`; a
second call goes on with what is there. Everything runs on one thread.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

import ast_sim
from ast_sim.dataset.solver_seconds import read_seconds
from ast_sim.figures import DeepestFrames
from ast_sim.inference.effort import Effort
from ast_sim.inference.evaluation.deepest_frames import deepest_frames
from ast_sim.inference.quantities.relative_errors import relative_error
from ast_sim.simulate.jobs.fastest_solver import deepest_frame
from ast_sim.support.provenance import provenance
from benchmarks.studies.phrases import (
    beside_solver,
    over_the_scenes,
    settings_tried,
    table_head,
    table_line,
    times_as_long,
)
from benchmarks.studies.rows import study_rows
from benchmarks.studies.validation_curve import CurvePoint, curve_line, minutes_per_step, validation_curve

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results" / "assembly.json"
PAGE = ROOT / "docs" / "results" / "assembly.md"


@dataclass(frozen=True)
class Row:
    """A product, its scenes and a training on them.

    Attributes:
        title: what the page calls it.
        spec: its specification.
        nodes, train, valid, test: of the dataset; nodes None: the sizes of the specification.
        steps, settings: of the training.
        solver_scenes: the number of test scenes in which the solver is run.
        after: the row whose run this training starts from.
        scenes: the row whose scenes it takes; None: its own.
    """

    title: str
    spec: Path
    nodes: int | None
    train: int
    steps: int
    valid: int = 10
    test: int = 50
    settings: dict[str, Any] = field(default_factory=dict)
    solver_scenes: int = 10
    after: str | None = None
    scenes: str | None = None

    def run_folder(self, name: str, folder: Path) -> Path:
        """Where the run of the row of that name lies."""
        return folder / f"run_{name}_{self.steps}"


@dataclass(frozen=True)
class WholeMotion:
    """A test scene, all frames of which are predicted together.

    Attributes:
        frames: how many.
        relative_error: at the deepest frame.
        seconds: of the answer.
        reaction, true_reaction, reaction_alone: in newton, in the last frame; the last one where that frame is
            predicted alone.
    """

    frames: int
    relative_error: float
    seconds: float
    reaction: float
    true_reaction: float
    reaction_alone: float


@dataclass(frozen=True)
class MeasuredProduct:
    """What was measured of a row.

    Attributes:
        row: its product, scenes and training.
        generation_minutes: of all its scenes.
        minutes: the training steps at their median time.
        effort: the default of the run.
        training: its validations.
        curves: the test scenes with all frames.
        solver_curves: the seconds of the solver for the first of them.
        deepest: the deepest frames of the test scenes.
    """

    row: Row
    generation_minutes: float
    minutes: float
    effort: Effort
    training: list[CurvePoint]
    curves: list[WholeMotion]
    solver_curves: list[float]
    deepest: DeepestFrames

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Self:
        """From what `measured` gave."""
        return cls(
            Row(**{**values["row"], "spec": Path(values["row"]["spec"])}),
            values["generation_minutes"],
            values["minutes"],
            Effort(**values["effort"]),
            [CurvePoint(**point) for point in values["training"]],
            [WholeMotion(**curve) for curve in values["curves"]],
            values["solver_curves"],
            DeepestFrames.from_json(values["deepest"]),
        )


_SETTINGS = {"peak_rate": 2e-3, "validate_scenes": 10, "validate_every": 500, "checkpoint_every": 500}
_BUMPER, _HOOK = (ROOT / "examples" / name / "SPEC.toml" for name in ("bumper", "snap_hook"))
ROWS = {
    "bumper": Row("Bumper, second-order elements", _BUMPER, nodes=None, train=100, steps=1700, settings=_SETTINGS),
    "snap_hook": Row("Snap hook, second-order elements", _HOOK, nodes=None, train=200, steps=1000, settings=_SETTINGS),
    "snap_hook_transolver": Row(
        "Snap hook, Transolver (timed beside much other work)",
        _HOOK,
        nodes=None,
        train=200,
        steps=1200,
        settings={**_SETTINGS, "model": "transolver"},
        solver_scenes=0,
        scenes="snap_hook",
    ),
    "snap_hook_mgn": Row(
        "Snap hook, MeshGraphNets",
        _HOOK,
        nodes=None,
        train=200,
        steps=820,
        settings={**_SETTINGS, "peak_rate": 4e-3, "batch_size": 4, "model": "mgn"},
        solver_scenes=0,
        scenes="snap_hook",
    ),
    "bumper_6000": Row(
        "Bumper, 6,000 nodes, after the small ones",
        _BUMPER,
        nodes=6000,
        train=20,
        valid=3,
        test=10,
        steps=300,
        settings={"validate_scenes": 3, "validate_every": 150, "checkpoint_every": 100},
        solver_scenes=1,
        after="bumper",
    ),
}


def trained(name: str, folder: Path) -> tuple[ast_sim.Run, Path]:
    """The run of a row and its dataset; what is there already is not made again."""
    row = ROWS[name]
    data = ast_sim.generate(
        "assembly", folder / f"{row.scenes or name}.h5", spec=row.spec, train=row.train, valid=row.valid, test=row.test,
        nodes=row.nodes, workers=1,
    ).path  # fmt: skip
    start = None if row.after is None else ROWS[row.after].run_folder(row.after, folder)
    run = ast_sim.train(
        data, row.run_folder(name, folder), from_run=start, steps=row.steps, resume=True, **row.settings
    )
    return run, data


def measured(name: str, folder: Path) -> dict[str, Any]:
    """Generate, train and measure a row."""
    row = ROWS[name]
    run, data = trained(name, folder)
    with run.open(data) as dataset:
        deepest = deepest_frames(run.model, dataset, "test", run.effort, row.solver_scenes, made_from=row.spec)
        curves = [_curve(run, dataset, index) for index in range(row.test)]
        solver_seconds = read_seconds(dataset).samples.values()
    record = MeasuredProduct(
        row,
        generation_minutes=float(sum(map(sum, solver_seconds))) / 60,
        minutes=minutes_per_step(run) * row.steps,
        effort=run.effort,
        training=validation_curve(run),
        curves=curves,
        solver_curves=_solver_curves(row) if row.solver_scenes else [],
        deepest=deepest,
    )
    spec = {"row": {**asdict(row), "spec": f"{row.spec.parent.name}/{row.spec.name}"}}
    return {**provenance(f"python -m benchmarks.studies.assembly {name}"), **asdict(record), **spec}


def _curve(run: ast_sim.Run, dataset: ast_sim.Dataset, index: int) -> WholeMotion:
    truth = dataset.load("test", index)
    began = time.perf_counter()
    answer = run.predict(truth)
    seconds = time.perf_counter() - began
    deepest = deepest_frame(truth)
    return WholeMotion(
        frames=int(answer.computed.sum()),
        relative_error=relative_error(answer.position[deepest], truth, deepest),
        seconds=seconds,
        reaction=_last_reaction(run, answer),
        true_reaction=truth.attributes["reaction"][-1],
        reaction_alone=_last_reaction(run, run.predict(truth, frames=[-1])),
    )


def _last_reaction(run: ast_sim.Run, answer: ast_sim.Answer) -> float:
    return replace(answer, info=run.info).figures()[-1]["reaction"]


def _solver_curves(row: Row) -> list[float]:
    """The seconds in which the solver finds all frames of the first test scenes, one after the other."""
    with tempfile.TemporaryDirectory() as folder:
        again = ast_sim.generate(
            "assembly", Path(folder) / "again.h5", spec=row.spec, train=1, valid=1, test=row.solver_scenes,
            nodes=row.nodes, workers=1,
        ).path  # fmt: skip
        with ast_sim.Dataset(again) as dataset:
            samples = read_seconds(dataset).samples
    return [sum(samples[f"test/{index:06d}"]) for index in range(row.solver_scenes)]


def page(results: dict[str, Any]) -> str:
    """The page of all rows that have a result."""
    shown = [MeasuredProduct.from_json(results[name]) for name in ROWS if name in results]
    alone = "product, trained, minutes, one call, error, reaction, largest stress, answer, solver, fastest setting"
    together = ["product", "frames", "error", "reaction", "answer", "solver"]
    introduction = _INTRODUCTION.format(settings=settings_tried({one.row.title: one.deepest for one in shown}))
    lines = [introduction, *table_head([*alone.split(", "), "pays after"], texts=2), *map(_alone, shown)]
    lines += [_TOGETHER, *table_head(together, texts=1), *map(_together, shown)]
    return "\n".join([*lines, *(line for one in shown for line in _section(one))])


def _section(one: MeasuredProduct) -> list[str]:
    """The worst scenes of a row, and how its errors fell."""
    deepest = one.deepest
    return [
        "",
        f"## {one.row.title}",
        "",
        f"{one.effort.text}. {over_the_scenes(deepest.scenes)} The Newton steps have not converged in"
        f" {deepest.not_converged} of {len(deepest.scenes)} scenes.",
        *([curve_line(one.training)] if one.training else []),
    ]


_INTRODUCTION = """# Own assemblies

Made by `python -m benchmarks.studies.assembly` from `benchmarks/results/assembly.json`; do not edit.

For each product of `examples`, scenes were generated, a run was trained on them, and it predicted frames of test
scenes, on one thread. "Error" is the error of the displacement on the free nodes at the deepest frame, relative to the
displacement (mean and standard error); "one call" is the error of the network alone. "Reaction" is the error of the
force that moves the tool, in the last frame. "Largest stress" is the error of the largest von Mises stress. The solver
goes to the same frame at its own stop test: straight in one, two or four load steps and frame by frame, whichever is
fastest. "Fastest setting" is the fastest of {settings} whose error is at most the answer's: looser stop tests, coarser
meshes, and the same Newton steps without a model. All times count what is prepared for a mesh. An answer's time is the
median over the test scenes; the solver's are medians over the scenes where it was run. "Pays after" is the number of
questions whose answers save as much time as the simulations and the training took.
"""

_TOGETHER = """
## All frames of a scene at once

With friction, a frame depends on the frames before. If all are predicted, Newton steps know the slip from each frame to
the next, and find the place of equilibrium to which the load path leads. So forces over the travel are more accurate
than the same frame alone. "Error" and "reaction" are of the same frames as above. The solver finds one frame after the
other.
"""


def _alone(one: MeasuredProduct) -> str:
    row, deepest = one.row, one.deepest
    errors = [scene.relative_error for scene in deepest.scenes]
    seconds = [scene.seconds for scene in deepest.scenes]
    spent = 60 * (one.generation_minutes + one.minutes)
    saved = 0.0 if deepest.solver is None else deepest.solver.seconds - deepest.solver.model_seconds
    return table_line([
        row.title,
        f"{row.train} scenes ({one.generation_minutes:.1f} min), {row.steps:,} steps",
        f"{one.minutes:.0f}",
        _percent([scene.after_calls[0] for scene in deepest.scenes if scene.after_calls]),
        _percent([error for error in errors if error is not None]),
        _reaction(one, alone=True),
        "-" if deepest.largest_stress is None else f"{100 * deepest.largest_stress:.0f} %",
        f"{1000 * deepest.seconds:.0f} ms",
        beside_solver(deepest.scenes, [0.0] * len(errors), seconds),
        beside_solver(deepest.scenes, errors, seconds),
        f"{spent / saved:,.0f} questions" if saved > 0 else "never: the solver is faster" if deepest.solver else "-",
    ])  # fmt: skip


def _together(one: MeasuredProduct) -> str:
    ratios = [theirs / ours.seconds for theirs, ours in zip(one.solver_curves, one.curves, strict=False)]
    return table_line([
        one.row.title,
        str(one.curves[0].frames),
        _percent([motion.relative_error for motion in one.curves]),
        _reaction(one, alone=False),
        f"{1000 * np.median([motion.seconds for motion in one.curves]):.0f} ms",
        times_as_long(one.solver_curves, ratios) if one.solver_curves else "-",
    ])  # fmt: skip


def _percent(errors: Sequence[float]) -> str:
    return f"{100 * np.mean(errors):.2g} ± {100 * np.std(errors) / len(errors) ** 0.5:.1g} %"


def _reaction(one: MeasuredProduct, alone: bool) -> str:
    """The errors of the force in the last frame, which is predicted alone or with all others."""
    touching = [motion for motion in one.curves if motion.true_reaction > 0]
    shares = [(motion.reaction_alone if alone else motion.reaction) / motion.true_reaction for motion in touching]
    errors = [abs(share - 1) for share in shares]
    return f"{100 * np.mean(errors):.2g} %, median {100 * np.median(errors):.2g} %"


def main(arguments: Sequence[str] | None = None) -> None:
    study_rows(__doc__, ROWS, arguments, measured, _said, (RESULTS, PAGE), page)


def _said(record: dict[str, Any]) -> str:
    one = MeasuredProduct.from_json(record)
    return f"{100 * one.deepest.relative_error:.3g} %, reaction {_reaction(one, alone=False)}"


if __name__ == "__main__":
    main()

"""Any frame in one jump: errors at the deepest frame, the time of an answer, and the solver at its best.

`python -m benchmarks.studies.jumps [ROW ...]` generates the scenes of each row, trains its runs and measures them on
the test scenes, which no training has seen. It writes benchmarks/results/jumps.json and docs/results/jumps.md. Data and
runs lie in `--folder`; a second call goes on with what is there. Everything runs on one thread.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np

import ast_sim
from ast_sim.figures import DeepestFrames
from ast_sim.inference.effort import MOST_NEWTON_STEPS, Effort, can_make_newton_steps
from ast_sim.inference.evaluation.deepest_frames import deepest_frames
from ast_sim.mechanics.linearised.linearised_contact import STILL
from ast_sim.support.provenance import provenance
from benchmarks.studies.phrases import beside_solver, over_the_scenes, settings_tried
from benchmarks.studies.rows import study_rows
from benchmarks.studies.validation_curve import CurvePoint, curve_line, minutes_per_step, validation_curve

RESULTS = Path(__file__).parents[1] / "results" / "jumps.json"
PAGE = Path(__file__).parents[2] / "docs" / "results" / "jumps.md"
MORE_CALLS = 2  # corrections on the page beyond the number that the model was trained for
TRAINING_SCENES = 100  # of the training split, whose error stands beside the one of test scenes
WITH_NEWTON = tuple((corrections, steps) for corrections in (0, 1) for steps in (1, 2, MOST_NEWTON_STEPS))


@dataclass(frozen=True)
class Row:
    """Scenes, and a training on them.

    Attributes:
        title: what the page calls it.
        family, data, nodes, frames, keep, order, seed, train, valid, test: of the dataset; `data` is the name of its
            file.
        steps: of the training.
        model: a registered model, in its preset `tiny`.
        model_settings: settings of the model, beyond the preset.
        settings: settings of the training.
        solver_scenes: the number of test scenes in which the solver is run.
    """

    title: str
    family: str
    data: str
    nodes: int
    train: int
    valid: int
    test: int
    steps: int
    frames: int | None = None
    keep: tuple[int, ...] | None = None
    order: int | None = None
    seed: int = 0
    model: str = "ast"
    model_settings: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    solver_scenes: int = 0


@dataclass(frozen=True)
class Turned:
    """The answers of one setting of the dial to all test scenes.

    Attributes:
        effort: the setting.
        relative_error, seconds: of each scene.
        stress_share, largest_stress: means over the scenes.
    """

    effort: Effort
    relative_error: list[float | None]
    seconds: list[float]
    stress_share: float | None
    largest_stress: float | None


@dataclass(frozen=True)
class MeasuredRow:
    """What was measured of a row.

    Attributes:
        row: its scenes and training.
        minutes: the training steps at their median time.
        effort: the default of the run.
        curve: its validations.
        dial: the settings, from fastest to most accurate; empty for a model that goes step by step.
        training_scenes: the error in scenes of the training.
        deepest: the test scenes, with the default effort.
    """

    row: Row
    minutes: float
    effort: Effort
    curve: list[CurvePoint]
    dial: list[Turned]
    training_scenes: float
    deepest: DeepestFrames

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Self:
        """From what `measured` gave."""
        return cls(
            Row(**values["row"]),
            values["minutes"],
            Effort(**values["effort"]),
            [CurvePoint(**point) for point in values["curve"]],
            [Turned(**{**turned, "effort": Effort(**turned["effort"])}) for turned in values["dial"]],
            values["training_scenes"],
            DeepestFrames.from_json(values["deepest"]),
        )


_PLATES = {"family": "deforming_plate", "frames": 41}
_DEEP = {**_PLATES, "keep": (14, 24, 34), "seed": 11, "test": 60, "valid": 60}
_PLATES_400 = {**_DEEP, "data": "plates400", "nodes": 400, "train": 6000}
_PLATES_1300 = {**_DEEP, "data": "plates1300", "nodes": 1300, "train": 1500, "valid": 40}
_SECOND_ORDER = {**_PLATES_1300, "data": "plates1300_second_order", "order": 2}
_PARTS = {"family": "abcd", "data": "parts400", "nodes": 400, "keep": (10, 15, 20), "seed": 11}
_PARTS = {**_PARTS, "train": 3000, "valid": 120, "test": 60}
_MIRRORED = {"mirror": ("x", "y"), "validate_scenes": 20}
_TURNED = {"mirror": ("x", "y", "z"), "validate_scenes": 60}
ROWS = {
    "plates400": Row(
        "Plates, 400 nodes, 10,000 steps", steps=10_000, settings=_MIRRORED, solver_scenes=10, **_PLATES_400
    ),
    "plates400_seed1": Row(
        "Plates, 400 nodes, second seed", steps=10_000, settings={**_MIRRORED, "seed": 1}, **_PLATES_400
    ),
    "plates400_seed2": Row(
        "Plates, 400 nodes, third seed", steps=10_000, settings={**_MIRRORED, "seed": 2}, **_PLATES_400
    ),
    "plates400_long": Row(
        "Plates, 400 nodes, 80,000 steps, with reactions", steps=80_000, settings=_MIRRORED, solver_scenes=10,
        model_settings={"state": ("reaction",)}, **_PLATES_400,
    ),
    "plates400_long_transolver": Row(
        "Plates, 400 nodes, Transolver, 94,400 steps, with reactions", steps=94_400, model="transolver",
        settings=_MIRRORED, model_settings={"state": ("reaction",)}, **_PLATES_400,
    ),
    "plates400_transolver": Row(
        "Plates, 400 nodes, Transolver", steps=11_800, model="transolver", settings=_MIRRORED, **_PLATES_400
    ),
    "plates400_mgn": Row(
        "Plates, 400 nodes, MeshGraphNets", steps=8_200, model="mgn", settings=_MIRRORED, **_PLATES_400
    ),
    "plates400_walk": Row(
        "Plates, 400 nodes, step by step", data="plates400_walk", nodes=400, train=200, valid=20, test=50,
        steps=12_000, model_settings={"jumps": False},
        settings={**_MIRRORED, "batch_size": 4, "peak_rate": 1e-3, "validate_every": 1500, "checkpoint_every": 1500},
        **_PLATES,
    ),
    "plates1300": Row(
        "Plates, 1,300 nodes, 12,000 steps", steps=12_000, settings=_MIRRORED, solver_scenes=10, **_PLATES_1300
    ),
    "plates1300_transolver": Row(
        "Plates, 1,300 nodes, Transolver", steps=14_100, model="transolver", settings=_MIRRORED, **_PLATES_1300
    ),
    "plates1300_mgn": Row(
        "Plates, 1,300 nodes, MeshGraphNets", steps=9_800, model="mgn", settings=_MIRRORED, **_PLATES_1300
    ),
    "plates1300_second_order": Row(
        "Plates, 1,300 nodes, second-order", steps=12_000, settings=_MIRRORED, solver_scenes=10, **_SECOND_ORDER
    ),
    "parts400": Row("Pairs of parts, 400 nodes", steps=10_000, settings=_TURNED, solver_scenes=5, **_PARTS),
    "parts400_long": Row(
        "Pairs of parts, 400 nodes, 36,000 steps", steps=36_000, settings=_TURNED, solver_scenes=5, **_PARTS
    ),
    "parts400_transolver": Row(
        "Pairs of parts, 400 nodes, Transolver", steps=11_800, model="transolver", settings=_TURNED, **_PARTS
    ),
}  # fmt: skip


def trained(name: str, folder: Path) -> tuple[ast_sim.Run, Path]:
    """The run of a row and its dataset; what is there already is not made again."""
    row = ROWS[name]
    data = ast_sim.generate(
        row.family, folder / f"{row.data}.h5", train=row.train, valid=row.valid, test=row.test, seed=row.seed,
        nodes=row.nodes, frames=row.frames, keep=row.keep, order=row.order,
    ).path  # fmt: skip
    run = ast_sim.train(
        data, folder / f"run_{name}", model=row.model, steps=row.steps, resume=True, model_settings=row.model_settings,
        **row.settings,
    )  # fmt: skip
    return run, data


def measured(name: str, folder: Path) -> dict[str, Any]:
    """Generate, train and measure a row."""
    row = ROWS[name]
    run, data = trained(name, folder)
    with run.open(data) as dataset:
        deepest = deepest_frames(run.model, dataset, "test", run.effort, row.solver_scenes)
        known = deepest_frames(run.model, dataset, "train", run.effort, most_scenes=TRAINING_SCENES).relative_error
        dial = [_turned(run, dataset, effort) for effort in _efforts(run)]
    minutes = minutes_per_step(run) * row.steps
    record = MeasuredRow(row, minutes, run.effort, validation_curve(run), dial, known, deepest)
    return {**provenance(f"python -m benchmarks.studies.jumps {name}"), **asdict(record)}


def _efforts(run: ast_sim.Run) -> list[Effort]:
    """The settings of the dial, from fastest to most accurate."""
    config = run.settings.model
    if not config.jumps:
        return []
    calls = [Effort(corrections) for corrections in range(1 + run.settings.train.corrections + MORE_CALLS)]
    return calls + ([Effort(*pair) for pair in WITH_NEWTON] if can_make_newton_steps(config) else [])


def _turned(run: ast_sim.Run, dataset: ast_sim.Dataset, effort: Effort) -> Turned:
    frames = deepest_frames(run.model, dataset, "test", effort)
    errors = [scene.relative_error for scene in frames.scenes]
    seconds = [scene.seconds for scene in frames.scenes]
    return Turned(effort, errors, seconds, frames.stress_share, frames.largest_stress)


def page(results: dict[str, Any]) -> str:
    """The page of all rows that have a result."""
    shown = [MeasuredRow.from_json(results[name]) for name in ROWS if name in results]
    introduction = _INTRODUCTION.format(settings=settings_tried({one.row.title: one.deepest for one in shown}))
    return "\n".join([introduction, *_table(shown), *(line for one in shown for line in _section(one))])


_INTRODUCTION = """# Any frame in one jump

Made by `python -m benchmarks.studies.jumps` from `benchmarks/results/jumps.json`; do not edit.

The deepest frame is the one in which a scene is deformed most. Its error is the root mean square of the error over the
free nodes, divided by the root mean square of their displacement; tables have the mean over the test scenes and its
standard error. "One call" has the error of the network alone, "error" with the corrections and Newton steps of
"effort", and "training scenes" the same on scenes of the training. "Minutes" are the steps times the median time
of a step, on one thread; other work on the machine made some rows slower, so rows with equal steps differ. An "answer"
is the median time from the question to positions and stress, for a scene alone, with all that is prepared for its mesh.
Rows without a solver were measured beside other work: their errors count, their times say little.
Validation has chosen how many corrections and Newton steps follow the first call of the model in the first table;
`predict(effort=)` chooses them for an answer. The tables below the first are the whole dial: they
were timed again, so times differ a little from the first table. The stress error in them is a share of the standard
deviation of the true stress in the frame: 1 is no better than the mean stress everywhere. Newton steps end when one is
small; where they do not end, the page says so.

The solver goes from rest to the same frame, on one thread: straight in one, two or four load steps and frame by frame,
whichever is fastest. What it prepares for a mesh is counted, too; the meshing is not. "Solver" is its time at its own
stop test. For "cheapest" {settings} are tried in each scene: the own stop test and looser ones, a longer range of
contact, meshes of a half and a quarter of the nodes, and 6 or 12 load steps of one Newton step with linearised contact.
In each scene the fastest counts whose error is at most the answer's; the own stop test always may. Its time divided by
the answer's time is the ratio of the scene. Seconds are medians, and "times as long" is the median of the ratios over
the scenes in which the solver was run (ten; five pairs of parts), with its standard error.
"""


def _table(shown: Sequence[MeasuredRow]) -> list[str]:
    head = ["scenes", "trained", "minutes", "one call", "effort", "error", "training scenes", "answer"]
    head += ["solver", "cheapest"]
    lines = ["| " + " | ".join(head) + " |", "| --- | --- | ---: | ---: | --- |" + " ---: |" * (len(head) - 5)]
    for one in shown:
        scenes = one.deepest.scenes
        errors = [scene.relative_error for scene in scenes]
        seconds = [scene.seconds for scene in scenes]
        lines.append("| " + " | ".join([
            one.row.title,
            _trained_text(one.row),
            f"{one.minutes:.0f}",
            mean_percent(one.dial[0].relative_error) if one.dial else "-",
            one.effort.text if one.row.model_settings.get("jumps", True) else "every frame",
            mean_percent(errors),
            f"{100 * one.training_scenes:.1f} %",
            f"{1000 * np.median(seconds):.0f} ms",
            beside_solver(scenes, [0.0] * len(errors), seconds),
            beside_solver(scenes, errors, seconds),
        ]) + " |")  # fmt: skip
    return lines


def _trained_text(row: Row) -> str:
    corrections = row.settings.get("corrections", 0)
    together = f", {corrections + 1} calls trained together" if corrections else ""
    return f"{row.train:,} scenes, {row.steps:,} steps{together}"


def mean_percent(errors: list[float | None]) -> str:
    """The mean with its standard error, as in "2.8 ± 0.2 %", and how many are missing."""
    known = [100 * error for error in errors if error is not None]
    failed = f", {len(errors) - len(known)} failed" if len(known) < len(errors) else ""
    digits = 1 if np.mean(known) >= 1 else 2
    return f"{np.mean(known):.{digits}f} ± {np.std(known) / len(known) ** 0.5:.{digits}f} %{failed}"


def _section(one: MeasuredRow) -> list[str]:
    deepest = one.deepest
    lines = ["", f"## {one.row.title}", "", over_the_scenes(deepest.scenes)]
    not_converged = [scene.name for scene in deepest.scenes if (scene.last_step or 0) > STILL]
    if not_converged:
        share = f"{len(not_converged)} of {len(deepest.scenes)} scenes"
        lines.append(f"The Newton steps have not converged in {share}: {', '.join(not_converged)}.")
    if deepest.stress_share is not None and deepest.largest_stress is not None:
        lines.append(
            f"Stress: the error is {deepest.stress_share:.2f} times the standard deviation of the true stress; the"
            f" largest stress is {100 * deepest.largest_stress:.0f} % off."
        )
    if one.curve:
        lines.append(curve_line(one.curve))
    if one.dial:
        head = ["corrections", "Newton steps", "error", "stress", "answer", "cheapest"]
        lines += ["", "| " + " | ".join(head) + " |", "|" + " ---: |" * len(head)]
    for turned in one.dial:
        lines.append("| " + " | ".join([
            f"{turned.effort.corrections}",
            f"up to {turned.effort.newton_steps}" if turned.effort.newton_steps else "0",
            mean_percent(turned.relative_error),
            "-" if turned.stress_share is None else f"{turned.stress_share:.2f}",
            f"{1000 * np.median(turned.seconds):.0f} ms",
            beside_solver(deepest.scenes, turned.relative_error, turned.seconds),
        ]) + " |")  # fmt: skip
    return lines


def main(arguments: Sequence[str] | None = None) -> None:
    study_rows(__doc__, ROWS, arguments, measured, _said, (RESULTS, PAGE), page)


def _said(record: dict[str, Any]) -> str:
    return f"{100 * MeasuredRow.from_json(record).deepest.relative_error:.3g} %"


if __name__ == "__main__":
    main()

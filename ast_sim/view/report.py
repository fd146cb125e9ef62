"""The report of runs: moving scenes, error curves, tables and the facts of the run, on one page (`page`).

`encode` packs the data into arrays, and the scripts in `assets` draw them.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ast_sim.figures import Figures
from ast_sim.scene import Trajectory
from ast_sim.support.errors import AstSimError
from ast_sim.view import page, tables
from ast_sim.view.encode import encode_curves, encode_scene, finite_json, motion_bytes

MOTION_BYTES = 3_600_000  # limit for all scenes together; longer scenes show every n-th frame
MIN_FRAMES = 12  # a scene keeps at least this many, however large it is
MAX_RUNS = 6  # a page draws one panel a run, and browsers allow at most 16


@dataclass(frozen=True, eq=False)
class ReportScene:
    """A test scene to show: `name` as in the evaluation's samples; `label` says why it was chosen ("median")."""

    name: str
    label: str
    truth: Trajectory
    prediction: Trajectory


@dataclass(frozen=True, eq=False)
class ReportRun:
    """What the report says of one run.

    Attributes:
        name: name of the run for the readers.
        model: name under which the model is registered, such as "ast".
        scenes: predictions to show.
        evaluation: what an evaluation measured, or None.
        metrics: the lines of `metrics.jsonl`.
        facts: model, parameters, data, seeds, in the order to show; the evaluation adds facts of its own.
    """

    name: str
    model: str
    scenes: Sequence[ReportScene]
    evaluation: Figures | None = None
    metrics: Sequence[Mapping[str, Any]] = ()
    facts: Mapping[str, str] = field(default_factory=dict)


def representative(errors: Mapping[str, float]) -> list[tuple[str, str]]:
    """The (label, name) of the scenes with the best, the median and the worst error; of fewer than three, all of them.

    A scene whose error is not finite (its rollout failed) counts as worse than any other.
    """
    ranked = sorted(errors, key=lambda name: (not errors[name] < float("inf"), errors[name], name))
    if len(ranked) < 3:
        return list(zip(["Best", "Worst"] if len(ranked) == 2 else ["Only scene"], ranked, strict=False))
    return [("Best", ranked[0]), ("Median", ranked[(len(ranked) - 1) // 2]), ("Worst", ranked[-1])]


def write(path: str | os.PathLike[str], runs: Sequence[ReportRun], title: str) -> None:
    """Write the report of one run, or of several side by side, as one HTML file.

    Scenes of several runs are matched by name. The truth and the label come from the first run that has the scene.

    Raises:
        AstSimError: there is no run or too many, a prediction belongs to another scene than its truth, or the file
            cannot be written.
        MissingExtra: plotly is not installed.
    """
    if not 1 <= len(runs) <= MAX_RUNS:
        raise AstSimError(f"a report shows 1 to {MAX_RUNS} runs, not {len(runs)}")
    page.write(path, page_data(runs), title)


def page_data(runs: Sequence[ReportRun]) -> dict[str, Any]:
    """Everything that the page's scripts show, as JSON."""
    names = _distinct([run.name for run in runs])
    models = [tables.TITLES.get(run.model, run.model) for run in runs]
    evaluations = [run.evaluation for run in runs]
    scenes = _scenes(runs)
    samples = tables.samples(evaluations, names)
    errors = dict(zip(samples["names"], samples["runs"][0], strict=True)) if samples else {}
    for scene in scenes:
        scene["error"] = errors.get(scene["name"])
    return finite_json(
        {
            "kind": "runs",
            "lead": _lead(runs, names),
            "tiles": tables.tiles(evaluations[0]) if len(runs) == 1 else [],
            "comparison": tables.comparison(names, evaluations),
            "units": tables.units(evaluations),
            "scenes": scenes,
            "scenesNote": _scenes_note(scenes, evaluations[0]),
            "tables": tables.measure_tables(names if len(runs) > 1 else models, evaluations),
            "samples": samples,
            "runs": [_run(run, name) for run, name in zip(runs, names, strict=True)],
            "footer": page.FOOTER,
        }
    )


def _run(run: ReportRun, name: str) -> dict[str, Any]:
    training, validation = tables.training_curves(run.metrics)
    facts = {**run.facts, **tables.evaluation_facts(run.evaluation)}
    rows = [[key, str(value)] for key, value in facts.items()]
    return {"name": name, "training": training, "validation": validation, "facts": rows}


def _scenes(runs: Sequence[ReportRun]) -> list[dict[str, Any]]:
    """The scenes of all runs, in order of their first appearance. Each has one prediction (or None) for each run."""
    first: dict[str, ReportScene] = {}
    for run in runs:
        for scene in run.scenes:
            first.setdefault(scene.name, scene)
    by_run = [{scene.name: scene.prediction for scene in run.scenes} for run in runs]
    cost = {
        name: motion_bytes(scene.truth) * (1 + sum(name in predictions for predictions in by_run))
        for name, scene in first.items()
    }
    total = sum(cost[name] * scene.truth.num_frames for name, scene in first.items())
    encoded = []
    for name, scene in first.items():
        frames = scene.truth.num_frames
        stride = max(1, min(-(-total // MOTION_BYTES), (frames - 1) // (MIN_FRAMES - 1)))
        predictions = [predictions.get(name) for predictions in by_run]
        shown = encode_scene(scene.truth, np.arange(0, frames, stride), predictions)
        curves = encode_curves(scene.truth, predictions)
        encoded.append({"name": name, "label": scene.label, **shown, "curves": curves})
    return encoded


def _scenes_note(scenes: Sequence[dict[str, Any]], evaluation: Figures | None) -> str:
    count = len(evaluation.scenes) if evaluation else 0
    note = ""
    if {"Best", "Median", "Worst"} <= {scene["label"] for scene in scenes} and count:
        note = (
            f"The best, the median and the worst of all {count} test scenes, by the displacement error of the rollout."
        )
    if any(len(scene["frames"]) < scene["total"] for scene in scenes):
        note += " Long scenes show evenly spaced frames only, to keep the page small; the curves have all frames."
    return note.strip()


def _lead(runs: Sequence[ReportRun], names: Sequence[str]) -> str:
    if len(runs) > 1:
        return f"Runs compared: {', '.join(names)}."
    return f"“{names[0]}” predicts scenes that it never saw, from their first frame and the obstacle’s path."


def _distinct(names: Sequence[str]) -> list[str]:
    """The names, numbered where one appears again."""
    counts: dict[str, int] = {}
    result = []
    for name in names:
        counts[name] = counts.get(name, 0) + 1
        result.append(name if counts[name] == 1 else f"{name} ({counts[name]})")
    return result

"""The figures of an evaluation (`ast-sim evaluate --out`) and of a training, arranged for the report's page."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ast_sim.figures import DeepestFrames, Figures, SceneFigures, main_nodes
from ast_sim.number_arrays import measured_time
from ast_sim.support.errors import counted
from ast_sim.view.encode import Json

DEFAULT_UNITS = {"displacement": "m", "stress": "Pa"}
HORIZONS = {"rollout_all": "Full rollout", "rollout_50": "First 50 steps of the rollout", "one_step": "One step"}
NODES = {"normal": "NORMAL nodes", "all": "all nodes", "deforming": "outside the obstacles"}
MEASURES = ("rmse_sequence", "rmse_pooled")
TRIVIAL = {
    "displacement": {"hold_still": "Hold still", "repeat_last": "Repeat the last increment"},
    "stress": {"stress_zero": "Zero", "stress_constant": "Constant mean", "stress_frame_mean": "Mean of the frame"},
}
MODEL = "model"
# The models' names as papers write them; a model that is not listed goes by its own name.
TITLES = {"ast": "AST", "mgn": "MGN", "bsms": "BSMS", "hcmt": "HCMT", "transolver": "Transolver"}
TRAINING_POINTS = 400  # a longer training curve is reduced to this many means


def units(evaluations: Sequence[Figures | None]) -> dict[str, str]:
    """The units of displacement and stress; metres and pascal where no evaluation says otherwise."""
    known = next((evaluation for evaluation in evaluations if evaluation), None)
    return {quantity: default if known is None else known.unit(quantity) for quantity, default in DEFAULT_UNITS.items()}


def measure_tables(names: Sequence[str], evaluations: Sequence[Figures | None]) -> list[Json]:
    """Two tables of errors: displacement and stress. Rows are measures; columns are runs and trivial predictors.

    The trivial predictors do not depend on the run, so they are taken from the first evaluation that has them. A
    model that jumps has no row for one step, because each of its frames is one step from the first.
    """
    unit = units(evaluations)
    tables = []
    for quantity, title in (("displacement", "Displacement"), ("stress", "von Mises stress")):
        columns = [(evaluation, MODEL) for evaluation in evaluations]
        for predictor in TRIVIAL[quantity]:
            first = next((e for e in evaluations if e and e.error(quantity, predictor)), None)
            columns.append((first, predictor))
        rows = _measure_rows(quantity, columns, _horizons(evaluations))
        if rows:
            titles = [*names, *TRIVIAL[quantity].values()]
            tables.append({"title": title, "unit": unit[quantity], "columns": titles, "rows": rows, "runs": len(names)})
    return tables


def _horizons(evaluations: Sequence[Figures | None]) -> dict[str, str]:
    """The horizons to show. The first 50 steps are the full rollout if no scene has more."""
    frames = [scene.frames for evaluation in evaluations if evaluation for scene in evaluation.scenes]
    short = bool(frames) and max(frames) <= 51
    return {key: title for key, title in HORIZONS.items() if not (short and key == "rollout_50")}


def _measure_rows(
    quantity: str, columns: Sequence[tuple[Figures | None, str]], horizons: Mapping[str, str]
) -> list[Json]:
    rows: list[Json] = []
    for horizon, title in horizons.items():
        of_title = []
        for nodes, measure in itertools.product(NODES, MEASURES):
            values = [_measure(figures, quantity, predictor, horizon, nodes, measure) for figures, predictor in columns]
            if any(value is not None for value in values):
                of_title.append({"label": measure, "note": NODES[nodes], "values": values})
        if of_title:
            rows += [{"group": title}, *of_title]
    return rows


def _measure(
    figures: Figures | None, quantity: str, predictor: str, horizon: str, nodes: str, measure: str
) -> float | None:
    if figures is None:
        return None
    row = figures.error(quantity, predictor, horizon, nodes)
    return None if row is None else getattr(row, measure)


def tiles(evaluation: Figures | None) -> list[Json]:
    """The figures that matter most, for the head of the page: errors, time, and how much was tested."""
    if not evaluation:
        return []
    shown = []
    for quantity, title, trivial in (
        ("displacement", "Displacement error", "hold_still"),
        ("stress", "Stress error", "stress_frame_mean"),
    ):
        model, reference = (evaluation.error(quantity, name) for name in (MODEL, trivial))
        if model is None:
            continue
        error = model.rmse_sequence
        detail = "full rollout, rmse_sequence"
        if error is None:
            detail = "no figure, because a rollout failed"
        elif reference is not None and reference.rmse_sequence:
            share = 100 * error / reference.rmse_sequence
            detail = f"{share:.0f} % of “{TRIVIAL[quantity][trivial].lower()}”, full rollout"
        shown.append({"label": title, "value": error, "unit": evaluation.unit(quantity), "detail": detail})
    return shown + _deepest_tiles(evaluation.deepest) + _speed_tiles(evaluation) + _scope_tiles(evaluation)


def _deepest_tiles(frames: DeepestFrames) -> list[Json]:
    """The deepest frame, predicted alone, beside the solver."""
    if frames.relative_error is None or frames.seconds is None:
        return []
    detail = f"of the displacement, {measured_time(frames.seconds)} on one thread"
    if frames.solver is not None:
        detail += f"; the solver: {measured_time(frames.solver.seconds)}"
    value = f"{100 * frames.relative_error:.3g}"
    return [{"label": "Deepest frame alone", "value": value, "suffix": "%", "detail": detail}]


def _speed_tiles(evaluation: Figures) -> list[Json]:
    model, solver = (median_of(evaluation, f"{who}_seconds_per_step") for who in ("model", "solver"))
    if model is None:
        return []
    where = f" on {counted(evaluation.threads, 'thread')}"
    tile = {"label": "Time per step", "value": model, "unit": "s", "detail": f"median over the scenes{where}"}
    if solver:
        tile["detail"] = f"solver: {measured_time(solver)} on 1 thread; model{where}; medians"
    if evaluation.speedup is None:
        return [tile]
    faster = {
        "label": "Speed-up over the solver",
        "value": f"{evaluation.speedup:.3g}",
        "suffix": "×",
        "detail": "all frames of the same scenes, one thread each; the solver’s time was recorded when it made them",
    }
    return [tile, faster]


def _scope_tiles(evaluation: Figures) -> list[Json]:
    if not evaluation.scenes:
        return []
    failures = evaluation.failures
    detail = f"{np.mean([scene.nodes for scene in evaluation.scenes]):.0f} nodes on average"
    if failures:
        detail = f"{counted(failures, 'rollout')} failed"
    return [{"label": "Test scenes", "value": str(len(evaluation.scenes)), "detail": detail}]


def median_of(evaluation: Figures | None, key: str) -> float | None:
    """The median of a number, over the scenes that have it."""
    values = [getattr(scene, key) for scene in (evaluation.scenes if evaluation else ())]
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def comparison(names: Sequence[str], evaluations: Sequence[Figures | None]) -> Json | None:
    """For several runs, the figures by which one chooses: one row a run."""
    if len(names) < 2 or not any(evaluations):
        return None
    unit = units(evaluations)

    def column(label: str, unit: str, values: list[Any]) -> Json:
        return {"label": label, "unit": unit, "values": values}

    def errors(quantity: str) -> list[Any]:
        nodes = main_nodes(quantity)
        return [_measure(e, quantity, MODEL, "rollout_all", nodes, "rmse_sequence") for e in evaluations]

    columns = [
        column("Displacement error", unit["displacement"], errors("displacement")),
        column("Stress error", unit["stress"], errors("stress")),
        column("Time per step", "s", [median_of(e, "model_seconds_per_step") for e in evaluations]),
        column("Speed-up over the solver", "×", [e.speedup if e else None for e in evaluations]),
    ]
    return {"names": list(names), "columns": [c for c in columns if any(v is not None for v in c["values"])]}


def samples(evaluations: Sequence[Figures | None], names: Sequence[str]) -> Json | None:
    """Errors of every test scene over the full rollout, in ascending order of the first run's; failed ones last."""
    by_run = [{scene.name: scene for scene in (e.scenes if e else ())} for e in evaluations]
    scenes = list(dict.fromkeys(name for run in by_run for name in run))
    if not scenes:
        return None

    def values(run: int, number: Callable[[SceneFigures], Any]) -> list[Any]:
        return [number(by_run[run][name]) if name in by_run[run] else None for name in scenes]

    def first(number: Callable[[SceneFigures], Any]) -> list[Any]:
        columns = [values(run, number) for run in range(len(by_run))]
        return [next((value for value in row if value is not None), None) for row in zip(*columns, strict=True)]

    runs = [values(run, lambda scene: scene.error("displacement")) for run in range(len(by_run))]
    order = sorted(range(len(scenes)), key=lambda i: (runs[0][i] is None, runs[0][i] or 0.0, scenes[i]))
    unit = units(evaluations)
    trivial = first(lambda scene: scene.error("displacement", "hold_still"))
    columns = [
        {"label": "Nodes", "unit": None, "values": first(lambda scene: scene.nodes)},
        {"label": "Frames", "unit": None, "values": first(lambda scene: scene.frames)},
    ]

    def add(label: str, unit: str, per_run: list[list[Any]]) -> None:
        for name, numbers in zip(names, per_run, strict=True):
            suffix = f", {name}" if len(names) > 1 else ""
            columns.append({"label": label + suffix, "unit": unit, "values": numbers})

    every = range(len(by_run))
    add("Displacement", unit["displacement"], runs)
    columns.append({"label": "Hold still", "unit": unit["displacement"], "values": trivial})
    add("Stress", unit["stress"], [values(run, lambda scene: scene.error("stress")) for run in every])
    add("Model’s step", "s", [values(run, lambda scene: scene.model_seconds_per_step) for run in every])
    solver = first(lambda scene: scene.solver_seconds_per_step)
    columns.append({"label": "Solver’s step", "unit": "s", "values": solver})
    return {
        "names": scenes,
        "order": order,
        "unit": unit["displacement"],
        "runs": runs,
        "trivial": trivial,
        "table": [c for c in columns if any(v is not None for v in c["values"])],
    }


def training_curves(metrics: Sequence[Mapping[str, Any]]) -> tuple[list[Json], list[Json]]:
    """The training losses and the validation errors by step, from the lines of `metrics.jsonl`."""
    losses = _curves(metrics, {"loss": "Loss", "motion": "Motion", "stress": "Stress"})
    return losses, _curves(metrics, {"valid_rmse": "Model", "valid_hold_still": "Hold still"})


def _curves(metrics: Sequence[Mapping[str, Any]], labels: Mapping[str, str]) -> list[Json]:
    curves = []
    for key, label in labels.items():
        points = [(m["step"], m[key]) for m in metrics if isinstance(m.get(key), int | float)]
        if points:
            parts = np.array_split(np.array(points, dtype=float), min(len(points), TRAINING_POINTS))
            step, value = np.array([part.mean(axis=0) for part in parts]).T
            curves.append({"name": label, "x": step.round().tolist(), "y": value.tolist()})
    return curves


def evaluation_facts(evaluation: Figures | None) -> dict[str, str]:
    """Where the figures come from: data, processor, versions, commit, command."""
    if not evaluation:
        return {}
    origin = evaluation.origin
    versions = ", ".join(f"{name} {number}" for name, number in origin.get("versions", {}).items() if number)
    processor = origin.get("processor")
    if processor:
        processor = f"{processor}, {counted(evaluation.threads, 'thread')}"
    facts = {
        "Run": origin.get("run"),
        "Data file": origin.get("data"),
        "Split": origin.get("split"),
        "Processor": processor,
        "Versions": versions,
        "Commit": origin.get("commit"),
        "Command": origin.get("command"),
    }
    return {key: str(value) for key, value in facts.items() if value}

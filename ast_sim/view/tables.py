"""The figures of an evaluation (`ast-sim evaluate --out`) and of a training, arranged for the report's page."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

Json = dict[str, Any]

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


def units(evaluations: Sequence[Json | None]) -> dict[str, str]:
    """The units of displacement and stress; metres and pascal where no evaluation says otherwise."""
    known = next((evaluation for evaluation in evaluations if evaluation), {})
    return {"displacement": known.get("length_unit", "m"), "stress": known.get("stress_unit", "Pa")}


def lookup(tree: Any, *keys: str) -> Any:
    """tree[key][key]..., or None if a key is missing."""
    for key in keys:
        tree = tree.get(key) if isinstance(tree, Mapping) else None
    return tree


def measure_tables(names: Sequence[str], evaluations: Sequence[Json | None]) -> list[Json]:
    """Two tables of errors: displacement and stress. Rows are measures; columns are runs and trivial predictors.

    The trivial predictors do not depend on the run, so they are taken from the first evaluation that has them. A
    model that jumps has no row for one step, because each of its frames is one step from the first.
    """
    unit = units(evaluations)
    summaries = [lookup(evaluation, "summary") for evaluation in evaluations]
    tables = []
    for quantity, title in (("displacement", "Displacement"), ("stress", "von Mises stress")):
        sources = [_of_model(evaluation, quantity) for evaluation in evaluations]
        for key in TRIVIAL[quantity]:
            sources.append(next((f for s in summaries if (f := lookup(s, key, quantity))), None))
        rows = _measure_rows(sources, _horizons(evaluations))
        if rows:
            columns = [*names, *TRIVIAL[quantity].values()]
            tables.append(
                {"title": title, "unit": unit[quantity], "columns": columns, "rows": rows, "runs": len(names)}
            )
    return tables


def _of_model(evaluation: Json | None, quantity: str) -> Json | None:
    found = lookup(evaluation, "summary", MODEL, quantity)
    if found is None or not evaluation.get("jumps"):
        return found
    return {horizon: errors for horizon, errors in found.items() if horizon != "one_step"}


def _horizons(evaluations: Sequence[Json | None]) -> dict[str, str]:
    """The horizons to show. The first 50 steps are the full rollout if no scene has more than these."""
    frames = [sample.get("frames") for e in evaluations for sample in (e or {}).get("samples") or []]
    short = bool(frames) and all(count is not None and count <= 51 for count in frames)
    return {key: title for key, title in HORIZONS.items() if not (short and key == "rollout_50")}


def _measure_rows(sources: Sequence[Json | None], horizons: Mapping[str, str]) -> list[Json]:
    rows: list[Json] = []
    for horizon, title in horizons.items():
        found = []
        for nodes, measure in itertools.product(NODES, MEASURES):
            values = [lookup(source, horizon, nodes, measure) for source in sources]
            if any(value is not None for value in values):
                found.append({"label": measure, "note": NODES[nodes], "values": values})
        if found:
            rows += [{"group": title}, *found]
    return rows


def tiles(evaluation: Json | None) -> list[Json]:
    """The figures that matter most, for the head of the page: errors, time, and how much was tested."""
    if not evaluation:
        return []
    unit, found = units([evaluation]), []
    for quantity, title, nodes, trivial in (
        ("displacement", "Displacement error", "normal", "hold_still"),
        ("stress", "Stress error", "deforming", "stress_frame_mean"),
    ):
        path = (quantity, "rollout_all", nodes, "rmse_sequence")
        error = lookup(evaluation, "summary", MODEL, *path)
        if lookup(evaluation, "summary", MODEL, quantity) is None:
            continue
        reference = lookup(evaluation, "summary", trivial, *path)
        detail = "full rollout, rmse_sequence"
        if error is None:
            detail = "no figure, because a rollout failed"
        elif reference:
            detail = f"{100 * error / reference:.0f} % of “{TRIVIAL[quantity][trivial].lower()}”, full rollout"
        found.append({"label": title, "value": error, "unit": unit[quantity], "detail": detail})
    return found + _asked_tiles(evaluation) + _speed_tiles(evaluation) + _scope_tiles(evaluation)


def _asked_tiles(evaluation: Json) -> list[Json]:
    """The deepest frame, asked for alone, beside the solver."""
    error, seconds = lookup(evaluation, "asked", "relative_error"), lookup(evaluation, "asked", "seconds")
    if error is None or seconds is None:
        return []
    detail = f"of the displacement, {1000 * seconds:.3g} ms on one thread"
    solver = lookup(evaluation, "asked", "solver", "seconds")
    if solver is not None:
        detail += f"; the solver: {1000 * solver:.3g} ms"
    return [{"label": "Deepest frame alone", "value": f"{100 * error:.3g}", "suffix": "%", "detail": detail}]


def _speed_tiles(evaluation: Json) -> list[Json]:
    model, solver = (mean_of(evaluation, f"{who}_seconds_per_step") for who in ("model", "solver"))
    if model is None:
        return []
    threads = evaluation.get("threads")
    where = f" on {threads} thread{'s' if threads != 1 else ''}" if threads else ""
    tile = {"label": "Time per step", "value": model, "unit": "s", "detail": f"mean over the scenes{where}"}
    if solver:
        tile["detail"] = f"solver: {1000 * solver:.3g} ms on 1 thread" + (f"; model{where}" if where else "")
    speedup = evaluation.get("speedup")
    if speedup is None:
        return [tile]
    faster = {
        "label": "Speed-up over the solver",
        "value": f"{speedup:.3g}",
        "suffix": "×",
        "detail": "all frames of the same scenes, one thread each; the solver’s time was recorded when it made them",
    }
    return [tile, faster]


def _scope_tiles(evaluation: Json) -> list[Json]:
    samples = evaluation.get("samples") or []
    if not samples:
        return []
    failures = evaluation.get("failures") or 0
    nodes = np.mean([sample["nodes"] for sample in samples if sample.get("nodes")] or [0])
    detail = f"{nodes:.0f} nodes on average" if nodes else ""
    if failures:
        detail = f"{failures} rollout{'s' if failures != 1 else ''} failed"
    return [{"label": "Test scenes", "value": str(len(samples)), "detail": detail}]


def mean_of(evaluation: Json | None, key: str) -> float | None:
    """The mean of a number of the samples, over those that have it."""
    values = [sample[key] for sample in (evaluation or {}).get("samples") or [] if sample.get(key) is not None]
    return float(np.mean(values)) if values else None


def comparison(names: Sequence[str], evaluations: Sequence[Json | None]) -> Json | None:
    """For several runs, the figures by which one chooses: one row a run."""
    if len(names) < 2 or not any(evaluations):
        return None
    unit = units(evaluations)

    def column(label: str, unit: str, values: list[Any]) -> Json:
        return {"label": label, "unit": unit, "values": values}

    def errors(quantity: str, nodes: str) -> list[Any]:
        return [lookup(e, "summary", MODEL, quantity, "rollout_all", nodes, "rmse_sequence") for e in evaluations]

    columns = [
        column("Displacement error", unit["displacement"], errors("displacement", "normal")),
        column("Stress error", unit["stress"], errors("stress", "deforming")),
        column("Time per step", "s", [mean_of(e, "model_seconds_per_step") for e in evaluations]),
        column("Speed-up over the solver", "×", [lookup(e, "speedup") for e in evaluations]),
    ]
    return {"names": list(names), "columns": [c for c in columns if any(v is not None for v in c["values"])]}


def samples(evaluations: Sequence[Json | None], names: Sequence[str]) -> Json | None:
    """Errors of every test scene over the full rollout, in ascending order of the first run's; failed ones last."""
    lists = [{s["name"]: s for s in (e or {}).get("samples") or []} for e in evaluations]
    scenes = list(dict.fromkeys(name for samples in lists for name in samples))
    if not scenes:
        return None

    def values(run: int, *path: str) -> list[Any]:
        return [lookup(lists[run].get(name), *path) for name in scenes]

    def first(*path: str) -> list[Any]:
        return [next((f for s in lists if (f := lookup(s.get(name), *path)) is not None), None) for name in scenes]

    path = (MODEL, "rollout_all", "normal")
    runs = [values(run, "displacement", *path) for run in range(len(lists))]
    order = sorted(range(len(scenes)), key=lambda i: (runs[0][i] is None, runs[0][i] or 0.0, scenes[i]))
    unit = units(evaluations)
    trivial = first("displacement", "hold_still", "rollout_all", "normal")
    columns = [
        {"label": "Nodes", "unit": None, "values": first("nodes")},
        {"label": "Frames", "unit": None, "values": first("frames")},
    ]

    def add(label: str, unit: str, per_run: list[list[Any]]) -> None:
        for name, numbers in zip(names, per_run, strict=True):
            suffix = f", {name}" if len(names) > 1 else ""
            columns.append({"label": label + suffix, "unit": unit, "values": numbers})

    every = range(len(lists))
    add("Displacement", unit["displacement"], runs)
    columns.append({"label": "Hold still", "unit": unit["displacement"], "values": trivial})
    add("Stress", unit["stress"], [values(run, "stress", MODEL, "rollout_all", "deforming") for run in every])
    add("Model’s step", "s", [values(run, "model_seconds_per_step") for run in every])
    columns.append({"label": "Solver’s step", "unit": "s", "values": first("solver_seconds_per_step")})
    return {
        "names": scenes,
        "order": order,
        "unit": unit["displacement"],
        "runs": runs,
        "trivial": trivial,
        "table": [c for c in columns if any(v is not None for v in c["values"])],
    }


def training_curves(metrics: Sequence[Json]) -> tuple[list[Json], list[Json]]:
    """The training losses and the validation errors by step, from the lines of `metrics.jsonl`."""
    losses = _curves(metrics, {"loss": "Loss", "motion": "Motion", "stress": "Stress"})
    return losses, _curves(metrics, {"valid_rmse": "Model", "valid_hold_still": "Hold still"})


def _curves(metrics: Sequence[Json], labels: Mapping[str, str]) -> list[Json]:
    curves = []
    for key, label in labels.items():
        points = [(m["step"], m[key]) for m in metrics if isinstance(m.get(key), int | float)]
        if points:
            parts = np.array_split(np.array(points, dtype=float), min(len(points), TRAINING_POINTS))
            step, value = np.array([part.mean(axis=0) for part in parts]).T
            curves.append({"name": label, "x": step.round().tolist(), "y": value.tolist()})
    return curves


def evaluation_facts(evaluation: Json | None) -> dict[str, str]:
    """Where the figures come from: data, processor, versions, commit, command."""
    if not evaluation:
        return {}
    versions = ", ".join(f"{name} {number}" for name, number in (evaluation.get("versions") or {}).items() if number)
    processor, threads = evaluation.get("processor"), evaluation.get("threads")
    if processor and threads:
        processor = f"{processor}, {threads} thread{'s' if threads != 1 else ''}"
    found = {
        "Run": evaluation.get("run"),
        "Data file": evaluation.get("data"),
        "Split": evaluation.get("split"),
        "Processor": processor,
        "Versions": versions,
        "Commit": evaluation.get("commit"),
        "Command": evaluation.get("command"),
    }
    return {key: str(value) for key, value in found.items() if value}

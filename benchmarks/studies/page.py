"""Writes docs/results/study.md: all studies that have a result, their curves, and the cost of the mesh size.

`python -m benchmarks.studies.page` writes it from benchmarks/results.
"""

from __future__ import annotations

import json
import statistics
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.steps import scaling_page
from benchmarks.studies.measured_run import MeasuredRun
from benchmarks.svg import axes_of_picture, save

INTRODUCTION = """# The models compared

Made by `python -m benchmarks.studies STUDY.toml`; the studies lie in `benchmarks/studies`. All runs of a study have the
same scenes, splits, time budget and settings of the training, except where a row names another setting, and except for
the state noise, which the tables show: a model that is trained on its own rollouts needs less of it.

- **Training.** Each model has the one of several learning rates with the best rollouts of the validation scenes. These
  rollouts also choose the checkpoint. The number of steps is what fits into the budget at the speed of the model, which
  was measured in turns before the trainings; for a row that came later, in turns with a row of the study, whose speed
  is then scaled. The tables also show how long each training took by the clock, beside other work.
- **Errors** are of the free nodes of the test scenes: root mean squares over coordinates, by sequence (`rmse_sequence`,
  as in the AST paper) or pooled over everything (`rmse_pooled`, as in MeshGraphNets). Each number is the mean over the
  seeds, with the lowest and the highest in brackets. All models go step by step here (`model.jumps=false`).
"""

AIM = 0.5  # AST's rollout error over the best baseline's; the paper reports 0.38 on deforming_plate
BASELINES = ("mgn", "bsms", "hcmt")  # of the paper

Run = dict[str, Any]
Value = Callable[[Run], Any]


def write_page(results: Path, pages: Path) -> None:
    """Write study.md and its pictures into `pages`, from the files study_*.json in `results`."""
    studies = {file.stem.removeprefix("study_"): read(file) for file in sorted(results.glob("study_*.json"))}
    parts = [INTRODUCTION, *glance({record["study"]["title"]: record["models"] for record in studies.values()})]
    for name, record in studies.items():
        draw(record, pages / "study" / f"{name}.svg")
        parts.append(section(record, name))
    if (sizes := results / "scaling.json").exists():
        record = json.loads(sizes.read_text(encoding="utf-8"))
        scaling_page.draw(record, pages / "study" / "scaling.svg")
        parts.append(scaling_page.section(record))
    (pages / "study.md").write_text("\n".join(parts), encoding="utf-8")


def read(file: Path) -> dict[str, Any]:
    """A result file of a study, in which a run that was measured has a MeasuredRun."""
    study = json.loads(file.read_text(encoding="utf-8"))
    for run in (run for model in study["models"].values() for run in model["runs"] if "measured" in run):
        run["measured"] = MeasuredRun.from_json(run["measured"])
    return study


def section(record: dict[str, Any], name: str) -> str:
    """One study: what it is, who is ahead, errors, errors by phase, cost, learning rates, settings."""
    study, models = record["study"], record["models"]
    budget = f"{study['minutes']:g} minutes" if study["minutes"] is not None else f"{study['samples']:,} frame pairs"
    lines = [f"## {study['title']}", "", *([study["about"], ""] if study["about"] else [])]
    lines += [
        f"{scenes(record['scenes'], study['data'])}; {budget} of training on {study['threads']} thread(s);"
        f" {seeds(models)}; {', '.join(origins(models))}.",
        "",
    ]
    lines += [*verdict(models), *table(models, ERRORS), "", *trivial(models), ""]
    if any(one.phases for one in measured_runs(models)):
        lines += ["Error by phase of contact, full rollout, mm (`rmse_sequence`):", "", *table(models, BY_PHASE), ""]
    lines += [
        *table(models, COST),
        "",
        *rates(study, models),
        "",
        *own_settings(study, models),
        *divergences(models, study["horizons"]),
        "",
    ]
    lines += [f"![Validation error over training time](study/{name}.svg)", ""]
    return "\n".join(lines)


def scenes(counts: dict[str, Any], data: dict[str, Any]) -> str:
    """What the runs were trained and tested on."""
    size = "".join(f", {data[key]:,} {key}" for key in ("nodes", "frames") if data[key] is not None)
    numbers = f"{counts['train']} scenes to train on, {counts['valid']} to validate, {counts['test']} to test"
    return f"`{counts['name']}`: {numbers}{size}"


def seeds(models: dict[str, Any]) -> str:
    """The seeds of the runs: of most rows, then of rows that have others."""
    rows = {name: ", ".join(str(run["seed"]) for run in model["runs"]) for name, model in models.items()}
    (common, _), *others = Counter(rows.values()).most_common()
    told = "; ".join(f"{', '.join(name for name in rows if rows[name] == theirs)}: {theirs}" for theirs, _ in others)
    return f"seeds {common}" + (f" ({told})" if others else "")


def origins(models: dict[str, Any]) -> list[str]:
    """The commits and processors of the runs, each once."""
    made = [one.figures.origin for one in measured_runs(models)]
    commits = sorted({(record["commit"] or "?")[:10] for record in made})
    return [
        f"commit{'s' if len(commits) > 1 else ''} {', '.join(commits)}",
        *sorted({record["processor"] for record in made}),
    ]


def measured(run: Run) -> MeasuredRun | None:
    """None: the run failed."""
    return run.get("measured")


def measured_runs(models: dict[str, Any]) -> list[MeasuredRun]:
    """The runs of all rows that did not fail."""
    return [one for model in models.values() for run in model["runs"] if (one := measured(run)) is not None]


def _of(value: Callable[[MeasuredRun], float | None], scale: float = 1) -> Value:
    """A figure of what was measured; None where the run failed."""

    def scaled(run: Run) -> float | None:
        one = measured(run)
        figure = None if one is None else value(one)
        return None if figure is None else scale * figure

    return scaled


def _error(quantity: str, horizon: str, scale: float, predictor: str = "model") -> Value:
    return _of(lambda one: one.error(quantity, predictor, horizon).rmse_sequence, scale)


Columns = dict[str, Value]
ERRORS: Columns = {
    "1 step, mm": _error("displacement", "one_step", 1e3),
    "50 steps, mm": _error("displacement", "rollout_50", 1e3),
    "rollout, mm": _error("displacement", "rollout_all", 1e3),
    "pooled, mm": _of(lambda one: one.error("displacement").rmse_pooled, 1e3),
    "stress, 1 step, kPa": _error("stress", "one_step", 1e-3),
    "stress, rollout, kPa": _error("stress", "rollout_all", 1e-3),
}
BY_PHASE: Columns = {
    "before contact": _of(lambda one: one.phase_error("before"), 1e3),
    "first contact": _of(lambda one: one.phase_error("first"), 1e3),
    "full contact": _of(lambda one: one.phase_error("full"), 1e3),
    "release": _of(lambda one: one.phase_error("release"), 1e3),
}
COST: Columns = {
    "parameters": _of(lambda one: one.parameters),
    "learning rate": lambda run: run["rate"],
    "noise, mm": lambda run: None if run.get("noise") is None else 1e3 * run["noise"],
    "batch": lambda run: run["batch"],
    "ms a training step": lambda run: 1e3 * run["seconds_per_step"],
    "ms a frame pair": lambda run: 1e3 * run["seconds_per_step"] / run["batch"],
    "steps": lambda run: run["steps"],
    "trained, min": lambda run: run["train_seconds"] / 60,
    "peak memory, GB": lambda run: run["peak_resident_bytes"] / 1e9,
    "ms a rollout step": _of(MeasuredRun.seconds_per_step, 1e3),
}


def rollout_errors(models: dict[str, Any]) -> dict[str, float | None]:
    """The rollout error of each row, mm."""
    return {name: _mean(model["runs"], ERRORS["rollout, mm"]) for name, model in models.items()}


def opponents(models: dict[str, Any]) -> tuple[str, str] | None:
    """The first row of AST, and the baseline of the paper with the smallest rollout error; None if one is missing."""
    errors = rollout_errors(models)
    known = [name for name in models if errors[name] is not None]
    ours = next((name for name in known if models[name]["model"] == "ast"), None)
    baselines = [name for name in known if models[name]["model"] in BASELINES]
    return (ours, min(baselines, key=errors.__getitem__)) if ours and baselines else None


def verdict(models: dict[str, Any]) -> list[str]:
    """AST beside the best of the paper's baselines: error of the rollout and time of a frame pair."""
    pair = opponents(models)
    if pair is None:
        return []
    ours, best = pair
    errors = rollout_errors(models)
    ratio = errors[ours] / errors[best]
    text = (
        f"**The rollout error of {ours} is {number(ratio)} times the error of the best baseline, {best}**"
        f" (the aim is {AIM:g}"
    )
    text += ", reached)" if ratio <= AIM else ", not reached)"
    if "MGN" in models:
        times = [_mean(models[name]["runs"], COST["ms a frame pair"]) for name in (ours, "MGN")]
        text += f"; its training takes {number(times[0] / times[1])} of MGN's time per frame pair"
    smaller = {name: error for name, error in errors.items() if error is not None and error < errors[ours]}
    ahead = [f"{name} ({number(error / errors[best])})" for name, error in smaller.items()]
    text += f". Better: {'; '.join(ahead)}." if ahead else ". No other row has a smaller error."
    return [text, ""]


def glance(studies: dict[str, Any]) -> list[str]:
    """All studies in one table: AST's errors beside the errors of the best baseline of each, and over them."""
    columns = {
        "rollout, mm": ERRORS["rollout, mm"],
        "first contact, mm": BY_PHASE["first contact"],
        "stress, rollout, kPa": ERRORS["stress, rollout, kPa"],
    }
    lines = []
    for title, models in studies.items():
        pair = opponents(models)
        if pair is None:
            continue
        cells = []
        for value in columns.values():
            ours, theirs = (_mean(models[name]["runs"], value) for name in pair)
            cells.append(f"{number(ours)} : {number(theirs)} = **{number(ours / theirs)}**" if ours and theirs else "-")
        lines.append(f"| {title} | {' | '.join([*pair, *cells])} |")
    if not lines:
        return []
    head = [
        f"| study | AST | best baseline | {' | '.join(columns)} |",
        f"| --- | --- | --- |{' ---: |' * len(columns)}",
    ]
    return ["AST beside the best of the paper's baselines, and the ratio; below 1 AST is ahead:", "", *head, *lines, ""]


def own_settings(study: dict[str, Any], models: dict[str, Any]) -> list[str]:
    """What was set beyond the presets: in all runs, then in the runs of a row."""
    rows = [("all", study["settings"]), *((name, model["settings"]) for name, model in models.items())]
    told = [f"{name}: `{' '.join(settings)}`" for name, settings in rows if settings]
    return [f"Set beyond the presets. {'; '.join(told)}.", ""] if told else []


def _mean(runs: list[Run], value: Value) -> float | None:
    """The mean over the seeds; None if a run has no such figure."""
    values = [value(run) for run in runs]
    return None if None in values else statistics.fmean(values)


def rates(study: dict[str, Any], models: dict[str, Any]) -> list[str]:
    """The validation errors by which each model's learning rate was chosen."""
    searched = {name: model for name, model in models.items() if model["search"]}
    if not searched:
        return []
    share = "" if study["search"] == 1 else f" with {100 * study['search']:g} % of the budget"
    tried = sorted({rate for model in searched.values() for rate in model["search"]}, key=float)
    lines = [f"Rollout error on the validation scenes, mm, by learning rate{share}; the best in bold:", ""]
    lines += [f"| model | {' | '.join(tried)} |", f"| --- |{' ---: |' * len(tried)}"]
    for name, model in searched.items():
        cells = []
        for rate in tried:
            error = model["search"].get(rate)
            cell = "-" if error is None else number(1e3 * error)
            cells.append(f"**{cell}**" if float(rate) == model["rate"] else cell)
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def table(models: dict[str, Any], columns: Columns) -> list[str]:
    """A row a model, a column a figure; columns that no run has are left out."""
    cells = {
        name: {column: of_seeds(model["runs"], value) for column, value in columns.items()}
        for name, model in models.items()
    }
    shown = [column for column in columns if any(row[column] for row in cells.values())]
    if not shown:
        return []
    lines = [f"| model | {' | '.join(shown)} |", f"| --- |{' ---: |' * len(shown)}"]
    return lines + [f"| {name} | {' | '.join(row[column] or '-' for column in shown)} |" for name, row in cells.items()]


def of_seeds(runs: list[Run], value: Value) -> str:
    """Mean, and the least and the most in brackets where runs differ; "failed" if a run that has results has none."""
    values = [value(run) for run in runs]
    if all(x is None for x in values):
        return "failed" if any("failed" in run for run in runs) else ""
    if any(x is None for x in values):
        return "failed"
    mean = number(statistics.fmean(values))
    ends = [number(end(values)) for end in (min, max)]
    return mean if ends[0] == ends[1] else f"{mean} [{ends[0]}, {ends[1]}]"


def number(x: float) -> str:
    """Three significant digits, more where whole."""
    return f"{x:,.0f}" if abs(x) >= 1000 else f"{x:.3g}"


def trivial(models: dict[str, Any]) -> list[str]:
    """What predictors without a model reach on the same scenes."""
    runs = [run for model in models.values() for run in model["runs"] if measured(run) is not None]
    if not runs:
        return []
    texts = [
        f"{what} {number(error)} mm"
        for what, error in (
            ("one step: hold still", _error("displacement", "one_step", 1e3, "hold_still")(runs[0])),
            ("repeat the last increment", _error("displacement", "one_step", 1e3, "repeat_last")(runs[0])),
            ("rollout: hold still", _error("displacement", "rollout_all", 1e3, "hold_still")(runs[0])),
        )
        if error is not None
    ]
    return [f"Without a model: {', '.join(texts)}."]


def divergences(models: dict[str, Any], horizons: int) -> list[str]:
    """Which runs did not stay finite in the long rollouts, and when."""
    lines = []
    for name, model in models.items():
        for run in model["runs"]:
            if "failed" in run:
                lines.append(f"- {name}, seed {run['seed']}: not evaluated: {run['failed']}")
            one = measured(run)
            diverged = {} if one is None else one.diverged
            lines += [f"- {name}, seed {run['seed']}: {text}" for text in diverged.values()]
    farthest = {name: [one.farthest for one in measured_runs({name: model})] for name, model in models.items()}
    reach = ", ".join(f"{name} {max(values):.2g}" for name, values in farthest.items() if values)
    first = f"Rolled out for {horizons} times the length of the scenes"
    told = (
        f"{first}, these did not stay finite:" if lines else f"{first}, every model stays finite on every test scene."
    )
    return [told, *lines, "", f"Farthest node from the centre, over the farthest of the truth: {reach}."]


def draw(record: dict[str, Any], file: Path) -> None:
    """Validation error over the budget spent, a line a model; thin lines are its other seeds.

    A step counts as long as it took when speeds were measured in turns: the clock of a run tells what ran beside, too.
    """
    figure, axes = axes_of_picture(7.2, 4.4)
    for number_, (name, model) in enumerate(record["models"].items()):
        for i, run in enumerate(model["runs"]):
            minutes = run["seconds_per_step"] / 60
            points = [(minutes * p["step"], 1e3 * p["valid_rmse"]) for p in run["curve"] if p["valid_rmse"] is not None]
            if points:
                width = 1.6 if i == 0 else 0.7
                axes.plot(
                    *zip(*points, strict=True), ".-", color=f"C{number_}", linewidth=width, label=None if i else name
                )
    axes.set(xlabel="training, minutes", ylabel="rollout error on validation scenes, mm", yscale="log")
    for ticks in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
        ticks("{x:g}")
    save(figure, axes, file)


if __name__ == "__main__":
    write_page(Path("benchmarks/results"), Path("docs/results"))

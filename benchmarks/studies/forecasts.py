"""Forecasts of trainings, each checked by the training itself.

`python -m benchmarks.studies.forecasts [ROW ...]` makes the trials of `ast-sim plan` for some datasets, with given
numbers of steps, then the training that they forecast. It writes benchmarks/results/forecasts.json and
docs/results/forecasts.md. Data and runs lie in `--folder`; a second call goes on with what is there. Everything runs on
one thread.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import ast_sim
from ast_sim.number_arrays import percent
from ast_sim.planning.forecast import DAMPING, SPREAD, Forecast, forecast
from ast_sim.planning.trials import GROWTH, LONGEST, WIDER, Trials, candidates
from ast_sim.support.errors import counted
from ast_sim.support.provenance import provenance
from ast_sim.training.configure import configure
from benchmarks.studies import assembly
from benchmarks.studies.rows import study_rows

RESULTS = Path(__file__).parents[1] / "results" / "forecasts.json"
PAGE = Path(__file__).parents[2] / "docs" / "results" / "forecasts.md"
SLOWER = 1.6  # times as long takes a step of the wider model


@dataclass(frozen=True)
class Row:
    """A training that is forecast.

    Attributes:
        title: what the page calls it.
        data: the name of the dataset's file.
        family, made: of the dataset, as for `generate`.
        first: steps of a trial of the first round.
        settings: changes of the settings, by dotted key.
    """

    title: str
    data: str
    family: str
    made: dict[str, Any]
    first: int
    settings: dict[str, Any] = field(default_factory=dict)


def _scenes_of(product: str) -> dict[str, Any]:
    """How the scenes of a row of `benchmarks.studies.assembly` are made."""
    row = assembly.ROWS[product]
    return {"spec": row.spec, "nodes": row.nodes, "train": row.train, "valid": row.valid, "test": row.test}


_PLATES = {"frames": 41, "keep": (14, 24, 34), "seed": 21, "valid": 40, "test": 0}
_CLIP = {"spec": Path(__file__).parents[2] / "examples" / "clip" / "SPEC.toml", "nodes": 1400, "frames": 7}
_CLIP = {**_CLIP, "solver": "calculix", "train": 80, "valid": 6, "test": 30}
_YIELDS = {"model.state": ("PEEQ", "reaction"), "train.mirror": ("y",), "train.stress_weight": 0.3}
_MIRRORED = {"train.mirror": ("x", "y")}
_PLATES_200 = ("plates200", "deforming_plate", {**_PLATES, "train": 300, "nodes": 200})
_PLATES_400 = ("plates400", "deforming_plate", {**_PLATES, "train": 600, "nodes": 400})
_PARTS = {"nodes": 400, "keep": (10, 15, 20), "seed": 21, "train": 400, "valid": 40, "test": 0}
ROWS = {
    "plates200": Row("300 plates, 200 nodes", *_PLATES_200, 50, _MIRRORED),
    "plates200_long": Row("300 plates, 200 nodes, three times as long", *_PLATES_200, 150, _MIRRORED),
    "plates400": Row("600 plates, 400 nodes", *_PLATES_400, 50, _MIRRORED),
    "clip": Row("80 metal clips, 1,400 nodes", "clip", "assembly", _CLIP, 40, _YIELDS),
    "parts400": Row("400 pairs of parts, 400 nodes", "parts400", "abcd", _PARTS, 50, {"train.mirror": ("x", "y", "z")}),
    "snap_hook": Row("200 snap hooks, second-order elements", "snap_hook", "assembly", _scenes_of("snap_hook"), 40),
    "bumper": Row("100 bumpers, second-order elements", "bumper", "assembly", _scenes_of("bumper"), 25),
}


def measured(name: str, folder: Path) -> dict[str, Any]:
    """The trials, the forecast and the training of a row."""
    row = ROWS[name]
    data = ast_sim.generate(row.family, folder / f"{row.data}.h5", **row.made)
    tried = candidates(configure(data.path, changes=row.settings), "tiny")
    trials = Trials(folder / f"trials_{row.data}", data.counts["train"], data.counts["valid"])
    steps = {name: int(row.first / (SLOWER if name.endswith("wider") else 1)) for name in tried}
    made = list(trials.rounds(tried, steps))
    longest = made[-1]
    half = trials.trained(longest.name, tried[longest.name], longest.steps, longest.scenes // 2)
    whole = trials.trained(longest.name, tried[longest.name], round(longest.steps / LONGEST))
    return {
        **provenance(f"python -m benchmarks.studies.forecasts {name}"),
        "title": row.title,
        "trials": [asdict(trial) for trial in made],
        "half": asdict(half),
        "whole": asdict(whole),
    }


_INTRODUCTION = f"""# Forecasts of trainings

Made by `python -m benchmarks.studies.forecasts` from `benchmarks/results/forecasts.json`; do not edit.

`ast-sim plan` forecasts the error of a training from shorter ones ([how](../how-to/plan-training.md)). Here each
forecast is checked by the training itself, which has {1 / LONGEST:g} times the steps of the longest trial. The trials
are whole trainings of `tiny` at three learning rates and of a model that is {WIDER:g} times as wide; in each of three
rounds the better half goes on, with {GROWTH} times the steps. Errors are measured with the network alone on validation
scenes, relative to their displacement. The forecast goes on along the power of the two longest trials, times
{DAMPING:g}; its interval reaches {100 * SPREAD:.0f} % above and below it. Both numbers were chosen after the trainings
on plates and clips, and before the others. The steps of each trial are given, not measured, so that other work on the
machine does not matter. There is no forecast if the longest trial is no better than the one before.
"""


def page(results: dict[str, Any]) -> str:
    """The page of all rows that have a result."""
    shown = [results[name] for name in ROWS if name in results]
    head = ["training", "best settings", "steps: error of its trials", "half of the scenes", "forecast", "training"]
    lines = [_INTRODUCTION, "| " + " | ".join(head) + " |", "| --- | --- | --- | ---: | ---: | ---: |"]
    inside = 0
    told = 0
    for row in shown:
        best, whole = row["trials"][-1]["name"], row["whole"]
        own = [(trial["steps"], trial["error"]) for trial in row["trials"] if trial["name"] == best]
        expected = forecast(own, whole["steps"])
        inside += expected is not None and expected.low <= whole["error"] <= expected.high
        told += expected is not None
        cells = [
            row["title"],
            best,
            ", ".join(f"{steps:,}: {percent(error, 3)}" for steps, error in own),
            percent(row["half"]["error"], 3),
            f"{whole['steps']:,} steps: {_told(expected)}",
            percent(whole["error"], 3),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    counts = [f"{inside} of {told} trainings ended within the interval of their forecast."]
    if told < len(shown):
        counts.append(f"{counted(len(shown) - told, 'training')} had no forecast.")
    return "\n".join([*lines, "", " ".join(counts)])


def _told(expected: Forecast | None) -> str:
    if expected is None:
        return "none"
    return f"{percent(expected.error, 3)} ({percent(expected.low, 3)} to {percent(expected.high, 3)})"


def main(arguments: Sequence[str] | None = None) -> None:
    study_rows(__doc__, ROWS, arguments, measured, _said, (RESULTS, PAGE), page)


def _said(results: dict[str, Any]) -> str:
    return percent(results["whole"]["error"], 3)


if __name__ == "__main__":
    main()

"""The page of `benchmarks.studies.coverage`."""

from __future__ import annotations

from typing import Any

from ast_sim.inference.quantities.band import LEVEL
from benchmarks.studies.phrases import table_head, table_line

LEVELS = (LEVEL, 0.9)  # what a run's bands are made for, and narrower ones
_COLUMNS = [f"{text} ({100 * level:g} %)" for level in LEVELS for text in ("held", "expected", "width")]
_INTRODUCTION = """# Do bands and promised errors hold?

Made by `python -m benchmarks.studies.coverage` from `benchmarks/results/coverage.json`; do not edit.

Each run is calibrated on scenes that neither trained nor chose it, and then predicts scenes that nobody has used.
A band holds in a scene if no free node of any frame is farther from the simulated position than it says (or no force
or largest stress of any frame is farther from the simulated one). A run's bands are made to hold in 95 of 100 scenes;
beside them stand bands for 90 of 100, from the same calibration. How many of the fresh scenes they hold in varies by
chance, with the calibration scenes and with the fresh ones: "expected" is the interval that contains this number in 99
of 100 such trials (beta-binomial). "Width" is the median over the scenes of the widest band divided by the median of
the largest error. Where the run warns that a scene is outside its training or unlike its calibration scenes, there is
no band.

A wanted error (`predict(error=...)`) is kept if the error of the answer at the deepest frame is no larger. It is
promised for 90 of 100 scenes, among the scenes without a warning.

"Either" counts scenes with a warning: scenes outside the ranges of the training, and scenes that the network finds
unlike the calibration scenes (p-value at most 0.05: by chance one ordinary scene in twenty). "No band" counts scenes in
which prescribed nodes move farther than in the calibration scenes, or whose mesh is another, too.
"""


def page(results: dict[str, Any]) -> str:
    """The page of all rows."""
    return "\n".join([_INTRODUCTION.rstrip(), *(line for result in results.values() for line in _section(result))])


def _section(result: dict[str, Any]) -> list[str]:
    bands = [
        [row["effort"], row["quantity"], *(cell for level in LEVELS for cell in _cells(row, level))]
        for row in result["rows"]
    ]
    levels = [one for row in result["rows"] for one in row["levels"].values()]
    inside = [one["held_interval_99"][0] <= one["held"] <= one["held_interval_99"][1] for one in levels]
    promises = [
        [
            promise["quantity"],
            f"{100 * promise['error']:g} %",
            promise.get("effort", "refused"),
            f"{promise['held']} of {result['promised_scenes']}" if "held" in promise else "-",
        ]
        for promise in result["promises"]
    ]
    told = [
        [kind, *(str(counts.get(key, "–")) for key in ("questions", "outside", "unlike", "told", "no_band"))]
        for kind, counts in result["told"].items()
    ]
    return [
        "",
        f"## {result['title']}",
        "",
        f"{result['calibration_scenes']} calibration scenes. {sum(inside)} of {len(inside)} numbers are as expected.",
        *_table(["effort", "band of", *_COLUMNS], bands, texts=2),
        *_table(["error of", "wanted", "effort", "kept"], promises, texts=1),
        *_table(
            ["scenes", "number", "outside the training", "unusual to the network", "either", "no band"], told, texts=1
        ),
    ]


def _cells(row: dict[str, Any], level: float) -> list[str]:
    """In how many scenes a band of this level held, in how many it is expected to, and how wide it is."""
    one = row["levels"].get(f"{level:g}")
    if one is None:
        return ["not measured", "–", "–"]
    held, expected = f"{one['held']} of {row['fresh_scenes']}", "{} to {}".format(*one["held_interval_99"])
    return [held, expected, f"{one['median_band'] / row['median_largest_error']:.1f} times"]


def _table(columns: list[str], rows: list[list[str]], texts: int) -> list[str]:
    return ["", *table_head(columns, texts), *map(table_line, rows)]

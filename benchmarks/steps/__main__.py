"""Training steps, predictions and Newton steps beside what was aimed at: a record for each number.

`python -m benchmarks.steps --before FOLDER [--json FILE] [ROW ...]`. FOLDER holds the state of this repository that
today's is compared with, built in place. Without `--json` the records go to benchmarks/results/steps.json, which keeps
the records of other rows, and the page docs/results/steps.md is made of them.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import ast_sim
from ast_sim.support.disk import write_json, write_text
from ast_sim.support.provenance import commit_of, provenance
from benchmarks.steps.whole_steps import MEASUREMENTS, Place

RESULTS = Path(__file__).parents[1] / "results" / "steps.json"
PAGE = Path(__file__).parents[2] / "docs" / "results" / "steps.md"


def page(results: dict[str, Any]) -> str:
    """The page of all rows that have a result."""
    shown = [results[row] for row in MEASUREMENTS if row in results]
    records = [record for one in shown for record in one["records"]]
    processors = ", ".join(sorted({one["processor"] for one in shown}))
    before = ", ".join(sorted({one["before"][:12] for one in shown}))
    reached = sum(record["reached"] for record in records)
    lines = [
        "# Steps and predictions beside their targets",
        "",
        "Made by `python -m benchmarks.steps --before FOLDER` from `benchmarks/results/steps.json`; do not edit.",
        "",
        f"Measured on an {processors}, two cores. The state before is commit `{before}`. A number that compares two",
        "times is the median of the ratios of neighbours, which were measured in turns. Newton steps and single",
        "predictions are in processor time, all others by the clock.",
        "",
        f"{reached} of {len(records)} targets are reached.",
        "",
        "| what | value | target | reached | |",
        "| --- | ---: | ---: | --- | --- |",
    ]
    return "\n".join(lines + [_line(record) for record in records])


def _line(record: dict[str, Any]) -> str:
    value = "–" if record["value"] is None else f"{record['value']:.3g} {record['unit']}".strip()
    reached = "yes" if record["reached"] else "**no**"
    return f"| {record['what']} | {value} | {record['target']} | {reached} | {record['note']} |"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rows", nargs="*", metavar="ROW", help=f"of {', '.join(MEASUREMENTS)} (default: all)")
    parser.add_argument("--before", type=Path, required=True, metavar="FOLDER", help="the other state, built in place")
    parser.add_argument("--repeats", type=int, default=10, help="samples of each side (default: %(default)s)")
    parser.add_argument("--json", type=Path, default=RESULTS, metavar="FILE", help="write the records here")
    options = parser.parse_args(arguments)
    unknown = set(options.rows) - set(MEASUREMENTS)
    if unknown:
        parser.error(f"there is no row {', '.join(sorted(unknown))}")
    ast_sim.keep_memory()
    results = json.loads(options.json.read_text(encoding="utf-8")) if options.json.exists() else {}
    for row in options.rows or MEASUREMENTS:
        with tempfile.TemporaryDirectory() as folder:
            place = Place(options.before.resolve(), Path(folder), options.repeats)
            records = [record.to_json() for record in MEASUREMENTS[row](place)]
        command = f"python -m benchmarks.steps --before FOLDER --repeats {options.repeats} {row}"
        results[row] = {**provenance(command), "before": commit_of(place.before), "records": records}
        write_json(options.json, results)
        print("\n".join(_line(record) for record in records), flush=True)
    if options.json == RESULTS:
        write_text(PAGE, page(results) + "\n")


if __name__ == "__main__":
    main()

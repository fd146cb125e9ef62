"""Times Newton steps of another state of this repository beside today's, in turns, by the size of the mesh.

`python -m benchmarks.steps.newton --before FOLDER [--json FILE]`. FOLDER holds the other state. Each sample is a
process of its own, with one thread; times are processor times. The first step is one from afar. A state that has
not ended after `--limit` seconds by the clock is given up.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim.support.disk import write_json
from ast_sim.support.provenance import commit_of, processor, provenance
from benchmarks.steps.newton_worker import CASES

WORKER = Path(__file__).with_name("newton_worker.py")


def sample(tree: Path, case: str, repeats: int, limit: float) -> dict[str, Any] | None:
    """What the worker tells with the package in the folder `tree`; None if it took too long."""
    variables = {**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    command = [sys.executable, str(WORKER), case, str(repeats)]
    try:
        told = subprocess.run(command, cwd=tree, env=variables, stdout=subprocess.PIPE, timeout=limit, check=True)
    except subprocess.TimeoutExpired:
        return None
    return json.loads(told.stdout)


def measure(trees: dict[str, Path], case: str, rounds: int, repeats: int, limit: float) -> dict[str, Any]:
    """Of each state the seconds of set-up and of each step, least and median, or None; how far the positions differ."""
    samples: dict[str, list[dict[str, Any]]] = {name: [] for name in trees}
    for _ in range(rounds):
        for name, tree in trees.items():
            told = sample(tree, case, repeats, limit)
            samples[name] += [told] if told else []
    row: dict[str, Any] = {name: summary(told) for name, told in samples.items()}
    if all(samples.values()):
        one, other = (np.array(told[-1]["position"]) for told in samples.values())
        row["difference"] = float(abs(one - other).max())
    return row


def summary(samples: list[dict[str, Any]]) -> dict[str, list[float]] | None:
    """Least and median of the set-up and of each step."""
    if not samples:
        return None
    times = [[setup, *steps] for told in samples for setup, steps in zip(told["setup"], told["steps"], strict=True)]
    columns = list(zip(*times, strict=True))
    return {"least": [min(one) for one in columns], "median": [statistics.median(one) for one in columns]}


def line_of(case: str, row: dict[str, Any], limit: float) -> str:
    """A line of the table: milliseconds of set-up and steps, least and (median)."""
    cells = []
    for times in (times for name, times in row.items() if name != "difference"):
        if times is None:
            cells.append(f"not within {limit:,.0f} s")
            continue
        pairs = zip(times["least"], times["median"], strict=True)
        cells.append(", ".join(f"{1e3 * least:,.3g} ({1e3 * median:,.3g})" for least, median in pairs))
    return f"| {case} | {' | '.join(cells)} | {row.get('difference', float('nan')):.1g} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", type=Path, required=True, metavar="FOLDER", help="the other state")
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES), metavar="CASE")
    parser.add_argument("--limit", type=float, default=600, help="seconds of one sample (%(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the record here")
    arguments = parser.parse_args()
    trees = {"before": arguments.before.resolve(), "now": Path(__file__).resolve().parents[2]}
    print(f"{processor()}; milliseconds of the processor for the set-up and each step, at least (median)")
    rows = {}
    for case in arguments.cases:
        nodes = int(case.split()[-2].replace(",", ""))
        rounds, repeats = (8, 5) if nodes < 2000 else (3, 2) if nodes < 10_000 else (2, 1) if nodes < 30_000 else (1, 1)
        rows[case] = measure(trees, case, rounds, repeats, arguments.limit)
        print(line_of(case, rows[case], arguments.limit), flush=True)
    if arguments.json is not None:
        command = "python -m benchmarks.steps.newton --before FOLDER --json FILE"
        before = commit_of(trees["before"])
        write_json(arguments.json, {**provenance(command), "before": before, "limit": arguments.limit, "cases": rows})


if __name__ == "__main__":
    main()

"""Times predictions of another state of this repository beside today's, in turns, and compares their answers.

`python -m benchmarks.steps.predictions --before FOLDER [--json FILE]`. FOLDER holds the other state, built in place.
The run that comes with the package predicts the last frame of new plates of 400 and of 1,300 nodes, by one call alone
and with one Newton step, on one thread. Each state has a process of its own. `processor` is the processor time of the
process, which other work on the machine disturbs less.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim.simulate.jobs.generate import generate
from ast_sim.support.disk import write_json
from ast_sim.support.provenance import commit_of, processor, provenance

NODES = (400, 1300)
NEWTON_STEPS = (0, 1)
AT_ONCE = 5  # predictions of a sample
PLATES = {"train": 0, "valid": 0, "test": 1, "seed": 912, "frames": 41, "keep": (14, 24, 34)}
WORKER = Path(__file__).with_name("prediction_worker.py")


def worker(tree: Path, data: Path) -> subprocess.Popen[str]:
    """A process that predicts with the package in the folder `tree`."""
    variables = {**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    command = [sys.executable, str(WORKER), str(data)]
    return subprocess.Popen(command, cwd=tree, env=variables, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def ask(process: subprocess.Popen[str], newton_steps: int) -> dict[str, Any]:
    """The seconds of a prediction, as the mean of a few, and its positions."""
    if process.stdin is None or process.stdout is None:
        raise RuntimeError("the process has no pipes")
    process.stdin.write(json.dumps([newton_steps, AT_ONCE]) + "\n")
    process.stdin.flush()
    return json.loads(process.stdout.readline())


def compare(trees: dict[str, Path], data: Path, newton_steps: int, repeats: int) -> dict[str, dict[str, list[float]]]:
    """Milliseconds of each state by clock, in turns, and the positions that it answers."""
    with ExitStack() as stack:
        workers = {name: stack.enter_context(worker(tree, data)) for name, tree in trees.items()}
        told: dict[str, dict[str, list[float]]] = {name: {"clock": [], "processor": []} for name in trees}
        for name, process in workers.items():
            for _ in range(3):
                told[name]["position"] = ask(process, newton_steps)["position"]
        for _ in range(repeats):
            for name, process in workers.items():
                answer = ask(process, newton_steps)
                for clock in ("clock", "processor"):
                    told[name][clock].append(1e3 * answer[clock])
        for process in workers.values():
            if process.stdin is not None:
                process.stdin.close()
    return told


def line_of(told: dict[str, dict[str, list[float]]]) -> str:
    """The times of all states, and how far the last state's positions are from the first one's, in units of 2^-24 of
    the largest coordinate."""
    parts = []
    for clock in ("clock", "processor"):
        values = [f"{name} {min(one[clock]):.2f} ({statistics.median(one[clock]):.2f})" for name, one in told.items()]
        parts.append(f"{clock}: {', '.join(values)} ms")
    positions = [np.array(one["position"]) for one in told.values()]
    far = float(np.abs(positions[-1] - positions[0]).max() / np.abs(positions[0]).max()) * 2**24
    return "; ".join(parts) + f"; positions differ by {far:.2g} roundings"


def samples_of(told: dict[str, dict[str, list[float]]]) -> dict[str, dict[str, list[float]]]:
    """The times of each state, without its positions."""
    return {name: {clock: one[clock] for clock in ("clock", "processor")} for name, one in told.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", type=Path, required=True, metavar="FOLDER", help="the other state, built in place")
    parser.add_argument("--repeats", type=int, default=40, help="samples of each state (%(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all samples here")
    arguments = parser.parse_args()
    trees = {"before": arguments.before.resolve(), "now": Path(__file__).resolve().parents[2]}
    print(f"{processor()}: at least, in parentheses the median")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for nodes in NODES:
            data = Path(folder) / f"plates{nodes}.h5"
            generate("deforming_plate", data, nodes=nodes, **PLATES)
            for newton_steps in NEWTON_STEPS:
                told = compare(trees, data, newton_steps, arguments.repeats)
                print(f"{nodes} nodes, {newton_steps} Newton steps: {line_of(told)}", flush=True)
                rows.append({"nodes": nodes, "newton_steps": newton_steps, "milliseconds": samples_of(told)})
    if arguments.json is not None:
        command = f"python -m benchmarks.steps.predictions --before FOLDER --repeats {arguments.repeats} --json FILE"
        write_json(arguments.json, {**provenance(command), "before": commit_of(trees["before"]), "rows": rows})


if __name__ == "__main__":
    main()

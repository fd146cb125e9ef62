"""Times a training step of another state of this repository beside today's, in turns, and counts what a step runs.

`python -m benchmarks.steps.before_after --before FOLDER --data FILE --json FILE`. FOLDER holds the other state, built
in place. Each state has a process of its own; both draw the same batches. `processor` is the processor time of all
threads of a process, which other work on the machine disturbs less.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from ast_sim.support.provenance import provenance
from benchmarks.steps.step_worker import KINDS, Setup
from benchmarks.steps.training_step import Worker

SETTINGS = ["train.batch_size=8", "train.steps=100000", "train.mirror=x,y"]  # of the demonstration


def compare(before: Path, data: Path, threads: int, repeats: int, steps: int) -> dict:
    """Milliseconds of a step of each state, least and median, by the clock and of the processor; the medians of the
    ratios of neighbours; the counts."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        setup = Setup(str(data.resolve()), "ast", "tiny", SETTINGS, str(folder))
        trees = {"before": before.resolve(), "now": Path(__file__).resolve().parents[2]}
        workers = {name: Worker("c", threads, setup, folder / name, tree=tree) for name, tree in trees.items()}
        for worker in workers.values():
            stack.callback(worker.close)
            worker.ask("step", 10)
        seconds: dict[str, list[float]] = {name: [] for name in workers}
        processor: dict[str, list[float]] = {name: [] for name in workers}
        for _ in range(repeats):
            for name, worker in workers.items():
                before_steps = worker.processor_seconds()
                seconds[name].append(worker.ask("step", steps))
                processor[name].append((worker.processor_seconds() - before_steps) / steps)
        shares = workers["now"].ask("profile", 10)
        return {
            "threads": threads,
            **summary(seconds),
            "processor": summary(processor),
            "shares": {kind: shares[kind] for kind in KINDS},
            "counts": {name: worker.ask("counts") for name, worker in workers.items()},
            "seconds": seconds,
        }


def summary(seconds: dict[str, list[float]]) -> dict[str, Any]:
    """Of the samples of "before" and "now"."""
    return {
        "min_ms": {name: 1e3 * min(values) for name, values in seconds.items()},
        "median_ms": {name: 1e3 * statistics.median(values) for name, values in seconds.items()},
        "ratio": median_ratio(seconds["before"], seconds["now"]),
    }


def median_ratio(samples: Sequence[float], others: Sequence[float]) -> float:
    """The median of the ratios of samples to others that were measured beside them, in turns."""
    return statistics.median(one / other for one, other in zip(samples, others, strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", type=Path, required=True, metavar="FOLDER", help="the other state, built in place")
    parser.add_argument("--data", type=Path, required=True, metavar="FILE", help="a dataset to train on")
    parser.add_argument("--json", type=Path, required=True, metavar="FILE", help="write the record and samples here")
    parser.add_argument("--threads", type=int, default=1, help="of each process (%(default)s)")
    parser.add_argument("--repeats", type=int, default=20, help="samples of each state (%(default)s)")
    parser.add_argument("--steps", type=int, default=5, help="of one sample (%(default)s)")
    arguments = parser.parse_args()
    record = compare(arguments.before, arguments.data, arguments.threads, arguments.repeats, arguments.steps)
    command = " ".join(["python -m benchmarks.steps.before_after", *sys.argv[1:]])
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    arguments.json.write_text(json.dumps({**provenance(command), **record}, indent=1) + "\n")
    print({key: value for key, value in record.items() if key != "seconds"})


if __name__ == "__main__":
    main()

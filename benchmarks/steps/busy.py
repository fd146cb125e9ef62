"""Time of a predicted frame alone and beside busy processes of low priority, on two threads.

`python -m benchmarks.steps.busy --json benchmarks/results/busy.json`. A scene of two blocks has 400 nodes. The busy
processes are endless loops, one for each thread, under `nice -n 19` ("low") and without it ("equal"). A thread of
OpenMP that waits sleeps at once, or sleeps soon, as `ast_sim` asks it to, or spins, which is libgomp's default. The
three workers take turns. A ratio is the time beside the loops over the time alone; `price` is the time alone over the
time alone of threads that spin.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ast_sim.support.disk import write_json
from ast_sim.support.provenance import provenance
from benchmarks.steps.scaling import write_blocks
from benchmarks.steps.step_worker import Setup
from benchmarks.steps.training_step import Worker

NODES = 400
SPINS = {"sleeps": "0", "sleeps_soon": "10000", "spins": "300000"}  # turns of libgomp's waiting loop
NICE = {"low": 19, "equal": 0}
LOOP = "while True: pass"


@contextmanager
def busy_loops(count: int, nice: int) -> Iterator[None]:
    """Endless loops of this priority."""
    loops = [subprocess.Popen(["nice", "-n", str(nice), sys.executable, "-c", LOOP]) for _ in range(count)]
    time.sleep(0.5)  # until all of them loop
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


def seconds(workers: dict[str, Worker], samples: int, frames: int) -> dict[str, dict[str, Any]]:
    """Seconds of one predicted frame, for each worker; a sample is the mean of `frames` of them."""
    for worker in workers.values():
        worker.ask("rollout", frames)  # fills caches
    times: dict[str, list[float]] = {name: [] for name in workers}
    for _ in range(samples):
        for name, worker in workers.items():
            times[name].append(worker.ask("rollout", frames))
    return {name: {"min": min(s), "median": statistics.median(s), "samples": s} for name, s in times.items()}


def measure(setup: Setup, threads: int, samples: int, frames: int, folder: Path) -> dict[str, Any]:
    """For each way of waiting: the seconds alone and beside the loops, their ratios and the price."""
    workers: dict[str, Worker] = {}
    try:
        for name, spins in SPINS.items():
            workers[name] = Worker("c", threads, setup, folder / f"{name}.log", {"GOMP_SPINCOUNT": spins})
        by_load = {"alone": seconds(workers, samples, frames)}
        for name, nice in NICE.items():
            with busy_loops(threads, nice):
                by_load[name] = seconds(workers, samples, frames)
    finally:
        for worker in workers.values():
            worker.close()
    median = {name: {way: values[way]["median"] for way in SPINS} for name, values in by_load.items()}
    return {
        way: {
            "price": median["alone"][way] / median["alone"]["spins"],
            "ratio": {name: median[name][way] / median["alone"][way] for name in NICE},
            **{name: values[way] for name, values in by_load.items()},
        }
        for way in SPINS
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True, metavar="FILE", help="write the figures here")
    parser.add_argument("--threads", type=int, default=2, help="(%(default)s)")
    parser.add_argument("--samples", type=int, default=15, help="(%(default)s)")
    parser.add_argument("--frames", type=int, default=10, help="frames of a sample (%(default)s)")
    arguments = parser.parse_args()
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        nodes, _ = write_blocks(folder / "blocks.h5", NODES)
        settings = ["train.batch_size=1", "train.statistics_pairs=1", "train.steps=100"]
        setup = Setup(str(folder / "blocks.h5"), "ast", "tiny", settings, name)
        records = measure(setup, arguments.threads, arguments.samples, arguments.frames, folder)
    record = {
        **provenance(" ".join(["python -m benchmarks.steps.busy", *sys.argv[1:]])),
        "threads": arguments.threads,
        "nodes": nodes,
        "note": f"{load:.1f} processes wanted to run on average in the minute before, on {os.cpu_count()} cores",
        **records,
    }
    write_json(arguments.json, record)
    print(json.dumps({way: {key: records[way][key] for key in ("price", "ratio")} for way in SPINS}, indent=2))


if __name__ == "__main__":
    main()

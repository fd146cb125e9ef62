"""Times whole training steps and rollout steps beside the torch backend of the same model.

`python -m benchmarks.steps.training_step --json FILE`. Each backend has a process of its own, because a process has
only one backend. Both keep freed memory, and both train on the same scenes. They take turns: while one works, the other
waits.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from ast_sim.support.provenance import provenance
from benchmarks.kernels.peak import peak
from benchmarks.kernels.targets import judge
from benchmarks.steps import scenes
from benchmarks.steps.step_worker import Setup

MEMORY = 20 << 30  # bytes of address space that a worker may take


class Worker:
    """A process with one backend that does what it is told, a line of JSON at a time.

    `variables` are environment variables that only this process has. `tree` is the folder whose package and worker it
    runs; None: these.
    """

    def __init__(
        self,
        backend: str,
        threads: int,
        setup: Setup,
        log: Path,
        variables: dict[str, str] | None = None,
        tree: Path | None = None,
    ) -> None:
        environment = {"AST_SIM_BACKEND": backend, "OMP_NUM_THREADS": str(threads), "MKL_NUM_THREADS": str(threads)}
        self._log = open(log, "w")  # noqa: SIM115 (closed with the process)
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.steps.step_worker", json.dumps(setup._asdict(), default=str)],
            env={**_environment(), **environment, **(variables or {})},
            cwd=tree,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            text=True,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY)),
        )

    def ask(self, what: str, count: int = 1) -> Any:
        """The answer to one request; raises RuntimeError with the worker's last words if it died."""
        try:
            self._process.stdin.write(json.dumps({"what": what, "count": count}) + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            pass
        for line in self._process.stdout:
            if line.startswith("{"):
                return json.loads(line)["answer"]
        self._process.wait()
        last = Path(self._log.name).read_text().strip().splitlines()[-1:]
        raise RuntimeError(f"the process ended with {self._process.returncode}: {''.join(last)[:300]}")

    def processor_seconds(self) -> float:
        """Of all its threads so far (Linux: a process has a clock whose number follows from its own)."""
        return time.clock_gettime(~self._process.pid << 3 | 2)

    def close(self) -> None:
        self._process.stdin.close()
        self._process.wait()
        self._log.close()


def _environment() -> dict[str, str]:
    import os

    return {key: value for key, value in os.environ.items() if not key.startswith("AST_SIM_")}


def measure(case: scenes.Case, threads: int, repeats: int, limit: float | None, folder: Path) -> list[dict]:
    """The records of one preset: its training step and its rollout step."""
    setup = Setup(str(case.data), "ast", case.preset, case.settings, str(folder))
    missing: dict[str, str] = {}
    with ExitStack() as stack:
        workers: dict[str, Worker] = {}
        for name, backend in (("ours", "c"), ("torch", "torch")):
            worker = Worker(backend, threads, setup, folder / f"{name}.log")
            stack.callback(worker.close)
            try:
                worker.ask("step", case.steps)  # fills caches
                workers[name] = worker
            except RuntimeError as error:
                missing[name] = str(error)
        if "ours" not in workers:
            raise RuntimeError(f"{case.preset}: {missing['ours']}")
        records = [
            _record(case, what, threads, in_turns(workers, what, case.steps, repeats)) for what in ("step", "rollout")
        ]
        # Before anything is watched: what the profiler writes down lies in memory, too.
        records[0]["peak_resident_bytes"] = {name: worker.ask("resident") for name, worker in workers.items()}
        for record, profile in zip(records, ("profile", "profile_rollout"), strict=True):
            shares = workers["ours"].ask(profile, max(case.steps, 5))
            record["shares"] = shares
            record["python_share"] = shares["python"] + shares["binding"]
            record["outside_kernels_share"] = 1 - shares["kernel"]
            record["missing"] = missing
        flops = workers["ours"].ask("flops")
        records[0]["gflops"] = flops / records[0]["samples"]["ours"]["min"] / 1e9
        records[0]["share_of_peak"] = records[0]["gflops"] / limit if limit else None
    return records


def in_turns(workers: dict[str, Worker], what: str, steps: int, repeats: int) -> dict[str, list[float]]:
    """Seconds a step, in turns."""
    samples: dict[str, list[float]] = {name: [] for name in workers}
    for _ in range(repeats):
        for name, worker in workers.items():
            samples[name].append(worker.ask(what, steps))
    return samples


def _record(case: scenes.Case, what: str, threads: int, samples: dict[str, list[float]]) -> dict:
    by_name = {
        name: {"min": min(values), "median": statistics.median(values), "samples": values}
        for name, values in samples.items()
    }
    record = {
        "preset": case.preset,
        "what": {"step": "training step", "rollout": "rollout step"}[what],
        "shape": case.shape if what == "step" else case.rollout_shape,
        "threads": threads,
        "samples": by_name,
    }
    if "torch" in by_name:
        record["ratio_of_min"] = by_name["torch"]["min"] / by_name["ours"]["min"]
        record["ratio_of_median"] = by_name["torch"]["median"] / by_name["ours"]["median"]
    return record


def growth(nodes: tuple[int, int], seconds: tuple[float, float]) -> float:
    """The exponent p of seconds ~ nodes^p between two sizes."""
    return math.log(seconds[1] / seconds[0]) / math.log(nodes[1] / nodes[0])


def line_of(record: dict) -> str:
    ours = record["samples"]["ours"]
    text = f"{record['preset']}, {record['what']}, {record['shape']}, {record['threads']} threads:"
    text += f" {1e3 * ours['min']:.2f} ms, median {1e3 * ours['median']:.2f}"
    if "ratio_of_min" in record:
        text += f"; torch {record['ratio_of_min']:.2f} x (medians {record['ratio_of_median']:.2f} x)"
    for name, reason in record["missing"].items():
        text += f"; {name}: {reason}"
    if record.get("share_of_peak"):
        text += f"; {record['gflops']:.0f} GF/s = {record['share_of_peak']:.0%} of peak"
    text += f"; Python {record['python_share']:.0%}, outside C kernels {record['outside_kernels_share']:.0%}"
    if "growth_exponent" in record:
        text += f"; cost grows with exponent {record['growth_exponent']:.3f}"
    if record.get("reached") is not None:
        text += f"; target {'reached' if record['reached'] else 'NOT reached'}"
    return text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True, metavar="FILE", help="write all records and samples here")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="numbers of threads (1 2)")
    parser.add_argument("--repeats", type=int, default=20, help="samples of each backend (%(default)s)")
    parser.add_argument("--cases", nargs="+", choices=scenes.CASES, default=list(scenes.CASES), help="only these")
    arguments = parser.parse_args()
    limits = peak(max(arguments.threads))
    header = {
        **provenance(" ".join(["python -m benchmarks.steps.training_step", *sys.argv[1:]])),
        "peak_gflops_by_threads": limits,
    }
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    records: list[dict] = []
    with tempfile.TemporaryDirectory() as folder:
        for name in arguments.cases:
            case = scenes.make(name, Path(folder))
            for threads in arguments.threads if case.every_thread else [max(arguments.threads)]:
                repeats = min(arguments.repeats, case.most_repeats)
                limit = limits and limits[str(threads)]
                made = measure(case, threads, repeats, limit, Path(folder))
                for record in made:
                    record["nodes"] = case.nodes
                before = [r for r in records if (r["preset"], r["what"]) == (case.preset, "training step")]
                if case.preset == "abcd_xl" and before:
                    small, large = before[-1], made[0]
                    seconds = (small["samples"]["ours"]["min"], large["samples"]["ours"]["min"])
                    large["growth_exponent"] = growth((small["nodes"], large["nodes"]), seconds)
                for record in made:
                    print(line_of(judge(record)), flush=True)
                records += made
                # After every case, so that a long run that is cut off leaves what it found.
                arguments.json.write_text(json.dumps({**header, "records": records}, indent=1) + "\n")


if __name__ == "__main__":
    main()

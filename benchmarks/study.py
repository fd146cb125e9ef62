"""Compares models under one protocol: equal scenes, splits, noise and budget, each with its own best learning rate.

`python -m benchmarks.study STUDY.toml [--workers W]` writes benchmarks/results/study_NAME.json and docs/study.md, in
which all studies with a result are shown. It is resumable: a run that is finished is not made again, one that was cut
off goes on from its last checkpoint. Runs and data lie in build/study. With W workers as many runs are trained at a
time, so their speed is measured beside each other.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ast_sim.data.file import Dataset
from ast_sim.errors import AstSimError
from ast_sim.evaluate import provenance
from ast_sim.results import write_json
from benchmarks.study_plan import Data, Entry, Study, read
from benchmarks.study_run import Job, run

FOLDER, RESULTS = Path("build/study"), Path("benchmarks/results")


def dataset(data: Data, folder: Path) -> Path:
    """The dataset file, generated if it is not there yet."""
    if data.path is not None:
        return Path(data.path)
    from ast_sim.simulate.generate import generate

    parts = [data.family, data.train, data.valid, data.test, data.seed, data.nodes, data.frames]
    out = folder / ("_".join("all" if part is None else str(part) for part in parts) + ".h5")
    counts = {"train": data.train, "valid": data.valid, "test": data.test}
    return generate(data.family, out, counts, seed=data.seed, nodes=data.nodes, frames=data.frames).path


def conduct(study: Study, entries: dict[str, Entry], data: Path, folder: Path, workers: int) -> dict[str, Any]:
    """All runs, and for each entry the one of each seed with its own rate.

    Returns:
        For each entry its `rate`, `search` (the best validation error by rate) and `runs`, one a seed.
    """

    def job(name: str, seed: int, rate: float) -> Job:
        place = folder / re.sub(r"[^\w.=-]+", "_", name) / f"rate_{rate:g}_seed_{seed}"
        return Job(study, name, entries[name], seed, rate, data, place)

    def all_of(jobs: Iterable[Job]) -> list[dict[str, Any]]:
        with ThreadPoolExecutor(workers) as pool:
            return list(pool.map(_told, jobs))

    first, *others = study.seeds
    rates = {name: entry.rates or study.rates for name, entry in entries.items()}
    searched = all_of(job(name, first, rate) for name, options in rates.items() for rate in options)
    found: dict[str, Any] = {}
    for name in entries:
        runs = [record for record in searched if record["name"] == name]
        best = min(runs, key=lambda record: _or_infinity(record["best_valid"]))
        search = {f"{record['rate']:g}": record["best_valid"] for record in runs}
        found[name] = {**asdict(entries[name]), "rate": best["rate"], "search": search, "runs": [best]}
    for record in all_of(job(name, seed, found[name]["rate"]) for seed in others for name in entries):
        found[record["name"]]["runs"].append(record)
    return found


def _told(job: Job) -> dict[str, Any]:
    """A run, of which a line tells when it is there."""
    record = run(job)
    best = record["best_valid"]
    valid = f"validation {best:.3g}" if best is not None else "no validation"
    told = record.get("failed") or f"{record['steps']:,} steps, {valid}"
    print(f"{job.name}, rate {job.rate:g}, seed {job.seed}: {told}", flush=True)
    return record


def _or_infinity(value: float | None) -> float:
    return float("inf") if value is None else value


def main() -> None:
    from benchmarks.study_page import write_page  # needs matplotlib

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path, metavar="STUDY.toml", help="see benchmarks/study_plan.py")
    parser.add_argument("--workers", type=int, default=1, help="runs at a time (%(default)s)")
    arguments = parser.parse_args()
    try:
        study, entries = read(arguments.study)
        data = dataset(study.data, FOLDER)
        found = conduct(study, entries, data, FOLDER / arguments.study.stem, arguments.workers)
    except AstSimError as error:
        sys.exit(str(error))
    made = provenance(f"python -m benchmarks.study {arguments.study}")
    file = RESULTS / f"study_{arguments.study.stem}.json"
    with Dataset(data) as opened:
        scenes = {"name": data.name if study.data.path else study.data.family, **opened.splits}
    write_json(file, {**made, "study": asdict(study), "scenes": scenes, "models": found})
    write_page(RESULTS, Path("docs"))
    print(f"{file}, docs/study.md")


if __name__ == "__main__":
    main()

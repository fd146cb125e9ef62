"""Compares models under one protocol: equal scenes, splits, noise and budget, each with its own best learning rate.

`python -m benchmarks.study STUDY.toml [--workers W]` writes benchmarks/results/study_NAME.json and docs/study.md, in
which all studies with a result are shown, anew after each run. It is resumable: a run that is finished is not made
again, one that was cut off goes on from its last checkpoint. Runs and data lie in build/study. With W workers as many
runs are trained at a time, so their speed is measured beside each other.
"""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ast_sim.data.file import Dataset
from ast_sim.errors import AstSimError
from ast_sim.evaluate import provenance
from ast_sim.results import write_json
from benchmarks.study_plan import Data, Entry, Study, read
from benchmarks.study_run import Job, measure_speeds, run, stop, train

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


def conduct(
    study: Study, entries: dict[str, Entry], data: Path, folder: Path, workers: int
) -> Iterator[dict[str, Any]]:
    """What is known after each run: all entries from the first seed, then from the next one.

    Yields:
        For each entry that has a run its `rate`, `search` (the best validation error by rate) and `runs`, one a seed.
    """
    found: dict[str, Any] = {}
    measure_speeds(
        [Job(study, name, entries[name], study.seeds[0], study.rates[0], 1, data, folder) for name in entries]
    )
    with ThreadPoolExecutor(workers) as pool:
        try:
            for seed in study.seeds:
                made = pool.map(lambda name, seed=seed: _entry(study, name, entries[name], seed, data, folder), entries)
                for name, (rate, search, record) in zip(entries, made, strict=True):
                    values = {**asdict(entries[name]), "rate": rate, "search": search, "runs": []}
                    found.setdefault(name, values)["runs"].append(record)
                    yield found
        except KeyboardInterrupt:
            stop()
            raise


def _entry(
    study: Study, name: str, entry: Entry, seed: int, data: Path, folder: Path
) -> tuple[float, dict[str, Any], dict[str, Any]]:
    """The own rate of an entry, the validation errors by which it was found (of several), and the record of its run."""
    rates = entry.rates or study.rates
    compared = rates if len(rates) > 1 else ()
    tried = [Job(study, name, entry, study.seeds[0], rate, study.search, data, folder) for rate in compared]
    errors = {job.rate: _told(train(job))["best_valid"] for job in tried}
    best = min(rates, key=lambda rate: float("inf") if errors.get(rate) is None else errors[rate])
    search = {f"{rate:g}": error for rate, error in errors.items()}
    return best, search, _told(run(Job(study, name, entry, seed, best, 1, data, folder)))


def _told(record: dict[str, Any]) -> dict[str, Any]:
    """A record, of which a line tells when it is there."""
    best = record["best_valid"]
    valid = f"validation {best:.3g}" if best is not None else "no validation"
    told = record.get("failed") or f"{record['steps']:,} steps, {valid}"
    print(f"{record['name']}, rate {record['rate']:g}, seed {record['seed']}: {told}", flush=True)
    return record


def main() -> None:
    from benchmarks.study_page import write_page  # needs matplotlib

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path, metavar="STUDY.toml", help="see benchmarks/study_plan.py")
    parser.add_argument("--workers", type=int, default=1, help="runs at a time (%(default)s)")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C
    name = arguments.study.stem
    file = RESULTS / f"study_{name}.json"
    try:
        study, entries = read(arguments.study)
        data = dataset(study.data, FOLDER)
        with Dataset(data) as opened:
            scenes = {"name": data.name if study.data.path else study.data.family, **opened.splits}
        made = provenance(f"python -m benchmarks.study {arguments.study}")
        for found in conduct(study, entries, data, FOLDER / name, arguments.workers):
            write_json(file, {**made, "study": asdict(study), "scenes": scenes, "models": found})
            write_page(RESULTS, Path("docs"))
    except AstSimError as error:
        sys.exit(str(error))
    except KeyboardInterrupt:
        sys.exit("stopped: the same command goes on from here")
    print(f"{file}, docs/study.md")


if __name__ == "__main__":
    main()

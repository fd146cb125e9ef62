"""Compares models under one protocol: equal scenes, splits and budget, each with its own best learning rate.

`python -m benchmarks.studies STUDY.toml [--workers W]` writes benchmarks/results/study_NAME.json. After each run it
also writes docs/results/study.md, which shows all studies that have a result.

A study can be stopped and resumed: a finished run is not made again, and a run that was cut off goes on from its last
checkpoint. Runs and data lie in build/study. If they are gone, the runs in the result file stay valid, and runs of new
rows and seeds join them. With W workers, W runs are trained at a time. Their speed is then measured while the others
run.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import asdict, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

from ast_sim.dataset.reader import Dataset
from ast_sim.support.disk import write_json
from ast_sim.support.errors import AstSimError
from ast_sim.support.provenance import provenance
from benchmarks.studies.plan import Data, Entry, Study, read
from benchmarks.studies.run import Job, keep_speed, measure_speeds, run, stop, train

FOLDER, RESULTS = Path("build/study"), Path("benchmarks/results")


def dataset(data: Data, folder: Path) -> Path:
    """The dataset file, generated if it is not there yet."""
    if data.path is not None:
        return Path(data.path)
    from ast_sim.simulate.jobs.generate import generate

    parts = [data.family, data.train, data.valid, data.test, data.seed, data.nodes, data.frames]
    out = folder / ("_".join("all" if part is None else str(part) for part in parts) + ".h5")
    counts = {"train": data.train, "valid": data.valid, "test": data.test}
    return generate(data.family, out, **counts, seed=data.seed, nodes=data.nodes, frames=data.frames).path


def finished(file: Path, study: Study, entries: dict[str, Entry]) -> dict[str, Any]:
    """The rows of a result file that stand: entries and budget, data and settings of the study are what they were.

    Runs of other seeds than the entry's, and failed runs, are left out.
    """
    if not file.exists():
        return {}
    written = json.loads(file.read_text(encoding="utf-8"))
    free = {"title": None, "about": None, "seeds": None}
    if {**written["study"], **free} != {**_plain(study), **free}:
        return {}
    rows = {}
    for name, entry in entries.items():
        row = written["models"].get(name, {"runs": []})
        runs = [run for run in row["runs"] if "failed" not in run and run["seed"] in study.seeds_of(entry)]
        if runs and {**row, **free}.items() >= {**_plain(entry), "seeds": None}.items():
            rows[name] = {**row, **_plain(entry), "runs": runs}
    return rows


def _plain(made: Study | Entry) -> dict[str, Any]:
    """As it is read from a result file."""
    return json.loads(json.dumps(asdict(made)))


def conduct(
    study: Study, entries: dict[str, Entry], data: Path, folder: Path, workers: int, known: dict[str, Any]
) -> Iterator[dict[str, Any]]:
    """What is known after each run: all entries from the first seed, then from the next one. Closed, it stops all runs.

    Args:
        known: rows whose runs are not made again (see `finished`); other seeds of them have the same rate and steps.

    Yields:
        For each entry that has a run its `rate`, `search` (the best validation error by rate) and `runs`, one a seed.
    """
    jobs = [Job(study, *entry, study.seeds[0], study.rates[0], 1, data, folder) for entry in entries.items()]
    for job in jobs:
        if job.name in known:
            keep_speed(job, known[job.name]["runs"][0])
    measure_speeds(jobs)
    rows = dict(known)
    if rows:
        yield rows
    with ThreadPoolExecutor(workers) as pool:
        try:
            for turn in zip_longest(*([replace(job, seed=seed) for seed in job.seeds] for job in jobs)):
                missing = [job for job in turn if job is not None and job.seed not in _seeds(rows.get(job.name))]
                for name, row in pool.map(lambda job: (job.name, _row(job, rows.get(job.name))), missing):
                    rows[name] = row
                    yield {name: rows[name] for name in entries if name in rows}
        except BaseException:  # Ctrl-C here, or what made its consumer close it
            stop()
            raise


def _seeds(row: dict[str, Any] | None) -> set[int]:
    return set() if row is None else {run["seed"] for run in row["runs"]}


def _row(job: Job, before: dict[str, Any] | None) -> dict[str, Any]:
    """The row of an entry with one run more; before the first one, its own rate is searched for."""
    row = before or {**asdict(job.entry), **_own_rate(job), "runs": []}
    record = _told(run(replace(job, rate=row["rate"])))
    return {**row, "runs": sorted([*row["runs"], record], key=lambda run: job.seeds.index(run["seed"]))}


def _own_rate(job: Job) -> dict[str, Any]:
    """The `rate` of an entry with the best validation error, and `search`, these errors by rate."""
    rates = job.entry.rates or job.study.rates
    compared = rates if len(rates) > 1 else ()
    tried = [replace(job, seed=job.seeds[0], rate=rate, share=job.study.search) for rate in compared]
    errors = {job.rate: _told(train(job))["best_valid"] for job in tried}
    best = min(rates, key=lambda rate: float("inf") if errors.get(rate) is None else errors[rate])
    return {"rate": best, "search": {f"{rate:g}": error for rate, error in errors.items()}}


def _told(record: dict[str, Any]) -> dict[str, Any]:
    """A record, of which a line tells when it is there."""
    best = record["best_valid"]
    valid = f"validation {best:.3g}" if best is not None else "no validation"
    told = record.get("failed") or f"{record['steps']:,} steps, {valid}"
    print(f"{record['name']}, rate {record['rate']:g}, seed {record['seed']}: {told}", flush=True)
    return record


def main() -> None:
    from benchmarks.studies.page import write_page  # needs matplotlib

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path, metavar="STUDY.toml", help="see benchmarks/studies/plan.py")
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
        made = provenance(f"python -m benchmarks.studies {arguments.study}")
        known = finished(file, study, entries)
        with closing(conduct(study, entries, data, FOLDER / name, arguments.workers, known)) as rows:
            for models in rows:
                write_json(file, {**made, "study": asdict(study), "scenes": scenes, "models": models})
                write_page(RESULTS, Path("docs/results"))
    except AstSimError as error:
        sys.exit(str(error))
    except KeyboardInterrupt:
        sys.exit("stopped: the same command goes on from here")
    print(f"{file}, docs/results/study.md")


if __name__ == "__main__":
    main()

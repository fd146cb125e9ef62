"""The runs of a study. Their speeds are measured; each is trained for the budget; its best checkpoint is evaluated.

Each stage leaves a file and is not done again: `speed.json` for the model, `trained.json` and `result.json` for the
run. A stage that failed leaves no file, so it is tried again the next time.
"""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ast_sim.runs.config_toml import read_config
from ast_sim.runs.metrics import Metrics
from ast_sim.runs.train_config import TrainConfig
from ast_sim.support.disk import write_json
from ast_sim.support.errors import ConfigError
from benchmarks.steps.step_worker import Setup
from benchmarks.steps.training_step import Worker
from benchmarks.studies.plan import Entry, Study

STEPS, REPEATS = 10, 5  # training steps of a turn, and turns
FEWEST = 3  # validations, also where rates are compared with a share of the budget


@dataclass(frozen=True)
class Job:
    """A run: which entry, from which seed, with which rate and share of the budget; `root` holds the study's runs."""

    study: Study
    name: str
    entry: Entry
    seed: int
    rate: float
    share: float
    data: Path
    root: Path

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seeds of all runs of the entry."""
        return self.study.seeds_of(self.entry)

    @property
    def place(self) -> Path:
        """The folder of all runs of the entry."""
        return self.root / re.sub(r"[^\w.=-]+", "_", self.name)

    @property
    def folder(self) -> Path:
        """The folder of the run."""
        return self.place / f"{'' if self.share == 1 else 'search_'}rate_{self.rate:g}_seed_{self.seed}"

    @property
    def speed(self) -> Path:
        """The file with the speed of the entry."""
        return self.place / "speed.json"

    @property
    def settings(self) -> list[str]:
        """What is set beyond the preset, the steps excepted."""
        return [*self.study.settings, *self.entry.settings, f"train.seed={self.seed}", f"train.peak_rate={self.rate}"]

    def environment(self) -> dict[str, str]:
        threads = str(self.study.threads)
        return {**os.environ, "OMP_NUM_THREADS": threads, "MKL_NUM_THREADS": threads}


def train(job: Job) -> dict[str, Any]:
    """The record of a training: what it took, how its validations went; `failed` says why it ended early."""
    return _once(job.folder / "trained.json", lambda: _trained(job))


def run(job: Job) -> dict[str, Any]:
    """The record of a training with its errors on the test scenes, `measured`; `failed` says why there are none."""
    record = train(job)
    return record if "failed" in record else _once(job.folder / "result.json", lambda: {**record, **_measured(job)})


def _once(file: Path, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What a file holds; it is made if it is not there, and written unless it tells of a failure."""
    if file.exists():
        return json.loads(file.read_text(encoding="utf-8"))
    file.parent.mkdir(parents=True, exist_ok=True)
    made = make()
    if "failed" not in made:
        write_json(file, made)
    return made


def _trained(job: Job) -> dict[str, Any]:
    speed, study = _speed(job), job.study
    if study.minutes is not None:
        steps = max(1, round(job.share * 60 * study.minutes / speed["seconds_per_step"]))
    else:
        steps = math.ceil(job.share * study.samples / speed["batch"])
    validations = max(min(FEWEST, study.validations), round(job.share * study.validations))
    every = max(1, steps // validations)
    settings = [*job.settings, f"train.steps={steps}", f"train.validate_every={every}", f"train.log_every={every}"]
    arguments = ["--model", job.entry.model, "--preset", job.entry.preset]
    arguments += [word for setting in settings for word in ("--set", setting)]
    words = ["-m", "ast_sim.cli", "train", str(job.data), "--out", str(job.folder / "run"), "--resume", *arguments]
    code, peak = _python(job, words, "train.log")
    record = {"name": job.name, "seed": job.seed, "rate": job.rate, **speed, "steps": steps}
    record |= {"peak_resident_bytes": peak, **_training(job.folder / "run")}
    return record if code == 0 else {**record, "failed": _last_line(job.folder / "train.log")}


def _measured(job: Job) -> dict[str, Any]:
    file = job.folder / "measured.json"
    words = ["-m", "benchmarks.studies.measure", str(job.folder / "run"), str(job.study.horizons), str(file)]
    code, _ = _python(job, words, "measure.log")
    if code != 0:
        return {"failed": _last_line(job.folder / "measure.log")}
    return {"measured": json.loads(file.read_text(encoding="utf-8"))}


def measure_speeds(jobs: list[Job]) -> None:
    """Measure, in turns, the seconds of a training step of each model, without validations and checkpoints.

    The least of all turns counts: what else the machine does must not give one model more steps than another. Neither
    must the hour: where the speed of an entry is known, it is measured once more beside the missing ones, and these are
    told as they would have been then.

    Raises:
        ConfigError: a model does not train, with its name and the reason.
    """
    missing = [job for job in jobs if not job.speed.exists()]
    known = [job for job in jobs if job.speed.exists()][: bool(missing)]
    seconds, batches = _measured_speeds([*missing, *known])
    slower = seconds[known[0].name] / _speed(known[0])["seconds_per_step"] if known else 1
    for job in missing:
        write_json(job.speed, {"seconds_per_step": seconds[job.name] / slower, "batch": batches[job.name]})


def _measured_speeds(jobs: list[Job]) -> tuple[dict[str, float], dict[str, int]]:
    """Seconds of a training step, and frame pairs in it, by entry."""
    with ExitStack() as stack:
        workers = {}
        for job in jobs:
            job.place.mkdir(parents=True, exist_ok=True)
            setup = Setup(str(job.data), job.entry.model, job.entry.preset, job.settings, str(job.place))
            workers[job.name] = Worker("c", job.study.threads, setup, job.place / "speed.log")
            stack.callback(workers[job.name].close)
        turns = [{name: _reply(name, workers[name], "step", STEPS) for name in workers} for _ in range(1 + REPEATS)]
        seconds = {name: min(turn[name] for turn in turns[1:]) for name in workers}  # the first one warms up
        return seconds, {name: _reply(name, workers[name], "batch") for name in workers}


def _speed(job: Job) -> dict[str, Any]:
    return json.loads(job.speed.read_text(encoding="utf-8"))


def keep_speed(job: Job, record: dict[str, Any]) -> None:
    """Let further runs of the entry have as many steps as the one of a record, wherever that was made."""
    job.place.mkdir(parents=True, exist_ok=True)
    write_json(job.speed, {name: record[name] for name in ("seconds_per_step", "batch")})


def _reply(name: str, worker: Worker, *request: Any) -> Any:
    try:
        return worker.ask(*request)
    except RuntimeError as error:
        raise ConfigError(f"{name}: {error}") from error


class Stopped(Exception):
    """The study was told to stop."""


_stopping = threading.Event()
_running: set[subprocess.Popen] = set()


def stop() -> None:
    """Stop all runs: each keeps a checkpoint, from which it goes on the next time."""
    _stopping.set()
    for process in tuple(_running):
        process.terminate()


def _python(job: Job, words: list[str], log: str) -> tuple[int, int]:
    """Exit code and peak resident bytes of a Python process whose output goes to a file; raises Stopped."""
    if _stopping.is_set():
        raise Stopped
    with open(job.folder / log, "a", encoding="utf-8") as out:
        # In a session of its own: a Ctrl-C reaches it through `stop` alone.
        process = subprocess.Popen(
            [sys.executable, *words], env=job.environment(), stdout=out, stderr=out, start_new_session=True
        )
        _running.add(process)
        if _stopping.is_set():  # since it was asked above: `stop` may not have seen the process
            process.terminate()
        _, status, usage = os.wait4(process.pid, 0)
        _running.remove(process)
    process.returncode = os.waitstatus_to_exitcode(status)  # so that Popen does not wait for it once more
    if _stopping.is_set():
        raise Stopped
    return process.returncode, usage.ru_maxrss * 1024


def _training(folder: Path) -> dict[str, Any]:
    """How the training went, from its metrics: losses and validations over the seconds spent in steps."""
    lines = [line for line in Metrics(folder) if "loss" in line]
    validations = {line["step"]: line for line in Metrics(folder) if "valid_rmse" in line}
    curve, seconds, before = [], 0.0, 0
    for line in lines:
        seconds += line["seconds"] * (line["step"] - before)
        before = line["step"]
        valid = validations.get(line["step"], {})
        curve.append({"step": before, "seconds": seconds, "loss": line["loss"], "valid_rmse": valid.get("valid_rmse")})
    errors = [point["valid_rmse"] for point in curve if point["valid_rmse"] is not None]
    options: TrainConfig | None = read_config(folder).train if (folder / "config.toml").exists() else None
    return {
        "curve": curve,
        "train_seconds": seconds,
        "best_valid": min(errors, default=None),
        "noise": None if options is None else options.noise,
    }


def _last_line(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else "it ended without a word"

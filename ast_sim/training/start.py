"""Starting or resuming a training: its settings, its folder, its processes."""

from __future__ import annotations

import dataclasses
import errno
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

from ast_sim.dataset.reader import Dataset
from ast_sim.inference.trained_run import Run
from ast_sim.models.registry import build_model, find_preset
from ast_sim.models.simulator import Simulator
from ast_sim.runs import checkpoint
from ast_sim.runs.train_config import RunConfig, TrainConfig, has_config, read_config, write_config
from ast_sim.support.errors import CheckpointError, ConfigError, TrainingError
from ast_sim.support.stop_signals import StopSignals
from ast_sim.support.toml_settings import change, override
from ast_sim.training.data_lengths import measure, scope_of
from ast_sim.training.defaults_from_data import resolve
from ast_sim.training.loop import Training
from ast_sim.training.processes import Processes


def configure(data: Path, preset: str, assignments: Sequence[str] = (), model: str = "ast") -> RunConfig:
    """The settings of a preset, changed by assignments `key=value`. Unset settings are filled in when training starts.

    Raises:
        ConfigError: there is no such model, preset or key (the text names the nearest one), or a value does not fit.
    """
    chosen = find_preset(model, preset)
    return override(RunConfig(chosen.model, TrainConfig(**chosen.train), str(data)), assignments)


def train(
    data: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    model: str = "ast",
    preset: str = "tiny",
    model_settings: Mapping[str, Any] | None = None,
    resume: bool = False,
    **settings: Any,
) -> Run:
    """Train a model on a dataset; returns the run, ready to predict.

    Args:
        data: the dataset file.
        out: the run folder. After a kill the same call with `resume=True` continues, and gives the same weights.
        model: a registered model, such as "ast", "mgn", "bsms", "hcmt" or "transolver".
        preset: the settings to start from.
        model_settings: changes of the model's settings, such as {"hidden": 32}.
        resume: continue after the newest checkpoint, if there is one.
        settings: changes of the training's settings (fields of `TrainConfig`), such as steps=4000, mirror=("x", "y").

    Raises:
        ConfigError: there is no such model, preset or setting (the text names the nearest one), or a value does not
            fit.
        DatasetError: the dataset cannot be read.
        TrainingError, CheckpointError: as in `start_training`.
    """
    start_training(Path(out), _chosen(data, model, preset, model_settings, settings), resume=resume)
    return Run(out)


def new_model(
    data: Dataset, model: str = "ast", preset: str = "tiny", model_settings: Mapping[str, Any] | None = None
) -> Simulator:
    """An untrained model that fits a dataset, for a training loop of your own (examples/own_loop.py).

    Raises:
        ConfigError: there is no such model, preset or setting, or the data does not fit.
    """
    config = _chosen(data.path, model, preset, model_settings, {})
    return build_model(resolve(config, data, measure(data)).model)


def _chosen(
    data: str | os.PathLike[str],
    model: str,
    preset: str,
    model_settings: Mapping[str, Any] | None,
    settings: Mapping[str, Any],
) -> RunConfig:
    changes = {f"model.{key}": value for key, value in (model_settings or {}).items()}
    changes |= {f"train.{key}": value for key, value in settings.items()}
    return change(configure(Path(data), preset, model=model), changes)


def start_training(run: Path, config: RunConfig | None = None, resume: bool = False, profile_steps: int = 0) -> None:
    """Train a model in the run folder `run`, or resume the training of the run in it.

    Args:
        config: the settings; with `resume` they must equal those of the run, and None takes those of the run.
        resume: continue after the newest checkpoint, if there is one.
        profile_steps: if above 0, print how the time of so many steps divides, instead of training.

    Raises:
        TrainingError: a loss or a gradient is not finite, the disk is full, or the folder already holds a run.
        ConfigError: settings are out of range, or differ from those of the run that is resumed.
        CheckpointError: another process trains in this folder, or no checkpoint in it can be read.
        SystemExit: SIGINT (code 130), SIGTERM (143) or SIGHUP (129) was received, or nobody reads the output (141);
            a checkpoint of the finished step was written.
    """
    run = Path(run)
    try:
        run.mkdir(parents=True, exist_ok=True)
        with Processes() as processes, _lock(run, processes), StopSignals() as signals, _told_by_leader(processes):
            saved = processes.of_leader(read_config(run) if has_config(run) else None)
            if saved is not None and not resume:
                raise TrainingError(f"{run} already holds a run: go on with --resume, or choose another folder")
            asked = config or saved
            if asked is None:
                raise TrainingError(f"{run} holds no run to resume: name the dataset to start one")
            with Dataset(asked.data) as dataset:
                scales = measure(dataset)
                resolved = asked if config is None else resolve(asked, dataset, scales)
                batch_size = resolved.train.batch_size
                if batch_size % processes.count:
                    raise ConfigError(f"train.batch_size = {batch_size} cannot be cut for {processes.count} processes")
                if saved is not None:
                    _require_same(run, saved, resolved)
                elif processes.leads:
                    write_config(run, resolved, scope_of(dataset), dataset.fingerprint())
                with Training(run, resolved, dataset, scales, signals, processes) as training:
                    if profile_steps:
                        training.profile(profile_steps)
                    else:
                        training.go()
    except BrokenPipeError:  # before the first step
        raise
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        advice = ": the last checkpoint is complete; make room, then go on with --resume" if full else ""
        raise TrainingError(f"{run}: {error}{advice}") from error


@contextmanager
def _lock(run: Path, processes: Processes) -> Iterator[None]:
    """Within the block the leading process holds the lock of the run folder. If it cannot, all processes raise."""
    with ExitStack() as held:
        error = None
        if processes.leads:
            try:
                held.enter_context(checkpoint.lock(run))
            except CheckpointError as refused:
                error = str(refused)
        error = processes.of_leader(error)
        if error is not None:
            raise CheckpointError(error)
        yield


@contextmanager
def _told_by_leader(processes: Processes) -> Iterator[None]:
    """Within the block only the leading process prints."""
    with ExitStack() as silent:
        if not processes.leads:
            nowhere = silent.enter_context(open(os.devnull, "w"))
            silent.enter_context(redirect_stdout(nowhere))
            silent.enter_context(redirect_stderr(nowhere))
        yield


def _require_same(run: Path, saved: RunConfig, asked: RunConfig) -> None:
    """Raise ConfigError if a setting differs, naming the first one; only the path of the dataset may differ."""
    for part in ("model", "train"):
        old, new = getattr(saved, part), getattr(asked, part)
        for key in (field.name for field in dataclasses.fields(old)):
            if getattr(old, key) != getattr(new, key):
                raise ConfigError(
                    f"{run} was started with {part}.{key} = {getattr(old, key)!r}, not {getattr(new, key)!r}:"
                    " resume without settings, or train in another folder"
                )

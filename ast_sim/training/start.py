"""Starting or resuming a training: its settings, its folder, its processes."""

from __future__ import annotations

import dataclasses
import errno
import os
import pickle
import shutil
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path
from typing import Any

import torch

from ast_sim.batches.torch_settings import usual_settings
from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.same_motions import motion_hashes
from ast_sim.inference.promises.known_weights import require_known_weights
from ast_sim.inference.trained_run import Run
from ast_sim.models.registry import build_model
from ast_sim.models.simulator import Simulator
from ast_sim.ops.library import keep_memory
from ast_sim.runs import checkpoint
from ast_sim.runs.config_toml import has_config, write_config
from ast_sim.runs.folder import RunFolder
from ast_sim.runs.run_file import open_run
from ast_sim.runs.train_config import RunConfig
from ast_sim.support.argument_checks import file_name, require_bool, require_function
from ast_sim.support.errors import RESUME, AstSimError, CheckpointError, ConfigError, TrainingError
from ast_sim.support.progress import ShowProgress, require_progress
from ast_sim.support.stop_signals import StopSignals
from ast_sim.training.callbacks import Callback
from ast_sim.training.configure import changes_of, configure, differences, path_of
from ast_sim.training.data_lengths import DataScales, measure, scope_of
from ast_sim.training.defaults_from_data import resolve
from ast_sim.training.loop import Training, fit_statistics, sampler_of
from ast_sim.training.parallel.launch import READY, require_cut, together, usual_processes
from ast_sim.training.parallel.processes import Processes
from ast_sim.training.time_budget import UNKNOWN_STEPS, steps_within
from ast_sim.view.files import make_folder

_training = threading.RLock()  # a callback may train


def train(
    data: str | os.PathLike[str] | Dataset,
    out: str | os.PathLike[str],
    *,
    model: str | None = None,
    preset: str | None = None,
    config: str | os.PathLike[str] | None = None,
    from_run: str | os.PathLike[str] | Run | None = None,
    state: Sequence[str] = (),
    model_settings: Mapping[str, Any] | None = None,
    resume: bool = False,
    callback: Callback | None = None,
    progress: ShowProgress = True,
    **settings: Any,
) -> Run:
    """Train a model on a dataset; returns the run, ready to predict.

    Args:
        data: the dataset file, or the open dataset.
        out: the run folder. After a kill the same call with `resume=True` continues, and gives the same weights.
        model: a registered model: "ast" (the default), "mgn", "bsms", "hcmt" or "transolver".
        preset: the settings to start from; by default "tiny".
        config: a TOML file with settings, such as `config.toml` of a run. It may leave settings out. It does not
            name the dataset. Other arguments win over it.
        from_run: a run: its folder, a file that `Run.save` wrote, or a `Run`. The new run starts with the weights and
            scales of its best checkpoint, and with its settings. The settings of the model stay. If `steps` or
            `minutes` differs, warm-up, decay, validations and checkpoints are chosen again.
        state: fields of the dataset that are predicted beside motion and stress, such as ("PEEQ", "reaction").
        model_settings: changes of the model's settings, such as {"hidden": 32}.
        resume: continue after the newest checkpoint, if there is one.
        callback: called with (step, {name: float}) when the losses are logged and after validations, such as
            `TensorBoard(folder)`. What it raises ends the training, after a checkpoint of the step.
        progress: True: a bar on a terminal, lines elsewhere; False: nothing is written, but the lines go to
            `logging.getLogger("ast_sim")`, as always; or a function that is called with (step, steps, text) after each
            step, and with the same step for each line: the losses, a validation, a stop.
        settings: changes of the training's settings (fields of `TrainConfig`), such as minutes=10, mirror=("x", "y").

    Raises:
        ConfigError: there is no such model, preset or setting (the text names the nearest one), or a value does not
            fit; a text about `config` names the file. Or the data does not fit the model of `from_run`.
        DatasetError: the dataset cannot be read.
        TrainingError, CheckpointError, KeyboardInterrupt: as in `start_training`.
    """
    require_bool(resume=resume)
    require_progress(progress)
    if callback is not None:
        require_function("callback", callback, 0, {}, what="a function of (step, figures)")
    changes = changes_of(state, model_settings, settings)
    folder = file_name(out, "out")
    if isinstance(from_run, Run):
        require_known_weights(from_run, "start from")
        from_run = from_run.path
    source = None if from_run is None else file_name(from_run, "from_run")
    chosen = configure(path_of(data), preset, (), model, config=config, from_run=source, changes=changes)
    start_training(folder, chosen, resume=resume, from_run=source, callback=callback, progress=progress)
    return Run(folder)


def new_model(
    data: str | os.PathLike[str] | Dataset,
    model: str = "ast",
    preset: str = "tiny",
    model_settings: Mapping[str, Any] | None = None,
) -> Simulator:
    """An untrained model that fits a dataset, for a training loop of your own (examples/own_loop.py). The statistics of
    its inputs and outputs are measured as at the start of `train`.

    Args:
        data: the dataset file, or the open dataset.
        model, preset, model_settings: as for `train`.

    Raises:
        ConfigError: there is no such model, preset or setting, or the data does not fit.
    """
    if not isinstance(data, Dataset):
        with Dataset(data) as dataset:
            return new_model(dataset, model, preset, model_settings)
    config = configure(data.path, preset, (), model, changes=changes_of((), model_settings, {}))
    resolved = resolve(config, data, measure(data))
    built = build_model(resolved.model)
    fit_statistics(built, sampler_of(built, data, resolved.train), resolved.train)
    return built


@contextmanager
def _alone() -> Iterator[None]:
    """Within the block no other thread trains: torch has one sequence of random numbers for all threads. Afterwards
    this sequence goes on as if nothing had been trained."""
    if not _training.acquire(blocking=False):
        raise TrainingError(
            "another thread of this process trains, and torch has one sequence of random numbers for both: train one"
            " after the other, or in processes of their own"
        )
    try:
        with torch.random.fork_rng(devices=[]):
            yield
    finally:
        _training.release()


@usual_settings()
@_alone()
def start_training(
    run: Path,
    config: RunConfig | None = None,
    resume: bool = False,
    profile_steps: int = 0,
    from_run: Path | None = None,
    callback: Callback | None = None,
    progress: ShowProgress = True,
) -> None:
    """Train a model in the run folder `run`, or resume the training of the run in it.

    Args:
        config: the settings; with `resume` they must equal the settings of the run, and None takes these.
        resume: continue after the newest checkpoint, if there is one.
        profile_steps: if above 0, print how the time of this number of steps divides, instead of training.
        from_run, callback, progress: as for `train`; `config` has the model of that run. The leading process calls.

    Raises:
        TrainingError: a loss or gradient is not finite, the disk is full, the folder holds a run, or a thread trains.
        ConfigError: settings are out of range, or differ from the settings of the run that is resumed, or the data does
            not fit the model of `from_run`.
        CheckpointError: another process trains in this folder, or no checkpoint in it can be read.
        KeyboardInterrupt: SIGINT, SIGTERM or SIGHUP was received, or nobody reads the output; a checkpoint of the
            finished step was written. The error is an `Interrupted`, which has the number of the signal.
    """
    folder = RunFolder(Path(run))
    along = {"run": run, "config": config, "resume": resume, "profile_steps": profile_steps, "from_run": from_run}
    with (
        _explained(folder.path),
        together(_process_count(folder, config, resume), config, along),
        Processes() as processes,
        _held(folder.path, processes),
        StopSignals() as signals,
        _told_by_leader(processes),
    ):
        saved = processes.of_leader(folder.settings if has_config(folder.path) else None)
        if saved is not None and not resume:
            raise TrainingError(f"{run} already holds a run: {RESUME}, or choose another folder")
        wanted = config or saved
        if wanted is None:
            raise TrainingError(f"{run} holds no run to resume: name the dataset to start one")
        source = None if from_run is None else open_run(from_run)
        with Dataset(folder.training_data() if config is None else wanted.data) as dataset:
            scales = measure(dataset)
            fit = partial(resolve, dataset=dataset, scales=scales, keep_model=source is not None)
            shared = {"signals": signals, "processes": processes, "progress": progress}
            begin = partial(Training, folder, dataset=dataset, scales=scales, **shared)
            wanted = _with_steps(wanted, saved, fit, begin)
            resolved = _cut(wanted if config is None else fit(wanted), processes.count)
            if source is not None:
                _require_fit(source, resolved, dataset, scales)
            if saved is not None:
                _require_same(folder, saved, resolved, source)
            elif processes.leads:
                scope = scope_of(dataset, resolved.model.data, resolved.train.mirror)
                start = None if source is None else source.start()
                origin = (dataset.fingerprint(), start, dataset.info.generator.get("spec"))
                write_config(folder.path, resolved, scope, *origin, _learned(dataset, resolved, source))
            with begin(config=resolved, callback=callback) as training:
                training.profile(profile_steps) if profile_steps else training.go()


def _learned(dataset: Dataset, config: RunConfig, source: RunFolder | None) -> dict[str, list[str]]:
    """The hashes of the scenes that train and choose a run, by split, and the ones of the run that it starts from."""
    used = motion_hashes(dataset, "train")[: config.train.scenes]
    own = {"train": used, "valid": motion_hashes(dataset, "valid")}
    if source is None:
        return own
    return {split: list(dict.fromkeys([*hashes, *source.scenes(split)])) for split, hashes in own.items()}


def train_along() -> None:
    """A process that trains along with the one that started it: it makes the same training, with its part of each
    batch. The arguments of `start_training` come through standard input; see `together`."""
    keep_memory()
    arguments = pickle.load(sys.stdin.buffer)
    sys.stdout.buffer.write(READY)
    sys.stdout.flush()
    start_training(**arguments)


def _with_steps(
    config: RunConfig, saved: RunConfig | None, fit: Callable[[RunConfig], RunConfig], begin: Callable[..., Training]
) -> RunConfig:
    """The settings; if they have minutes and no steps, with the number of steps that fits into the minutes: of the run
    that is resumed, or measured."""
    minutes = config.train.minutes
    if minutes is None or config.train.steps is not None:
        return config
    if saved is not None and saved.train.minutes == minutes:
        steps = saved.train.steps
    else:
        timed = fit(dataclasses.replace(config, train=dataclasses.replace(config.train, steps=UNKNOWN_STEPS)))
        with begin(config=timed) as training:
            steps = steps_within(minutes, training)
    return dataclasses.replace(config, train=dataclasses.replace(config.train, steps=steps))


@contextmanager
def _explained(run: Path) -> Iterator[None]:
    """Within the block, errors of the disk become a TrainingError."""
    try:
        yield
    except BrokenPipeError:  # before the first step
        raise
    except OSError as error:
        if isinstance(error, FileNotFoundError) and _lay_in(run, error) and not run.is_dir():
            raise TrainingError(
                f"{run} is gone since the training began: if it was moved, {RESUME} where it is now"
            ) from error
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        advice = f": the last checkpoint is complete; make room, then {RESUME}" if full else ""
        raise TrainingError(f"{run}: {error}{advice}") from error


def _lay_in(run: Path, error: OSError) -> bool:
    """Whether an error is about a file of the run."""
    return isinstance(error.filename, str | os.PathLike) and Path(error.filename).is_relative_to(run)


@contextmanager
def _held(run: Path, processes: Processes) -> Iterator[None]:
    """Within the block the run folder is there, and the leading process holds its lock. If it cannot, all processes
    raise. If the block fails before the run has settings, a folder that was made for it is removed."""
    absent = next((folder for folder in reversed([run, *run.parents]) if not folder.exists()), None)
    with ExitStack() as held:
        refusal = None
        try:
            if processes.leads:  # alone, so that it knows whether the folder was there
                make_folder(run)
                held.enter_context(checkpoint.lock(run))
        except AstSimError as error:
            refusal = str(error)
        refusal = processes.of_leader(refusal)
        if refusal is not None:
            raise CheckpointError(refusal)
        try:
            yield
        except BaseException:
            if processes.leads and absent is not None and not has_config(run):
                shutil.rmtree(absent, ignore_errors=True)
            raise


@contextmanager
def _told_by_leader(processes: Processes) -> Iterator[None]:
    """Within the block only the leading process prints."""
    if processes.leads:
        yield
        return
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        yield


def _process_count(folder: RunFolder, config: RunConfig | None, resume: bool) -> int:
    """The number of processes to train in: as set, as the run that is resumed had it, or as usual. A process that is
    one of several already starts no others."""
    if Processes().count > 1:
        return 1
    if config is not None and config.train.processes is not None:
        return config.train.processes
    if resume and has_config(folder.path):
        return folder.settings.train.processes or 1
    return 1 if config is None else usual_processes(config)


def _cut(config: RunConfig, processes: int) -> RunConfig:
    """The settings with the number of processes, each of which takes its part of every batch."""
    require_cut(config, processes)
    return dataclasses.replace(config, train=dataclasses.replace(config.train, processes=processes))


def _require_fit(source: RunFolder, config: RunConfig, dataset: Dataset, scales: DataScales) -> None:
    """Raise ConfigError if the model of the run `source` cannot learn from the dataset."""
    source.require_fit(dataset)
    if config.model.data.planar and not scales.planar:
        raise ConfigError(f"{dataset.path} leaves the plane z = 0, in which {source.path} keeps all nodes")


def _require_same(run: RunFolder, saved: RunConfig, config: RunConfig, source: RunFolder | None) -> None:
    """Raise ConfigError if a setting or the run to start from differs, naming the first one; only the path of the
    dataset and the number of processes may differ."""
    for key, old, new in differences(saved, config, "model", "train"):
        if key == "train.processes":
            continue
        raise ConfigError(
            f"{run.path} was started with {key} = {old!r}, not {new!r}: resume with its settings (on the command line"
            " leave out the dataset and all settings), or train in another folder"
        )
    start = run.origin.get("start")
    if source is not None and (start is None or Path(start["run"]) != source.path.resolve()):
        begun = "without another run" if start is None else f"from {start['run']}"
        raise ConfigError(
            f"{run.path} was started {begun}, not from {source.path}: resume without it, or train in another folder"
        )

"""The settings that a training is given: of a preset or of a run, changed by a file and by assignments."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ast_sim.dataset.reader import Dataset
from ast_sim.models.registry import find_preset
from ast_sim.runs.config_toml import read_changes
from ast_sim.runs.run_file import open_run
from ast_sim.runs.train_config import RunConfig, TrainConfig
from ast_sim.support.argument_checks import file_name, require_type, several
from ast_sim.support.errors import ConfigError, DatasetError
from ast_sim.support.toml_settings import NONE, NOTHING, assigned, change

_LENGTHS = ("train.minutes", "train.steps", "train.epochs")
_FOLLOW_FROM_STEPS = ("train.warmup", "train.decay", "train.validate_every", "train.checkpoint_every")


def configure(
    data: str | os.PathLike[str],
    preset: str | None = None,
    assignments: Sequence[str] = (),
    model: str | None = None,
    *,
    config: str | os.PathLike[str] | None = None,
    from_run: Path | None = None,
    changes: Mapping[str, Any] = NOTHING,
) -> RunConfig:
    """The settings of a preset or of a run, changed by a file, then by assignments `key=value` and by `changes`, values
    by dotted key. Unset settings are filled in when training starts.

    Arguments and errors are as for `train`.
    """
    file = None if config is None else file_name(config, "config")
    given = {} if file is None else read_changes(file)
    if "train.steps" in given:  # the settings of a run have all of them
        for key in ("train.minutes", "train.epochs"):
            given.pop(key, None)
    if from_run is None:
        with _naming(file):
            named = given.pop("model.name", "ast")
            chosen = find_preset(str(named) if model is None else model, "tiny" if preset is None else preset)
        settings = RunConfig(chosen.model, TrainConfig(**chosen.train), str(data))
    elif model is not None or preset is not None:
        raise ConfigError("a run that starts from another one has its model and settings: leave model and preset out")
    else:
        source = open_run(from_run).settings
        settings = dataclasses.replace(source, train=dataclasses.replace(source.train, minutes=None), data=str(data))
    before = settings
    with _naming(file):
        settings = _changed(settings, given, reschedule=from_run is not None)
    later = {**assigned(settings, assignments), **changes}
    settings = _changed(settings, later, reschedule=from_run is not None or "train.steps" in given)
    _require_effect(later, settings)
    for key, old, new in differences(before, settings, "model") if from_run is not None else ():
        raise ConfigError(f"{key} is {new!r}, but {from_run} has {old!r}: a run that starts from it keeps its model")
    return settings


def path_of(data: str | os.PathLike[str] | Dataset) -> Path:
    """The path of a dataset that is named by its path or is open.

    Raises:
        DatasetError: it was opened in another unit of length than the one of the file.
    """
    if not isinstance(data, Dataset):
        return file_name(data, "data")
    with Dataset(data.absolute_path) as in_own_unit:
        if in_own_unit.info.length_unit != data.info.length_unit:
            raise DatasetError(f"{data.path} was opened in {data.info.length_unit}: open it without length_unit")
    return data.absolute_path


def changes_of(
    state: Sequence[str], model_settings: Mapping[str, Any] | None, train_settings: Mapping[str, Any]
) -> dict[str, Any]:
    """The changes of settings that the arguments of `train` ask for, by dotted key.

    Raises:
        ConfigError: `state` is no list, or `model_settings` no mapping; or both have the state.
    """
    state = several("state", state, "names of fields, such as ['reaction']")
    model_settings = {} if model_settings is None else model_settings
    require_type("model_settings", model_settings, Mapping, "values by name, such as {'hidden': 32}")
    if state and "state" in model_settings:
        raise ConfigError("model_settings has the state, too: give it once")
    of_model = {**({"state": tuple(state)} if state else {}), **model_settings}
    changes = {f"model.{key}": value for key, value in of_model.items()}
    return changes | {f"train.{key}": value for key, value in train_settings.items()}


def _changed(config: RunConfig, values: Mapping[str, Any], reschedule: bool) -> RunConfig:
    """Settings with new values. With `reschedule`, another number of steps leaves open what follows from it. Minutes,
    steps and epochs replace each other."""
    lengths = [key for key in _LENGTHS if values.get(key) not in (None, NONE)]
    if len(lengths) > 1:
        raise ConfigError(f"{' and '.join(lengths)} exclude each other: give one of them")
    if lengths == ["train.steps"]:
        values = {"train.minutes": NONE, **values}
    elif lengths:
        values = {**dict.fromkeys(("train.minutes", "train.steps", *_FOLLOW_FROM_STEPS), NONE), **values}
    if reschedule and values.get("train.steps", config.train.steps) != config.train.steps:
        values = {**dict.fromkeys(_FOLLOW_FROM_STEPS, NONE), **values}
    return change(config, values)


def _require_effect(given: Mapping[str, Any], config: RunConfig) -> None:
    """Raise ConfigError if a setting that was given, not a preset's, has no effect on the dataset."""
    keys = [key for key in ("stress_weight", "validate_every", "validate_scenes") if given.get(f"train.{key}")]
    if not keys:
        return
    with Dataset(config.data) as dataset:
        of_stress = config.model.state or dataset.info.stress_location != "none"
        unvalidated = None if dataset.count("valid") else f"{dataset.path} has no validation scenes"
    useless = dict.fromkeys(keys, unvalidated)
    useless["stress_weight"] = None if of_stress else "no stress and no field is predicted"
    for key in keys:
        if useless[key] is not None:
            value = getattr(config.train, key)
            raise ConfigError(f"train.{key} = {value} is of no use here: {useless[key]}; leave it out")


@contextmanager
def _naming(file: Path | None) -> Iterator[None]:
    """Within the block, a ConfigError names the file, if there is one."""
    try:
        yield
    except ConfigError as error:
        if file is None:
            raise
        raise ConfigError(f"{file}: {error}") from error


def differences(old: RunConfig, new: RunConfig, *parts: str) -> Iterator[tuple[str, Any, Any]]:
    """The settings that differ: dotted key, old value, new value."""
    for part in parts:
        before, after = vars(getattr(old, part)), vars(getattr(new, part))
        yield from ((f"{part}.{key}", before[key], after[key]) for key in before if before[key] != after[key])

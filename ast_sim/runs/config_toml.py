"""The settings and the scope of a run as files: `config.toml` and `scope.toml` for people, `run.json` to compare with.

`run.json` holds the settings, the scope and the dataset that the run was started with, the checkpoint that gave its
first weights if it starts from another run, the specification of an assembly if the dataset was made of one, the hashes
of the scenes that train and choose it (`same_motions`), and the SHA-256 of them all. It is written once. A reader
compares the other two files with it, so a damaged or edited file is noticed. Each checkpoint holds the SHA-256, so a
checkpoint of another run is noticed.
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ast_sim.runs import CONFIG, SCOPE
from ast_sim.runs.scope import Scope
from ast_sim.runs.train_config import RunConfig
from ast_sim.support.disk import read_text, write_text
from ast_sim.support.errors import CheckpointError, ConfigError
from ast_sim.support.toml_settings import from_values, leaves, to_toml, to_values

ORIGIN = "run.json"
VERSION = 2  # in version 1 elastic forces, an input, had another Poisson's ratio than the scenes
_KEYS = {"version", CONFIG, SCOPE, "data", "sha256"}
_START = "start"  # only in a run that starts from another one
_SPECIFICATION = "specification"  # only in a run that was trained on an assembly
_SCENES = "scenes"  # not in older runs


def has_config(run: Path) -> bool:
    """Whether the folder holds a run."""
    return (run / CONFIG).is_file()


def write_config(
    run: Path,
    settings: RunConfig,
    scope: Scope,
    data: str,
    start: Mapping[str, Any] | None = None,
    specification: Mapping[str, Any] | None = None,
    scenes: Mapping[str, Sequence[str]] | None = None,
) -> None:
    """Write the three files, each whole; `data` is the dataset's fingerprint, `start` the checkpoint that gives the
    first weights, `specification` what `AssemblySpec.describe` gave when the dataset was made, `scenes` the hashes of
    the scenes by split.

    The settings come last: a folder with settings has the other two.
    """
    values = {"version": VERSION, CONFIG: to_values(settings), SCOPE: to_values(scope), "data": data}
    values |= {_START: dict(start)} if start else {}
    values |= {_SPECIFICATION: dict(specification)} if specification else {}
    values |= {_SCENES: {split: " ".join(hashes) for split, hashes in scenes.items()}} if scenes else {}
    write_text(run / SCOPE, _text(scope))
    write_text(run / ORIGIN, json.dumps({**values, "sha256": _hash(values)}, indent=1) + "\n")
    write_text(run / CONFIG, _text(settings))


def write_settings(path: Path, settings: RunConfig) -> None:
    """Write settings for `train(config=)`; what is unset stays unset."""
    write_text(path, _text(settings))


def read_config(run: Path) -> RunConfig:
    """The settings of a run, with the facts of its data.

    Raises:
        CheckpointError: the folder holds no run, or `run.json` cannot be read.
        ConfigError: the file was edited or damaged; the text names the first setting that differs.
    """
    return from_values(RunConfig, _verified(run, CONFIG)).knowing(read_scope(run).data)


def read_scope(run: Path) -> Scope:
    """The scope of a run; errors as in `read_config`."""
    return from_values(Scope, _verified(run, SCOPE))


def read_changes(path: Path) -> dict[str, Any]:
    """The settings in a file of the format of `config.toml`, by dotted key; all but the path of the dataset. The file
    may leave settings out.

    Raises:
        ConfigError: the file cannot be read, is no TOML, or is of another version; the text names the file.
    """
    try:
        changes = _leaves(path)
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise ConfigError(f"{path} is not valid TOML: {error}") from error
    changes.pop("data", None)
    version = changes.pop("version", VERSION)
    if version != VERSION:
        raise ConfigError(f"{path} has version {version}, not {VERSION}: use the ast_sim that wrote it")
    return changes


def read_origin(run: Path) -> dict[str, Any]:
    """The content of `run.json`: `config.toml`, `scope.toml`, `data`, `sha256`; `start`, `specification` and `scenes`
    if there are such.

    Raises:
        CheckpointError: the file is missing, damaged or of another version.
    """
    path = run / ORIGIN
    try:
        origin = json.loads(path.read_text(encoding="utf-8"))
        if origin.keys() - {_START, _SPECIFICATION, _SCENES} != _KEYS or origin["sha256"] != _hash(origin):
            raise ValueError
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read ({error.strerror}): {_advice(ORIGIN)}") from error
    except (ValueError, AttributeError, TypeError, RecursionError) as error:
        raise CheckpointError(f"{path} is damaged: its content does not fit its SHA-256: {_advice(ORIGIN)}") from error
    if origin["version"] != VERSION:
        raise CheckpointError(f"{path} has version {origin['version']}, not {VERSION}: use the ast_sim that wrote it")
    return origin


def _verified(run: Path, name: str) -> dict[str, Any]:
    """The table of the file `name` of a run; the file must hold what the run was started with."""
    path = run / name
    try:
        written = _leaves(path)
    except OSError as error:
        raise CheckpointError(f"{run} is not a run folder: {name} cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise ConfigError(f"{path} is damaged: it is not valid TOML ({error}): {_advice(name)}") from error
    kept = read_origin(run)[name]
    wanted = {"version": VERSION, **dict(leaves(kept))}
    for key in (*wanted, *written):
        if key not in written:
            raise ConfigError(f"{path}: {key} is missing; the run was started with {wanted[key]!r}: {_advice(name)}")
        if key not in wanted:
            raise ConfigError(f"{path}: {key} is no setting of this run: {_advice(name)}")
        if written[key] != wanted[key]:
            raise ConfigError(
                f"{path}: {key} is {written[key]!r}, but the run was started with {wanted[key]!r}: {_advice(name)}"
            )
    return kept


def _leaves(path: Path) -> dict[str, Any]:
    """The values in a TOML file by dotted key. Raises OSError or ValueError."""
    try:
        return dict(leaves(tomllib.loads(read_text(path))))
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def _advice(name: str) -> str:
    return f"restore {name} as it was, or train in another folder"


def _text(settings: RunConfig | Scope) -> str:
    return f"version = {VERSION}\n{to_toml(settings)}"


def _hash(values: Mapping[str, Any]) -> str:
    """The SHA-256 of all values but the value of the key `sha256`."""
    hashed = {key: value for key, value in values.items() if key != "sha256"}
    return hashlib.sha256(json.dumps(hashed, sort_keys=True).encode()).hexdigest()

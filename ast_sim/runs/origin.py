"""`run.json` of a run: the settings, the scope and the dataset that the run was started with, the checkpoint that gave
its first weights if it starts from another run, and the SHA-256 of them all.

The file is written once. `config.toml` and `scope.toml` hold the same settings for people to read. A reader compares
them with `run.json`, so a damaged or edited file is noticed. Each checkpoint holds the SHA-256, so a checkpoint of
another run is noticed.
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ast_sim.support.disk import write_text
from ast_sim.support.errors import CheckpointError, ConfigError
from ast_sim.support.toml_settings import leaves

ORIGIN = "run.json"
CONFIG = "config.toml"
SCOPE = "scope.toml"
VERSION = 1

_KEYS = {"version", CONFIG, SCOPE, "data", "sha256"}
_START = "start"  # only in a run that starts from another one


def write_origin(run: Path, tables: Mapping[str, Any], data: str, start: Mapping[str, Any] | None = None) -> None:
    """Write the tables of the TOML files, by the name of their file, and the fingerprint of the dataset; `start` says
    which checkpoint gave the first weights."""
    values = {"version": VERSION, **tables, "data": data, **({_START: dict(start)} if start else {})}
    write_text(run / ORIGIN, json.dumps({**values, "sha256": _hash(values)}, indent=1) + "\n")


def read_origin(run: Path) -> dict[str, Any]:
    """The content of `run.json`: `config.toml`, `scope.toml`, `data`, `sha256`, and `start` if there is one.

    Raises:
        CheckpointError: the file is missing, damaged or of another version.
    """
    path = run / ORIGIN
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        damaged = found.keys() - {_START} != _KEYS or found["sha256"] != _hash(
            {k: v for k, v in found.items() if k != "sha256"}
        )
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read ({error.strerror}): {_advice(path.name)}") from error
    except (ValueError, AttributeError, TypeError, RecursionError) as error:
        raise CheckpointError(f"{path} is damaged: {_advice(path.name)}") from error
    if damaged:
        raise CheckpointError(f"{path} is damaged: its content does not fit its SHA-256: {_advice(path.name)}")
    if found["version"] != VERSION:
        raise CheckpointError(f"{path} has version {found['version']}, not {VERSION}: use the ast_sim that wrote it")
    return found


def verified(run: Path, name: str) -> dict[str, Any]:
    """The table of the file `name` of a run; the file must hold what the run was started with.

    Raises:
        CheckpointError: the folder holds no run, or `run.json` cannot be read.
        ConfigError: the file is damaged or was edited; the text names the first setting that differs.
    """
    path = run / name
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise CheckpointError(f"{run} is not a run folder: {name} cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is damaged: it is not UTF-8: {_advice(name)}") from error
    kept = read_origin(run)[name]
    try:
        found = dict(leaves(tomllib.loads(text)))
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path} is damaged: it is not valid TOML ({error}): {_advice(name)}") from error
    wanted = {"version": VERSION, **dict(leaves(kept))}
    for key in (*wanted, *found):
        if key not in found:
            raise ConfigError(f"{path}: {key} is missing; the run was started with {wanted[key]!r}: {_advice(name)}")
        if key not in wanted:
            raise ConfigError(f"{path}: {key} is no setting of this run: {_advice(name)}")
        if found[key] != wanted[key]:
            raise ConfigError(
                f"{path}: {key} is {found[key]!r}, but the run was started with {wanted[key]!r}: {_advice(name)}"
            )
    return kept


def _advice(name: str) -> str:
    return f"restore {name} as it was, or train in another folder"


def _hash(values: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()

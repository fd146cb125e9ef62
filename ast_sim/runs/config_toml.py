"""`config.toml` of a run, its settings as a file; its scope is read and written the same way."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ast_sim.runs.origin import CONFIG, SCOPE, VERSION, verified, write_origin
from ast_sim.runs.scope import Scope
from ast_sim.runs.train_config import RunConfig
from ast_sim.support.disk import read_text, write_text
from ast_sim.support.errors import ConfigError
from ast_sim.support.toml_settings import from_values, leaves, to_toml, to_values


def has_config(run: Path) -> bool:
    """Whether the folder holds a run."""
    return (run / CONFIG).is_file()


def read_config(run: Path) -> RunConfig:
    """The settings of a run.

    Raises:
        CheckpointError: the folder holds no run.
        ConfigError: the file was edited or damaged; the text names the first setting that differs.
    """
    return from_values(RunConfig, verified(run, CONFIG))


def read_scope(run: Path) -> Scope:
    """The scope of a run; errors as in `read_config`."""
    return from_values(Scope, verified(run, SCOPE))


def read_changes(path: Path) -> dict[str, Any]:
    """The settings in a file of the format of `config.toml`, by dotted key; all but the path of the dataset. The file
    may leave settings out.

    Raises:
        ConfigError: the file cannot be read, is no TOML, or is of another version; the text names the file.
    """
    try:
        found = dict(leaves(tomllib.loads(read_text(path))))
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path} is not valid TOML: {error}") from error
    found.pop("data", None)
    version = found.pop("version", VERSION)
    if version != VERSION:
        raise ConfigError(f"{path} has version {version}, not {VERSION}: use the ast_sim that wrote it")
    return found


def write_config(
    run: Path, settings: RunConfig, scope: Scope, data: str, start: Mapping[str, Any] | None = None
) -> None:
    """Write the scope, `run.json` and the settings, each as a whole file; `data` is the dataset's fingerprint, `start`
    the checkpoint that gives the first weights.

    The settings come last: a folder with settings has the other two.
    """
    write_text(run / SCOPE, _text(scope))
    write_origin(run, {CONFIG: to_values(settings), SCOPE: to_values(scope)}, data, start)
    write_text(run / CONFIG, _text(settings))


def _text(settings: RunConfig | Scope) -> str:
    return f"version = {VERSION}\n{to_toml(settings)}"

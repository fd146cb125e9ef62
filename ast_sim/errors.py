"""Errors that a user can act on.

The text of each says what is wrong, where (file, sample, frame, node, value) and what to do. The command line
prints it as one line on stderr and exits with code 2; from Python they are ordinary exceptions.
"""

from __future__ import annotations

import importlib
from types import ModuleType


class AstSimError(Exception):
    """Base of all errors that a user can act on."""


class ConfigError(AstSimError, ValueError):
    """A setting that does not exist or does not fit."""


class DatasetError(AstSimError, ValueError):
    """A dataset or mesh file that is truncated, damaged or inconsistent."""


class CheckpointError(AstSimError):
    """A checkpoint or run folder that cannot be read, written or locked."""


class TrainingError(AstSimError):
    """Training that cannot go on, such as a loss that is not finite."""


class RolloutError(AstSimError):
    """A prediction that left the finite numbers or the domain."""


class SimulationError(AstSimError):
    """A finite-element solve that cannot be finished."""


class MissingExtra(AstSimError, ImportError):
    """An optional dependency that is not installed."""


def require(extra: str, *modules: str) -> list[ModuleType]:
    """Import the modules of an optional extra.

    Raises:
        MissingExtra: with the pip line that installs the extra.
    """
    found = []
    for name in modules:
        try:
            found.append(importlib.import_module(name))
        except ImportError as error:
            line = f'pip install "ast_sim[{extra}]"'
            raise MissingExtra(f"{name} is needed here but cannot be imported ({error}): {line}") from error
    return found

"""Errors that a user can act on.

The text of an error says what is wrong, where it is wrong (file, sample, frame, node, value) and what to do. The
command line prints this text as one line on stderr and exits with code 2. In Python they are ordinary exceptions.
"""

from __future__ import annotations

import difflib
import importlib
import sys
import warnings
from collections.abc import Iterable
from types import ModuleType
from typing import Any

_PACKAGE = __name__.partition(".")[0]
RESUME = "go on with resume=True (--resume)"  # what to do where a training has stopped


class AstSimError(Exception):
    """Base of all errors that a user can act on."""


class LooksWrong(UserWarning):
    """A line of the table of what can be read but is probably wrong in data."""


class ConfigError(AstSimError, ValueError):
    """A setting that does not exist or does not fit."""


class DatasetError(AstSimError, ValueError):
    """A dataset or mesh file that is truncated, damaged or inconsistent."""


class CheckpointError(AstSimError):
    """A checkpoint or run folder that cannot be read, written or locked."""


class TrainingError(AstSimError):
    """Training that cannot go on, such as a loss that is not finite."""


class RolloutError(AstSimError):
    """A prediction that left the finite numbers or the domain.

    Attributes:
        answer: the `Answer` so far, with the frames before the one that failed; None if there is none.
    """

    def __init__(self, text: str, answer: Any = None) -> None:
        super().__init__(text)
        self.answer = answer


class SimulationError(AstSimError):
    """A finite-element solve that cannot be finished."""


class MissingExtra(AstSimError, ImportError):
    """An optional dependency that is not installed."""


def warn(text: str, category: type[Warning] = UserWarning) -> None:
    """Warn of something at the line outside this package that led here, the one that its author can change."""
    level = 2
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] == _PACKAGE:
        frame = frame.f_back
        level += 1
    warnings.warn(text, category, stacklevel=level)


def nearest_name(name: str, known: Iterable[str]) -> str:
    """An ending for a message about an unknown name: the nearest known one, or all that there are."""
    known = list(known)
    close = difflib.get_close_matches(str(name), known, 1, 0.5)
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; there are: {', '.join(known)}" if known else "; there are none"


def counted(number: int, one: str, several: str = "") -> str:
    """A number and what it counts: counted(3, "node") is "3 nodes"; `several` where that is not `one` with an s."""
    return f"{number:,} {one}" if number == 1 else f"{number:,} {several or one + 's'}"


def printable(text: str) -> str:
    """The text, with escapes for control characters, which a terminal would obey, and for bytes that are no text."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def is_utf8(path: str) -> bool:
    """Whether the bytes of a path are UTF-8. Python has surrogates in place of other bytes."""
    return not any("\ud800" <= c <= "\udfff" for c in path)


def require(extra: str, *modules: str) -> list[ModuleType]:
    """Import the modules of an optional extra.

    Raises:
        MissingExtra: a module cannot be imported; the text gives the pip command that installs the extra.
    """
    imported = []
    for name in modules:
        try:
            imported.append(importlib.import_module(name))
        except ImportError as error:
            if interrupted(error):  # Ctrl-C while a compiled module is imported
                raise KeyboardInterrupt from error
            line = f'pip install "ast_sim[{extra}]"'
            raise MissingExtra(f"{name} is needed here but cannot be imported ({error}): {line}") from error
    return imported


def interrupted(error: BaseException | None) -> bool:
    """Whether a KeyboardInterrupt lies behind the error."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None

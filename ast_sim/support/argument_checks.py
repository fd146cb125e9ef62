"""Checks of what a caller hands over: a wrong kind of argument is one clear line that names the argument."""

from __future__ import annotations

import inspect
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ast_sim.support.errors import ConfigError


def file_name(value: Any, name: str) -> Path:
    """The name of a file or a folder as a path; ~ is the home folder.

    Raises:
        ConfigError: it is neither a text nor a path, or it is empty; the text names the argument `name`.
    """
    if not is_file_name(value):
        raise ConfigError(f"{name} is {in_short(value)}; it must be the name of a file or a folder")
    return at_home(Path(value))


def is_file_name(value: Any) -> bool:
    """Whether the value is a text or a path that can name a file."""
    try:
        text = os.fspath(value)
        return isinstance(text, str) and "\0" not in text and os.fsencode(text) != b""
    except (TypeError, UnicodeEncodeError):  # no path; or half of a pair of UTF-16, which no name has
        return False


def at_home(path: Path) -> Path:
    """The path, in the home folder if it begins with ~, as a shell would have it."""
    return path.expanduser() if path.parts[:1] == ("~",) else path


def require_type(name: str, value: Any, types: type | tuple[type, ...], what: str) -> None:
    """Raise ConfigError unless the argument `name` is an instance of one of the types, which `what` says in words."""
    if not isinstance(value, types):
        raise ConfigError(f"{name} is {in_short(value)}; it must be {what}")


def require_line(name: str, value: Any) -> None:
    """Raise ConfigError unless the argument `name`, which stands in messages and titles, is one line of text."""
    require_type(name, value, str, "a text")
    if value.splitlines() != [value]:
        raise ConfigError(f"{name} is {in_short(value)}; it must be one line of text")


def several(name: str, values: Any, what: str) -> list[Any]:
    """What an argument holds as a list; `what` says in words what it may hold.

    Raises:
        ConfigError: it is one thing; or a text, whose letters would be taken for the things; or things by name, whose
            names would be.
    """
    wrong = ConfigError(f"{name} is {in_short(values)}; it must be a list of {what}")
    if isinstance(values, str | bytes | Mapping):
        raise wrong
    try:
        return list(values)
    except TypeError as error:  # an array of no axis counts as Iterable
        raise wrong from error


def require_function(name: str, value: Any, *arguments: Any, what: str) -> None:
    """Raise ConfigError unless the argument `name` can be called with `arguments`, which `what` says in words: a long
    work would fail at its first call. A function in C may not tell what it takes."""
    try:
        inspect.signature(value).bind(*arguments)
    except TypeError as error:
        raise ConfigError(f"{name} is {in_short(value)}; it must be {what}") from error
    except ValueError:
        return


def require_bool(**values: Any) -> None:
    """Raise ConfigError unless the arguments are True or False: any text, such as "no", would count as True."""
    for name, value in values.items():
        require_type(name, value, bool, "True or False")


def in_short(value: Any) -> str:
    """A value in a message: itself if it is short, else its type."""
    if value is None or isinstance(value, str | int | float | complex | bytes):
        shown = repr(value)
        return shown if len(shown) <= 60 else f"{shown[:50]}..."
    return f"the class {value.__name__}" if isinstance(value, type) else f"of the type {type(value).__name__}"

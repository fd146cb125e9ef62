"""What the text of an argument of the command line may be."""

from __future__ import annotations

import argparse
import pkgutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ast_sim.support.errors import ConfigError


def path(text: str) -> Path:
    """The name of a file or a folder."""
    if not text or "\0" in text:
        raise argparse.ArgumentTypeError(f"{text!r} is no name of a file or a folder")
    return Path(text)


def whole_numbers(text: str) -> tuple[int, ...]:
    """Numbers such as 5,10,-1."""
    try:
        numbers = tuple(int(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no list of whole numbers, such as 5,10,-1") from None
    if any(abs(number) >= 1 << 63 for number in numbers):
        raise argparse.ArgumentTypeError("a number above 2^63 - 1")
    return numbers


def at_least(least: int) -> Any:
    """A whole number that is not smaller."""

    def number(text: str) -> int:
        value = int(text)
        if value < least:
            raise argparse.ArgumentTypeError(f"{value} is below {least}")
        if value >= 1 << 63:
            raise argparse.ArgumentTypeError("a number above 2^63 - 1")
        return value

    number.__name__ = "whole number"
    return number


def read_by(place: str) -> Callable[[str], Any]:
    """An argument that a function of ours reads, such as "package.module:function", which is imported when it is
    needed; its ConfigError becomes the parser's own error."""

    def read(text: str) -> Any:
        try:
            return pkgutil.resolve_name(place)(text)
        except ConfigError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return read

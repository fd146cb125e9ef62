"""The arguments of the command line: a parser, options in groups, and what their texts may be."""

from __future__ import annotations

import argparse
import pkgutil
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from ast_sim.support.argument_checks import at_home, is_file_name
from ast_sim.support.errors import ConfigError, nearest_name, printable

Key = TypeVar("Key")
Value = TypeVar("Value")


class _Once(argparse.Action):
    """An option that takes one value. A second one is an error; argparse would take it in place of the first."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: Any, values: Any, option: str | None = None) -> None:
        before = vars(namespace).setdefault("_given", set())
        if option is not None and self.dest in before:
            parser.error(f"{option} is given twice: leave one out")
        before.add(self.dest)
        setattr(namespace, self.dest, values)


class Parser(argparse.ArgumentParser):
    """A parser that reports wrong arguments in one line. Its help ends with the lines that `more` makes when it is
    printed, since what they tell of takes time to import."""

    more: Callable[[], list[str]] = list

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.register("action", None, _Once)
        self.register("action", "store", _Once)

    def read(self, words: Sequence[str], into: argparse.Namespace) -> None:
        """Read the arguments. A value -- is refused first: argparse would leave an option without its value. Arguments
        that nothing takes are refused by the parser of the command, `into.parser`, which knows its options."""
        for word in words:
            if word.startswith("--") and word.endswith("=--"):
                self.error(f"{word}: -- is no value")
        _, unknown = self.parse_known_args(words, into)
        if unknown:
            getattr(into, "parser", self).refuse(unknown)

    def refuse(self, unknown: list[str]) -> NoReturn:
        """Refuse arguments that nothing takes: the first option by its name, or a word too many."""
        for word in unknown:
            if word.startswith("-"):
                name = word.split("=")[0]
                known = [option for option in self._option_string_actions if option.startswith("--")]
                self.error(f"there is no option {name}{nearest_name(name, known)}")
        self.error(f"{unknown[0]!r} is one argument too many")

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {printable(message)} (see {self.prog} --help)\n")

    def _print_message(self, message: str, file: Any = None) -> None:
        """Of argparse, which keeps quiet where a help cannot be written."""
        if message:
            (file or sys.stderr).write(message)

    def format_help(self) -> str:
        return super().format_help() + "".join(f"{line}\n" for line in self.more())


def add_each(to: Any, options: Mapping[str, str], **shared: Any) -> None:
    """Add options that differ only in their names and helps: a key is "--name METAVAR", its value is the help."""
    for option, text in options.items():
        name, metavar = option.split()
        to.add_argument(name, metavar=metavar, help=text, **shared)


def add_out(to: Parser, metavar: str, about: str, required: bool = True) -> None:
    to.add_argument("--out", type=path, metavar=metavar, required=required, help=about)
    add_overwrite(to)


def add_overwrite(to: Parser) -> None:
    to.add_argument("--overwrite", action="store_true", help="replace the output if it exists")


def path(text: str) -> Path:
    """The name of a file or a folder; ~ is the home folder, also in --out=~/x, where a shell leaves it."""
    if not is_file_name(text):
        raise argparse.ArgumentTypeError(f"{text!r} is no name of a file or a folder")
    return at_home(Path(text))


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


def by_name(option: str, pairs: Iterable[tuple[Key, Value]]) -> dict[Key, Value]:
    """The values of an option that may be repeated, such as --move BODY=X,Y,Z, by what each is for.

    Raises:
        ConfigError: two are for the same.
    """
    values: dict[Key, Value] = {}
    for key, value in pairs:
        if key in values:
            raise ConfigError(f"{option} is given twice for {key}: leave one out")
        values[key] = value
    return values


def read_by(place: str) -> Callable[[str], Any]:
    """An argument that a function of ours reads, such as "package.module:function", which is imported when it is
    needed; its ConfigError becomes the parser's own error."""

    def read(text: str) -> Any:
        try:
            return pkgutil.resolve_name(place)(text)
        except ConfigError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return read

"""The lines of an input deck of Abaqus or CalculiX: keywords with their options and their data lines.

A keyword line is `*NAME, OPTION=VALUE, FLAG`; letters have no case, and spaces have no meaning in names. Lines that
begin with `**` are comments and may stand anywhere. `*INCLUDE, INPUT=FILE` stands for the lines of that file. This
module knows no keyword but that one.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from ast_sim.support.errors import DatasetError

# A deck includes files that include files up to this depth.
_DEEPEST = 32

# A comment before the first keyword, behind a sign that a mail or a merge has left.
_MARKED_COMMENT = re.compile(r"[^\w\s*,.+-]+\s*\*\*")

_NAMED = re.compile(r'\s*("[^"]*"|[^=,"]+?)\s*(?:=\s*("[^"]*"|[^,"]*?)\s*)?(?:,|$)')


@dataclass(frozen=True)
class Line:
    """A line of a deck, and where it stands."""

    text: str
    file: Path
    number: int

    @property
    def place(self) -> str:
        return f"{self.file}:{self.number}"


@dataclass(frozen=True, eq=False)
class Keyword:
    """A keyword of a deck.

    Attributes:
        name: in upper case, without spaces: "NODE", "NODEPRINT".
        options: by name in upper case; the value as it is written, without quotes; empty for a flag.
        line: the keyword line.
        data: its data lines, without comments and empty lines.
    """

    name: str
    options: dict[str, str]
    line: Line
    data: list[Line]

    def error(self, text: str) -> DatasetError:
        return DatasetError(f"{self.line.place}: *{self.name}: {text}")

    def required(self, option: str) -> str:
        """The value of an option that must be there."""
        if not self.options.get(option):
            raise self.error(f"has no {option}=")
        return self.options[option]


def known_key(name: str, known: Collection[str]) -> str:
    """Which of the known names, in upper case, a name means. Quotes are no part of it. Spaces have no meaning, as in
    CalculiX, unless they tell two of the known names apart."""
    key = name.strip('"').upper()
    alike = [] if key in known else [one for one in known if _without_spaces(one) == _without_spaces(key)]
    return alike[0] if len(alike) == 1 else key


def _without_spaces(name: str) -> str:
    return "".join(name.split())


def read_keywords(path: Path) -> list[Keyword]:
    """The keywords of a deck and of the files that it includes, in order.

    Raises:
        DatasetError: a file cannot be read, is included by itself, or does not begin with a keyword.
    """
    keywords: list[Keyword] = []
    lines = _lines(path, ())
    line = next((one for one in lines if not _MARKED_COMMENT.match(one.text)), None)
    while line is not None:
        if not line.text.startswith("*"):
            raise DatasetError(f"{line.place}: a data line before the first keyword: this is no deck of Abaqus")
        line, keyword = _keyword(line, lines, path)
        keywords.append(keyword)
    return keywords


def _keyword(first: Line, lines: Iterator[Line], deck: Path) -> tuple[Line | None, Keyword]:
    """A keyword of a deck, and the line after it."""
    text = first.text
    line = next(lines, None)
    # After a comma at the end, options go on in the next line. A data line does not begin with a letter and an "=".
    while line is not None and text.endswith(",") and re.match(r"[A-Za-z ]+=|[A-Za-z ]+$", line.text):
        text = text + line.text
        line = next(lines, None)
    name, _, rest = text[1:].partition(",")
    keyword = Keyword(re.sub(r"\s+", "", name).upper(), _options(first, rest), first, [])
    while line is not None and not line.text.startswith("*"):
        keyword.data.append(line)
        line = next(lines, None)
    if "INPUT" in keyword.options and keyword.name in ("NODE", "ELEMENT", "NSET", "ELSET", "BOUNDARY"):
        more = list(_lines(_included(first, keyword.options["INPUT"], deck), (deck, first.file)))
        wrong = next((one for one in more if one.text.startswith("*")), None)
        if wrong is not None:
            raise DatasetError(f"{wrong.place}: a keyword in a file that holds data lines of *{keyword.name} only")
        keyword.data.extend(more)
    return line, keyword


def _options(line: Line, text: str) -> dict[str, str]:
    options: dict[str, str] = {}
    place = 0
    while text[place:].strip(" \t,"):
        place += len(text[place:]) - len(text[place:].lstrip(" \t,"))  # nothing may stand between two commas
        option = _NAMED.match(text, place)
        if option is None:
            raise DatasetError(f"{line.place}: the options {text.strip()!r} cannot be read")
        name = re.sub(r"\s+", "", option[1]).upper()
        value = (option[2] or "").strip().strip('"')
        if options.setdefault(name, value) != value:
            raise DatasetError(f"{line.place}: the option {name} stands twice, as {options[name]!r} and {value!r}")
        place = option.end()
    return options


def _lines(path: Path, within: tuple[Path, ...]) -> Iterator[Line]:
    """The lines of a file without comments and empty lines; includes are replaced by the lines of their file."""
    if path in within or len(within) > _DEEPEST:
        raise DatasetError(f"{path}: is included by itself")
    lines = _own_lines(path)
    for line in lines:
        text = line.text
        if not re.match(r"\*\s*include", text, re.IGNORECASE):
            yield line
            continue
        if text.endswith(","):  # its options go on in the next line
            text += next(lines, line).text
        options = _options(line, text.partition(",")[2])
        if not options.get("INPUT"):
            raise DatasetError(f"{line.place}: {text!r} names no file: write *INCLUDE, INPUT=FILE")
        first = (*within, path)[0]
        yield from _lines(_included(line, options["INPUT"], first), (*within, path))


def _own_lines(path: Path) -> Iterator[Line]:
    for number, text in enumerate(re.split(r"\r\n|\r|\n", _text(path)), 1):
        text = text.strip()
        if text and not text.startswith("**"):
            yield Line(text, path, number)


def _included(line: Line, name: str, first: Path) -> Path:
    """The file that a line names. Abaqus and CalculiX look for it where the job runs: in the folder of the `first`
    file. Other programs name it as it lies from the file of the line."""
    for folder in (first.parent, line.file.parent):
        for candidate in (folder / name, folder / name.replace("\\", "/")):
            if candidate.is_file():
                return candidate
    raise DatasetError(f"{line.place}: includes {name}, which does not exist")


def _text(path: Path) -> str:
    """The text of a file: UTF-8 if it is that, else Latin-1, of which only names and comments are made."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror}") from error
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return content.decode("utf-16", errors="replace")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")

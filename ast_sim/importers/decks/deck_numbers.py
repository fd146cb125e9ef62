"""The numbers in the data lines of a deck: coordinates of nodes, and elements that may go on over several lines."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence

import numpy as np

from ast_sim.importers.decks.keyword_lines import Keyword, Line
from ast_sim.support.errors import DatasetError, counted

# Fortran writes 4.2D+00, and 4.2+100 where an exponent has three digits.
_FORTRAN = re.compile(r"^([-+]?[0-9.]+)(?:[dDeE])?([-+][0-9]+)$")
_NUMBER = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([dDeE][-+]?[0-9]+)?")


def tokens(line: Line) -> list[str]:
    """The entries of a data line; a comma at its end adds none."""
    entries = [entry.strip() for entry in line.text.split(",")]
    while entries and not entries[-1]:
        entries.pop()
    return entries


def real(text: str, line: Line) -> float:
    """A number as Fortran writes it; nothing is 0."""
    if not text:
        return 0.0
    bare = _FORTRAN.sub(r"\1e\2", text)
    if not _NUMBER.fullmatch(bare):
        raise DatasetError(f"{line.place}: {text!r} is no number{_of_parameter(text)}")
    return float(bare.lower().replace("d", "e"))


def whole(text: str, line: Line) -> int:
    if not re.fullmatch(r"[-+]?[0-9]{1,18}", text):
        raise DatasetError(f"{line.place}: {text!r} is no whole number{_of_parameter(text)}")
    return int(text)


def _of_parameter(text: str) -> str:
    """What to do about `<width>`, which stands for a number that *PARAMETER of Abaqus gives."""
    return ": it stands for a value of *PARAMETER; write the number itself" if re.search("<.*>", text) else ""


def refuse_decimal_commas(line: Line, most: int, what: str) -> None:
    """Raise DatasetError if a line has more than `most` entries and none of them has a decimal point."""
    if "." not in line.text and len(tokens(line)) > most:
        raise DatasetError(
            f"{line.place}: {line.text.strip()!r} has more entries than {what}, and no decimal point: write 4.2 for a"
            " number, not 4,2, and 1. for a whole one"
        )


def nodes_of(keyword: Keyword) -> tuple[np.ndarray, np.ndarray]:
    """The numbers [n] and coordinates [n, 3] of a block of nodes; coordinates that are left out are 0. What follows
    them is the normal of a shell."""
    table = _table(keyword.data, 4, np.float64)
    if table is not None and np.array_equal(table[:, 0], np.round(table[:, 0])) and (abs(table[:, 0]) < 2**53).all():
        return table[:, 0].astype(np.int64), table[:, 1:]
    numbers = np.zeros(len(keyword.data), np.int64)
    points = np.zeros((len(keyword.data), 3))
    for row, line in enumerate(keyword.data):
        entries = tokens(line)
        refuse_decimal_commas(line, 4, "a number and three coordinates")
        numbers[row] = whole(entries[0] if entries else "", line)
        for axis, text in enumerate(entries[1:4]):
            points[row, axis] = real(text, line)
    return numbers, points


def elements_of(keyword: Keyword, count: int) -> tuple[np.ndarray, list[list[str]] | np.ndarray]:
    """The numbers [c] of a block of elements and their nodes: [c, count] int64, or as text where they are named by
    instances. An element goes on in the next line until it has all of its nodes."""
    table = _table(keyword.data, count + 1, np.int64)
    if table is not None:
        return table[:, 0], table[:, 1:]
    numbers: list[int] = []
    rows: list[list[str]] = []
    named = False
    for line in keyword.data:
        entries = tokens(line)
        if not rows or len(rows[-1]) == count:
            numbers.append(whole(entries.pop(0) if entries else "", line))
            rows.append([])
        rows[-1].extend(entries)
        if len(rows[-1]) > count:
            raise DatasetError(
                f"{line.place}: element {numbers[-1]} has {counted(len(rows[-1]), 'node')}; its type has {count}"
            )
        for text in entries:
            if not re.fullmatch(r"\+?[0-9]{1,18}", text):
                named = named or "." in text
                if "." not in text:
                    raise DatasetError(f"{line.place}: {text!r} is no number of a node")
    if rows and len(rows[-1]) < count:
        raise keyword.error(f"element {numbers[-1]} has {counted(len(rows[-1]), 'node')}; its type has {count}")
    if named:
        return np.array(numbers, np.int64), rows
    return np.array(numbers, np.int64), np.array(rows, np.int64).reshape(-1, count)


def nodes_in(keyword: Keyword) -> tuple[int, np.ndarray]:
    """How many elements a block has, and the numbers of all their nodes. How many nodes an element has is not known: it
    goes on after a comma at the end of a line."""
    count = 0
    nodes = []
    goes_on = False
    for line in keyword.data:
        numbers = [whole(text, line) for text in tokens(line)]
        count += not goes_on
        nodes += numbers if goes_on else numbers[1:]
        goes_on = line.text.endswith(",")
    return count, np.unique(np.array(nodes, np.int64))


def _table(lines: Sequence[Line], columns: int, dtype: type) -> np.ndarray | None:
    """[lines, columns]: the lines as plain numbers; None if they are not all of this form."""
    if not lines:
        return np.zeros((0, columns), dtype)
    wanted = columns - 1
    if any(line.text.rstrip(", \t").count(",") != wanted for line in lines):
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            texts = (line.text for line in lines)
            return np.loadtxt(texts, dtype, delimiter=",", usecols=range(columns), ndmin=2, comments=None)
        except (ValueError, OverflowError, Warning):
            return None

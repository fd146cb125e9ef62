"""The results in an .frd file of CalculiX: what their headers say, and for which nodes they have values.

Source: the manual of CalculiX GraphiX, chapter "Result Format". A reader that fills missing nodes with zeros makes no
difference between a value of 0 and none.
"""

from __future__ import annotations

import contextlib
import mmap
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim.support.errors import DatasetError

# A header: name of the set, time, number of nodes, a text, kind of the analysis, number of the increment, a text and
# the format of the numbers. Then the name of the result, and a line for each of its columns.
_HEADER = re.compile(
    rb"^  100C.{6}(?P<time>.{12})(?P<count>.{12}).{20}(?P<kind>..)(?P<increment>.{5}).{10}(?P<format>..)[^\n]*\n"
    rb" -4  (?P<name>.{8})[^\n]*\n(?P<columns>(?: -5[^\n]*\n)*)",
    re.MULTILINE,
)
_NO_NUMBER = re.compile(rb"^ -[12][^\n]*[*dDqQ,;][^\n]*", re.MULTILINE)  # stars: more digits than there is room for
_MODES = {b"2": "modes of vibration", b"4": "modes of buckling"}
_OF_A_MODE = b"    1PMODE "  # stands before the header of each result of a mode, also of modes with damping

_TEXT_WIDTHS = {0: 5, 1: 10}  # of the number of a node, by format
_BINARY_WIDTHS = {2: 4, 3: 8}  # of a value, by format


@dataclass(frozen=True)
class FrdResult:
    """A result of an increment. `columns` are stored; `start` is where its numbers begin in the file."""

    name: str
    time: float
    increment: bytes
    count: int
    columns: int
    format: int
    start: int

    def is_whole(self, content: mmap.mmap) -> bool:
        """Whether the file goes on to the end of its numbers; a reader fills what is missing with zeros."""
        if self.format in _TEXT_WIDTHS:
            return content.find(b"\n -3", self.start - 1) >= 0
        return self.start + self.count * self._row.itemsize <= len(content)

    def nodes(self, content: mmap.mmap) -> np.ndarray:
        """[count] the numbers of the nodes that it has values for."""
        if self.format in _TEXT_WIDTHS:
            block = content[self.start : content.find(b"\n -3", self.start - 1)]
            numbers = re.findall(rb"^ -1(.{%d})" % _TEXT_WIDTHS[self.format], block, re.MULTILINE)
            return np.array(numbers).astype(np.int64)
        return self._rows(content)["node"].astype(np.int64)

    def vectors(self, content: mmap.mmap) -> np.ndarray:
        """[count, 3] the values of a result with three columns."""
        if self.format in _TEXT_WIDTHS:
            block = content[self.start : content.find(b"\n -3", self.start - 1)]
            line = rb"^ -1.{%d}(.{12})(.{12})(.{12})" % _TEXT_WIDTHS[self.format]
            return np.array(re.findall(line, block, re.MULTILINE)).astype(np.float64).reshape(-1, 3)
        return self._rows(content)["values"].astype(np.float64)

    def _rows(self, content: mmap.mmap) -> np.ndarray:
        """The rows of a binary result: `node` and `values`."""
        return np.frombuffer(content[self.start : self.start + self.count * self._row.itemsize], self._row)

    @property
    def _row(self) -> np.dtype[Any]:
        return np.dtype([("node", "<i4"), ("values", f"<f{_BINARY_WIDTHS[self.format]}", self.columns)])


def read_frd_headers(path: Path) -> tuple[list[int], list[FrdResult]]:
    """The numbers of nodes and elements that a file declares, and its results.

    Raises:
        DatasetError: the results are modes or vibrations, which are no frames of a motion, the times of the increments
            do not ascend, or a line holds what is no number.
    """
    try:
        with opened(path) as content:
            counts = [_declared(content, key) for key in (b"2C", b"3C")]
            headers = [(header.groupdict(), header.end()) for header in _HEADER.finditer(content)]
            results = [_result(header, end) for header, end in headers]
            wrong = _no_number(content, results)
            cut_off = next((result for result in results if not result.is_whole(content)), None)
            of_modes = content.find(_OF_A_MODE) >= 0
    except (OSError, ValueError) as error:
        told = " ".join(str(error).split())
        raise DatasetError(f"{path}: cannot be read as results of CalculiX: it is damaged: {told}") from error
    if wrong is not None:
        raise DatasetError(f"{path}: cannot be read as results of CalculiX: no number in the line {wrong!r}")
    if cut_off is not None:
        raise DatasetError(
            f"{path}: is cut off in {cut_off.name} at the time {cut_off.time:g}: copy it whole, or solve the job again"
        )
    imaginary = next((result.name for result in results if result.name in ("DISPI", "PDISP")), None)
    if imaginary is not None:
        raise DatasetError(
            f"{path}: holds {imaginary}, the displacement of a vibration at a frequency, which is no frame of a motion"
        )
    kinds = [header["kind"].strip() for header, _ in headers] + [b"2"] * of_modes
    modes = next((_MODES[kind] for kind in kinds if kind in _MODES), None)
    if modes is not None:
        raise DatasetError(
            f"{path}: holds {modes}, which are no frames of a motion: write the results of a *STATIC or *DYNAMIC step"
        )
    _require_ascending(path, results)
    _require_once(path, results)
    return counts, results


def _require_once(path: Path, results: list[FrdResult]) -> None:
    """Check that no increment has a result twice for all of its nodes: of two, a reader takes the last."""
    held = Counter((result.name, result.time, result.count) for result in results)
    for (name, time, _), often in held.items():
        if often > 1:
            raise DatasetError(
                f"{path}: holds {name} {often} times for the time {time:g}: is it put together of two files? Take one"
            )


def _require_ascending(path: Path, results: list[FrdResult]) -> None:
    """Check that increments follow each other in time: readers sort them by their times."""
    increments: dict[float, bytes] = {}
    for before, result in zip([None, *results], results, strict=False):
        if increments.setdefault(result.time, result.increment) != result.increment:
            raise DatasetError(
                f"{path}: two increments have the time {result.time:g}, so their results cannot be told apart: let the"
                " time go on from step to step (no TIME RESET), and write increments that differ by more than rounding"
            )
        if before is not None and result.time < before.time:
            raise DatasetError(
                f"{path}: the increment at the time {result.time:g} stands after the one at {before.time:g}: let the"
                " time go on from step to step (no TIME RESET)"
            )


def _no_number(content: mmap.mmap, results: list[FrdResult]) -> str | None:
    """The first line of results as text that holds something else than numbers, which a reader may take for 0."""
    for result in results:
        if result.format in _TEXT_WIDTHS:
            end = content.find(b"\n -3", result.start - 1)
            line = _NO_NUMBER.search(content, result.start, end if end >= 0 else len(content))
            if line is not None:
                return line[0].decode(errors="replace").strip()
    return None


def partly_given(path: Path, results: list[FrdResult], nodes: int) -> Iterator[tuple[FrdResult, np.ndarray]]:
    """The results that have values for fewer than all `nodes`, as *NODE FILE with NSET= writes them, and the numbers
    of the nodes that have some."""
    few = [result for result in results if result.count < nodes]
    if few:
        with opened(path) as content:
            for result in few:
                yield result, result.nodes(content)


def _declared(content: mmap.mmap, key: bytes) -> int:
    declared = re.search(rb" {4}" + key + rb" +([0-9]+) ", content)  # no new line precedes it in a binary file
    return int(declared[1]) if declared else 0


def _result(header: dict[str, bytes], end: int) -> FrdResult:
    columns = [line for line in header["columns"].splitlines() if line[33:38].strip() != b"1"]  # 1: computed by others
    return FrdResult(
        header["name"].decode(errors="replace").strip(),
        float(header["time"]),
        header["increment"],
        int(header["count"]),
        len(columns),
        int(header["format"]),
        end,
    )


@contextlib.contextmanager
def opened(path: Path) -> Iterator[mmap.mmap]:
    """The bytes of a file."""
    with path.open("rb") as file, contextlib.closing(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)) as content:
        yield content

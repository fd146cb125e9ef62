"""Files that are a frame each in order of time: by the times inside, else by the numbers in their names."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ast_sim.support.errors import DatasetError

_NUMBER = re.compile(r"([0-9]+(?:[.,][0-9]+)?(?:[eE][-+]?[0-9]+)?)")


def natural_order(path: Path) -> list[tuple[float, str]]:
    """A sort key by which frame_10 comes after frame_9, and Result-0.0005 or Result-0,0005 before Result-0.001."""
    parts = _NUMBER.split(path.stem)
    return [(value_of(part), "") if place % 2 else (-1.0, part) for place, part in enumerate(parts)]


def value_of(number: str) -> float:
    """The value of a number in a name, which may have a decimal comma."""
    return float(number.replace(",", "."))


def words_of(name: str) -> tuple[str, ...]:
    """What stands between the numbers of a name."""
    return tuple(_NUMBER.split(name)[::2])


def numbers_in(name: str) -> tuple[str, ...]:
    """The numbers of a name."""
    return tuple(_NUMBER.split(name)[1::2])


def ordered(files: list[Path], times: list[float | None]) -> tuple[list[int], list[str]]:
    """The order of files that are a frame each, and a note where it is not certain.

    The times inside the files decide, if each has one and no two are equal. Else the numbers in the names decide, read
    as numbers: 0.0005, 1e-03, 10. If several of them vary, or they do not count evenly, a note says so.

    Args:
        files: in natural order.
        times: what each file says of its time.

    Raises:
        DatasetError: the files are two series with the same numbers.
    """
    as_named = list(range(len(files)))
    known = [time for time in times if time is not None]
    if len(set(known)) == len(files) and np.isfinite(known).all():
        order = np.argsort(known, kind="stable").tolist()
        by_name = "the times inside the files, not of their names"
        return order, [] if order == as_named else [_said(files, order, by_name)]
    unused = _unused_times(files, times)
    if len({words_of(file.stem) for file in files}) > 1:
        _require_one_series(files)
        return as_named, [*unused, _said(files, as_named, "their names, which differ in more than a number")]
    whole = sorted(as_named, key=lambda index: _whole_numbers(files[index]))
    by_number = "the numbers in their names, read with their decimals"
    return as_named, unused + (_doubts(files) if whole == as_named else [_said(files, as_named, by_number)])


def _unused_times(files: list[Path], times: list[float | None]) -> list[str]:
    """A note if the times inside the files differ, but do not order them: two are equal, or a file has none."""
    if len(set(times) - {None}) < 2:
        return []
    if None in times:
        return [f"{files[times.index(None)].name} says no time, other files do: the times inside are not used"]
    again = next((index for index, time in enumerate(times) if time in times[:index]), None)
    if again is None:
        return []
    first = files[times.index(times[again])].name
    return [f"{first} and {files[again].name} say the same time {times[again]:g}: the times inside are not used"]


def _require_one_series(files: list[Path]) -> None:
    """Check that files whose names differ in words are not two series that count alike, such as the parts of a model
    that Kratos writes beside the whole: Structure_0_1, Structure_0_2, Parts_0_1, Parts_0_2."""
    series: dict[tuple[str, ...], list[tuple[str, ...]]] = {}
    for file in files:
        series.setdefault(words_of(file.stem), []).append(numbers_in(file.stem))
    first: dict[tuple[tuple[str, ...], ...], tuple[str, ...]] = {}
    for words, numbers in series.items():
        other = first.setdefault(tuple(sorted(numbers)), words)
        if other is not words and len(numbers) > 1:
            named = " and ".join("*".join(one) for one in (other, words))
            raise DatasetError(
                f"{files[0].parent}: the files {named} have the same numbers and no times: give each series a folder of"
                " its own, or list the files of the frames in a PVD file"
            )


def _doubts(files: list[Path]) -> list[str]:
    """A note if the numbers in the names of files, in order of time, may be of two simulations, or leave one out."""
    columns = zip(*(numbers_in(file.stem) for file in files), strict=True)
    varied = [column for column in columns if len(set(column)) > 1]
    if len(varied) > 1:
        told = _said(files, list(range(len(files))), f"{len(varied)} numbers in their names")
        return [f"{told}; if these are several simulations, give each a folder of its own"]
    if not varied or not all(text.isdigit() for text in varied[0]):
        return []
    steps = np.diff([float(text) for text in varied[0]])
    if steps.min() == steps.max():
        return []
    if steps.min() == 0:
        twice = int(np.argmin(steps))
        return [f"{files[twice].name} and {files[twice + 1].name} have one number: is one a copy of the other?"]
    wide = int(np.argmax(steps > steps.min()))
    return [f"{files[wide + 1].name} follows {files[wide].name}: is a frame missing between them?"]


def _said(files: list[Path], order: list[int], by_what: str) -> str:
    first = ", ".join(files[index].name for index in order[:3])
    return f"the frames stand in the order of {by_what}: {first}{', ...' if len(files) > 3 else ''}"


def _whole_numbers(path: Path) -> list[tuple[int, str]]:
    parts = re.split(r"([0-9]+)", path.stem)
    return [(int(part), "") if place % 2 else (-1, part) for place, part in enumerate(parts)]

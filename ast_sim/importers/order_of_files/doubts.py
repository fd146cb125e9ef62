"""Whether the files that a PVD or .series file lists are of one run: what their names and the times inside them say."""

from __future__ import annotations

from collections.abc import Sequence
from os.path import relpath
from pathlib import Path

import numpy as np

from ast_sim.importers.order_of_files.by_name import numbers_in, value_of, words_of
from ast_sim.support.errors import DatasetError

APART = 1e-6  # of the whole time: files of one run are farther apart
_SAME = 1e-6  # of a time


def doubts_of_listed(source: Path, files: list[list[Path]], times: Sequence[float]) -> list[str]:
    """Notes if the names of the files, grouped by frame, do not count as the list does.

    Raises:
        DatasetError: a file is listed twice for one time, or two times differ by rounding alone.
    """
    for frame, time in zip(files, times, strict=True):
        twice = next((file for file in frame if frame.count(file) > 1), None)
        if twice is not None:
            raise DatasetError(f"{source}: lists {twice.name} twice for the time {time:g}")
    near = np.flatnonzero(np.diff(times) < APART * (times[-1] - times[0]))
    if len(near):
        one, other = (files[near[0] + step][0].name for step in (0, 1))
        raise DatasetError(
            f"{source}: lists {one} and {other} for times that differ by rounding alone ({times[near[0]]!r},"
            f" {times[near[0] + 1]!r}): leave one out if they are of two runs"
        )
    notes: list[str] = []
    for part in zip(*files, strict=True):
        notes += _names_against_list(source, [relpath(file, source.parent) for file in part])
    return list(dict.fromkeys(notes))


def _names_against_list(source: Path, names: list[str]) -> list[str]:
    """A note if the names of the files of a part, in order of time, differ in words, or their numbers do not ascend."""
    words = [words_of(name) for name in names]
    if len(set(words)) > 1:
        other = next(index for index, one in enumerate(words) if one != words[0])
        return [
            f"the names of the files that {source.name} lists differ in more than a number ({names[other - 1]},"
            f" {names[other]}): are they of one run?"
        ]
    varied = [column for column in zip(*map(numbers_in, names), strict=True) if len(set(column)) > 1]
    back = np.flatnonzero(np.diff([value_of(text) for text in varied[0]]) <= 0) if len(varied) == 1 else []
    if not len(back):
        return []
    return [f"{source.name} lists {names[back[0] + 1]} after {names[back[0]]}: are their times right?"]


def doubts_of_times(source: Path, listed: Sequence[float], inside: Sequence[float | None]) -> list[str]:
    """A note if the times inside the files do not go with the times that are listed for them: they do not ascend, or
    most are equal and some are not."""
    known = np.array([np.nan if time is None else time for time in inside])
    if not np.isfinite(known).all() or (known == known[0]).all():
        return []
    differ = np.abs(known - listed) > _SAME * np.abs(listed).max()
    wrong = differ if 2 * differ.sum() < len(differ) else np.append(False, np.diff(known) <= 0)
    if not wrong.any():
        return []
    frame = int(np.argmax(wrong))
    return [
        f"{source.name} lists the time {listed[frame]:g} for frame {frame}, whose file says {known[frame]:g}: is it the"
        " right file?"
    ]

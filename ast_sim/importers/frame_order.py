"""The files of a simulation in order of time: by the times inside, else by the numbers in their names; PVD files, and
the .series files of ParaView."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from ast_sim.importers.formats.together import labels_of
from ast_sim.importers.frames_in_file import ONE_FRAME, holds_frames
from ast_sim.support.errors import DatasetError

# ParaView's files that list the files of frames with their times: run.vtu.series beside run_0.vtu.
SERIES = ".series"

_NUMBER = re.compile(r"([0-9]+(?:\.[0-9]+)?(?:[eE][-+]?[0-9]+)?)")


FilePart = tuple[str, float, str]
_Frames = dict[float, list[tuple[FilePart, Path]]]  # by time


class FrameFiles(NamedTuple):
    """The files of a simulation, grouped by frame, the time of each frame where a PVD file says it, and what tells the
    files of a frame apart, the same for all frames; none if nothing does."""

    files: list[list[Path]]
    times: list[float] | None = None
    labels: Sequence[str] = ()


def natural_order(path: Path) -> list[tuple[float, str]]:
    """A sort key by which frame_10 comes after frame_9, and Result-0.0005 before Result-0.001."""
    parts = _NUMBER.split(path.stem)
    return [(float(part), "") if place % 2 else (-1.0, part) for place, part in enumerate(parts)]


def frame_files(source: Path) -> FrameFiles:
    """The files of a simulation, without a look into them.

    Raises:
        DatasetError: the source is no simulation, it is damaged, or it lists a file that does not exist.
    """
    if source.is_dir():
        files = files_of_frames(source)
        if not files:
            raise DatasetError(f"{source}: the folder holds no .vtu file or other file of a frame")
        return FrameFiles([[file] for file in sorted(files, key=natural_order)])
    if not source.is_file():
        raise DatasetError(f"{source}: there is no such file or folder")
    if source.suffix.lower() == ".pvd":
        return _collection(source)
    if source.suffix.lower() == SERIES:
        return _series(source)
    if source.suffix.lower() in ONE_FRAME or holds_frames(source):
        return FrameFiles([[source]])
    raise DatasetError(
        f"{source}: must be a .pvd or .series file, a folder of files of frames ({', '.join(ONE_FRAME)}), or one file"
        " with all frames, such as .vtkhdf, .frd, .xdmf or .exo"
    )


def files_of_frames(folder: Path) -> list[Path]:
    """The files of a folder that are a frame each. Pieces that a .pvtu or .vtm file lists are not counted."""
    entries = [entry for entry in folder.iterdir() if entry.is_file() and not entry.name.startswith(".")]
    for endings in ((".pvtu",), (".vtm", ".vtmb"), (".vtu",), (".vtk",), (".pvtp",), (".vtp",)):
        files = [entry for entry in entries if entry.suffix.lower() in endings]
        if files:
            return files
    return []


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
    if len({_words(file) for file in files}) > 1:
        _require_one_series(files)
        return as_named, [_said(files, as_named, "their names, which differ in more than a number")]
    whole = sorted(as_named, key=lambda index: _whole_numbers(files[index]))
    by_number = "the numbers in their names, read with their decimal points"
    return as_named, _doubts(files) if whole == as_named else [_said(files, as_named, by_number)]


def _words(file: Path) -> tuple[str, ...]:
    return tuple(_NUMBER.split(file.stem)[::2])


def _require_one_series(files: list[Path]) -> None:
    """Check that files whose names differ in words are not two series that count alike, such as the parts of a model
    that Kratos writes beside the whole: Structure_0_1, Structure_0_2, Parts_0_1, Parts_0_2."""
    series: dict[tuple[str, ...], list[tuple[str, ...]]] = {}
    for file in files:
        series.setdefault(_words(file), []).append(tuple(_NUMBER.split(file.stem)[1::2]))
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
    columns = zip(*(_NUMBER.split(file.stem)[1::2] for file in files), strict=True)
    varied = [column for column in columns if len(set(column)) > 1]
    if len(varied) > 1:
        told = _said(files, list(range(len(files))), f"{len(varied)} numbers in their names")
        return [f"{told}; if these are several simulations, give each a folder of its own"]
    if not varied or not all(text.isdigit() for text in varied[0]):
        return []
    steps = np.diff([float(text) for text in varied[0]])
    if steps.min() == steps.max():
        return []
    wide = int(np.argmax(steps > steps.min()))
    return [f"{files[wide + 1].name} follows {files[wide].name}: is a frame missing between them?"]


def _said(files: list[Path], order: list[int], by_what: str) -> str:
    first = ", ".join(files[index].name for index in order[:3])
    return f"the frames stand in the order of {by_what}: {first}{', ...' if len(files) > 3 else ''}"


def _whole_numbers(path: Path) -> list[tuple[int, str]]:
    parts = re.split(r"([0-9]+)", path.stem)
    return [(int(part), "") if place % 2 else (-1, part) for place, part in enumerate(parts)]


def _collection(source: Path) -> FrameFiles:
    """The files that a PVD file lists, by their time; files of one time are the parts of one frame, in the order of
    their groups and numbers."""
    try:
        root = ElementTree.parse(source).getroot()
        entries = [
            (float(entry.get("timestep", "nan")), _part(entry), entry.attrib["file"])
            for entry in root.iterfind("Collection/DataSet")
        ]
    except (OSError, ElementTree.ParseError, ValueError, KeyError) as error:
        raise DatasetError(f"{source}: is damaged or no PVD file: {error}") from error
    if not entries:
        raise DatasetError(f"{source}: lists no frames (no DataSet in a Collection)")
    times = [time for time, _, _ in entries]
    if len(entries) > 1 and not np.isfinite(times).all():
        raise DatasetError(f"{source}: every frame needs a timestep")
    frames: _Frames = {}
    for time, part, name in sorted(entries, key=lambda one: one[0]):
        frames.setdefault(time, []).append((part, _listed(source, name)))
    counts = {len(files) for files in frames.values()}
    if len(counts) > 1:
        raise DatasetError(f"{source}: lists {min(counts)} to {max(counts)} files for a time; must be equally many")
    files, labels = _parts_in_order(source, frames)
    return FrameFiles(files, list(frames) if len(frames) > 1 else None, labels if len(labels) > 1 else [])


def _part(entry: ElementTree.Element) -> FilePart:
    """What a PVD file says of a part of a frame: its group, its number and its name."""
    return entry.get("group", ""), float(entry.get("part", "0")), entry.get("name", "")


def _parts_in_order(source: Path, frames: _Frames) -> tuple[list[list[Path]], list[str]]:
    """The files of each frame in the order of their parts, and what tells these apart: what the PVD file says of them,
    or else the names of the files, if these do."""
    if all(len({part for part, _ in files}) == len(files) for files in frames.values()):
        if len({frozenset(part for part, _ in files) for files in frames.values()}) > 1:
            raise DatasetError(f"{source}: lists other parts for one time than for another")
        first = sorted(part for part, _ in next(iter(frames.values())))
        return [[file for _, file in sorted(files)] for files in frames.values()], [
            f"{group} {number:g} {name}".strip() for group, number, name in first
        ]
    listed = [[file for _, file in files] for files in frames.values()]
    labels = [labels_of([str(file) for file in files]) for files in listed]
    if len({frozenset(label) for label in labels}) > 1 or len(set(labels[0])) < len(labels[0]):
        return listed, []
    pairs = [sorted(zip(*both, strict=True), key=_label_order) for both in zip(labels, listed, strict=True)]
    return [[file for _, file in frame] for frame in pairs], [label for label, _ in pairs[0]]


def _label_order(labelled_file: tuple[str, Path]) -> list[tuple[float, str]]:
    return natural_order(Path(labelled_file[0]))


def _series(source: Path) -> FrameFiles:
    """The files that a .series file of ParaView lists, by their time."""
    try:
        entries = [(float(one["time"]), str(one["name"])) for one in json.loads(source.read_text("utf-8"))["files"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{source}: is damaged or no .series file of ParaView: {error!r}") from error
    times = [time for time, _ in entries]
    if not entries or not np.isfinite(times).all() or len(set(times)) < len(times):
        raise DatasetError(f"{source}: must list files of frames, each with a time of its own; it has {times[:6]}")
    entries.sort()
    return FrameFiles([[_listed(source, name)] for _, name in entries], sorted(times) if len(times) > 1 else None)


def _listed(source: Path, name: str) -> Path:
    """A file that a PVD or .series file lists; Windows writes its path with backslashes."""
    file = source.parent / name
    if not file.is_file() and "\\" in name:
        file = source.parent / name.replace("\\", "/")
    if file.suffix.lower() not in ONE_FRAME:
        raise DatasetError(f"{source}: lists {name}, which is no .vtu file nor another file of a frame")
    if not file.is_file():
        raise DatasetError(f"{source}: lists {source.parent / name}, which does not exist")
    return file

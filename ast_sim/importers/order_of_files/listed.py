"""The files that a PVD file or a .series file of ParaView lists, in order of time."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from ast_sim.importers.formats.together import labels_of
from ast_sim.importers.frames_in_file import ONE_FRAME
from ast_sim.importers.order_of_files.by_name import natural_order
from ast_sim.importers.order_of_files.doubts import doubts_of_listed
from ast_sim.support.errors import DatasetError, counted

# ParaView's files that list the files of frames with their times: run.vtu.series beside run_0.vtu.
SERIES = ".series"

FilePart = tuple[str, float, str]
_Frames = dict[float, list[tuple[FilePart, Path]]]  # by time


class FrameFiles(NamedTuple):
    """The files of a simulation, grouped by frame, the time of each frame where a PVD file says it, and what tells the
    files of a frame apart, the same for all frames; none if nothing does. Notes say what is not certain."""

    files: list[list[Path]]
    times: list[float] | None = None
    labels: Sequence[str] = ()
    notes: Sequence[str] = ()


def in_collection(source: Path) -> FrameFiles:
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
    others = sum("file" in entry.attrib for entry in root.iter()) - len(entries)
    if others:
        raise DatasetError(
            f"{source}: {counted(others, 'entry with a file is', 'entries with a file are')} no DataSet right in a"
            " Collection: write them so"
        )
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
    notes = doubts_of_listed(source, files, list(frames))
    if len(files[0]) > 1 and len({part for part, _ in frames[times[0]]}) == 1:
        first = ", ".join(file.name for file in files[0][:3]) + (", ..." if len(files[0]) > 3 else "")
        notes.insert(0, f"the {len(files[0])} files of each time are read as parts of one frame: {first}")
    return FrameFiles(files, list(frames) if len(frames) > 1 else None, labels if len(labels) > 1 else [], notes)


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


def in_series(source: Path) -> FrameFiles:
    """The files that a .series file of ParaView lists, by their time."""
    try:
        entries = [(float(one["time"]), str(one["name"])) for one in json.loads(source.read_text("utf-8"))["files"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{source}: is damaged or no .series file of ParaView: {error!r}") from error
    times = [time for time, _ in entries]
    if not entries or not np.isfinite(times).all() or len(set(times)) < len(times):
        raise DatasetError(f"{source}: must list files of frames, each with a time of its own; it has {times[:6]}")
    entries.sort()
    files = [[_listed(source, name)] for _, name in entries]
    notes = doubts_of_listed(source, files, sorted(times))
    return FrameFiles(files, sorted(times) if len(times) > 1 else None, notes=notes)


def _listed(source: Path, name: str) -> Path:
    """A file that a PVD or .series file lists; Windows writes its path with backslashes."""
    file = source.parent / name
    if not file.is_file() and "\\" in name:
        file = source.parent / name.replace("\\", "/")
    if file.suffix.lower() not in (*ONE_FRAME, ".vtkhdf"):
        raise DatasetError(f"{source}: lists {name}, which is no .vtu file nor another file of a frame")
    if not file.is_file():
        raise DatasetError(f"{source}: lists {source.parent / name}, which does not exist")
    return file

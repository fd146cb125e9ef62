"""Results in a folder that belong to none of the simulations that are taken from it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from ast_sim.importers.formats.declared_sizes import linked_files
from ast_sim.importers.formats.exodus.exodus_files import is_hdf
from ast_sim.importers.formats.vtk_files import BLOCKS
from ast_sim.importers.frames_in_file import ONE_FRAME, holds_frames
from ast_sim.importers.order_of_files.by_name import natural_order
from ast_sim.support.errors import counted

# Files that list other files, and how.
_LISTING = (".pvd", ".series", ".pvtu", ".pvtp", ".pvts", *BLOCKS)
_LISTED = re.compile(rb"\b(?:[Ff]ile|Source)\s*=\s*[\"']([^\"']+)[\"']|\"name\"\s*:\s*\"([^\"]+)\"")


def left_out(folder: Path, taken: Iterable[Path]) -> list[str]:
    """A note on results in a folder, or in folders in it, that are not `taken` and that no taken file lists."""
    known = set(_with_listed(taken))
    others = [
        entry
        for entry in sorted(folder.iterdir(), key=natural_order)
        if entry.name[0] != "." and any(file.resolve() not in known for file in _results_in(entry))
    ]
    if not others:
        return []
    named = ", ".join(other.name for other in others[:3]) + (", ..." if len(others) > 3 else "")
    where = f"with results in {folder.name}"
    left_out = counted(len(others), f"other file or folder {where} is", f"other files or folders {where} are")
    return [f"{left_out} left out: {named}"]


def _results_in(entry: Path) -> Iterator[Path]:
    files = entry.rglob("*") if entry.is_dir() else [entry]
    yield from (file for file in files if file.suffix.lower() in ONE_FRAME or holds_frames(file))


def no_pieces(files: Iterable[Path]) -> list[Path]:
    """The files that are whole: without pieces that another one lists or takes arrays from, and without the second file
    of TetGen."""
    whole = [file for file in files if file.suffix.lower() != ".ele" or not file.with_suffix(".node").is_file()]
    listed = {piece for file in whole for piece in _with_listed([file]) if piece != file.resolve()}
    return [file for file in whole if file.resolve() not in listed]


def _with_listed(files: Iterable[Path]) -> Iterator[Path]:
    """The files, and what they list, and what that lists, in full."""
    for file in files:
        yield file.resolve()
        if file.suffix.lower() in _LISTING and file.is_file():
            names = ((one or other).decode(errors="replace") for one, other in _LISTED.findall(file.read_bytes()))
            yield from _with_listed(file.parent / name.replace("\\", "/") for name in names)
        if file.suffix.lower() == ".vtkhdf" and is_hdf(file):
            yield from _with_listed(linked_files(file))

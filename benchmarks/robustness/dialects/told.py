"""Whether what is told of a file is what is to be told: each note that must come, and nothing else."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.robustness.dialects.random_simulation import CORNERS, Simulation, corners_of
from benchmarks.robustness.dialects.scene_nodes import Wrong

# What a note says of each defect.
_OF_DEFECTS = {
    "inside out": r"[\d,]+ tetrahedr(on that was|a that were) inside out (is|are) turned over",
    "twice": r"[\d,]+ elements? that stands? in the file twice (is|are) taken once",
    "unused": r"[\d,]+ points? of no element (is|are) left out",
    "unstitched": r"[\d,]+ points at [\d,]+ places? are joined: "
    "(each element has points of its own|pieces of the file meet there)",
    "order": "the elements of .* stand in another order: they are reordered as in the first",
}

# What decks call the kinds of cells, with letters behind it.
_IN_DECKS = {"tetra10": "C3D10", "hexahedron20": "C3D20", "wedge15": "C3D15"}


def require_told(simulation: Simulation, pairs: np.ndarray, further: Sequence[str], notes: Sequence[str]) -> None:
    """Check that each note that must come is among the notes, with its count, and that no other note is.

    Args:
        pairs: [N, 2] as of `pairs_of`.
        further: patterns of the notes that must come beside those on cells and defects.

    Raises:
        Wrong: a note is missing, or says what is not so.
    """
    left = list(notes)
    for pattern in [*_of_cells(simulation), *map(_OF_DEFECTS.__getitem__, sorted(simulation.defects)), *further]:
        said = [note for note in left if re.fullmatch(pattern, note)]
        if not said:
            raise Wrong(f"no word like {pattern!r}: {notes}")
        left = [note for note in left if note not in said]
    made = int((pairs[:, 0] != pairs[:, 1]).sum())
    for what, wanted in (*_curved(simulation).items(), ("edges? of elements that have corners only gets?", made)):
        said = [note for note in left if re.match(rf"[\d,]+ {what} ", note)]
        count = sum(int(note.split()[0].replace(",", "")) for note in said)
        if count != wanted and not ("twice" in simulation.defects and count > wanted > 0):
            raise Wrong(f"{count} and not {wanted} {what!r}: {notes}")
        left = [note for note in left if note not in said]
    if left:
        raise Wrong(f"without a reason it is said: {'; '.join(left)}")


def _of_cells(simulation: Simulation) -> Iterator[str]:
    """Patterns of the notes on cells that are cut."""
    for shape in set(CORNERS) - {"tetra"}:
        cells = sum(len(nodes) for _, kind, nodes in simulation.blocks if corners_of(kind) == CORNERS[shape])
        if cells:
            are = "cell of the kind {} is" if cells == 1 else "cells of the kind {} are"
            yield rf"{cells:,} {are.format(shape)} cut into [\d,]+ tetrahedra"


def _curved(simulation: Simulation) -> dict[str, int]:
    """How many cells keep their corners only, by a pattern of what notes call their kind."""
    kept = {kind: 0 for kind in ("tetra10", "hexahedron20", "wedge15", "pyramid13")}
    for _, kind, cells in simulation.blocks:
        if kind in kept and not (kind == "tetra10" and simulation.ten_nodes):
            kept[kind] += len(cells)
    named = {kind: rf"cells? of the kind ({kind}|{_IN_DECKS.get(kind, kind)}[A-Z]*)" for kind in kept}
    return {rf"{named[kind]} keeps? (its|their) corners": count for kind, count in kept.items()}


def told_of_order(names: Sequence[str], by_times: bool) -> tuple[str, ...]:
    """Patterns of the note on files whose order in time another reading of their names would not give.

    Args:
        names: of the files, in order of time.
        by_times: whether the files hold their times.
    """
    if by_times:
        plain = all(re.search(r"\d", name) for name in map(_stem, names)) or list(names) == sorted(names)
        return () if plain else ("the frames stand in the order of the times inside the files, not of their names: .*",)
    whole = sorted(names, key=lambda name: list(map(int, re.findall(r"\d+", _stem(name)))))
    by_decimals = "the frames stand in the order of the numbers in their names, read with their decimals: .*"
    return () if whole == list(names) else (by_decimals,)


def _stem(name: str) -> str:
    return Path(name).stem

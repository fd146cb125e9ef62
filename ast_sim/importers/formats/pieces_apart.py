"""Pieces of an XML file that VTK cannot read together. It takes the arrays of each piece by their places in the list of
the first one, whatever their names: where a piece lacks an array, or lists them in another order, it mixes them up. It
refuses pieces in files of their own of which one lacks an array.
"""

from __future__ import annotations

import contextlib
import re
import tempfile
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree

from ast_sim.importers.formats.declared_sizes import Declared

_FIELDS = ("PPointData", "PCellData")


def read_apart(declared: Declared) -> list[list[int]]:
    """The numbers of the pieces that are to be read together, for each reading; empty if VTK can read the file as it
    is. Pieces without points are left out where the first one is, since it has the names of all arrays."""
    with_points = [piece for piece, (points, _) in enumerate(declared.pieces) if points]
    if not with_points or len(declared.pieces) == 1:
        return []
    if are_unlike(declared):
        return [[piece] for piece in with_points]
    return [with_points] if declared.pieces[0] == (0, 0) else []


def are_unlike(declared: Declared) -> bool:
    """Whether the pieces with points list other arrays, or the same ones in another order or with other types."""
    lists: list[list[tuple[str | None, ...]]] = [[] for _ in declared.pieces]
    for array in declared.arrays:
        if array.piece >= 0 and array.place in ("Points", "PointData", "CellData"):
            name = "" if array.place == "Points" else array.name
            kinds = (array.attributes.get("type"), array.attributes.get("NumberOfComponents"))
            lists[array.piece].append((array.place, name, *kinds))
    return (
        len({tuple(sorted(one, key=_place)) for one, (points, _) in zip(lists, declared.pieces, strict=True) if points})
        > 1
    )


def files_apart(path: Path, declared: Mapping[str, Declared]) -> list[str]:
    """The files with points that a .pvtu or .pvtp file lists, if one of them lacks a field that it declares, since VTK
    refuses this; else none.

    Args:
        declared: what each of these files says, by its name.
    """
    root = ElementTree.parse(path).getroot()
    fields = {
        (place.tag[1:], array.get("Name", "")) for place in root.iter() if place.tag in _FIELDS for array in place
    }
    held = {name: one for name, one in declared.items() if any(points for points, _ in one.pieces)}
    lack = [name for name, one in held.items() if fields - {(array.place, array.name) for array in one.arrays}]
    return list(held) if lack else []


def _place(array: tuple[str | None, ...]) -> str:
    return array[0] or ""


@contextlib.contextmanager
def copy_of(path: Path, content: bytes) -> Iterator[Path]:
    """A file of the same name with other content."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        copy.write_bytes(content)
        yield copy


def with_pieces_only(path: Path, kept: Collection[int]) -> bytes:
    """A file without its other pieces."""
    head, mark, data = path.read_bytes().partition(b"<AppendedData")
    whole = re.compile(rb"<Piece\b[^>]*/>|<Piece\b.*?</Piece>", re.DOTALL)
    numbers = iter(range(len(whole.findall(head))))
    return whole.sub(lambda piece: piece[0] if next(numbers) in kept else b"", head) + mark + data

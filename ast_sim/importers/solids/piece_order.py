"""Which piece of a frame is which piece of the first frame. A piece is a block, a part or a file of a frame; a body may
be the first piece in one frame and the second in another.

Names decide, unless they are but numbers, such as Block-00 and Block-01: these may count the pieces as they stand.
Numbers of points decide, too. Without either the meshes decide, and among equal meshes the places: the way from one
piece to another turns little from frame to frame.
"""

from __future__ import annotations

import re
from collections.abc import Hashable, Sequence
from typing import NamedTuple

import numpy as np

from ast_sim.importers.formats.source_mesh import SourceMesh
from ast_sim.plausibility.body_places import nearest_bodies
from ast_sim.support.errors import DatasetError

_WHAT_HELPS = "give them names, or the points global ids, or write them in one order in all frames"

_BY_NAME = "the blocks of {} stand in another order"
_BY_PLACE = "the pieces of {} stand in another order, as their meshes and places tell"


class _Piece(NamedTuple):
    """A piece: the rows of its points in the whole mesh, its name, the numbers of its points, its cells."""

    rows: np.ndarray
    name: str
    numbers: bytes
    cells: bytes


def rows_by_piece(frame: SourceMesh, first: SourceMesh, before: np.ndarray) -> tuple[np.ndarray, str] | None:
    """[n]: where the points of the first frame stand in a frame, and a note if they stand in another order; None if
    nothing tells.

    Args:
        before: [n, 3] the points of another frame, in the order of the first.

    Raises:
        DatasetError: pieces have equal meshes, and neither names nor places tell which is which.
    """
    if frame.pieces is None or first.pieces is None:
        return None
    mine, theirs = _pieces(frame), _pieces(first)
    names = [piece.name for piece in mine]
    named = sorted(names) == sorted(piece.name for piece in theirs)
    unique = named and "" not in names and len(set(names)) == len(names)
    if unique and not _counted(names):
        return _rows(mine, _matched([piece.name for piece in theirs], names)), _BY_NAME
    if unique and (by_name := _fits(mine, theirs, ("name", "cells"))) is not None:
        by_place = _by_place(frame, mine, theirs, before, ("cells",), refuse=False)
        if by_place is not None and by_place != by_name:
            row = next(index for index, (a, b) in enumerate(zip(by_place, by_name, strict=True)) if a != b)
            raise DatasetError(
                f"{frame.path}: the block {mine[by_place[row]].name!r} lies where {theirs[row].name!r} lay in another"
                f" frame, and their meshes are equal: did they change their places? Please {_WHAT_HELPS}"
            )
        return _rows(mine, by_name), _BY_NAME
    for facts in (("name", "numbers", "cells"), ("numbers", "cells"), ("name", "cells"), ("cells",)):
        if ("name" not in facts or named) and _same_kinds(mine, theirs, facts):
            order = _by_place(frame, mine, theirs, before, facts, refuse=True)
            return None if order is None else (_rows(mine, order), _BY_PLACE)
    return None


def _pieces(mesh: SourceMesh) -> list[_Piece]:
    """The pieces of a mesh that have points; the points of each in the order of their numbers, if they have some."""
    assert mesh.pieces is not None
    local = np.empty(len(mesh.points), np.int64)
    pieces = []
    for piece in np.unique(mesh.pieces).tolist():
        rows = np.flatnonzero(mesh.pieces == piece)
        numbers = b""
        if mesh.same_point is not None and len(np.unique(mesh.same_point[rows])) == len(rows):
            rows = rows[np.argsort(mesh.same_point[rows])]
            numbers = mesh.same_point[rows].tobytes()
        local[rows] = np.arange(len(rows))
        cells = [len(rows).to_bytes(8, "little")]
        for block in mesh.blocks:
            nodes = np.sort(local[block.nodes[mesh.pieces[block.nodes[:, 0]] == piece]], axis=1)
            if len(nodes):
                cells += [block.kind.encode(), nodes[np.lexsort(nodes.T[::-1])].tobytes()]
        name = mesh.piece_names[piece] if mesh.piece_names else ""
        pieces.append(_Piece(rows, name, numbers, b" ".join(cells)))
    return pieces


def _counted(names: Sequence[str]) -> bool:
    """Whether names differ in numbers alone."""
    return len({re.sub("[0-9]+", "", name) for name in names}) == 1


def _matched(wanted: Sequence[Hashable], given: Sequence[Hashable]) -> list[int]:
    place = {key: index for index, key in enumerate(given)}
    return [place[key] for key in wanted]


def _rows(pieces: list[_Piece], order: list[int]) -> np.ndarray:
    return np.concatenate([pieces[index].rows for index in order])


def _keys(pieces: list[_Piece], facts: tuple[str, ...]) -> list[tuple[str | bytes, ...]]:
    return [tuple(getattr(piece, fact) for fact in facts) for piece in pieces]


def _same_kinds(mine: list[_Piece], theirs: list[_Piece], facts: tuple[str, ...]) -> bool:
    return sorted(_keys(mine, facts)) == sorted(_keys(theirs, facts))


def _fits(mine: list[_Piece], theirs: list[_Piece], facts: tuple[str, ...]) -> list[int] | None:
    """The order of pieces of which no two are alike; None if the first frame has others."""
    if not _same_kinds(mine, theirs, facts):
        return None
    return _matched(_keys(theirs, facts), _keys(mine, facts))


def _by_place(
    frame: SourceMesh,
    mine: list[_Piece],
    theirs: list[_Piece],
    before: np.ndarray,
    facts: tuple[str, ...],
    refuse: bool,
) -> list[int] | None:
    """The order in which pieces of the same kinds are the ones of the first frame. None, or an error, if places do not
    tell."""
    given, wanted = _keys(mine, facts), _keys(theirs, facts)
    order = [0] * len(wanted)
    for key in set(wanted):
        places = [index for index, one in enumerate(wanted) if one == key]
        those = [index for index, one in enumerate(given) if one == key]
        if len(places) == 1:
            order[places[0]] = those[0]
            continue
        now = np.stack([frame.points[mine[index].rows].ravel() for index in those])
        then = np.stack([before[theirs[index].rows].ravel() for index in places])
        nearest = nearest_bodies(now, then)
        if nearest is None:
            if not refuse:
                return None
            raise DatasetError(
                f"{frame.path}: {len(places)} blocks or pieces have equal meshes and no names, and they moved too far"
                f" since the frame before: which is which? Please {_WHAT_HELPS}"
            )
        for place, index in zip(places, nearest, strict=True):
            order[place] = those[index]
    return order

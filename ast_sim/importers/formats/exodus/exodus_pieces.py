"""The pieces of an Exodus file that a parallel run has written: job.e.4.0, job.e.4.1, job.e.4.2 and job.e.4.3."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path

import numpy as np

from ast_sim.importers.formats.exodus import EXODUS
from ast_sim.importers.formats.exodus.exodus_files import node_numbers
from ast_sim.importers.formats.source_mesh import SourceMesh
from ast_sim.importers.formats.together import require_one_time, together
from ast_sim.support.errors import DatasetError

FramesOf = Callable[[Path], Iterator[SourceMesh]]

_PIECE = re.compile(rf"(.*(?:{'|'.join(map(re.escape, EXODUS))}))\.(\d+)\.(\d+)", re.IGNORECASE)


def is_piece(path: Path) -> bool:
    """Whether a file is a piece, by its name."""
    return _PIECE.fullmatch(path.name) is not None


def is_first_piece(path: Path) -> bool:
    """Whether a file is the first of the pieces, by its name."""
    match = _PIECE.fullmatch(path.name)
    return match is not None and int(match[3]) == 0


def piece_frames(path: Path, read: FramesOf) -> Iterator[SourceMesh]:
    """The frames of all pieces, of which `path` is one; nodes with one number are one point.

    Args:
        read: the frames of an Exodus file.

    Raises:
        DatasetError: a piece is missing or damaged, has no numbers of nodes, or has other frames than the first.
    """
    pieces = _pieces_beside(path)
    numbers = [node_numbers(piece) for piece in pieces]
    with tempfile.TemporaryDirectory() as folder:
        readings = [_frames_of(piece, Path(folder) / str(rank), read) for rank, piece in enumerate(pieces)]
        for parts in zip_longest(*readings):
            if None in parts:
                short = pieces[parts.index(None)].name
                raise DatasetError(f"{path}: its piece {short} has fewer frames than others: take all of one run")
            require_one_time(parts)
            yield _joined_pieces(path, parts, numbers)


def _pieces_beside(path: Path) -> list[Path]:
    match = _PIECE.fullmatch(path.name)
    assert match is not None
    width = len(match[3])
    pieces = [path.with_name(f"{match[1]}.{match[2]}.{rank:0{width}d}") for rank in range(int(match[2]))]
    missing = [piece.name for piece in pieces if not piece.is_file()]
    if missing or path not in pieces:
        lacking = f"{missing[0]} is missing" if missing else "there is no piece of this number"
        raise DatasetError(
            f"{path}: is a piece of a parallel run, but {lacking}: put all pieces into one folder, or"
            " join them with epu"
        )
    return pieces


def _frames_of(piece: Path, folder: Path, read: FramesOf) -> Iterator[SourceMesh]:
    """The frames of a piece, which is read under the name of the whole: its ending says the format."""
    folder.mkdir()
    link = folder / piece.name.rsplit(".", 2)[0]
    link.symlink_to(piece.resolve())
    try:
        yield from (replace(frame, path=piece) for frame in read(link))
    except DatasetError as error:
        raise DatasetError(str(error).replace(str(link), str(piece))) from error


def _joined_pieces(path: Path, parts: Sequence[SourceMesh], numbers: Sequence[np.ndarray]) -> SourceMesh:
    given = [
        replace(part, same_point=of_piece[part.same_point])
        for part, of_piece in zip(parts, numbers, strict=True)
        if part.same_point is not None
    ]
    return replace(together(given), path=path)

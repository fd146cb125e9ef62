"""STL files as CAD programs write them: text in any case, binary, one solid or several, with or without colours.

Legend: F triangles.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ast_sim.support.errors import counted

_HEADER = 84
_MARK = b"\xef\xbb\xbf"  # with which some editors of Windows begin a text
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("colour", "<u2")])
_WORDS = re.compile(rb"[^\s]+")
_SOLID = re.compile(rb"(?im)^[ \t]*solid\b[ \t]*(.*?)[ \t]*$")
_END = re.compile(rb"(?im)^[ \t]*end[ \t]*solid\b")


class BadSurface(Exception):
    """What is wrong with a surface, in words."""


@dataclass(frozen=True, eq=False)
class StlFile:
    """What an STL file holds.

    Attributes:
        corners: [F,3,3] float64, the corners of the triangles.
        solid: [F] the number of the solid that each belongs to.
        names: the names of the solids; "" for one without a name.
    """

    corners: np.ndarray
    solid: np.ndarray
    names: tuple[str, ...]


def read_stl(path: Path) -> StlFile:
    """Read an STL file.

    Raises:
        BadSurface: it cannot be read, is cut off or holds no triangle.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BadSurface(f"it cannot be read: {error.strerror}") from error
    data = data.removeprefix(_MARK)
    stl = _text(data) if _is_text(data) else _binary(data)
    if not len(stl.corners):
        raise BadSurface("it holds no triangles")
    if not np.isfinite(stl.corners).all():
        first = int(np.argmin(np.isfinite(stl.corners).all(axis=(1, 2))))
        raise BadSurface(f"a corner of triangle {first} is not finite: {stl.corners[first].tolist()}")
    return stl


def _is_text(data: bytes) -> bool:
    """Whether the file is text. Some programs begin binary files with "solid", too; their size tells."""
    if len(data) >= _HEADER and len(data) == _HEADER + _TRIANGLE.itemsize * int.from_bytes(data[80:84], "little"):
        return False
    return data[:1000].lstrip().lower().startswith(b"solid") and b"\0" not in data[:1000]


def _binary(data: bytes) -> StlFile:
    if len(data) < _HEADER:
        raise BadSurface(
            f"it has {counted(len(data), 'byte')}: neither a text that begins with 'solid' nor a binary STL file"
        )
    count = int.from_bytes(data[80:84], "little")
    held, left = divmod(len(data) - _HEADER, _TRIANGLE.itemsize)
    if held < count:
        raise BadSurface(f"it is cut off: it says {counted(count, 'triangle')}, but holds {held:,}")
    if left or held > count:
        raise BadSurface(
            f"it says {counted(count, 'triangle')}, but has {counted(len(data) - _HEADER, 'byte')} of them, 50 each"
        )
    rows = np.frombuffer(data, _TRIANGLE, count, _HEADER)
    return StlFile(rows["corners"].astype(np.float64), np.zeros(count, int), ("",))


def _text(data: bytes) -> StlFile:
    """Blocks of `solid NAME ... endsolid NAME`, each with facets of one loop of three vertices."""
    data = data.replace(b"\r", b"\n")
    starts = list(_SOLID.finditer(data))
    ends = [*(one.start() for one in starts[1:]), len(data)]
    corners, owner, names = [], [], []
    for number, (start, end) in enumerate(zip(starts, ends, strict=True)):
        triangles = _facets(data[start.end() : end])
        corners.append(triangles)
        owner.append(np.full(len(triangles), number))
        names.append(start[1].decode(errors="replace").strip())
    return StlFile(np.concatenate(corners), np.concatenate(owner), tuple(names))


def _facets(block: bytes) -> np.ndarray:
    """[F,3,3]: the triangles of a block of text."""
    end = _END.search(block)
    words = np.array(_WORDS.findall(block[: end.start() if end else None].lower()), dtype="S32")
    vertex = np.flatnonzero(words == b"vertex")
    facets = int((words == b"facet").sum())
    if end is None or int((words == b"endfacet").sum()) != facets:
        raise BadSurface(f"it is cut off after {counted(facets, 'facet')}: 'endfacet' or 'endsolid' is missing")
    if len(vertex) != 3 * facets:
        raise BadSurface(
            f"it holds {counted(facets, 'facet')}, but {counted(len(vertex), 'vertex', 'vertices')}; each facet has"
            " three"
        )
    if not facets:
        return np.zeros((0, 3, 3))
    numbers = words[np.minimum(vertex[:, None] + np.arange(1, 4), len(words) - 1)]
    try:
        return numbers.astype(np.float64).reshape(-1, 3, 3)
    except ValueError as error:
        raise BadSurface(f"a vertex has no three numbers: {error}") from error

"""Surfaces in OBJ, OFF and PLY files, in a form that meshio reads; what it reads over in them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ast_sim.importers.formats.source_mesh import INSTEAD
from ast_sim.support.errors import DatasetError

# Lines of OBJ files that make curves and curved surfaces.
_CURVED_OBJ = ("cstype", "curv", "curv2", "surf")


def plain_ply(path: Path) -> bytes:
    """A PLY file that calls the corners of its faces as meshio does; other programs leave out the plural."""
    return re.sub(rb"\bvertex_index\b", b"vertex_indices", path.read_bytes(), count=1)


def plain_obj(path: Path) -> bytes:
    """An OBJ file with its points and faces alone.

    Raises:
        DatasetError: it holds no points, curves, or a face that cannot be cut into triangles.
    """
    lines = list(_lines_of_obj(path))
    if not any(line.startswith("v ") for line in lines):
        raise DatasetError(f"{path}: cannot be read as a mesh: holds no points as OBJ files do; {INSTEAD}")
    return "\n".join(lines).encode()


def _lines_of_obj(path: Path) -> Iterator[str]:
    """The corners and faces of an OBJ file, without textures, normals and colours, without numbers that count from the
    end, and without faces of more than four corners."""
    text = path.read_text("latin-1")
    if "\0" in text[:100]:
        raise DatasetError(f"{path}: cannot be read as a mesh: is no text; compilers use this ending, too")
    points: list[list[float]] = []
    for line in text.replace("\\\n", " ").splitlines():
        key, *entries = line.partition("#")[0].split() or [""]
        if key in _CURVED_OBJ or (key == "v" and len(entries) == 4 and float(entries[3]) != 1):
            raise DatasetError(f"{path}: holds curves or curved surfaces, and those are not read; {INSTEAD}")
        if key == "v":
            points.append([float(entry) for entry in entries[:3]])
            yield " ".join(["v", *entries[:3]])
        elif key == "f":
            numbers = [int(entry.partition("/")[0]) for entry in entries]
            yield from _faces(path, [number if number > 0 else len(points) + 1 + number for number in numbers], points)


def plain_off(path: Path) -> bytes:
    """An OFF file in the form of OBJ: meshio knows triangles alone, and takes colours for corners."""
    rows = [row for line in path.read_text("latin-1").splitlines() if (row := line.partition("#")[0].split())]
    if rows[0][0] not in ("OFF", "COFF", "NOFF", "CNOFF", "STOFF") or "BINARY" in rows[0]:
        raise DatasetError(f"{path}: cannot be read as a mesh: begins with {' '.join(rows[0])[:40]!r}, not with OFF")
    counts, *rows = [rows[0][1:], *rows[1:]] if len(rows[0]) > 1 else rows[1:]
    corners, faces = (int(text) for text in counts[:2])
    if len(rows) < corners + faces:
        raise DatasetError(
            f"{path}: cannot be read as a mesh: holds fewer lines than {corners} points and {faces} faces"
        )
    points = [[float(text) for text in row[:3]] for row in rows[:corners]]
    lines = ["v " + " ".join(row[:3]) for row in rows[:corners]]
    for count, *entries in rows[corners : corners + faces]:
        lines += _faces(path, [1 + int(text) for text in entries[: int(count)]], points)
    return "\n".join(lines).encode()


def _faces(path: Path, corners: list[int], points: list[list[float]]) -> Iterator[str]:
    """The lines of OBJ of a face, whose corners count from 1; one with more than four is cut into triangles, one with
    fewer than three is an edge and left out."""
    if len(corners) <= 4:
        if len(corners) > 2:
            yield " ".join(["f", *map(str, corners)])
        return
    at = np.array([points[corner - 1] for corner in corners])
    for first in range(len(corners)):
        start, *others = np.roll(at, -first, axis=0)
        normals = np.cross(others[:-1] - start, others[1:] - start)
        if (normals @ normals.sum(axis=0) > 0).all():
            start, *others = corners[first:] + corners[:first]
            yield from (f"f {start} {one} {other}" for one, other in zip(others, others[1:], strict=False))
            return
    raise DatasetError(
        f"{path}: a face of {len(corners)} corners cannot be cut from one of them: cut the faces into triangles"
    )


def require_header_of_ply(path: Path) -> None:
    """Raise DatasetError unless the points of a PLY file begin with x, y and z: meshio takes other columns for them; or
    if its faces have columns behind which meshio looks for the next face."""
    header, end, _ = path.read_bytes().partition(b"end_header")
    vertex = re.search(rb"element\s+vertex\s[^\n]*\n((?:\s*(?:property|comment)\b[^\n]*\n)*)", header)
    names = re.findall(rb"property\s+\S+\s+(\S+)", vertex[1]) if vertex else []
    _, _, faces = header.partition(b"element face")
    columns = re.findall(rb"property\s+(list)?.*?(\S+)\s*$", faces.partition(b"element")[0], re.MULTILINE)
    further = [name.decode() for _, name in columns[1:]]
    wrong = "" if columns[:1] and columns[0][0] else "its faces do not begin with their corners"
    if not wrong and further and (b"format ascii" not in header or any(kind for kind, _ in columns[1:])):
        wrong = f"its faces have further columns: write it without {', '.join(further)}"
    if not end or names[:3] != [b"x", b"y", b"z"]:
        wrong = "is cut off within its header" if not end else "its points do not begin with x, y and z"
    if wrong:
        raise DatasetError(f"{path}: cannot be read as a mesh: {wrong}; {INSTEAD}")

"""Several meshes as one: the blocks, pieces or files of a frame."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ast_sim.importers.formats.source_mesh import SourceMesh
from ast_sim.support.errors import DatasetError, counted

_TENSOR = 4  # columns or more; two and three are a vector


def labels_of(files: Sequence[str]) -> list[str]:
    """What tells the files of one frame apart: the words in their names, or else the numbers that differ; empty texts
    if their names have not one form."""
    parts = [re.split(r"([0-9]+)", file.replace("\\", "/")) for file in files]
    words = [" ".join(part[::2]) for part in parts]
    if len(set(words)) == len(words):
        return words
    if len({len(part) for part in parts}) > 1:
        return [""] * len(files)
    differ = [column for column in zip(*parts, strict=True) if len(set(column)) > 1]
    return [" ".join(label) for label in zip(*differ, strict=True)] or [""] * len(files)


def labelled(mesh: SourceMesh, label: str) -> SourceMesh:
    """A mesh whose pieces have this label before their names."""
    if not label:
        return mesh
    count = 1 if mesh.pieces is None else int(mesh.pieces.max(initial=0)) + 1
    names = mesh.piece_names or ("",) * count
    return replace(mesh, piece_names=tuple(f"{label}/{name}" if name else label for name in names))


def require_one_time(parts: Sequence[SourceMesh]) -> None:
    """Check that the files of the parts of a frame do not say different times.

    Raises:
        DatasetError: two do.
    """
    timed = [part for part in parts if part.time is not None]
    other = next(
        (part for part in timed if not np.isclose(part.time or 0, timed[0].time or 0, rtol=1e-6, atol=0)), None
    )
    if other is not None:
        raise DatasetError(
            f"{other.path}: is a part of a frame at the time {other.time:g}, {timed[0].path.name} at {timed[0].time:g}:"
            " list parts of one time together"
        )


def together(meshes: Sequence[SourceMesh]) -> SourceMesh:
    """One mesh of several, with all points of the first, then of the second, and so on. A field that one of them lacks
    is NaN there, and a note says so. The path and the time come from the first."""
    if len(meshes) == 1:
        return meshes[0]
    meshes, columns, said = _with_like_columns(meshes)
    starts = np.cumsum([0, *(len(mesh.points) for mesh in meshes)])
    blocks = [
        replace(block, nodes=block.nodes + start)
        for mesh, start in zip(meshes, starts, strict=False)
        for block in mesh.blocks
    ]
    point_fields, notes = _filled([(mesh.point_fields, len(mesh.points)) for mesh in meshes])
    of_blocks = [
        ({name: parts[index] for name, parts in mesh.cell_fields.items()}, len(block.nodes))
        for mesh in meshes
        for index, block in enumerate(mesh.blocks)
    ]
    cell_fields, more = _filled(of_blocks)
    ends = np.cumsum([0, *(rows for _, rows in of_blocks)])
    groups: dict[str, np.ndarray] = {}
    for mesh, start in zip(meshes, starts, strict=False):
        for name, nodes in mesh.groups.items():
            groups[name] = np.concatenate([groups.get(name, nodes[:0]), nodes + start])
    with_ids = [mesh.same_point for mesh in meshes if mesh.same_point is not None]
    return SourceMesh(
        meshes[0].path,
        np.concatenate([mesh.points for mesh in meshes]),
        blocks,
        point_fields,
        {name: [v[a:b] for a, b in zip(ends, ends[1:], strict=False)] for name, v in cell_fields.items()},
        groups,
        list(dict.fromkeys([note for mesh in meshes for note in mesh.notes] + said + notes + more)),
        meshes[0].time,
        columns,
        np.concatenate(with_ids) if len(with_ids) == len(meshes) else None,
        *_pieces(meshes),
    )


def _with_like_columns(
    meshes: Sequence[SourceMesh],
) -> tuple[Sequence[SourceMesh], dict[str, tuple[str, ...]], list[str]]:
    """Meshes whose fields have their named columns in one order, the names of these, and notes.

    A field is left out whose columns have other names in another mesh. Columns without names are taken for the named
    ones if they are not more than three, so a vector; of a tensor the order may be another one.
    """
    columns = {name: names for mesh in reversed(meshes) for name, names in mesh.columns.items()}
    notes = []
    for name, names in [*columns.items()]:
        holding = [mesh for mesh in meshes if name in mesh.point_fields or name in mesh.cell_fields]
        of_each = [mesh.columns.get(name, names if len(names) < _TENSOR else ()) for mesh in holding]
        if all(one == names for one in of_each):
            continue
        if all(sorted(one) == sorted(names) and len(set(one)) == len(names) for one in of_each):
            meshes = [_permuted(mesh, name, names) for mesh in meshes]
            continue
        listed = " and ".join(dict.fromkeys(", ".join(one) or "nothing" for one in of_each))
        notes.append(f"the columns of the field {name!r} are called {listed} in different blocks: it is left out")
        meshes = [_without(mesh, name) for mesh in meshes]
        del columns[name]
    return meshes, columns, notes


def _permuted(mesh: SourceMesh, name: str, names: tuple[str, ...]) -> SourceMesh:
    """A mesh with the columns of a field in the order of their `names`."""
    own = mesh.columns.get(name, names)
    order = [own.index(one) for one in names]
    points, cells = dict(mesh.point_fields), dict(mesh.cell_fields)
    if name in points and points[name].shape[1:] == (len(names),):
        points[name] = points[name][:, order]
    if name in cells and all(part.shape[1:] == (len(names),) for part in cells[name]):
        cells[name] = [part[:, order] for part in cells[name]]
    return replace(mesh, point_fields=points, cell_fields=cells)


def _without(mesh: SourceMesh, name: str) -> SourceMesh:
    points, cells = dict(mesh.point_fields), dict(mesh.cell_fields)
    points.pop(name, None)
    cells.pop(name, None)
    return replace(mesh, point_fields=points, cell_fields=cells)


def _pieces(meshes: Sequence[SourceMesh]) -> tuple[np.ndarray, tuple[str, ...]]:
    """The piece of each point, and the names of the pieces; a mesh that has no pieces is one."""
    pieces: list[np.ndarray] = []
    names: list[str] = []
    for mesh in meshes:
        own = np.zeros(len(mesh.points), np.int64) if mesh.pieces is None else mesh.pieces
        pieces.append(len(names) + own)
        names += mesh.piece_names or [""] * int(own.max(initial=0) + 1)
    return np.concatenate(pieces), tuple(names)


def _filled(parts: list[tuple[dict[str, np.ndarray], int]]) -> tuple[dict[str, np.ndarray], list[str]]:
    """The fields of all parts in one array each, NaN where a part lacks one, and notes on these."""
    fields: dict[str, np.ndarray] = {}
    notes = []
    for name in dict.fromkeys(name for given, _ in parts for name in given):
        given = [(one.get(name), rows) for one, rows in parts]
        there = [values for values, _ in given if values is not None]
        if any(values.shape[1:] != there[0].shape[1:] or values.dtype.kind not in "iufb" for values in there):
            notes.append(f"the field {name!r} has other columns in other blocks and is left out")
            continue
        lacking = sum(rows for values, rows in given if values is None)
        if lacking:
            notes.append(f"the field {name!r} is missing in some blocks: it is NaN in {counted(lacking, 'row')}")
        empty = [np.full((rows, *there[0].shape[1:]), np.nan) for values, rows in given if values is None]
        fields[name] = np.concatenate([v if v is not None else empty.pop(0) for v, _ in given])
    return fields, notes

"""Whether a frame holds the points and the cells of the first one, and in which order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ast_sim.importers.formats.source_mesh import SourceMesh
from ast_sim.importers.solids.piece_order import rows_by_piece
from ast_sim.support.errors import DatasetError, counted

# Names of fields by which programs number points, in small letters and without underlines.
_NUMBERS = ("globalnodeid", "globalids", "globalid", "nodeid", "nodeids", "pointid", "pointids", "id", "ids")


def in_order_of(frame: SourceMesh, first: SourceMesh, before: np.ndarray) -> tuple[SourceMesh, list[str]]:
    """A frame with its points in the order of the first frame, and a note if they stood in another one, unless the
    points stand where they stood before; see `piece_order`.

    Args:
        before: [n, 3] the points of another frame, in the order of the first.

    Raises:
        DatasetError: a field numbers the points in another order, or nothing tells which piece is which.
    """
    if len(frame.points) != len(first.points) or np.array_equal(frame.points, first.points):
        return frame, []
    rows = _rows_by_number(frame.same_point, first.same_point)
    said = "the points of {} stand in another order"
    if rows is None and (by_piece := rows_by_piece(frame, first, before)) is not None:
        rows, said = by_piece
    if rows is None or np.array_equal(rows, np.arange(len(rows))):
        _require_numbers(frame, first)
        return frame, []
    place = np.argsort(rows)
    ordered = replace(
        frame,
        points=frame.points[rows],
        blocks=[replace(block, nodes=place[block.nodes]) for block in frame.blocks],
        point_fields={name: values[rows] for name, values in frame.point_fields.items()},
        groups={name: np.sort(place[nodes]) for name, nodes in frame.groups.items()},
        same_point=None if frame.same_point is None else frame.same_point[rows],
        pieces=first.pieces,
        piece_names=first.piece_names,
    )
    return ordered, [f"{said.format(frame.path.name)}: they are reordered as in the first"]


def _rows_by_number(numbers: np.ndarray | None, wanted: np.ndarray | None) -> np.ndarray | None:
    """[n]: where the wanted numbers stand among others; None if they are not the same numbers, or stand twice."""
    if numbers is None or wanted is None:
        return None
    mine, theirs = np.argsort(numbers, kind="stable"), np.argsort(wanted, kind="stable")
    if not np.array_equal(numbers[mine], wanted[theirs]) or (np.diff(numbers[mine]) == 0).any():
        return None
    rows = np.empty(len(mine), np.int64)
    rows[theirs] = mine
    return rows


def _require_numbers(frame: SourceMesh, first: SourceMesh) -> None:
    for name, values in frame.point_fields.items():
        before = first.point_fields.get(name)
        if before is None or name.lower().replace("_", "") not in _NUMBERS or values.dtype.kind not in "iu":
            continue
        rows = _rows_by_number(values.ravel(), before.ravel())
        if rows is not None and not np.array_equal(rows, np.arange(len(rows))):
            raise DatasetError(
                f"{frame.path}: the field {name!r} numbers the points in another order than in {first.path.name}: write"
                " the points in one order, or leave the field out"
            )


def order_of_cells(frame: SourceMesh, first: SourceMesh) -> np.ndarray | None:
    """[cells]: where each cell of the first frame stands in a frame; None if they stand alike.

    Raises:
        DatasetError: the frame has other points or other cells; the text names it.
    """
    if len(frame.points) != len(first.points):
        raise DatasetError(
            f"{frame.path}: has {counted(len(frame.points), 'point')}, {first.path.name} {len(first.points):,}"
        )
    if len(frame.blocks) == len(first.blocks) and all(
        a.kind == b.kind and np.array_equal(a.nodes, b.nodes) for a, b in zip(frame.blocks, first.blocks, strict=True)
    ):
        return None
    mine, theirs = _keys(frame), _keys(first)
    if mine.shape == theirs.shape:
        order, wanted = np.lexsort(mine.T[::-1]), np.lexsort(theirs.T[::-1])
        if np.array_equal(mine[order], theirs[wanted]):
            place = np.empty(len(order), np.int64)
            place[wanted] = order
            return place
    raise DatasetError(f"{frame.path}: its elements differ from {first.path.name}; the mesh must not change")


def _keys(mesh: SourceMesh) -> np.ndarray:
    """[cells, nodes + 1]: the nodes of each cell in ascending order, filled up with -1, and its number of nodes."""
    most = max((block.nodes.shape[1] for block in mesh.blocks), default=0)
    rows = []
    for block in mesh.blocks:
        nodes = np.sort(block.nodes, axis=1)
        filled = np.pad(nodes, ((0, 0), (0, most - nodes.shape[1])), constant_values=-1)
        rows.append(np.column_stack([filled, np.full(len(nodes), nodes.shape[1])]))
    return np.concatenate([np.zeros((0, most + 1), np.int64), *rows])

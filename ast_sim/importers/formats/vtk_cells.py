"""VTK's cells as blocks of cells of one kind."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ast_sim.importers.formats.source_mesh import BEZIER, SHAPES, CellBlock, node_count
from ast_sim.support.errors import DatasetError, counted

# Types of VTK with a fixed number of nodes.
_KINDS = {
    1: "vertex",
    3: "line",
    5: "triangle",
    8: "pixel",
    9: "quad",
    10: "tetra",
    11: "voxel",
    12: "hexahedron",
    13: "wedge",
    14: "pyramid",
    21: "line3",
    22: "triangle6",
    23: "quad8",
    24: "tetra10",
    25: "hexahedron20",
    26: "wedge15",
    27: "pyramid13",
    28: "quad9",
    29: "hexahedron27",
    30: "quad6",
    31: "wedge12",
    32: "wedge18",
    33: "hexahedron24",
    34: "triangle7",
    35: "line4",
    37: "pyramid19",
}

# Lagrange and Bezier cells: their number of nodes says the order; the corners stand first.
_ANY_ORDER = {68: "line", 69: "triangle", 70: "quad", 71: "tetra", 72: "hexahedron", 73: "wedge", 74: "pyramid"}
_BEZIER = {number + 7: shape for number, shape in _ANY_ORDER.items()}
_ANY_ORDER |= _BEZIER

# The corners of a pixel and of a voxel, in the order of a quadrilateral and of a hexahedron.
_REORDERED = {"pixel": ("quad", [0, 1, 3, 2]), "voxel": ("hexahedron", [0, 1, 3, 2, 4, 5, 7, 6])}

_REFUSED = {41: "convex sets of points", 42: "polyhedra", 36: "curved polygons", 51: "parametric curves"}


def blocks_of(
    path: Path, types: np.ndarray, offsets: np.ndarray, connectivity: np.ndarray
) -> list[tuple[CellBlock, np.ndarray]]:
    """The cells of each type and number of nodes, and their rows among all cells.

    Args:
        types: [c] VTK's types.
        offsets: [c + 1] where the nodes of each cell begin in `connectivity`.

    Raises:
        DatasetError: a type is not known, or the arrays do not fit each other; the text names the file.
    """
    sizes = np.diff(offsets)
    if len(offsets) != len(types) + 1 or (sizes < 0).any() or offsets[0] < 0 or offsets[-1] > len(connectivity):
        raise DatasetError(f"{path}: cannot be read as a mesh: the offsets of its cells do not fit the cells")
    blocks = []
    keys, first = np.unique(np.stack([types.astype(np.int64), sizes], axis=1), axis=0, return_index=True)
    for number, size in keys[np.argsort(first)].tolist():
        rows = np.flatnonzero((types == number) & (sizes == size))
        nodes = connectivity[offsets[rows][:, None] + np.arange(size)]
        blocks.append((_block(path, number, size, nodes), rows))
    return blocks


def _block(path: Path, number: int, size: int, nodes: np.ndarray) -> CellBlock:
    kind = _KINDS.get(number)
    if number in _ANY_ORDER and size:
        shape = _ANY_ORDER[number]
        corners = SHAPES[shape][1]
        kind = shape if size == corners else f"{shape}{size}"
        label = f"{BEZIER if number in _BEZIER else ''}{kind}"
        return _require_size(path, CellBlock(kind, nodes, label), corners)
    if number in (2, 4, 0):  # points and lines of any length, empty cells: no volume and no surface
        return CellBlock("vertex", nodes[:, :1], "polyline" if number == 4 else "vertex")
    if number == 7 and size in (3, 4):
        return CellBlock("triangle" if size == 3 else "quad", nodes, "polygon")
    if kind is None:
        what = _REFUSED.get(number, f"cells of VTK's type {number} with {counted(size, 'node')}")
        raise DatasetError(f"{path}: holds {what}, which are not known here: mesh the bodies with tetrahedra")
    if kind in _REORDERED:
        shape, order = _REORDERED[kind]
        if size != len(order):
            raise DatasetError(f"{path}: cannot be read as a mesh: a {kind} has {counted(size, 'node')}")
        return CellBlock(shape, nodes[:, order], kind)
    if size != node_count(kind):
        raise DatasetError(f"{path}: cannot be read as a mesh: a {kind} has {counted(size, 'node')}")
    return CellBlock(kind, nodes, kind)


def _require_size(path: Path, block: CellBlock, least: int) -> CellBlock:
    if block.nodes.shape[1] < least:
        raise DatasetError(
            f"{path}: cannot be read as a mesh: a {block.label} has {counted(block.nodes.shape[1], 'node')}"
        )
    return block

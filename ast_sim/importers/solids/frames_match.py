"""Whether a frame holds the cells of the first one, and in which order."""

from __future__ import annotations

import numpy as np

from ast_sim.importers.formats.source_mesh import SourceMesh
from ast_sim.support.errors import DatasetError


def order_of_cells(frame: SourceMesh, first: SourceMesh) -> np.ndarray | None:
    """[cells]: where each cell of the first frame stands in a frame; None if they stand alike.

    Raises:
        DatasetError: the frame has other points or other cells; the text names it.
    """
    if len(frame.points) != len(first.points):
        raise DatasetError(f"{frame.path}: has {len(frame.points)} points, {first.path.name} {len(first.points)}")
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

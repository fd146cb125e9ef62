"""Which cells of a file become elements: tetrahedra of all cells with a volume, or triangles if there are none.

This is the one place where cells of a higher order than the second, and curved hexahedra, prisms, pyramids and
triangles, are reduced to their corners, where hexahedra, prisms and pyramids are cut into tetrahedra and quadrilaterals
into triangles, where elements that stand twice are taken once, and where elements are turned over.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from ast_sim.element_topology import turned_over
from ast_sim.importers.formats.source_mesh import SourceMesh
from ast_sim.importers.solids.middles import NO_NODE, middles_of, require_near
from ast_sim.importers.solids.splitting import tetrahedra_of, triangles_of
from ast_sim.support.errors import DatasetError, counted

# Values of cells that are copies agree to this share of the largest value.
_ALIKE = 1e-5


@dataclass(frozen=True, eq=False)
class Elements:
    """Elements, and what was done to get them.

    Attributes:
        nodes: [E, 3 or 4] int64 points of the file, the corners; tetrahedra have a positive volume.
        middles: [E, 6] int64 points of the file in the middles of the edges of tetrahedra, `NO_NODE` where an element
            has none; None if none has any.
        rows: [E] int64 the cell that each is part of, counted over all blocks of the file.
        copies: [C, 2] int64 the cells that are left out since their nodes are the nodes of a cell before them, and that
            cell.
        blocks: the numbers of the blocks that became elements.
        notes: sentences on what was changed.
        mirrored: whether all elements were inside out.
        reduced: whether some keep their corners only, though they have further nodes.
    """

    nodes: np.ndarray
    middles: np.ndarray | None
    rows: np.ndarray
    copies: np.ndarray
    blocks: list[int]
    notes: list[str]
    mirrored: bool = False
    reduced: bool = False


def elements_of(mesh: SourceMesh, point_of: np.ndarray, corners: bool = False) -> Elements:
    """The elements of a mesh.

    Args:
        point_of: [n] the point that stands for each point of the file.
        corners: leave out the nodes within the edges of second-order tetrahedra.

    Raises:
        DatasetError: there are none, or a tetrahedron names a node twice; the text names the file and the cell.
    """
    dimension = max((block.dimension for block in mesh.blocks), default=0)
    chosen = [index for index, block in enumerate(mesh.blocks) if block.dimension == dimension]
    if dimension < 2:
        held = ", ".join(mesh.counts()) or "no cells"
        raise DatasetError(
            f"{mesh.path}: holds {held}; the elements must be tetrahedra, hexahedra, prisms or pyramids, or triangles"
            " and quadrilaterals alone: mesh the bodies with tetrahedra"
        )
    starts = np.cumsum([0, *(len(block.nodes) for block in mesh.blocks)])
    nodes, middles, rows, copies, told = [], [], [], [], []
    for shape in dict.fromkeys(mesh.blocks[index].shape for index in chosen):
        of_shape = [index for index in chosen if mesh.blocks[index].shape == shape]
        cells = np.concatenate([point_of[mesh.blocks[index].corners] for index in of_shape])
        middle = np.concatenate([middles_of(mesh.blocks[index], point_of) for index in of_shape])
        row = np.concatenate([starts[index] + np.arange(len(mesh.blocks[index].nodes)) for index in of_shape])
        first, copy = _first_of_its_nodes(cells)
        copies.append(row[copy])
        cells, middle, row = cells[first], middle[first], row[first]
        if shape == "tetra":
            _require_proper(mesh, cells, row)
        elif shape != "triangle":
            cut, owner = triangles_of(cells) if shape == "quad" else tetrahedra_of(shape, cells)
            kind = "triangles" if shape == "quad" else "tetrahedra"
            are = counted(len(cells), f"cell of the kind {shape} is", f"cells of the kind {shape} are")
            told.append(f"{are} cut into {len(cut):,} {kind}")
            cells = cut
            middle = middle[owner]
            row = row[owner]
        nodes.append(cells)
        middles.append(middle)
        rows.append(row)
    reduced = _reduced(mesh, chosen, corners)
    said = [*reduced, *told]
    copy = np.concatenate(copies)
    if len(copy):
        are = counted(
            len(copy), "element that stands in the file twice is", "elements that stand in the file twice are"
        )
        said.append(f"{are} taken once")
    elements, middle, row = (np.concatenate(parts) for parts in (nodes, middles, rows))
    if dimension == 2:
        return Elements(elements, None, row, copy, chosen, said, reduced=bool(reduced))
    second = not corners and bool((middle != NO_NODE).any())
    if second:
        require_near(mesh, elements, middle, row)
    turned, more = _turned_over(mesh, elements, row, starts)
    elements, middle = turned_over(elements, turned), turned_over(middle, turned)
    mirrored = bool(turned.all()) and all(mesh.blocks[index].shape != "wedge" for index in chosen)
    middle = middle if second else None
    return Elements(elements, middle, row, copy, chosen, [*said, *more], mirrored, bool(reduced))


def _reduced(mesh: SourceMesh, chosen: list[int], corners: bool) -> list[str]:
    """Notes on the cells that keep their corners only, by kind."""
    counts: Counter[str] = Counter()
    for block in (mesh.blocks[index] for index in chosen):
        if block.is_curved and (corners or not block.has_middles):
            counts[block.label] += len(block.nodes)
    return [
        f"{counted(count, f'cell of the kind {kind} keeps its', f'cells of the kind {kind} keep their')} corners only"
        for kind, count in counts.items()
    ]


def told_of_copies(values: np.ndarray, copies: np.ndarray) -> list[str]:
    """A note if values at the cells of the file are others at `copies`, as of `Elements`, than at their first cells."""
    left_out, kept = values[copies.T]
    scale = np.nanmax(np.abs(values), initial=0.0)
    alike = np.isclose(left_out, kept, rtol=0, atol=_ALIKE * scale, equal_nan=True)
    others = int((~alike).any(axis=tuple(range(1, alike.ndim))).sum())
    have = counted(others, "element that stands in the file twice has", "elements that stand in the file twice have")
    return [f"{have} other values there: the first ones are taken"] if others else []


def _first_of_its_nodes(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rows of cells whose nodes are not the nodes of a cell before them, in ascending order; and [C, 2] the others,
    each with the first cell of its nodes."""
    ordered = np.sort(cells, axis=1)
    order = np.lexsort(ordered.T)
    new = np.append(True, (ordered[order[1:]] != ordered[order[:-1]]).any(axis=1)) if len(cells) else order == 0
    first = order[new][np.cumsum(new) - 1]  # lexsort is stable: the first of equal rows comes first
    return np.sort(order[new]), np.stack([order[~new], first[~new]], axis=1)


def _require_proper(mesh: SourceMesh, cells: np.ndarray, rows: np.ndarray) -> None:
    ordered = np.sort(cells, axis=1)
    repeated = (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)
    if repeated.any():
        first = int(np.argmax(repeated))
        raise DatasetError(f"{mesh.path}: element {rows[first]} refers to a node twice: {cells[first].tolist()}")


def _turned_over(
    mesh: SourceMesh, elements: np.ndarray, rows: np.ndarray, starts: np.ndarray
) -> tuple[np.ndarray, list[str]]:
    """[E] bool: the tetrahedra that are inside out, and notes on them.

    The order of the nodes of a prism differs from program to program, so prisms are turned over without a note. Cells
    that are so warped that some of their tetrahedra are inside out fold over themselves; the check of the scene tells.
    There is no note either if the format of the file counts the nodes of all cells the other way around.
    """
    corners = mesh.points[elements]
    negative = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
    shape_of = np.repeat([block.shape for block in mesh.blocks], np.diff(starts))
    of_elements = shape_of[rows]
    if mesh.other_way and negative[of_elements != "wedge"].all():
        return negative, []
    plain = of_elements == "tetra"
    notes = []
    if (negative & plain).any():
        are = counted(
            (negative & plain).sum(), "tetrahedron that was inside out is", "tetrahedra that were inside out are"
        )
        notes.append(f"{are} turned over")
    cells, cell = np.unique(rows[~plain], return_inverse=True)
    if len(cells):
        turned = np.bincount(cell.ravel(), negative[~plain]) == np.bincount(cell.ravel())
        turned &= shape_of[cells] != "wedge"
        if turned.any():
            are = counted(turned.sum(), "cell that was inside out is", "cells that were inside out are")
            notes.append(f"{are} turned over")
    return negative, notes

"""Bodies to start from, as scenes: a box, a plate, a ball, a cylinder. `Scene.join` puts them side by side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Integral
from typing import Any

import numpy as np

from ast_sim.number_arrays import connected_parts, real_numbers, three_numbers
from ast_sim.scene import Scene
from ast_sim.simulate.shapes import mesh
from ast_sim.support.argument_checks import in_short, several
from ast_sim.support.errors import ConfigError, warn

MOST_CELLS = 10_000_000


def box(low: Sequence[float], high: Sequence[float], cells: Sequence[int], **arrays: Any) -> Scene:
    """A box of tetrahedra between two corners; all nodes are free.

    Args:
        low, high: [3], the lowest and the highest corner.
        cells: [3], the cells along x, y and z. Each is cut into six tetrahedra.
        arrays: other arguments of `Scene.of`, such as handles or material.

    Raises:
        ConfigError: a size or a number of cells is not above 0.
        DatasetError: these are no numbers, or not three where three are needed.
    """
    start, end = three_numbers("the box", "low", low), three_numbers("the box", "high", high)
    size = np.subtract(end, start)
    cells = _above_zero("the box", size, cells)
    coordinates, elements = mesh.hexahedral_grid(cells)
    return Scene.of(coordinates / np.asarray(cells) * size + start, elements, **arrays)


def plate(size: Sequence[float], cells: Sequence[int], holes: Sequence[Sequence[float]] = (), **arrays: Any) -> Scene:
    """A plate of tetrahedra around the origin, with round holes through its thickness; all nodes are free.

    Args:
        size: [3], along x, y and z; z is the thickness.
        cells: [3], the cells along x, y and z.
        holes: [H, 3], centre x, centre y and radius; a cell whose centre lies in a hole is left out.
        arrays: other arguments of `Scene.of`.

    Raises:
        ConfigError: a size or a number of cells is not above 0, a hole leaves out no cell, or they leave none.
        DatasetError: these are no numbers, or not three where three are needed.
    """
    lengths = three_numbers("the plate", "size", size)
    cells = _above_zero("the plate", lengths, cells)
    cut = real_numbers("the plate", "holes", holes).astype(np.float64)
    if cut.size and (cut.ndim != 2 or cut.shape[1] != 3 or not (cut[:, 2] > 0).all() or not np.isfinite(cut).all()):
        raise ConfigError("the holes of the plate must be triples: centre x, centre y and a radius above 0")
    for hole in cut.reshape(-1, 3):
        _require_cut(lengths, cells, hole)
    nodes, elements = mesh.plate(lengths.tolist(), cells, cut.reshape(-1, 3))
    if not len(elements):
        raise ConfigError("the holes leave no cell of the plate: make them smaller, or move them")
    pieces = 1 + int(connected_parts(elements, len(nodes)).max())
    if pieces > 1:
        warn(f"the holes cut the plate into {pieces} pieces, each a body of its own: make them smaller, or move them")
    return Scene.of(nodes, elements, **arrays)


def _require_cut(size: np.ndarray, cells: Sequence[int], hole: np.ndarray) -> None:
    """Raise ConfigError if a hole leaves out no cell, as if it were not there."""
    x, y = (size[axis] * ((np.arange(cells[axis]) + 0.5) / cells[axis] - 0.5) - hole[axis] for axis in (0, 1))
    if not (x[:, None] ** 2 + y**2 < hole[2] ** 2).any():
        raise ConfigError(
            f"no cell of the plate has its centre in the hole at ({hole[0]:g}, {hole[1]:g}) of radius {hole[2]:g}: move"
            " the hole, or take more cells"
        )


def ball(center: Sequence[float], radius: float, cells: int, **arrays: Any) -> Scene:
    """A ball of tetrahedra; all nodes are free.

    Args:
        center: [3].
        radius: its radius.
        cells: the cells across the diameter, an even number.
        arrays: other arguments of `Scene.of`.

    Raises:
        ConfigError: the radius is not above 0, or the number of cells is not even.
        DatasetError: these are no numbers, or not three where three are needed.
    """
    _above_zero("the ball", [radius], [cells], even=True)
    middle = three_numbers("the ball", "center", center)
    position, elements = mesh.ball(radius, cells)
    return Scene.of(position + middle, elements, **arrays)


def cylinder(
    center: Sequence[float], radius: float, length: float, cells: int, axis: str = "z", **arrays: Any
) -> Scene:
    """A cylinder of tetrahedra; all nodes are free.

    Args:
        center: [3], the middle of its axis.
        radius, length: its radius, and its length along the axis.
        cells: the cells across the diameter and along the axis, an even number.
        axis: "x", "y" or "z".
        arrays: other arguments of `Scene.of`.

    Raises:
        ConfigError: a size is not above 0, the number of cells is not even, or there is no such axis.
        DatasetError: these are no numbers, or not three where three are needed.
    """
    _above_zero("the cylinder", [radius, length], [cells], even=True)
    middle = three_numbers("the cylinder", "center", center)
    if axis not in ("x", "y", "z"):
        raise ConfigError(f"the axis of the cylinder is {axis!r}; must be x, y or z")
    position, elements = mesh.cylinder(radius, length / 2, cells)
    return Scene.of(np.roll(position, "xyz".index(axis), axis=1) + middle, elements, **arrays)


def _above_zero(what: str, sizes: Sequence[float] | np.ndarray, cells: Sequence[int], even: bool = False) -> list[int]:
    """The numbers of cells, after a check."""
    if not (real_numbers(what, "its sizes", sizes) > 0).all() or not np.isfinite(sizes).all():
        shown = ", ".join(f"{size:g}" for size in sizes)
        raise ConfigError(f"{what} has the size [{shown}]; every size must be above 0")
    counts = several("cells", cells, "three numbers of cells")
    whole = all(isinstance(count, Integral) and not isinstance(count, bool) and int(count) > 0 for count in counts)
    if not whole or len(counts) != (1 if even else 3) or (even and counts[0] % 2):
        needs = "an even whole number" if even else "three whole numbers"
        raise ConfigError(f"{what} has {counts} cells; must be {needs} above 0")
    along = 3 * counts if even else counts
    if math.prod(map(int, along)) > MOST_CELLS:
        told = " x ".join(map(in_short, along))
        raise ConfigError(f"{what} has {told} cells; more than {MOST_CELLS:,} are too many for one scene")
    return counts

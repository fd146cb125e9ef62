"""Several grids of an XDMF file on the same points: FEniCS writes marks of cells and faces beside a mesh, and a series
for each function."""

from __future__ import annotations

import contextlib
import re
import xml.etree.ElementTree as ET
from copy import deepcopy
from pathlib import Path
from typing import Any

from ast_sim.support.errors import DatasetError, counted

_POINTER = re.compile(r"xpointer\(/Xdmf/(.*)/([^/]*)\)")


def with_one_grid(path: Path, tree: ET.ElementTree[Any]) -> list[str]:
    """Leave the grid with most cells of the highest dimension in a file without a series, with its points written out.
    Notes on the others.

    Raises:
        DatasetError: two grids have points of their own, or a grid refers to something that there is not.
    """
    domain = tree.find("Domain")
    grids = tree.findall("Domain/Grid")
    if domain is None or len(grids) < 2:
        return []
    points = [_points(path, tree, grid) for grid in grids]
    if any(one is not points[0] for one in points):
        raise DatasetError(
            f"{path}: holds {counted(len(grids), 'grid')} with points of their own: write all bodies into one grid"
        )
    kept = max(grids, key=_rank)
    if kept.find("Geometry") is None:
        for include in [one for one in kept if one.tag.endswith("include")]:
            kept.remove(include)
        kept.insert(0, deepcopy(points[0]))
    others = [grid for grid in grids if grid is not kept]
    for grid in others:
        domain.remove(grid)
    left_out = [grid for grid in others if grid.find("Attribute") is not None or -1 < _rank(grid)[0] != _rank(kept)[0]]
    named = [grid.get("Name", "without a name") for grid in left_out]
    are = counted(len(named), "grid on the same points is", "grids on the same points are")
    return [f"{are} left out: {', '.join(named)}"] if named else []


def with_one_series(tree: ET.ElementTree[Any]) -> bool:
    """Put the fields of all series into the first, if they have the same times and no points or cells of their own.
    Whether there are several such."""
    domain = tree.find("Domain")
    series = tree.findall("Domain/Grid[@GridType='Collection']")
    times = [[time.get("Value") for time in one.iterfind("Grid/Time")] for one in series]
    own = [one for one in series[1:] if one.find("Grid/Geometry") is not None or one.find("Grid/Topology") is not None]
    if domain is None or len(series) < 2 or own or any(one != times[0] for one in times):
        return False
    first, *others = series
    if any(one.get("CollectionType") != "Temporal" or len(one) != len(first) for one in series):
        return False
    for other in others:
        for grid, further in zip(first, other, strict=True):
            grid.extend(further.findall("Attribute"))
        domain.remove(other)
    return True


def _points(path: Path, tree: ET.ElementTree[Any], grid: ET.Element) -> ET.Element:
    """The points of a grid: its own, or the ones that it includes from another grid."""
    own = grid.find("Geometry")
    if own is not None:
        return own
    pointers = [one.get("xpointer", "") for one in grid if one.tag.endswith("include")]
    for pointer in pointers:
        target = _POINTER.fullmatch(pointer)
        if target and "Geometry" in target[2]:
            with contextlib.suppress(SyntaxError, KeyError):  # no path as ElementTree knows them
                points = tree.getroot().find(f"./{target[1]}/Geometry")
                if points is not None:
                    return points
    name = grid.get("Name", "without a name")
    raise DatasetError(f"{path}: the grid {name!r} has no points, but {pointers}: write its Geometry into it")


def _rank(grid: ET.Element) -> tuple[int, int, int]:
    """The dimension of the cells of a grid, their number, and the number of its fields."""
    topology = grid.find("Topology")
    if topology is None:
        return -1, 0, 0
    kind = topology.get("TopologyType", topology.get("Type", "")).lower()
    dimension = next((size for size, word in ((1, "poly"), (1, "edge"), (2, "tri"), (2, "quad")) if word in kind), 3)
    cells = topology.get("NumberOfElements", topology.get("Dimensions", ""))
    return dimension, int(cells) if cells.isdigit() else 0, len(grid.findall("Attribute"))

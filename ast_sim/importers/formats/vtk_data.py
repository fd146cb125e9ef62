"""What a data set of VTK holds: its meshes, their names, their arrays and its time. Only the process that reads files
loads VTK."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

# The blocks in which VTK keeps the sets of Exodus.
_SETS = {"Node Sets": "nodes", "Side Sets": "sides"}

_TRIANGLE = 5  # VTK's types of cells
_POLYGON = 7


class Refused(Exception):
    """VTK cannot read a file. The text says why."""


class Block(NamedTuple):
    """A mesh of a data set; the names of its blocks, joined by slashes; its own name if it is a set of Exodus, after
    "nodes " or "sides "."""

    data: Any
    name: str = ""
    of_set: str = ""


def blocks_of(data: Any, names: tuple[str, ...] = ()) -> list[Block]:
    """The meshes of a data set, one for each block that is there."""
    from vtkmodules.vtkCommonDataModel import (
        vtkCompositeDataSet,
        vtkDataSet,
        vtkMultiBlockDataSet,
        vtkPartitionedDataSetCollection,
    )

    if isinstance(data, vtkDataSet):
        kind = next((_SETS[name] for name in names[:-1] if name in _SETS), "")
        return [Block(data, "/".join(names), f"{kind} {names[-1]}" if kind else "")]
    if not isinstance(data, vtkCompositeDataSet):
        raise Refused(f"holds a {data.GetClassName().removeprefix('vtk') if data is not None else 'nothing'}, no mesh")
    blocks = []
    if isinstance(data, vtkMultiBlockDataSet | vtkPartitionedDataSetCollection):
        several = isinstance(data, vtkMultiBlockDataSet)
        for index in range(data.GetNumberOfBlocks() if several else data.GetNumberOfPartitionedDataSets()):
            held = data.GetBlock(index) if several else data.GetPartitionedDataSet(index)
            facts = data.GetMetaData(index) if data.HasMetaData(index) else None
            label = (facts.Get(vtkCompositeDataSet.NAME()) if facts is not None else None) or ""
            if held is not None:
                blocks += blocks_of(held, (*names, label))
        return blocks
    iterator = data.NewIterator()
    while not iterator.IsDoneWithTraversal():
        blocks += blocks_of(iterator.GetCurrentDataObject(), names)
        iterator.GoToNextItem()
    return blocks


def time_of(data: Any, blocks: Sequence[Block] = ()) -> float | None:
    """The time that a data set says, or else the one that its meshes say; None if they say none.

    Raises:
        Refused: they say several.
    """
    times = sorted({time for block in blocks if (time := _own_time(block.data)) is not None})
    if len(times) > 1:
        raise Refused(f"its blocks are of different times ({times[0]:g}, {times[1]:g}): write the blocks of one frame")
    own = _own_time(data)
    return own if own is not None or not times else times[0]


def _own_time(data: Any) -> float | None:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    facts = data.GetFieldData()
    arrays = [facts.GetArray(index) for index in range(facts.GetNumberOfArrays())] if facts is not None else []
    named = {(array.GetName() or "").lower(): array for array in arrays if array is not None}  # None: a text
    for name in ("timevalue", "time_value", "time"):
        if name in named and named[name].GetNumberOfValues() == 1:
            return float(vtk_to_numpy(named[name]).ravel()[0])
    return None


def arrays_of(block: Block) -> dict[str, np.ndarray]:
    """The arrays of a mesh by name; see `reading_worker`."""
    from vtkmodules.vtkCommonDataModel import vtkPolyData, vtkUnstructuredGrid
    from vtkmodules.vtkFiltersCore import vtkAppendFilter, vtkTriangleFilter

    data = block.data
    if block.of_set:
        ids = _numpy(data.GetCells().GetConnectivityArray()).astype(np.int64) if data.GetNumberOfCells() else ()
        return {f"group {block.of_set}": np.unique(np.asarray(ids, np.int64))}
    held = data.GetNumberOfCells()
    if isinstance(data, vtkPolyData) and (data.GetNumberOfStrips() or data.GetPolys().GetMaxCellSize() > 4):
        cut = vtkTriangleFilter()
        cut.SetInputData(data)
        cut.Update()
        data = cut.GetOutput()
    more = data.GetNumberOfCells() - held
    if not isinstance(data, vtkUnstructuredGrid):
        append = vtkAppendFilter()
        append.AddInputData(data)
        append.Update()
        data = append.GetOutput()
    arrays = {"points": np.zeros((0, 3)), "types": np.zeros(0, np.uint8), "connectivity": np.zeros(0, np.int64)}
    arrays["offsets"] = np.zeros(1, np.int64)
    arrays["block"] = np.array([block.name.encode(errors="replace")])
    arrays["more"] = np.array([more])
    if data.GetNumberOfPoints():
        arrays["points"] = _numpy(data.GetPoints().GetData())
    if data.GetNumberOfCells():
        cells = data.GetCells()
        arrays["types"] = _numpy(data.GetCellTypes())
        arrays["offsets"] = _numpy(cells.GetOffsetsArray()).astype(np.int64)
        arrays["connectivity"] = _numpy(cells.GetConnectivityArray()).astype(np.int64)
    for place, fields in (("point", data.GetPointData()), ("cell", data.GetCellData())):
        for index in range(fields.GetNumberOfArrays()):
            array = fields.GetArray(index)  # None for text
            if array is not None and array.GetName():
                again = "#2" if f"{place} {array.GetName()}" in arrays else ""  # u beside ux, uy and uz of Exodus
                arrays[f"{place} {array.GetName()}{again}"] = _numpy(array)
                names = [array.GetComponentName(c) or "" for c in range(array.GetNumberOfComponents())]
                if any(names):
                    arrays[f"{place}-columns {array.GetName()}{again}"] = np.array(names, "S")
    arrays = _with_cut_polygons(arrays)
    ids = _numpy(data.GetPointData().GetGlobalIds())
    return arrays if ids is None else {**arrays, "global": ids}


def _with_cut_polygons(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of a mesh whose polygons of more than four corners are cut into triangles, which stand behind all
    other cells."""
    long = (arrays["types"] == _POLYGON) & (np.diff(arrays["offsets"]) > 4)
    if not long.any():
        return arrays
    triangles, of = _triangles(arrays, np.flatnonzero(long))
    rows = np.concatenate([np.flatnonzero(~long), of])
    kept = np.repeat(~long, np.diff(arrays["offsets"]))
    sizes = np.concatenate([np.diff(arrays["offsets"])[~long], np.full(len(of), 3)])
    return {
        **arrays,
        **{name: values[rows] for name, values in arrays.items() if name.startswith("cell ")},
        "types": np.concatenate([arrays["types"][~long], np.full(len(of), _TRIANGLE, np.uint8)]),
        "offsets": np.concatenate([[0], np.cumsum(sizes)]),
        "connectivity": np.concatenate([arrays["connectivity"][kept], triangles.ravel()]),
        "more": arrays["more"] + len(of) - long.sum(),
    }


def _triangles(arrays: dict[str, np.ndarray], rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[t, 3], [t]: the triangles into which VTK cuts polygons, also such as are not convex, and the row of each."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
    from vtkmodules.vtkFiltersCore import vtkTriangleFilter

    points = vtkPoints()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(arrays["points"], float), deep=True))
    cells = vtkCellArray()
    for row in rows:
        corners = arrays["connectivity"][arrays["offsets"][row] : arrays["offsets"][row + 1]]
        cells.InsertNextCell(len(corners), corners.tolist())
    surface = vtkPolyData()
    surface.SetPoints(points)
    surface.SetPolys(cells)
    numbers = numpy_to_vtk(rows, deep=True)
    numbers.SetName("row")
    surface.GetCellData().AddArray(numbers)
    cut = vtkTriangleFilter()
    cut.SetInputData(surface)
    cut.Update()
    made = cut.GetOutput()
    of = _numpy(made.GetCellData().GetArray("row")).astype(np.int64)
    if len(np.unique(of)) < len(rows):
        raise Refused("has a polygon that cannot be cut into triangles: write triangles")
    return _numpy(made.GetPolys().GetConnectivityArray()).astype(np.int64).reshape(-1, 3), of


def of_used_points(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of a mesh that has all points of its file, for the points of its cells alone; `global` are these."""
    used, nodes = np.unique(arrays["connectivity"], return_inverse=True)
    wrong = used[(used < 0) | (used >= len(arrays["points"]))]
    if len(wrong):
        raise IndexError(f"an element has the node {wrong[0] + 1}, but the nodes are 1 to {len(arrays['points'])}")
    at_points = [name for name in arrays if name == "points" or name.startswith("point ")]
    return {**arrays, "connectivity": nodes.ravel(), "global": used, **{name: arrays[name][used] for name in at_points}}


def _numpy(array: Any) -> Any:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    return None if array is None else vtk_to_numpy(array)

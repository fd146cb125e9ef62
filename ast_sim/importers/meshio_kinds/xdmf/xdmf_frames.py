"""Frames of XDMF: what meshio's reader takes otherwise than it is meant is written out for it, or refused."""

from __future__ import annotations

import contextlib
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim.importers.formats.source_mesh import SourceMesh, from_meshio
from ast_sim.importers.meshio_kinds.meshio_files import by_meshio, what_meshio_says
from ast_sim.importers.meshio_kinds.xdmf.xdmf_grids import with_one_grid, with_one_series
from ast_sim.importers.meshio_kinds.xdmf.xdmf_items import made_of_others, require_linked, with_joined_points, write_out
from ast_sim.importers.meshio_kinds.xdmf.xdmf_spellings import (
    with_defaults,
    with_fields_of_one_step,
    with_known_words,
    with_own_times,
    with_references,
    with_series_of_version_3,
    with_version,
    without_fields_of_grids,
    without_time,
)
from ast_sim.support.errors import DatasetError, counted

# How the coordinates of points may stand.
_POINTS = ("XYZ", "XY", "X_Y_Z", "X_Y")


def xdmf_frames(path: Path) -> Iterator[SourceMesh]:
    """The frames of a series; a file without a series is one frame. Frames that have a geometry or cells of their own
    keep them; meshio's reader of series takes the points and cells of the first."""
    import meshio

    try:
        tree = ET.parse(path)
    except (ET.ParseError, OSError, ValueError, LookupError) as error:
        raise DatasetError(f"{path}: cannot be read as a mesh: it is no XML: {error}") from error
    several = with_known_words(tree) | with_version(tree) | with_series_of_version_3(tree)
    several |= with_own_times(path, tree) | with_fields_of_one_step(tree) | with_one_series(tree)
    told = without_fields_of_grids(tree)
    _require_understood(path, tree)
    require_linked(path, tree)
    series = tree.findall("Domain/Grid[@GridType='Collection']")
    version = str(tree.getroot().get("Version"))
    if series and version.partition(".")[0] != "3":
        raise DatasetError(
            f"{path}: is XDMF of the version {version}; write a series of version 3 (Xdmf3 in ParaView), .vtkhdf or"
            " .pvd"
        )
    sets = dict.fromkeys(one.get("Name", "without a name") for one in tree.iter("Set"))
    several |= bool(told) or (not series and len(tree.findall("Domain/Grid")) > 1)
    told += [f"{counted(len(sets), 'set is', 'sets are')} not read: {', '.join(sets)}"] if sets else []
    told += [] if series else with_one_grid(path, tree)
    time, timed = (None, False) if series else without_time(path, tree)
    if series:
        _require_plain(path, series)
        _require_no_other(path, tree, series[0])
    changes = [
        several,
        with_defaults(tree),
        with_references(path, tree),
        timed,
        with_joined_points(tree),
        made_of_others(tree),
    ]
    with _beside(path, tree, any(changes)) as copy:
        if not series:
            mesh = by_meshio(path, copy)
            _require_count(mesh, tree.find(".//Topology"))
            yield replace(mesh, time=time, notes=[*mesh.notes, *told])
            return
        try:
            with meshio.xdmf.TimeSeriesReader(copy) as reader:
                shared = reader.read_points_cells()
                for step, grid in enumerate(reader.collection):
                    points, cells = _own_mesh(reader, grid, shared)
                    reader.cells = cells
                    time, point_data, cell_data = reader.read_data(step)
                    values: Any = cell_data
                    frame = meshio.Mesh(np.asarray(points), cells, point_data, values)
                    mesh = from_meshio(frame, path)
                    topology = grid.find("Topology")
                    _require_count(mesh, tree.find(".//Topology") if topology is None else topology)
                    yield replace(mesh, time=float(time), notes=[*mesh.notes, *told])
        except DatasetError:
            raise
        except (Exception, SystemExit) as error:
            raise DatasetError(f"{path}: cannot be read as a mesh: {what_meshio_says(error)}") from error


def _require_count(mesh: SourceMesh, topology: ET.Element | None) -> None:
    """Raise DatasetError if a topology says another number of cells than its array has."""
    said = "" if topology is None else topology.get("NumberOfElements", topology.get("Dimensions", ""))
    cells = sum(len(block.nodes) for block in mesh.blocks)
    if said.isdigit() and int(said) != cells:
        raise DatasetError(
            f"{mesh.path}: says that it holds {counted(int(said), 'cell')}, but their array has {cells:,}"
        )


def _own_mesh(reader: Any, grid: ET.Element, shared: tuple[Any, Any]) -> tuple[Any, Any]:
    """The points and cells of a grid; of the first grid where it has none of its own."""
    if grid.find("Geometry") is None and grid.find("Topology") is None:
        return shared
    reader.mesh_grid = grid
    points, cells = reader.read_points_cells()
    return shared[0] if points is None else points, cells or shared[1]


def _require_understood(path: Path, tree: ET.ElementTree[Any]) -> None:
    """Raise DatasetError if nodes are not counted from 0 or stand in an order of their own,
    or a grid has a field twice: meshio reads over it."""
    for attribute in tree.iter("Attribute"):
        center = attribute.get("Center", "Node")
        if center not in ("Node", "Cell"):
            raise DatasetError(
                f"{path}: the field {attribute.get('Name')!r} has its values at the place {center!r}: write them at the"
                " nodes or in the cells (in FEniCS by write, not by write_checkpoint)"
            )
    for topology in tree.iter("Topology"):
        if topology.get("BaseOffset", "0").strip() not in ("", "0"):
            raise DatasetError(
                f"{path}: counts its nodes from {topology.get('BaseOffset')} (BaseOffset); must be from 0"
            )
        if topology.get("Order"):
            raise DatasetError(f"{path}: its cells have an Order of nodes; must be the one of XDMF, without an Order")
    for geometry in tree.iter("Geometry"):
        kind = geometry.get("GeometryType", geometry.get("Type", "XYZ")).upper()
        if kind not in _POINTS:
            raise DatasetError(f"{path}: has a Geometry of the type {kind}; must be one of {', '.join(_POINTS)}")
    for grid in tree.iter("Grid"):
        for part in ("Geometry", "Topology"):
            if len(grid.findall(part)) > 1:
                raise DatasetError(
                    f"{path}: a grid has {counted(len(grid.findall(part)), 'entry', 'entries')} {part}; must have one"
                )
        if any(not one.get("Name") for one in grid.findall("Attribute")):
            raise DatasetError(f"{path}: a grid has a field (Attribute) without a Name: name it")
        fields = [(one.get("Name"), one.get("Center", "Node")) for one in grid.findall("Attribute")]
        twice = next((name for name, center in fields if fields.count((name, center)) > 1), None)
        if twice is not None:
            raise DatasetError(f"{path}: a grid has the field {twice!r} twice")


def _require_no_other(path: Path, tree: ET.ElementTree[Any], series: ET.Element) -> None:
    """Raise DatasetError if a grid stands beside a series that does not refer to it, or several do."""
    beside = [grid for grid in tree.findall("Domain/Grid") if grid is not series]
    refers = any(item.tag.endswith("include") or item.get("Reference") for item in series.iter())
    if len(beside) > 1 or (beside and not refers):
        raise DatasetError(f"{path}: holds a grid beside the series of frames: write all bodies into one grid")


def _require_plain(path: Path, series: list[ET.Element]) -> None:
    """Raise DatasetError unless there is one series over time, and each of its frames is one grid with its time."""
    if len(series) > 1:
        raise DatasetError(
            f"{path}: holds {len(series)} series of frames, and one can be read: write all bodies and fields into one"
        )
    kind = series[0].get("CollectionType")
    if kind != "Temporal":
        raise DatasetError(
            f"{path}: holds a collection of the type {kind!r}; must be 'Temporal', a grid for each frame"
        )
    for number, grid in enumerate(series[0]):
        if grid.tag != "Grid" or grid.get("GridType") == "Collection" or grid.find("Time[@Value]") is None:
            raise DatasetError(f"{path}: entry {number} of the series is no single grid with a Time of its own")


@contextlib.contextmanager
def _beside(path: Path, tree: ET.ElementTree[Any], changed: bool) -> Iterator[Path]:
    """An XDMF file; or a copy, if its tree was changed, or if numbers stand in binary files beside it, which meshio
    looks for in the folder in which the process runs: the copy names them in full."""
    binary = [item for item in tree.iter("DataItem") if item.get("Format") == "Binary" and item.text]
    for item in binary:
        if item.get("Endian") == "Big" or item.get("Seek", "0") != "0" or item.get("Compression", "Raw") != "Raw":
            raise DatasetError(
                f"{path}: its binary numbers must be plain ones of this machine, from the start of a file"
            )
        item.text = str(path.parent.resolve() / str(item.text).strip())
    if not binary and not changed:
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        write_out(path, tree, Path(folder))
        for item in tree.iter("DataItem"):
            if item.get("Format") == "HDF" and item.text:
                item.text = str(path.parent.resolve() / item.text.strip())
        tree.write(copy)
        yield copy

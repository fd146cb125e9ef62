"""Trajectories as files that ParaView opens: a PVD series of VTU files, or one temporal VTKHDF file."""

from __future__ import annotations

import contextlib
import html
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import meshio
import numpy as np

from ast_sim.element_topology import CELL_KINDS
from ast_sim.scene import Trajectory
from ast_sim.support.disk import Disk, output_file, replacing, temporary_name
from ast_sim.support.errors import AstSimError, is_utf8, require
from ast_sim.view.fields import Fields, fields
from ast_sim.view.files import explained

if TYPE_CHECKING:
    import pyvista

VTK_TYPE = {3: 5, 4: 10, 10: 24}


def write(path: str | os.PathLike[str], trajectory: Trajectory, prediction: Trajectory | None = None) -> None:
    """Write a trajectory for ParaView; with `prediction`, write the prediction and its errors instead.

    The suffix chooses the format. `.pvd` is a collection; a folder of the same name beside it holds one binary VTU file
    a frame. `.vtkhdf` is one file (VTKHDF 2.0, temporal UnstructuredGrid, the mesh stored once). A frame stands at its
    time; where times are not known, at its number.

    Point fields: displacement (from rest, in the unit of the positions), node_type, body; von_mises [Pa] at nodes or
    cells, wherever the stress is, and named fields likewise. With a prediction, the geometry is the predicted one, and
    the fields error (vector), error_magnitude, von_mises_error and NAME_error are added: prediction minus truth. Frames
    that the prediction does not have are left out. The bands of an answer (one number a frame, as in `Answer.figures`)
    are field data, and so are the notes on its scene; in a `.pvd` file these are a comment, since meshio reads no file
    with a text.

    No half-written file is ever left under the final name.

    Raises:
        AstSimError: the suffix is not supported, the prediction is of another scene or has a frame that the truth does
            not have, or the file cannot be written.
    """
    path = Path(path)
    writers = {".pvd": _write_pvd, ".vtkhdf": _write_vtkhdf}
    if path.suffix not in writers:
        raise AstSimError(f"{path}: cannot export to {path.suffix or 'no suffix'!r}; use {' or '.join(writers)}")
    shown = fields(trajectory, prediction)
    with explained(path):
        writers[path.suffix](output_file(path), trajectory.scene.elements, shown)


def to_pyvista(trajectory: Trajectory) -> pyvista.UnstructuredGrid:
    """The first frame as a grid of PyVista, with the fields that `write` writes.

    Raises:
        MissingExtra: pyvista is not installed.
    """
    (pyvista,) = require("pyvista", "pyvista")
    elements = trajectory.scene.elements
    shown = fields(trajectory)
    grid = pyvista.UnstructuredGrid({VTK_TYPE[elements.shape[1]]: elements.astype(np.int64)}, shown.position[0])
    for name, values in {**{name: values[0] for name, values in shown.point.items()}, **shown.static}.items():
        grid.point_data[name] = values
    for name, values in shown.cell.items():
        grid.cell_data[name] = values[0]
    return grid


def _write_pvd(path: Path, elements: np.ndarray, shown: Fields) -> None:
    folder = path.with_suffix("")
    if not is_utf8(folder.name):
        raise AstSimError(f"{path}: a .pvd file cannot hold a name that is not UTF-8: choose another name, or .vtkhdf")
    names = [f"frame_{frame:05d}.vtu" for frame in range(len(shown.position))]
    with _replacing_folder(folder) as temporary:
        for frame, name in enumerate(names):
            _write_vtu(temporary / name, elements, shown, frame)
    lines = [
        f'    <DataSet timestep="{time!r}" part="0" file="{html.escape(folder.name)}/{name}"/>'
        for time, name in zip(shown.times.tolist(), names, strict=True)
    ]
    head = [
        '<?xml version="1.0"?>',
        '<VTKFile type="Collection" version="0.1" byte_order="LittleEndian">',
        "  <Collection>",
    ]
    if shown.notes:
        head.insert(1, f"<!-- notes: {re.sub('-(?=-)', '- ', shown.notes)} -->")  # a comment cannot hold "--"
    with replacing(path) as temporary:
        temporary.write_text("\n".join([*head, *lines, "  </Collection>", "</VTKFile>", ""]), encoding="utf-8")


def _write_vtu(path: Path, elements: np.ndarray, shown: Fields, frame: int) -> None:
    mesh = meshio.Mesh(
        shown.position[frame],
        [(CELL_KINDS[elements.shape[1]], elements)],
        point_data={**{name: values[frame] for name, values in shown.point.items()}, **shown.static},
        cell_data={name: [values[frame]] for name, values in shown.cell.items()},
    )
    meshio.write(path, mesh, file_format="vtu", binary=True)
    if shown.bands:  # meshio writes no field data
        head, grid, rest = path.read_bytes().partition(b"<UnstructuredGrid>\n")
        path.write_bytes(head + grid + _field_data(shown, frame).encode() + rest)


def _field_data(shown: Fields, frame: int) -> str:
    """The bands in a frame, as VTU has what belongs to a frame as a whole."""
    lines = (
        f'<DataArray type="Float64" Name="{name}" NumberOfTuples="1" format="ascii">{band[frame]}</DataArray>\n'
        for name, band in shown.bands.items()
    )
    return f"<FieldData>\n{''.join(lines)}</FieldData>\n"


@contextlib.contextmanager
def _replacing_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder that takes the place of `folder`, which must be absent or hold an earlier series."""
    if folder.exists() and not (folder.is_dir() and all(f.match("frame_*.vtu") for f in folder.iterdir())):
        raise AstSimError(f"{folder}, the folder for the VTU files, holds other files: choose another name")
    folder = Path(os.path.realpath(folder)) if folder.is_symlink() else folder
    temporary, old = temporary_name(folder), temporary_name(folder)
    try:
        temporary.mkdir()
        yield temporary
        if folder.exists():
            folder.rename(old)
        temporary.rename(folder)
    except BaseException:
        if old.exists() and not folder.exists():
            old.rename(folder)
        raise
    finally:
        for leftover in (temporary, old):
            shutil.rmtree(leftover, ignore_errors=True)


def _write_vtkhdf(path: Path, elements: np.ndarray, shown: Fields) -> None:
    with replacing(path) as temporary, _hdf5(temporary) as file:
        root = file.create_group("VTKHDF")
        root.attrs["Version"] = np.array([2, 0], dtype=np.int64)
        root.attrs.create("Type", b"UnstructuredGrid", dtype=h5py.string_dtype("ascii", len("UnstructuredGrid")))
        _write_mesh(root, elements, shown.position)
        _write_steps(root, shown)


@contextlib.contextmanager
def _hdf5(path: Path) -> Iterator[h5py.File]:
    """A new HDF5 file. The first error of the disk is raised at the end: HDF5 itself would end the process."""
    with contextlib.closing(Disk(path)) as disk:
        try:
            with h5py.File(disk, "w") as file:
                yield file
        except (OSError, RuntimeError, ValueError):
            if disk.error is None:
                raise
        disk.sync()
    if disk.error is not None:
        raise disk.error


def _write_mesh(root: h5py.Group, elements: np.ndarray, position: np.ndarray) -> None:
    """Write the mesh once, because all time steps share its connectivity, and the points of all steps in a row."""
    frames, nodes = position.shape[:2]
    count, corners = elements.shape
    root["NumberOfPoints"] = np.array([nodes], dtype=np.int64)
    root["NumberOfCells"] = np.array([count], dtype=np.int64)
    root["NumberOfConnectivityIds"] = np.array([elements.size], dtype=np.int64)
    root["Connectivity"] = elements.astype(np.int64).reshape(-1)
    root["Offsets"] = np.arange(count + 1, dtype=np.int64) * corners
    root["Types"] = np.full(count, VTK_TYPE[corners], dtype=np.uint8)
    root.create_dataset("Points", data=position.reshape(frames * nodes, 3), chunks=(nodes, 3), compression="gzip")


def _write_steps(root: h5py.Group, shown: Fields) -> None:
    """Write the times, and where the points and fields of each step start in the arrays of all steps in a row."""
    frames, nodes = shown.position.shape[:2]
    start = np.arange(frames, dtype=np.int64)
    zero = np.zeros(frames, dtype=np.int64)
    steps = root.create_group("Steps")
    steps.attrs["NSteps"] = np.int64(frames)
    steps["Values"] = shown.times
    steps["NumberOfParts"] = zero + 1
    steps["PartOffsets"] = zero
    steps["PointOffsets"] = start * nodes
    steps["CellOffsets"] = zero[:, None]
    steps["ConnectivityIdOffsets"] = zero[:, None]
    for group, moving, static in (("PointData", shown.point, shown.static), ("CellData", shown.cell, {})):
        data, offsets = root.create_group(group), steps.create_group(f"{group}Offsets")
        for name, values in moving.items():
            rows = values.shape[1]
            flat = values.reshape(frames * rows, *values.shape[2:])
            data.create_dataset(name, data=flat, chunks=(rows, *flat.shape[1:]), compression="gzip")
            offsets[name] = start * rows
        for name, values in static.items():
            data[name] = values
            offsets[name] = zero
    data, offsets = root.create_group("FieldData"), steps.create_group("FieldDataOffsets")
    for name, values in shown.bands.items():
        data[name] = values
        offsets[name] = start
    if shown.notes:
        as_ascii = h5py.string_dtype("ascii")  # VTK does not read what is marked as UTF-8; the bytes are the same
        data.create_dataset("notes", data=[shown.notes.encode()], dtype=as_ascii)
        offsets["notes"] = zero

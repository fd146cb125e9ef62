"""Reading a simulation from one VTKHDF file: an unstructured grid whose points and fields change over the steps."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ast_sim.importers.mesh_file import MeshFile, read_mesh
from ast_sim.support.errors import DatasetError

# gzip packs nothing more tightly than this.
_LARGEST_RATIO = 1032

_KINDS = {5: ("triangle", 3), 10: ("tetra", 4)}


def vtkhdf_frames(path: Path) -> Iterator[MeshFile]:
    """The frames of a file of triangles and tetrahedra in one part; a file without steps is one frame.

    Raises:
        DatasetError: the file is damaged, of another type, or in several parts; the text names it.
    """
    try:
        with h5py.File(path, "r") as file:
            root: Any = file["VTKHDF"]
            kind = root.attrs["Type"]
            kind = kind.decode() if isinstance(kind, bytes) else str(kind)
            if kind != "UnstructuredGrid":
                raise DatasetError(f"{path}: its type is {kind}; must be UnstructuredGrid")
            steps = root.get("Steps")
            count = 1 if steps is None else int(steps.attrs["NSteps"])
            if count < 1:
                raise DatasetError(f"{path}: holds no steps")
            for step in range(count):
                yield _frame(path, root, steps, step)
    except DatasetError:
        raise
    except (OSError, KeyError, ValueError, IndexError, TypeError, RuntimeError, AttributeError, MemoryError) as error:
        raise DatasetError(f"{path}: is damaged or no VTKHDF file: {' '.join(str(error).split())}") from error


def _frame(path: Path, root: Any, steps: Any, step: int) -> MeshFile:
    import meshio

    def start(name: str) -> int:
        return 0 if steps is None or name not in steps else int(np.ravel(steps[name][step])[0])

    def fields(place: str, count: int) -> dict[str, Any]:
        return {n: _rows(v, start(f"{place}Offsets/{n}"), count) for n, v in root.get(place, {}).items()}

    if steps is None:
        parts, part = len(root["NumberOfPoints"]), 0
    else:
        parts, part = int(steps["NumberOfParts"][step]) if "NumberOfParts" in steps else 1, start("PartOffsets")
    if parts != 1:
        raise DatasetError(f"{path}: step {step} is in {parts} parts; merge them into one")
    points, cells, ids = (int(root[f"NumberOf{name}"][part]) for name in ("Points", "Cells", "ConnectivityIds"))
    # The offsets of each part have one number more than the part has cells.
    first = start("CellOffsets")
    offsets = _rows(root["Offsets"], first + part if first else 0, cells + 1).astype(np.int64)
    types = _rows(root["Types"], first, cells)
    connectivity = _rows(root["Connectivity"], start("ConnectivityIdOffsets"), ids).astype(np.int64)
    blocks, taken = [], []
    for number in np.unique(types):
        if int(number) not in _KINDS:
            raise DatasetError(f"{path}: holds cells of VTK's type {number}; must be 5 (triangle) or 10 (tetra)")
        name, corners = _KINDS[int(number)]
        taken.append(np.flatnonzero(types == number))
        blocks.append((name, connectivity[offsets[taken[-1]][:, None] + np.arange(corners)]))
    cell_data: dict[str, Any] = {
        name: [values[rows] for rows in taken] for name, values in fields("CellData", cells).items()
    }
    nodes = _rows(root["Points"], start("PointOffsets"), points)
    return read_mesh(meshio.Mesh(nodes, blocks, fields("PointData", points), cell_data), path=path)


def _rows(values: h5py.Dataset, first: int, count: int) -> np.ndarray:
    """The rows from `first` on.

    Raises:
        ValueError: the array has fewer, or it is mostly empty: a small file may declare an array of any size.
    """
    if values.nbytes > _LARGEST_RATIO * (values.id.get_storage_size() + 1024):
        raise ValueError(f"{values.name} declares {values.nbytes} bytes, but the file does not hold them")
    if first < 0 or count < 0 or first + count > len(values):
        raise ValueError(f"{values.name} has {len(values)} rows, but rows {first} to {first + count} are needed")
    return values[first : first + count]

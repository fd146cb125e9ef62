"""What an Exodus file says of itself: whether it is whole, and whether VTK reads its elements as they are."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ast_sim.importers.formats.declared_sizes import looked_at
from ast_sim.importers.formats.exodus.netcdf_head import NetcdfHead, is_classic, read_netcdf_head
from ast_sim.support.errors import DatasetError

# How many nodes elements may have so that VTK reads them as they are, by the beginning of their kind.
_NODES = {
    "TRI": (3, 6),
    "QUA": (4, 8, 9),
    "SHE": (3, 4, 8),
    "TET": (4, 10, 15),
    "PYR": (5, 13),
    "WED": (6, 15, 18, 21),
    "HEX": (8, 20, 27),
}
_CELLS = re.compile(r"connect\d+").fullmatch  # the names of the arrays with their nodes


@dataclass(frozen=True)
class ExodusFacts:
    """What a file says of itself.

    Attributes:
        kinds: for each block the kind of its elements and how many nodes each has.
        ids: the numbers of the blocks.
        steps: how many frames the file holds.
        timed: whether it says their times.
        texts: names of texts that are stored in a way that VTK does not read.
        lacking: the first array of values of a variable at the nodes that is named, but not there; "" if none.
    """

    kinds: list[tuple[str, int]]
    ids: list[int]
    steps: int
    timed: bool
    texts: list[str]
    lacking: str


def is_hdf(path: Path) -> bool:
    """Whether a file is an HDF5 file."""
    with path.open("rb") as file:
        return file.read(8) == b"\x89HDF\r\n\x1a\n"


def exodus_facts(path: Path) -> ExodusFacts | None:
    """What an Exodus file says; None if it is neither a classic NetCDF file nor an HDF5 file.

    Raises:
        DatasetError: it is cut off or damaged.
    """
    if is_hdf(path):
        return looked_at(path, _facts_of_hdf)
    if not is_classic(path):
        return None
    head = _head(path)
    try:
        return _facts(head.variables, lambda name: head.values(path, name), head.records or 0, [])
    except (ValueError, IndexError) as error:
        raise DatasetError(f"{path}: is cut off or damaged: {error}") from error


def _head(path: Path) -> NetcdfHead:
    """The head of a classic NetCDF file that is whole."""
    try:
        head = read_netcdf_head(path)
        if head.needed > path.stat().st_size:
            raise ValueError(f"it needs {head.needed} bytes")
    except ValueError as error:
        raise DatasetError(f"{path}: is cut off or damaged: the file is shorter than it says: copy it whole") from error
    return head


def _facts_of_hdf(file: h5py.File) -> ExodusFacts:
    arrays = {name: one for name, one in file.items() if isinstance(one, h5py.Dataset)}
    held = {"title": file.attrs, **{f"elem_type of {name}": one.attrs for name, one in arrays.items() if _CELLS(name)}}
    texts = [name for name, attrs in held.items() if _is_of_any_length(attrs, name.partition(" ")[0])]
    moving = [one for name, one in arrays.items() if name == "time_whole" or name.startswith("vals_")]
    steps = max((one.shape[0] for one in moving), default=0)
    return _facts(arrays, lambda name: arrays[name][()], steps, texts)


def _is_of_any_length(attrs: h5py.AttributeManager, name: str) -> bool:
    kind = h5py.check_string_dtype(attrs.get_id(name).dtype) if name in attrs else None
    return kind is not None and kind.length is None


def _facts(arrays: Mapping[str, Any], values: Callable[[str], np.ndarray], steps: int, texts: list[str]) -> ExodusFacts:
    kinds = [_kind_of(one) for name, one in arrays.items() if _CELLS(name)]
    ids = values("eb_prop1").ravel().tolist() if "eb_prop1" in arrays else []
    count = arrays["name_nod_var"].shape[0] if steps and "name_nod_var" in arrays else 0
    wanted = [] if "vals_nod_var" in arrays else [f"vals_nod_var{number}" for number in range(1, count + 1)]
    lacking = next((name for name in wanted if name not in arrays), "")
    return ExodusFacts(kinds, ids, steps, "time_whole" in arrays, texts, lacking)


def node_numbers(path: Path) -> np.ndarray:
    """[n] int64: the numbers that a file gives its nodes.

    Raises:
        DatasetError: it gives none, or is damaged.
    """
    name = "node_num_map"
    if is_hdf(path):
        numbers = looked_at(path, lambda file: file[name][()] if name in file else None)
    else:
        head = _head(path)
        numbers = head.values(path, name) if name in head.variables else None
    if numbers is None:
        raise DatasetError(f"{path}: gives its nodes no numbers ({name}), by which pieces join: use epu to join them")
    return np.asarray(numbers).astype(np.int64)


def _kind_of(cells: Any) -> tuple[str, int]:
    """What an array with the nodes of a block says: the kind of its elements and how many nodes each has."""
    kind = cells.attrs.get("elem_type", b"")
    return (kind.decode("latin-1") if isinstance(kind, bytes) else str(kind)).strip("\0 "), int(cells.shape[-1])


def require_whole_exodus(path: Path) -> ExodusFacts | None:
    """Check that an Exodus file of the classic NetCDF kind has the bytes that its head declares, that results do not go
    on in files with other meshes (job.e-s002 beside job.e), and that VTK reads the blocks as they are.

    Returns:
        What it says, as `exodus_facts`.

    Raises:
        DatasetError: they do, or it is cut off: VTK takes zeros for what is missing; or VTK would take other nodes.
    """
    further = sorted(path.parent.glob(f"{path.name}-s[0-9]*"))
    if further:
        raise DatasetError(f"{path}: goes on in {further[0].name} with another mesh; the mesh must not change")
    facts = exodus_facts(path)
    if facts is None:
        return None
    wrong = [(kind, nodes) for kind, nodes in facts.kinds if nodes not in _NODES.get(kind[:3].upper(), (nodes,))]
    if wrong:
        kind, nodes = wrong[0]
        *known, last = _NODES[kind[:3].upper()]
        raise DatasetError(
            f"{path}: holds {kind} elements of {nodes} nodes, and VTK mistakes which nodes they have: write them with"
            f" {', '.join(map(str, known))} or {last} nodes"
        )
    if any(not kind for kind, _ in facts.kinds):
        raise DatasetError(f"{path}: does not say of which kind a block is: write its elem_type, such as TETRA4")
    twice = next((one for one in facts.ids if facts.ids.count(one) > 1), None)
    if twice is not None:
        raise DatasetError(f"{path}: has two blocks of the number {twice}: give each block a number of its own")
    if facts.lacking:
        raise DatasetError(f"{path}: lacks {facts.lacking}, for which VTK takes zeros: write the file again")
    if facts.texts:
        raise DatasetError(
            f"{path}: its {facts.texts[0]} is a text of any length (NC_STRING), and VTK reads characters (NC_CHAR):"
            " write it in letters of ASCII"
        )
    return facts

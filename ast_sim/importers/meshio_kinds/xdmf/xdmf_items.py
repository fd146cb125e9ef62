"""Numbers of XDMF that are made of other numbers: parts of larger arrays, and columns that are joined.

    HyperSlab     an item with start, stride and count of each axis, and the array that these choose from
    Coordinates   an item with a row of indices for each number, and the array that these choose from
    Function      JOIN($0, $1, ...): the items as the columns of one array; 0*$0: a column of zeros

meshio knows plain numbers alone, so the others are written into a file beside a copy of the XDMF file.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ast_sim.importers.formats.declared_sizes import require_linked_files
from ast_sim.support.errors import DatasetError, counted

_JOIN = re.compile(r"\s*JOIN\s*\(\s*(\$\d+(?:\s*[,;]\s*\$\d+)*)\s*\)\s*", re.IGNORECASE)

_ZEROS = re.compile(r"\s*0\s*\*\s*\$0\s*")

# Coordinates with an array for each axis, and how they are called if they stand in one.
_APART = {"X_Y_Z": "XYZ", "X_Y": "XY"}


def _kind(item: ET.Element) -> str:
    return item.get("ItemType", "Uniform").upper()


def made_of_others(tree: ET.ElementTree[Any]) -> bool:
    """Whether numbers of a file are made of other numbers."""
    return any(_kind(item) != "UNIFORM" for item in tree.iter("DataItem"))


def require_linked(path: Path, tree: ET.ElementTree[Any]) -> None:
    """Check that the HDF5 files of a file have all files from which they take arrays; see `require_linked_files`."""
    items = [item for item in tree.iter("DataItem") if item.get("Format") == "HDF"]
    names = {(item.text or "").strip().rpartition(":")[0] for item in items}
    for file in sorted(path.parent / name for name in names):
        if file.is_file():
            require_linked_files(file)


def with_joined_points(tree: ET.ElementTree[Any]) -> bool:
    """Write coordinates that stand in an array for each axis as one that joins them. Whether there are some."""
    changed = False
    for geometry in tree.iter("Geometry"):
        key = "GeometryType" if "GeometryType" in geometry.attrib else "Type"
        together = _APART.get(geometry.get(key, "").upper())
        items = list(geometry)
        sizes = {int(np.prod(_dimensions(item))) for item in items}
        if together is None or len(items) != len(together) or len(sizes) != 1:
            continue
        changed = True
        for item in items:
            geometry.remove(item)
        geometry.set(key, together)
        operands = ", ".join(f"${number}" for number in range(len(items)))
        size = f"{sizes.pop()} {len(items)}"
        joined = ET.SubElement(geometry, "DataItem", ItemType="Function", Function=f"JOIN({operands})", Dimensions=size)
        joined.extend(items)
    return changed


def write_out(path: Path, tree: ET.ElementTree[Any], folder: Path) -> None:
    """Put plain numbers, in a file of the folder, in the place of numbers that are made of others.

    Raises:
        DatasetError: their meaning is not clear, or they do not fit; the text names the file and the cause.
    """
    made = folder / "items.h5"
    outer = [item for parent in tree.iter() if parent.tag != "DataItem" for item in parent.findall("DataItem")]
    for number, item in enumerate(outer):
        if _kind(item) == "UNIFORM":
            continue
        values = _values(path, item)
        with h5py.File(made, "a") as file:
            file[f"item{number}"] = values
        dimensions = item.get("Dimensions", "")
        item.clear()
        item.attrib.update(Format="HDF", Dimensions=dimensions)
        item.text = f"{made}:/item{number}"


def _values(path: Path, item: ET.Element) -> np.ndarray:
    """The numbers of an item, in the form that it says."""
    kind = _kind(item)
    parts = item.findall("DataItem")
    if kind == "HYPERSLAB" and len(parts) == 2:
        values = _chosen(path, parts[1], lambda array: _slab(path, _values(path, parts[0]), array))
    elif kind == "COORDINATES" and len(parts) == 2:
        values = _chosen(path, parts[1], lambda array: _picked(path, _values(path, parts[0]), array[()]))
    elif kind == "FUNCTION":
        values = _joined(path, item, parts)
    elif kind == "UNIFORM":
        return _plain(path, item, lambda array: array[()])
    else:
        raise DatasetError(
            f"{path}: has numbers of the type {item.get('ItemType')} of {counted(len(parts), 'item')}; must be plain"
            " ones (Uniform)"
        )
    shape = _dimensions(item)
    if values.size != np.prod(shape):
        raise DatasetError(
            f"{path}: numbers of the type {item.get('ItemType')} have the Dimensions {item.get('Dimensions', 'none')},"
            f" but {counted(values.size, 'is', 'are')} chosen"
        )
    return values.reshape(shape)


def _chosen(path: Path, item: ET.Element, choose: Any) -> np.ndarray:
    """What `choose` takes of the array of an item; of a file, this part alone is read."""
    return _plain(path, item, choose) if _kind(item) == "UNIFORM" else choose(_values(path, item))


def _plain(path: Path, item: ET.Element, choose: Any) -> np.ndarray:
    """What `choose` takes of plain numbers.

    Raises:
        DatasetError: they cannot be read.
    """
    from meshio.xdmf.main import XdmfReader

    told = f"{path}: the numbers {(item.text or '').strip()[:60]!r} cannot be read"
    try:
        if item.get("Format") == "HDF":
            name, _, inner = (item.text or "").strip().rpartition(":")
            with h5py.File(path.parent / name, "r") as file:
                return choose(file[inner])
        return choose(XdmfReader(path)._read_data_item(item))
    except DatasetError:
        raise
    except Exception as error:  # of damaged numbers, meshio and h5py raise any
        raise DatasetError(f"{told}: {' '.join(str(error).split())}") from error


def _slab(path: Path, numbers: np.ndarray, array: Any) -> np.ndarray:
    """A part of an array, by start, stride and count of each axis."""
    if numbers.size != 3 * len(array.shape):
        raise DatasetError(
            f"{path}: a HyperSlab has {counted(numbers.size, 'number')} for an array of the shape {tuple(array.shape)};"
            " must be start, stride and count of each axis"
        )
    start, stride, count = numbers.reshape(3, -1).astype(np.int64)
    last = start + (count - 1) * stride
    if (start < 0).any() or (stride < 1).any() or (count < 1).any() or (last >= array.shape).any():
        raise DatasetError(
            f"{path}: a HyperSlab begins at {start.tolist()} and has {count.tolist()} places in steps of"
            f" {stride.tolist()}, which the array of the shape {tuple(array.shape)} has not"
        )
    return np.asarray(array[tuple(map(slice, start.tolist(), (last + 1).tolist(), stride.tolist()))])


def _picked(path: Path, numbers: np.ndarray, array: np.ndarray) -> np.ndarray:
    """The numbers of an array at rows of indices."""
    rows = numbers.astype(np.int64).reshape(-1, array.ndim) if numbers.size % array.ndim == 0 else None
    if rows is None or (rows < 0).any() or (rows >= array.shape).any():
        raise DatasetError(
            f"{path}: Coordinates must be, for each number, an index for each axis of an array of the shape"
            f" {array.shape}"
        )
    return array[tuple(rows.T)]


def _joined(path: Path, item: ET.Element, parts: list[ET.Element]) -> np.ndarray:
    """Items as the columns of one array."""
    said = item.get("Function", "")
    if _ZEROS.fullmatch(said) and len(parts) == 1:
        return np.zeros_like(_values(path, parts[0]))
    match = _JOIN.fullmatch(said)
    order = [int(number) for number in re.findall(r"\d+", match[1])] if match else []
    shape = _dimensions(item)
    fits = bool(order) and max(order) < len(parts) and shape[-1:] == (len(order),)
    columns = [_values(path, parts[number]).ravel() for number in order] if fits else []
    if not columns or len({len(column) for column in columns}) > 1:
        raise DatasetError(
            f"{path}: has numbers by the function {said!r} with the Dimensions {item.get('Dimensions', 'none')}; one"
            " can be read that joins columns of equal length, JOIN($0, $1, $2) with the Dimensions of a column and 3"
        )
    return np.stack(columns, axis=-1)


def _dimensions(item: ET.Element) -> tuple[int, ...]:
    """The Dimensions of an item; one of no numbers where it does not say them."""
    said = item.get("Dimensions", "").split()
    return tuple(map(int, said)) if said and all(text.isdigit() for text in said) else (0,)

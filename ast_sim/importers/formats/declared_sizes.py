"""The sizes that a file declares, compared with what it can hold, before a reader allocates memory for them.

XML files of VTK say how many points and cells each piece has, and each compressed array says what it unpacks to. A few
kilobytes may declare gigabytes. HDF5 files declare the shapes of their arrays.
"""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar
from xml.parsers import expat

import h5py
import numpy as np

from ast_sim.support.errors import DatasetError, counted

# No linear or quadratic cell of VTK has more nodes, apart from Lagrange cells of a high order.
_MOST_NODES = 216

# The bytes of an array of facts on the whole file, such as its time: always this number, more if it declares them.
_FACTS = 1 << 20
_MOST_FACTS = 1 << 26

# What a byte of a file can become: LZMA and zlib pack nothing more tightly than that; as text a number has two bytes.
_RATIO_PACKED = 8192
_RATIO_PLAIN = 4

_CHUNK = 1 << 20
_APPENDED = b"<AppendedData"
_Found = TypeVar("_Found")

_BYTES = {"8": 1, "16": 2, "32": 4, "64": 8}


@dataclass(eq=False)
class Array:
    """A data array of an XML file: what it declares, and the first characters of its data."""

    name: str
    place: str
    attributes: dict[str, str]
    piece: int
    text: str = ""


@dataclass(eq=False)
class Declared:
    """What an XML file of VTK says it holds: points and cells of each piece, its arrays, the files of its pieces."""

    root: dict[str, str] = field(default_factory=dict)
    kind: str = ""
    pieces: list[tuple[int, int]] = field(default_factory=list)
    arrays: list[Array] = field(default_factory=list)
    sources: list[str] = field(default_factory=list)
    appended: str = ""
    data_start: int = 0


def declared_in_xml(path: Path) -> Declared:
    """What an XML file of VTK declares, without its data.

    Raises:
        DatasetError: the file is damaged, or an array is larger than the declared numbers of points and cells allow or
            than the file can hold; the text names the file and the array.
    """
    try:
        declared = _scanned(path)
        _require_sizes(path, declared)
    except (expat.ExpatError, ValueError, LookupError, binascii.Error) as error:
        told = " ".join(str(error).split())
        raise DatasetError(f"{path}: cannot be read as a mesh: it is damaged or no XML file of VTK: {told}") from error
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror}") from error
    return declared


def needed_bytes(declared: Declared) -> int:
    """The bytes of the points, cells and fields that an XML file declares."""
    return sum(_limit(array, declared.pieces) for array in declared.arrays if array.attributes.get("type") != "String")


def _scanned(path: Path) -> Declared:
    """Go through the tags of a file, up to the raw bytes that may follow them."""
    declared = Declared()
    open_tags = []
    parser = expat.ParserCreate()
    parser.buffer_text = False

    def start(tag: str, attributes: dict[str, str]) -> None:
        place = open_tags[-1] if open_tags else ""
        if tag == "VTKFile":
            declared.root = attributes
            declared.kind = attributes.get("type", "")
        elif tag == "Piece":
            declared.sources += [attributes["Source"]] if "Source" in attributes else []
            if "NumberOfPoints" in attributes:
                cells = ("NumberOfCells", "NumberOfVerts", "NumberOfLines", "NumberOfStrips", "NumberOfPolys")
                counts = [int(attributes.get(name, 0)) for name in ("NumberOfPoints", *cells)]
                if min(counts) < 0:
                    raise ValueError(f"a piece has {min(counts)} points or cells")
                declared.pieces.append((counts[0], sum(counts[1:])))
        elif tag == "DataArray":
            if place in ("PointData", "CellData") and not attributes.get("Name"):
                raise ValueError(f"an array of its {place} has no name: name it, or leave it out")
            declared.arrays.append(Array(attributes.get("Name", place), place, attributes, len(declared.pieces) - 1))
        elif tag == "AppendedData":
            declared.appended = attributes.get("encoding", "raw")
        open_tags.append(tag)

    def text(characters: str) -> None:
        if open_tags and open_tags[-1] == "DataArray" and len(declared.arrays[-1].text) < 64:
            declared.arrays[-1].text = (declared.arrays[-1].text + characters).lstrip()[:64]

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda tag: open_tags.pop()
    parser.CharacterDataHandler = text
    before = 0
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            while b"<" in chunk[-len(_APPENDED) :] and (more := file.read(len(_APPENDED))):
                chunk += more  # the tag must not be cut
            mark = chunk.find(_APPENDED)
            if mark >= 0:  # what follows its tag is no text of XML if it is raw
                chunk += file.read(1024)
                end = chunk.index(b"_", chunk.index(b">", mark))
                parser.Parse(chunk[:end])
                declared.data_start = before + end + 1
                return declared
            parser.Parse(chunk)
            before += len(chunk)
    parser.Parse(b"", True)
    return declared


def _require_sizes(path: Path, declared: Declared) -> None:
    size = path.stat().st_size
    compressed = "compressor" in declared.root
    ratio = _RATIO_PACKED if compressed else _RATIO_PLAIN
    header = np.dtype("u8" if declared.root.get("header_type") == "UInt64" else "u4")
    header = header.newbyteorder(">" if declared.root.get("byte_order") == "BigEndian" else "<")
    offsets: set[str] = set()
    for points, cells in declared.pieces:
        if points + cells > ratio * size:
            raise DatasetError(
                f"{path}: declares {counted(points, 'point')} and {counted(cells, 'cell')}, more than a file of"
                f" {size:,} bytes can hold"
            )
    with path.open("rb") as file:
        for array in declared.arrays:
            limit = _limit(array, declared.pieces)
            kind = array.attributes.get("format")
            if kind == "appended":
                offset = array.attributes.get("offset", "")
                if offset in offsets and limit:
                    raise DatasetError(
                        f"{path}: the array {array.name} shares its data with another array; the file is damaged"
                    )
                offsets.add(offset)
            if not compressed or kind not in ("appended", "binary") or array.attributes.get("type") == "String":
                continue
            unpacked = _unpacked(_first_bytes(file, declared, array), header)
            if unpacked > limit:
                raise DatasetError(
                    f"{path}: the array {array.name} unpacks to more than {limit} bytes, which is all that the declared"
                    " numbers of points and cells allow; the file is damaged"
                )


def _limit(array: Array, pieces: list[tuple[int, int]]) -> int:
    """The bytes that an array may have."""
    columns = int(array.attributes.get("NumberOfComponents") or 1)
    if array.place == "FieldData" or not 0 <= array.piece < len(pieces):
        declared = 8 * columns * int(array.attributes.get("NumberOfTuples") or 0)
        return max(_FACTS, min(declared, _MOST_FACTS))
    points, cells = pieces[array.piece]
    rows = points if array.place in ("Points", "PointData") else cells
    if array.place not in ("Points", "PointData", "CellData"):  # of the cells themselves
        columns = 1 if array.name == "types" else _MOST_NODES  # dolfin's offsets are as long as its connectivity
    return rows * columns * _BYTES.get("".join(filter(str.isdigit, array.attributes.get("type", ""))), 8)


def _first_bytes(file: Any, declared: Declared, array: Array) -> bytes:
    """The first bytes of the data of an array, at least three numbers of its header."""
    if array.attributes.get("format") == "binary":
        text = array.text.encode()
    else:
        file.seek(declared.data_start + int(array.attributes.get("offset", 0)))
        text = file.read(64)
        if declared.appended == "raw":
            return text
    text = re.split(rb"[^A-Za-z0-9+/=]", text, maxsplit=1)[0]  # what follows the last array is no data
    text = text[: len(text) // 4 * 4]
    return base64.b64decode(text.partition(b"=")[0][: len(text.partition(b"=")[0]) // 4 * 4] or text)


def _unpacked(data: bytes, header: np.dtype) -> int:
    """What the blocks of an array unpack to: the number of blocks, the size of one, the size of the last (0: whole)."""
    blocks, one, last = (int(number) for number in np.frombuffer(data, header, 3))
    return (blocks - 1) * one + (last or one) if blocks else 0


def stored_in_hdf(path: Path, group: str) -> int:
    """The bytes of all arrays of a group of an HDF5 file.

    Raises:
        DatasetError: the file is damaged, or an array declares more than the file can hold: a small file may declare
            an array of any size.
    """

    def total(file: Any) -> int:
        sizes = [0]

        def look(_: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset) and item.dtype.kind in "iufb":
                if item.nbytes > _RATIO_PACKED * (item.id.get_storage_size() + 1024):
                    raise ValueError(f"{item.name} declares {item.nbytes} bytes, but the file does not hold them")
                sizes.append(item.nbytes)

        file[group].visititems(look)
        return sum(sizes)

    return looked_at(path, total)


def linked_files(path: Path) -> list[Path]:
    """The files from which an HDF5 file takes arrays, by virtual arrays or external links.

    Raises:
        DatasetError: it is damaged.
    """

    def names_in(file: Any) -> set[str]:
        names: set[str] = set()

        def look(_: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset):
                names.update(one.file_name for one in (item.virtual_sources() if item.is_virtual else ()))
            else:
                links = (item.get(name, getlink=True) for name in item)
                names.update(link.filename for link in links if isinstance(link, h5py.ExternalLink))

        look("/", file)
        file.visititems(look)
        return names - {"."}  # the file itself

    return sorted(path.parent / name for name in looked_at(path, names_in))


def require_linked_files(path: Path) -> None:
    """Check that an HDF5 file has all `linked_files`. HDF5 takes zeros for a virtual array whose file is missing, and
    looks for it where the process runs, too.

    Raises:
        DatasetError: one is missing, or the file is damaged.
    """
    missing = next((file for file in linked_files(path) if not file.is_file()), None)
    if missing is not None:
        raise DatasetError(f"{path}: takes numbers from {missing.name}, which is not there: copy it beside this file")


def declared_in_vtkhdf(path: Path) -> list[list[int]]:
    """[points, cells] of each step of a VTKHDF file of an unstructured grid; empty for other types.

    Raises:
        DatasetError: the file is damaged.
    """

    def counts(file: Any) -> list[list[int]]:
        root = file["VTKHDF"]
        kind = root.attrs["Type"]
        if (kind.decode() if isinstance(kind, bytes) else str(kind)) != "UnstructuredGrid":
            return []
        points, cells = root["NumberOfPoints"][:], root["NumberOfCells"][:]
        steps = root.get("Steps")
        if steps is None:
            return [[int(points.sum()), int(cells.sum())]]
        count = int(steps.attrs["NSteps"])
        first = steps["PartOffsets"][:count] if "PartOffsets" in steps else np.arange(count)
        parts = steps["NumberOfParts"][:count] if "NumberOfParts" in steps else np.ones(count, int)
        ranges = [slice(int(start), int(start) + int(length)) for start, length in zip(first, parts, strict=True)]
        of_steps = [[int(points[part].sum()), int(cells[part].sum())] for part in ranges]
        for place, column in (("Point", 0), ("Cell", 1)):
            for name, starts in steps.get(f"{place}DataOffsets", {}).items():
                rows = root[f"{place}Data/{name}"].shape[0]
                _require_each_row_once(name, rows, starts[:count], np.array(of_steps)[:, column])
        return of_steps

    return looked_at(path, counts)


def _require_each_row_once(name: str, rows: int, starts: np.ndarray, lengths: np.ndarray) -> None:
    """Check that each of the rows of a field is of one step, or of several steps that share all of their rows.

    Raises:
        ValueError: two steps share a part of their rows, or some rows are of no step.
    """
    bounds = np.unique(np.stack([starts, starts + lengths], axis=1), axis=0)
    if (bounds[1:, 0] < bounds[:-1, 1]).any():
        raise ValueError(f"two steps share a part of the rows of {name!r}: its offsets are wrong")
    used = int((bounds[:, 1] - bounds[:, 0]).sum())
    if used < rows:
        raise ValueError(f"the steps use {used} of the {rows} rows of {name!r}: its offsets are wrong")


def looked_at(path: Path, look: Callable[[Any], _Found]) -> _Found:
    """What a function finds in an HDF5 file; the errors of h5py become errors that name the file."""
    try:
        with h5py.File(path, "r") as file:
            return look(file)
    except (OSError, KeyError, ValueError, IndexError, TypeError, RuntimeError, AttributeError, MemoryError) as error:
        told = " ".join(str(error).split())
        raise DatasetError(f"{path}: is damaged or no HDF5 file of a mesh: {told}") from error

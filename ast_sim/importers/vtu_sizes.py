"""The sizes that a VTU file declares, compared with what its compressed arrays unpack to.

A few megabytes of zlib or LZMA can unpack to gigabytes. The file says how many points and cells it has, so the size of
each array is known before it is unpacked.
"""

from __future__ import annotations

import base64
import io
import lzma
import zlib
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ast_sim.support.errors import DatasetError

# No linear or quadratic cell of VTK has more nodes.
_MOST_NODES = 27

# The most bytes of an array of facts on the whole file, such as its time.
_FACTS = 1 << 20

_DAMAGED = (ElementTree.ParseError, LookupError, ValueError, OverflowError, EOFError, zlib.error, lzma.LZMAError)


def require_declared_sizes(path: Path) -> None:
    """Check that no compressed array of a VTU file unpacks to more than its points and cells need.

    A file that cannot be understood is left to the reader.

    Raises:
        DatasetError: an array is too large, or two arrays share their data; the text names the file and the array.
    """
    try:
        root, raw = _tree(path.read_bytes())
        compressor = root.get("compressor")
        if compressor is None:
            return
        arrays = list(_arrays(root))
    except _DAMAGED:
        return
    appended = root.find("AppendedData")
    shared = b"" if appended is None else (raw or (appended.text or "").strip().removeprefix("_").encode())
    header = np.dtype("u8" if root.get("header_type") == "UInt64" else "u4")
    header = header.newbyteorder(">" if root.get("byte_order") == "BigEndian" else "<")
    offsets: set[str | None] = set()
    for array, limit in arrays:
        name, kind, offset = array.get("Name", "Points"), array.get("format"), array.get("offset")
        if kind == "appended" and offset in offsets:
            raise DatasetError(f"{path}: the array {name} shares its data with another array; the file is damaged")
        offsets.add(offset)
        encoded = kind == "binary" or not raw
        if kind in ("appended", "binary") and _exceeds(array, shared, encoded, header, compressor, limit):
            raise DatasetError(
                f"{path}: the array {name} unpacks to more than {limit} bytes, which is all that the declared numbers"
                " of points and cells allow; the file is damaged"
            )


def _tree(content: bytes) -> tuple[ElementTree.Element, bytes]:
    """The XML of a file, and its appended data if they are raw bytes."""
    start = content.find(b"<AppendedData")
    if start < 0 or b'encoding="raw"' not in content[start : content.find(b">", start)]:
        return ElementTree.fromstring(content), b""
    begin, end = content.index(b">", start) + 1, content.rindex(b"</AppendedData>")
    return ElementTree.fromstring(content[:begin] + content[end:]), content[begin:end].split(b"_", 1)[1]


def _arrays(root: ElementTree.Element) -> Iterator[tuple[ElementTree.Element, int]]:
    """Each array of a file, and the bytes that it may have."""
    size = {"8": 1, "16": 2, "32": 4, "64": 8}
    for piece in root.iter("Piece"):
        points, cells = int(piece.attrib["NumberOfPoints"]), int(piece.attrib["NumberOfCells"])
        for place in piece:
            rows = points if place.tag in ("Points", "PointData") else cells
            for array in place.iter("DataArray"):
                columns = int(array.get("NumberOfComponents") or 1)
                if place.tag == "Cells":
                    columns = 1 if array.get("Name") in ("offsets", "types") else _MOST_NODES
                yield array, rows * columns * size["".join(filter(str.isdigit, array.get("type", "")))]
    for array in root.iterfind("UnstructuredGrid/FieldData/DataArray"):
        yield array, _FACTS


def _exceeds(
    array: ElementTree.Element, shared: bytes, encoded: bool, header: np.dtype, compressor: str, limit: int
) -> bool:
    """Whether an array unpacks to more than `limit` bytes. Its data start with the number of blocks, the size of a
    block, the size of the last block and the compressed sizes of all blocks. Where they are damaged, the reader fails.
    """

    def read(start: int, count: int) -> bytes:
        """`count` bytes of the part that starts at `start`."""
        if encoded:
            return base64.b64decode(data[start : start + -(-count // 3) * 4])[:count]
        return data[start : start + count]

    left = limit + 1
    try:
        appended = array.get("format") == "appended"
        data = shared[int(array.get("offset", 0)) :] if appended else (array.text or "").strip().encode()
        length = (3 + int(np.frombuffer(read(0, header.itemsize), header)[0])) * header.itemsize
        sizes = np.frombuffer(read(0, length), header)[3:]
        packed = io.BytesIO(read(-(-length // 3) * 4 if encoded else length, int(sizes.sum(dtype=np.uint64))))
        for size in sizes.tolist():
            block = packed.read(size)
            if compressor == "vtkZLibDataCompressor":
                left -= len(zlib.decompressobj().decompress(block, left))
            else:
                with lzma.LZMAFile(io.BytesIO(block)) as unpacked:
                    left -= unpacked.seek(left)  # unpacks so many bytes, or all, and keeps none
            if left == 0:
                return True
    except _DAMAGED:
        pass
    return False

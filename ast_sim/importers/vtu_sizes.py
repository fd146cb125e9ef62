"""The sizes that a VTU file declares, compared with what its compressed arrays unpack to.

A few megabytes of zlib or LZMA can unpack to gigabytes. The file says how many points and cells it has, so the size of
each array is known before it is unpacked.
"""

from __future__ import annotations

import base64
import lzma
import zlib
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ast_sim.support.errors import DatasetError

# No linear or quadratic cell of VTK has more nodes.
_MOST_NODES = 27

# Unpacking goes in pieces of so many bytes. An array of facts on the whole file, such as its time, has at most one.
_PIECE = 1 << 20


def require_declared_sizes(path: Path) -> None:
    """Check that no compressed array of a VTU file unpacks to more than its points and cells need.

    A file that cannot be understood is left to the reader.

    Raises:
        DatasetError: an array is too large, or two arrays share their data; the text names the file and the array.
    """
    content = path.read_bytes()
    try:
        root, raw = _tree(content)
        if root.get("compressor") is None:
            return
        arrays = list(_arrays(root))
    except (ElementTree.ParseError, LookupError, ValueError):
        return
    appended = root.find("AppendedData")
    shared = b"" if appended is None else (raw or (appended.text or "").strip().removeprefix("_").encode())
    header = np.dtype({"UInt64": "u8", "UInt32": "u4"}.get(root.get("header_type", "UInt32"), "u4"))
    header = header.newbyteorder(">" if root.get("byte_order") == "BigEndian" else "<")
    offsets: set[str] = set()
    for array, limit in arrays:
        kind, name, offset = array.get("format"), array.get("Name", "Points"), array.get("offset", "0")
        if kind == "appended" and offset in offsets:
            raise DatasetError(f"{path}: the array {name} shares its data with another array; the file is damaged")
        offsets |= {offset} if kind == "appended" else set()
        data = shared[int(offset) :] if kind == "appended" else (array.text or "").strip().encode()
        encoded = kind == "binary" or not raw
        if kind in ("appended", "binary") and _exceeds(data, encoded, header, root.attrib["compressor"], limit):
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
        yield array, _PIECE


def _exceeds(data: bytes, encoded: bool, header: np.dtype, compressor: str, limit: int) -> bool:
    """Whether an array unpacks to more than `limit` bytes. Its data start with the number of blocks, the size of a
    block, the size of the last block and the compressed sizes of all blocks."""

    def read(start: int, count: int) -> bytes:
        """`count` bytes of the part that starts at `start`."""
        if not encoded:
            return data[start : start + count]
        try:
            return base64.b64decode(data[start : start + -(-count // 3) * 4])[:count]
        except ValueError:
            return b""

    first = np.frombuffer(read(0, header.itemsize), header)
    if len(first) == 0:
        return False
    length = (3 + int(first[0])) * header.itemsize
    sizes = np.frombuffer(read(0, min(length, len(data)) // header.itemsize * header.itemsize), header)[3:]
    if len(sizes) < int(first[0]):
        return False
    packed = read(-(-length // 3) * 4 if encoded else length, int(sizes.sum(dtype=np.uint64)))
    ends = np.cumsum(sizes.astype(np.int64))
    total = 0
    for start, end in zip(ends - sizes.astype(np.int64), ends, strict=True):
        for count in _unpacked(packed[start:end], compressor):
            total += count
            if total > limit:
                return True
    return False


def _unpacked(block: bytes, compressor: str) -> Iterator[int]:
    """The sizes of the pieces of a block, as they are unpacked."""
    if compressor == "vtkZLibDataCompressor":
        stream = zlib.decompressobj()
        while block and not stream.eof:
            try:
                piece = stream.decompress(block, _PIECE)
            except zlib.error:
                return
            yield len(piece)
            block = stream.unconsumed_tail
        return
    while block:  # an LZMA block may hold several streams
        unpacker = lzma.LZMADecompressor()
        while not unpacker.eof:
            try:
                piece = unpacker.decompress(block, _PIECE)
            except (lzma.LZMAError, EOFError):
                return
            yield len(piece)
            block = b""
            if unpacker.needs_input:
                return
        block = unpacker.unused_data

"""Reading TFRecord files of `tf.train.Example` messages without TensorFlow; nothing in them is trusted.

A file is a sequence of records: u64 length, u32 masked CRC-32C of these eight bytes, payload, u32 masked CRC-32C of the
payload; all little-endian (TensorFlow, `core/lib/io/record_writer.h`). A payload is a message in the wire format of
protobuf (`core/example/feature.proto`):

    Example   { Features features = 1 }
    Features  { map<string, Feature> feature = 1 }
    Feature   { oneof kind { BytesList bytes_list = 1; FloatList float_list = 2; Int64List int64_list = 3 } }
    BytesList { repeated bytes value = 1 }

A map is a repeated message {key = 1, value = 2}. So all fields down to the bytes are length-delimited; other fields are
refused. Each length is compared with the number of bytes left before anything is read or allocated.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator
from itertools import islice
from pathlib import Path
from typing import Self

from ast_sim.support.errors import DatasetError, require

_HEADER = struct.Struct("<QI")
_CHECKSUM = struct.Struct("<I")
_LENGTH_DELIMITED = 2
_VARINT_BYTES = 10  # of a number of 64 bits
_KINDS = {2: "a float_list", 3: "an int64_list"}

Span = tuple[int, int]  # first byte, and the byte after the last


class RecordFile:
    """Reads the records of a TFRecord file, one after the other; a context manager.

    Raises:
        DatasetError: the file is truncated or damaged; the text names the file, the record and its first byte.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise DatasetError(f"{self.path}: there is no such file")
        try:
            self._file = open(self.path, "rb")  # noqa: SIM115 (closed by close)
        except OSError as error:
            raise DatasetError(f"{self.path}: cannot be read: {error}") from error
        self._left = os.fstat(self._file.fileno()).st_size
        self._start = 0
        self.count = 0  # records read so far

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    @property
    def at_end(self) -> bool:
        return self._left == 0

    def read(self) -> bytes:
        """The payload of the next record; both checksums are compared."""
        header = self._take(_HEADER.size, "header")
        length, checksum = _HEADER.unpack(header)
        if masked_crc(header[:8]) != checksum:
            self._fail("the checksum of its length does not fit: the file is damaged or no TFRecord file")
        if length > self._left - _CHECKSUM.size:
            self._fail(f"it declares {length} bytes, but {self._left} are left: the file is truncated or damaged")
        payload = self._take(length, "payload")
        (checksum,) = _CHECKSUM.unpack(self._take(_CHECKSUM.size, "checksum"))
        if masked_crc(payload) != checksum:
            self._fail(f"the checksum of its {length} bytes does not fit: the file is damaged")
        self._start += _HEADER.size + length + _CHECKSUM.size
        self.count += 1
        return payload

    def _take(self, size: int, what: str) -> bytes:
        if size > self._left:
            self._fail(f"its {what} has {size} bytes, but {self._left} are left: the file is truncated")
        try:
            found = self._file.read(size)
        except OSError as error:
            raise DatasetError(f"{self.path}: cannot be read: {error}") from error
        if len(found) < size:
            self._fail(f"only {len(found)} of {size} bytes of its {what} could be read: the file was cut meanwhile")
        self._left -= size
        return found

    def _fail(self, what: str) -> None:
        raise DatasetError(f"{self.path}: record {self.count} at byte {self._start}: {what}")


def masked_crc(data: bytes) -> int:
    """The checksum of TFRecord: CRC-32C, rotated to the right by 15 bits, plus a constant.

    Raises:
        MissingExtra: google-crc32c is not installed.
    """
    (google_crc32c,) = require("tfrecord", "google_crc32c")
    crc = google_crc32c.value(data)
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def find_values(payload: bytes, names: Collection[str], where: str) -> dict[str, Span]:
    """Find the values of features in an `Example`.

    Args:
        payload: the message.
        names: the features to find; other features are ignored.
        where: the file and the record, for messages.

    Returns:
        The span of the value of each feature that the message has.

    Raises:
        DatasetError: the payload is no `Example`, or a feature to find occurs twice or is not one value of bytes. The
            text names `where` and what is wrong.
    """
    wanted = {name.encode(): name for name in names}
    longest = max(map(len, wanted), default=0)
    found: dict[str, Span] = {}
    for features in _fields(payload, (0, len(payload)), "Example", (1,), where):
        for entry in _fields(payload, features[1], "Features", (1,), where):
            key, feature = _entry(payload, entry[1], where)
            # A key that is longer than all names is not copied.
            name = wanted.get(payload[slice(*key)]) if key[1] - key[0] <= longest else None
            if name is None:
                continue
            if name in found:
                raise DatasetError(f"{where}: the feature {name} is there twice")
            found[name] = _bytes_value(payload, feature, f"{where}: the feature {name}")
    return found


def _entry(payload: bytes, span: Span, where: str) -> tuple[Span, Span]:
    """The key and the value of an entry of the map; a missing one is empty."""
    found: dict[int, Span] = {}
    for number, part in _fields(payload, span, "an entry of Features", (1, 2), where):
        if number in found:
            raise DatasetError(f"{where}: an entry of Features at byte {span[0]} of the record has two keys or values")
        found[number] = part
    return found.get(1, (0, 0)), found.get(2, (0, 0))


def _bytes_value(payload: bytes, span: Span, where: str) -> Span:
    """The one value of a `Feature` that holds a BytesList."""
    # There may be millions of lists; two are enough to see that there are too many.
    lists = list(islice(_fields(payload, span, "Feature", (1, 2, 3), where), 2))
    if len(lists) != 1 or lists[0][0] != 1:
        kind = _KINDS.get(lists[0][0], "several lists") if lists else "nothing"
        raise DatasetError(f"{where} holds {kind}; must be a bytes_list, the raw bytes of an array")
    values = list(islice(_fields(payload, lists[0][1], "BytesList", (1,), where), 2))
    if len(values) != 1:
        count = "no value" if not values else "several values"
        raise DatasetError(f"{where} holds {count}; must have one, the raw bytes of an array")
    return values[0][1]


def _fields(payload: bytes, span: Span, message: str, known: tuple[int, ...], where: str) -> Iterator[tuple[int, Span]]:
    """The number and the span of each field of the message in `span`."""
    at, end = span
    while at < end:
        start = at
        tag, at = _varint(payload, at, end, where)
        number, wire_type = tag >> 3, tag & 7
        if number not in known or wire_type != _LENGTH_DELIMITED:
            raise DatasetError(
                f"{where}: {message} has a field {number} of wire type {wire_type} at byte {start} of the record:"
                " this is no tf.train.Example"
            )
        length, at = _varint(payload, at, end, where)
        if length > end - at:
            raise DatasetError(
                f"{where}: field {number} of {message} at byte {start} of the record declares {length} bytes,"
                f" but {end - at} are left"
            )
        yield number, (at, at + length)
        at += length


def _varint(payload: bytes, at: int, end: int, where: str) -> tuple[int, int]:
    """The number that starts at byte `at`, seven bits in each byte, the lowest first; and the byte after it."""
    value = 0
    for shift, byte in enumerate(payload[at : min(end, at + _VARINT_BYTES)]):
        value |= (byte & 0x7F) << 7 * shift
        if byte < 0x80:
            return value, at + shift + 1
    raise DatasetError(f"{where}: the number at byte {at} of the record has no end: this is no tf.train.Example")

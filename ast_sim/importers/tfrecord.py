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

import contextlib
import struct
from collections.abc import Collection, Iterator
from itertools import count, islice
from pathlib import Path
from typing import BinaryIO

from ast_sim.support.errors import DatasetError, counted, require

_HEADER = struct.Struct("<QI")
_CHECKSUM = struct.Struct("<I")
_LENGTH_DELIMITED = 2
_VARINT_BYTES = 10  # of a number of 64 bits
_KINDS = {2: "a float_list", 3: "an int64_list"}

Span = tuple[int, int]  # first byte, and the byte after the last


def read_records(path: Path) -> Iterator[bytes]:
    """The payloads of the records of a TFRecord file, one after the other; all checksums are compared.

    Raises:
        DatasetError: the file is empty, truncated or damaged; the text names the file, the record and its first byte.
    """
    if not path.is_file():
        raise DatasetError(f"{path}: there is no such file")
    try:
        size = path.stat().st_size
        if size == 0:
            raise DatasetError(f"{path}: is empty: download it again")
        with open(path, "rb") as file:
            for index in count():
                if file.tell() == size:
                    return
                # The payload has no name here, so its memory is free before the next one is read.
                yield _payload(file, size, f"{path}: record {index} at byte {file.tell()}")
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error}") from error


def count_records(path: Path, limit: int | None = None) -> int:
    """The number of records of a TFRecord file by their lengths alone, at most `limit`; 0 where there is no file. In a
    damaged file it means nothing."""
    number = 0
    place = 0
    with contextlib.suppress(OSError), open(path, "rb") as file:
        size = path.stat().st_size
        while number != limit and place < size:
            file.seek(place)
            place += _HEADER.size + int.from_bytes(file.read(8), "little") + _CHECKSUM.size
            number += 1
    return number


def _payload(file: BinaryIO, size: int, where: str) -> bytes:
    """The payload of the record that starts here in a file of this size."""

    def take(count: int, what: str) -> bytes:
        data = file.read(count)
        if len(data) < count:
            raise DatasetError(
                f"{where}: its {what} has {counted(count, 'byte')}, but {counted(len(data), 'is', 'are')} left: the"
                " file is truncated"
            )
        return data

    header = take(_HEADER.size, "header")
    length, checksum = _HEADER.unpack(header)
    if masked_crc(header[:8]) != checksum:
        raise DatasetError(f"{where}: the checksum of its length does not fit: the file is damaged or no TFRecord file")
    left = size - file.tell()
    if length > left - _CHECKSUM.size:
        raise DatasetError(
            f"{where}: it declares {counted(length, 'byte')}, but {counted(left, 'is', 'are')} left: the file is"
            " truncated or damaged"
        )
    payload = take(length, "payload")
    if _CHECKSUM.pack(masked_crc(payload)) != take(_CHECKSUM.size, "checksum"):
        raise DatasetError(f"{where}: the checksum of its {counted(length, 'byte')} does not fit: the file is damaged")
    return payload


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
    wanted: dict[bytes | memoryview, str] = {name.encode(): name for name in names}
    view = memoryview(payload)  # keys are looked up without a copy
    spans: dict[str, Span] = {}
    for _, features in _fields(payload, (0, len(payload)), "Example", (1,), where):
        for _, entry in _fields(payload, features, "Features", (1,), where):
            parts = list(islice(_fields(payload, entry, "an entry of Features", (1, 2), where), 3))
            key, feature = (dict(parts).get(number, (0, 0)) for number in (1, 2))  # a missing one is empty
            if len(dict(parts)) < len(parts):
                raise DatasetError(
                    f"{where}: an entry of Features at byte {entry[0]} of the record has two keys or values"
                )
            name = wanted.get(view[slice(*key)])
            if name is None:
                continue
            if name in spans:
                raise DatasetError(f"{where}: the feature {name} is there twice")
            spans[name] = _bytes_value(payload, feature, f"{where}: the feature {name}")
    return spans


def _bytes_value(payload: bytes, span: Span, where: str) -> Span:
    """The one value of a `Feature` that holds a BytesList."""
    # There may be millions of lists or values; two are enough to see that there are too many.
    lists = list(islice(_fields(payload, span, "Feature", (1, 2, 3), where), 2))
    kind = lists[0][0] if lists else 0
    if len(lists) == 1 and kind == 1:
        values = list(islice(_fields(payload, lists[0][1], "BytesList", (1,), where), 2))
        if len(values) == 1:
            return values[0][1]
        held = "several values" if values else "no value"
    else:
        held = _KINDS.get(kind, "several lists") if lists else "nothing"
    raise DatasetError(f"{where} holds {held}; must be a bytes_list of one value, the raw bytes of an array")


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
                f"{where}: field {number} of {message} at byte {start} of the record declares"
                f" {counted(length, 'byte')}, but {counted(end - at, 'is', 'are')} left"
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

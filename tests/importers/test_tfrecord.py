"""TFRecord files and the messages in them: what is read, and how everything else is refused."""

import struct
import sys

import numpy as np
import pytest
from deepmind_samples import bytes_feature, crc32c, entry, example, field, frame, varint

from ast_sim.importers.tfrecord import find_values, masked_crc, read_records
from ast_sim.support.errors import DatasetError, MissingExtra


def values(payload: bytes, *names: str) -> dict[str, bytes]:
    return {name: payload[slice(*span)] for name, span in find_values(payload, names, "here").items()}


def test_checksums_follow_the_definition():
    """RFC 3720, B.4; and the checksum of TFRecord that TensorFlow's own tests give for no bytes at all."""
    assert crc32c(b"123456789") == 0xE3069283
    assert crc32c(bytes(32)) == 0x8A9136AA
    assert crc32c(bytes(range(32))) == 0x46DD794E
    assert masked_crc(b"") == 0xA282EAD8
    for size in (1, 7, 8, 100, 1000):
        data = np.random.default_rng(size).bytes(size)
        assert frame(data) == struct.pack("<QI", size, masked_crc(struct.pack("<Q", size))) + data + struct.pack(
            "<I", masked_crc(data)
        )


def test_a_missing_checksum_package_is_named(tmp_path, monkeypatch):
    path = tmp_path / "a.tfrecord"
    path.write_bytes(frame(b"one"))
    monkeypatch.setitem(sys.modules, "google_crc32c", None)
    with pytest.raises(MissingExtra, match=r'google_crc32c .* pip install "ast_sim\[tfrecord\]"'):
        list(read_records(path))


def test_records_come_in_order(tmp_path):
    given = [b"", b"one", bytes(range(256)) * 40]
    path = tmp_path / "a.tfrecord"
    path.write_bytes(b"".join(map(frame, given)))
    assert list(read_records(path)) == given
    path.write_bytes(b"")
    with pytest.raises(DatasetError, match=f"{path}: is empty"):
        list(read_records(path))


LENGTH = frame(b"")[:12]  # a valid header of a record of no bytes


def header(length: int) -> bytes:
    packed = struct.pack("<Q", length)
    return packed + struct.pack("<I", masked_crc(packed))


FILES = {
    "half a header": (b"\x00" * 11, "record 1 at byte 19: its header has 12 bytes, but 11 are left"),
    "no header": (b"\x00" * 12, "record 1 at byte 19: the checksum of its length does not fit"),
    "no payload": (LENGTH, "record 1 at byte 19: it declares 0 bytes, but 0 are left"),
    "half a payload": (frame(b"payload")[:16], "it declares 7 bytes, but 4 are left"),
    "half a checksum": (frame(b"payload")[:-1], "it declares 7 bytes, but 10 are left"),
    "another payload": (frame(b"payload").replace(b"pay", b"pax"), "the checksum of its 7 bytes does not fit"),
    "another checksum": (frame(b"payload")[:-1] + b"!", "the checksum of its 7 bytes does not fit"),
    "2^63": (header(1 << 63), "it declares 9,223,372,036,854,775,808 bytes, but 0 are left"),
    "2^64 - 1": (header((1 << 64) - 1) + bytes(100), "it declares 18,446,744,073,709,551,615 bytes, but 100 are left"),
    "one too many": (header(6) + bytes(9), "it declares 6 bytes, but 9 are left"),
}


@pytest.mark.parametrize("case", FILES)
def test_a_damaged_file_is_named(tmp_path, case):
    content, message = FILES[case]
    path = tmp_path / "a.tfrecord"
    path.write_bytes(frame(b"one") + content)
    with pytest.raises(DatasetError, match=message) as error:
        list(read_records(path))
    assert str(error.value).startswith(f"{path}: record 1 at byte 19: ")


def test_a_file_that_shrinks_while_it_is_read(tmp_path):
    path = tmp_path / "a.tfrecord"
    whole = 2 * frame(bytes(100_000))
    path.write_bytes(whole)
    records = read_records(path)
    next(records)
    path.write_bytes(whole[:150_000])
    with pytest.raises(
        DatasetError, match="record 1 at byte 100016: its payload has 100,000 bytes, but 49,972 are left"
    ):
        next(records)


def test_no_file(tmp_path):
    for path in (tmp_path, tmp_path / "none.tfrecord"):
        with pytest.raises(DatasetError, match=f"{path}: there is no such file"):
            next(read_records(path))


def test_features_are_found_by_name():
    payload = example({"a": np.arange(3, dtype="<i4"), "bb": np.zeros(0), "c": np.ones(50, "<f4")})
    assert values(payload, "a", "bb", "d") == {"a": b"\0\0\0\0\1\0\0\0\2\0\0\0", "bb": b""}
    assert values(payload, "c")["c"] == np.ones(50, "<f4").tobytes()
    assert values(b"", "a") == {} and values(payload) == {}


def test_what_the_wire_format_allows_is_read():
    """Features in several parts, keys after values, entries without a key, and numbers with more bytes than needed."""
    key, value = field(1, b"a"), field(2, bytes_feature(b"first"))
    swapped = field(1, field(1, value + key))
    nameless = field(1, field(1, field(2, bytes_feature(b"second"))))
    assert values(swapped + nameless, "a", "") == {"a": b"first", "": b"second"}
    long = b"\x8a\x80\x00" + b"\x9f\x80\x80\x80\x80\x80\x80\x80\x80\x00"  # field 1, 31 bytes
    assert values(long + entry("b", bytes_feature(bytes(20))), "b") == {"b": bytes(20)}


def feature(content: bytes) -> bytes:
    return field(1, entry("a", content))


MESSAGES = {
    "a number": (b"\x08\x01", "Example has a field 1 of wire type 0 at byte 0"),
    "a fixed number": (field(1, b"\x0d\0\0\0\0"), "Features has a field 1 of wire type 5 at byte 2"),
    "a group": (field(1, field(1, b"\x0b\x0c")), "an entry of Features has a field 1 of wire type 3 at byte 4"),
    "another field": (field(2, b""), "Example has a field 2 of wire type 2"),
    "field 0": (b"\x02\x00", "Example has a field 0 of wire type 2"),
    "too long": (b"\x0a\x05abcd", "field 1 of Example at byte 0 of the record declares 5 bytes, but 4 are left"),
    "2^63": (b"\x0a" + varint(1 << 63), "declares 9,223,372,036,854,775,808 bytes, but 0 are left"),
    "nested and too long": (
        feature(b"\x0a\x7f" + bytes(9)),
        "field 1 of Feature .* declares 127 bytes, but 9 are left",
    ),
    "2^63 in the list": (
        feature(field(1, b"\x0a" + varint(1 << 63))),
        "field 1 of BytesList .* 9,223,372,036,854,775,808",
    ),
    "no end": (b"\x0a\xff\xff", "the number at byte 1 of the record has no end"),
    "eleven bytes": (b"\x0a" + b"\x80" * 10 + b"\x00", "the number at byte 1 of the record has no end"),
    "an end beyond": (feature(b"\x0a"), "the number at byte 10 of the record has no end"),
    "floats": (feature(field(2, bytes(4))), "the feature a holds a float_list; must be a bytes_list"),
    "integers": (feature(field(3, bytes(1))), "the feature a holds an int64_list"),
    "two lists": (feature(2 * bytes_feature(b"x")), "the feature a holds several lists"),
    "an empty feature": (feature(b""), "the feature a holds nothing"),
    "no value": (feature(field(1, b"")), "the feature a holds no value"),
    "two values": (feature(field(1, 2 * field(1, b"x"))), "the feature a holds several values"),
    "text": (feature(b"some text"), "Feature has a field 14 of wire type 3"),
    "twice": (field(1, 2 * entry("a", bytes_feature(b"x"))), "the feature a is there twice"),
    "two keys": (field(1, field(1, field(1, b"a") + field(1, b"a"))), "has two keys or values"),
}


@pytest.mark.parametrize("case", MESSAGES)
def test_a_wrong_message_is_named(case):
    payload, message = MESSAGES[case]
    with pytest.raises(DatasetError, match=message) as error:
        values(payload, "a")
    assert str(error.value).startswith("here: ")

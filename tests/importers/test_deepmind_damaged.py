"""A thousand mutations of each file of MeshGraphNets data: one clear error, or numbers that pass every check."""

import random
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from deepmind_samples import FAMILIES, bytes_feature, entry, example, field, frame, meta, records, varint, write

from ast_sim.importers.deepmind import convert_deepmind, read_trajectories
from ast_sim.importers.deepmind_meta import read_meta
from ast_sim.importers.tfrecord import read_records
from ast_sim.support.errors import DatasetError

BY_TENSORFLOW = Path(__file__).parent / "deepmind"
MUTATIONS = 1000
# Messages, views and the like, which do not grow with the file.
FIXED_BYTES = 1 << 15
HUGE = (1 << 63, (1 << 63) - 1, (1 << 64) - 1, 1 << 31, 1 << 32)


def flip(data: bytes, dice: random.Random) -> bytes:
    found = bytearray(data)
    for _ in range(dice.choice((1, 1, 2, 8))):
        found[dice.randrange(len(found))] ^= 1 << dice.randrange(8)
    return bytes(found)


def cut(data: bytes, dice: random.Random) -> bytes:
    return data[: dice.randrange(len(data))]


def insert(data: bytes, dice: random.Random) -> bytes:
    at = dice.randrange(len(data))
    return data[:at] + dice.randbytes(dice.choice((1, 4, 100))) + data[at:]


def remove(data: bytes, dice: random.Random) -> bytes:
    at = dice.randrange(len(data))
    return data[:at] + data[at + dice.choice((1, 4, 100)) :]


def overwrite(data: bytes, dice: random.Random) -> bytes:
    """A block of one value, of noise, or a length that no file has."""
    at = dice.randrange(len(data))
    block = dice.choice((bytes(16), b"\xff" * 16, dice.randbytes(16), *(struct.pack("<Q", huge) for huge in HUGE)))
    return (data[:at] + block + data[at + len(block) :])[: len(data)]


def huge_record(data: bytes, dice: random.Random) -> bytes:
    """The length of the first record, with a checksum that fits."""
    return frame_header(dice.choice(HUGE)) + data[12:]


def frame_header(length: int) -> bytes:
    """The header of a record which has as its payload the eight bytes of the length: the checksum is the same."""
    packed = struct.pack("<Q", length)
    return packed + frame(packed)[-4:]


FILE_MUTATIONS = (flip, flip, cut, insert, remove, overwrite, huge_record)


def structure(data: bytes, names: list[str], dice: random.Random) -> int:
    """A place near the name of a feature, where tags and lengths are, or, rarely, any."""
    at = data.find(dice.choice(names).encode())
    return dice.randrange(len(data)) if at < 0 else min(len(data) - 1, max(0, at + dice.randrange(-8, 24)))


def flip_structure(data: bytes, names: list[str], dice: random.Random) -> bytes:
    found = bytearray(data)
    found[structure(data, names, dice)] ^= 1 << dice.randrange(8)
    return bytes(found)


def huge_length(data: bytes, names: list[str], dice: random.Random) -> bytes:
    at = structure(data, names, dice)
    return data[:at] + varint(dice.choice(HUGE)) + data[at + 1 :]


def noise_in_structure(data: bytes, names: list[str], dice: random.Random) -> bytes:
    at = structure(data, names, dice)
    return data[:at] + dice.randbytes(dice.randrange(1, 12)) + data[at + dice.randrange(12) :]


def nested(data: bytes, names: list[str], dice: random.Random) -> bytes:
    """Messages in messages, by the hundred, noise in the innermost; as a further feature or in place of everything."""
    inner = dice.randbytes(dice.randrange(20))
    for _ in range(dice.choice((1, 3, 10, 300))):
        inner = field(dice.choice((1, 1, 1, 2, 3)), inner)
    extra = field(1, entry(dice.choice([*names, "other"]), inner))
    return dice.choice((inner, data + extra, extra + data))


def many(data: bytes, names: list[str], dice: random.Random) -> bytes:
    """Hundreds of empty fields: of values, of features, of maps."""
    count = dice.randrange(1, 400)
    values = bytes_feature(b"") if dice.random() < 0.5 else field(1, field(1, b"") * count)
    extra = dice.choice((field(1, entry(names[0], values)), field(1, b"") * count, field(1, field(1, b"") * count)))
    return dice.choice((data + extra, extra + data))


def any_byte(mutate):
    return lambda data, names, dice: mutate(data, dice)


PAYLOAD_MUTATIONS = (
    flip_structure,
    flip_structure,
    huge_length,
    noise_in_structure,
    nested,
    many,
    *map(any_byte, (flip, cut, insert, remove, overwrite)),
)


def read_all(path: Path, meta) -> int:
    """What the conversion reads and checks; the number of trajectories."""
    count = 0
    for trajectory in read_trajectories(path, meta):
        trajectory.check(f"{path}: record {count}")
        count += 1
        del trajectory
    return count


@pytest.fixture(autouse=True, scope="module")
def loaded(tmp_path_factory):
    """A reading that is not measured: the memory of what is imported at the first one is not the file's."""
    for family in FAMILIES:
        source = write(tmp_path_factory.mktemp(family), family)
        read_all(source / "test.tfrecord", read_meta(source / "meta.json"))


def peak_of(call) -> int:
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def outcome(path: Path, meta, data: bytes) -> str | None:
    """The error that reading these bytes gives, None if they are read; the memory that it took is bounded."""
    path.touch()
    with open(path, "r+b") as file:  # written over, not replaced: some file systems wait for the disk then
        file.write(data)
        file.truncate()
    errors = []

    def read() -> None:
        try:
            read_all(path, meta)
        except DatasetError as found:
            errors.append(str(found))

    peak = peak_of(read)
    assert peak < 2 * len(data) + FIXED_BYTES, (peak, len(data), errors)
    for error in errors:
        assert error.startswith(f"{path}: ") and "\n" not in error and len(error) < 400, error
    return errors[0] if errors else None


def source_of(tmp_path: Path, family: str, writer: str) -> Path:
    return BY_TENSORFLOW / family if writer == "TensorFlow" else write(tmp_path, family)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("writer", ["TensorFlow", "the definition"])
def test_every_mutation_of_a_file_is_found(tmp_path, family, writer):
    """The checksums see all of them, but a file that ends with a whole record."""
    source = source_of(tmp_path, family, writer)
    told = read_meta(source / "meta.json")
    data, path, dice = (source / "test.tfrecord").read_bytes(), tmp_path / "test.tfrecord", random.Random(1)
    assert outcome(path, told, data) is None
    (first,) = struct.unpack_from("<Q", data)
    found = []
    for index in range(MUTATIONS):
        mutated = FILE_MUTATIONS[index % len(FILE_MUTATIONS)](data, dice)
        found.append(outcome(path, told, mutated) or "")
        assert found[-1] or mutated in (data, data[: first + 16]), index
    for message in ("the checksum of its length does", "bytes does not fit", "it declares"):
        assert any(message in error for error in found), message


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("writer", ["TensorFlow", "the definition"])
def test_every_mutation_under_a_right_checksum_is_an_error_or_other_numbers(tmp_path, family, writer):
    source = source_of(tmp_path, family, writer)
    told = read_meta(source / "meta.json")
    payload = next(read_records(source / "valid.tfrecord"))
    path, dice, names = tmp_path / "valid.tfrecord", random.Random(2), list(told.features)
    assert outcome(path, told, frame(payload)) is None
    found = []
    for index in range(MUTATIONS):
        mutated = PAYLOAD_MUTATIONS[index % len(PAYLOAD_MUTATIONS)](payload, names, dice)
        found.append(outcome(path, told, frame(mutated)) or "")
    assert 0.02 * MUTATIONS < found.count("") < 0.4 * MUTATIONS
    for message in (
        "are left", "has no end", "this is no tf.train.Example", "has no feature", "is there twice", "several values",
        "must be a bytes_list", "refers to node",
    ):  # fmt: skip
        assert any(message in error for error in found), message


def frames_of(arrays: dict[str, np.ndarray], **changes: np.ndarray) -> bytes:
    return frame(example({**arrays, **changes}))


def test_the_memory_of_a_large_record_is_bounded(tmp_path):
    """One record of 1.5 MB with what takes most: many frames, many cells, numbers that are not finite, a cut end."""
    changes = {"trajectory_length": 64, "features": meta("deforming_plate")["features"]}
    for name in ("world_pos", "stress"):
        changes["features"][name]["shape"][0] = 64
    source = write(tmp_path, "deforming_plate", changes)
    nodes, told, path = 1200, read_meta(source / "meta.json"), source / "train.tfrecord"
    cells = records("deforming_plate", "train")[0]["cells"]
    arrays = {
        "cells": cells,
        "node_type": np.zeros((1, nodes, 1), "<i4"),
        "mesh_pos": np.zeros((1, nodes, 3), "<f4"),
        "world_pos": np.arange(64 * nodes * 3, dtype="<f4"),
        "stress": np.ones((64, nodes, 1), "<f4"),
    }
    nan, long = np.full(64 * nodes * 3, np.nan, "<f4"), np.full((1, 100_000, 4), [0, 1, 2, 3], "<i4")
    assert outcome(path, told, frames_of(arrays)) is None
    assert "frame 0 at node 0 is not finite" in outcome(path, told, frames_of(arrays, world_pos=nan))
    assert "refers to node -1" in outcome(path, told, frames_of(arrays, cells=-np.ones_like(long)))
    assert "are left" in outcome(path, told, frames_of(arrays)[:-1])
    for given in (arrays, {**arrays, "cells": long}):
        path.write_bytes(frames_of(given))
        peak = peak_of(lambda: convert_deepmind(source, tmp_path / "d.h5", splits=["train"]))
        assert peak < 2 * path.stat().st_size

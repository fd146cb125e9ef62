"""Small folders in the form of the MeshGraphNets data sets; every number is a fraction that float32 holds exactly.

`meta` and `records` say what is in them; `example`, `frame` and `crc32c` write TFRecord files from the definitions of
the format alone, with nothing of ast_sim or of what it uses.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from data_samples import block

FRAMES = 8
COUNTS = {"train": 3, "valid": 1, "test": 2}
FAMILIES = ("deforming_plate", "sphere_simple")


def meta(family: str) -> dict[str, Any]:
    """As the files of these names; for sphere_simple as its paper describes it."""
    plate = family == "deforming_plate"
    features = {
        "cells": {"type": "static", "shape": [1, -1, 4 if plate else 3], "dtype": "int32"},
        "node_type": {"type": "static", "shape": [1, -1, 1], "dtype": "int32"},
        "mesh_pos": {"type": "static", "shape": [1, -1, 3 if plate else 2], "dtype": "float32"},
        "world_pos": {"type": "dynamic", "shape": [FRAMES, -1, 3], "dtype": "float32"},
    }
    if plate:
        features["stress"] = {"type": "dynamic", "shape": [FRAMES, -1, 1], "dtype": "float32"}
    return {
        "simulator": "comsol" if plate else "arcsim",
        "dt": 0 if plate else 0.01,
        "collision_radius": 0.03 if plate else 0.05,
        "features": features,
        "field_names": list(features),
        "trajectory_length": FRAMES,
    }


def records(family: str, split: str) -> list[dict[str, np.ndarray]]:
    """The arrays of each trajectory, in the shapes that `meta` gives."""
    make = _plate if family == "deforming_plate" else _sphere
    return [make(np.random.default_rng([len(split), index])) for index in range(COUNTS[split])]


def _fractions(generator: np.random.Generator, *shape: int) -> np.ndarray:
    return (generator.integers(-1024, 1024, shape) / 4096).astype(np.float32)


def _plate(generator: np.random.Generator) -> dict[str, np.ndarray]:
    """A block held at x = 0, and a cube over it that is an obstacle."""
    plate, cube = block(int(generator.integers(2, 4)), 1, 1), block(1, 1, 1)
    points = np.concatenate([plate.rest_position, cube.rest_position + np.float32([0, 0, 1.5])])
    kinds = np.concatenate([plate.node_type, np.ones(cube.num_nodes)])
    return {
        "cells": np.concatenate([plate.elements, cube.elements + plate.num_nodes])[None].astype(np.int32),
        "node_type": kinds[None, :, None].astype(np.int32),
        "mesh_pos": points[None],
        "world_pos": points + _fractions(generator, FRAMES, len(points), 3),
        "stress": np.abs(_fractions(generator, FRAMES, len(points), 1)) * 4096,
    }


def _sphere(generator: np.random.Generator) -> dict[str, np.ndarray]:
    """A sheet of 2 columns and some rows of squares whose first node is held, and an octahedron that is an obstacle."""
    rows = int(generator.integers(2, 4))
    number = np.arange(3 * (rows + 1)).reshape(-1, 3)
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]))
    sheet = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    ball = [[x, y, z] for x in (0, 1) for y in (2, 3) for z in (4, 5)]  # the faces of an octahedron
    flat = np.stack(np.meshgrid(np.arange(rows + 1), np.arange(3), indexing="ij"), -1).reshape(-1, 2) / 4
    count = len(flat)
    # What the file holds for the nodes of the sphere means nothing.
    mesh_pos = np.concatenate([flat, np.full((6, 2), np.nan)]).astype(np.float32)
    kinds = np.concatenate([[3], np.zeros(count - 1), np.ones(6)])
    return {
        "cells": np.concatenate([sheet, np.array(ball) + count])[None].astype(np.int32),
        "node_type": kinds[None, :, None].astype(np.int32),
        "mesh_pos": mesh_pos[None],
        "world_pos": _fractions(generator, FRAMES, count + 6, 3) * 4,
    }


def _table() -> list[int]:
    """CRC-32C of each byte: the reflected polynomial 0x82F63B78 (RFC 3720, appendix B.4)."""
    table = []
    for value in range(256):
        for _ in range(8):
            value = value >> 1 ^ (0x82F63B78 if value & 1 else 0)
        table.append(value)
    return table


_TABLE = _table()


def crc32c(data: bytes) -> int:
    crc = 0xFFFFFFFF
    for byte in data:
        crc = crc >> 8 ^ _TABLE[(crc ^ byte) & 0xFF]
    return crc ^ 0xFFFFFFFF


def frame(payload: bytes) -> bytes:
    """A record with its length and its checksums."""

    def masked(data: bytes) -> bytes:
        crc = crc32c(data)
        return struct.pack("<I", ((crc >> 15 | (crc & 0x7FFF) << 17) + 0xA282EAD8) % (1 << 32))

    length = struct.pack("<Q", len(payload))
    return length + masked(length) + payload + masked(payload)


def varint(value: int) -> bytes:
    """Seven bits a byte, the lowest first; the top bit says that more follow."""
    found = bytearray()
    while value >= 0x80:
        found.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*found, value])


def field(number: int, content: bytes) -> bytes:
    """A length-delimited field."""
    return varint(number << 3 | 2) + varint(len(content)) + content


def bytes_feature(content: bytes) -> bytes:
    """A Feature with a BytesList of one value."""
    return field(1, field(1, content))


def entry(name: str, feature: bytes) -> bytes:
    """An entry of the map of Features, as a field of it."""
    return field(1, field(1, name.encode()) + field(2, feature))


def example(arrays: dict[str, np.ndarray]) -> bytes:
    """An Example with a bytes feature for each array."""
    return field(1, b"".join(entry(name, bytes_feature(array.tobytes())) for name, array in arrays.items()))


def write(folder: Path, family: str, changes: dict[str, Any] | None = None) -> Path:
    """The folder of a family, in which keys of its meta.json may be changed; returns `folder / family`."""
    folder = folder / family
    folder.mkdir(parents=True)
    (folder / "meta.json").write_text(json.dumps({**meta(family), **(changes or {})}))
    for split in COUNTS:
        data = b"".join(frame(example(arrays)) for arrays in records(family, split))
        (folder / f"{split}.tfrecord").write_bytes(data)
    return folder

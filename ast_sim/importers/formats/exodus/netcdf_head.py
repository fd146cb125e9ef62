"""The head of a classic NetCDF file: its variables and how many bytes the file must have.

All three kinds are known: CDF-1, CDF-2 and CDF-5 with its numbers of 64 bits.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

_KINDS = {1: "i1", 2: "S1", 3: ">i2", 4: ">i4", 5: ">f4", 6: ">f8", 7: "u1", 8: ">u2", 9: ">u4", 10: ">i8", 11: ">u8"}

Attributes = dict[str, bytes]


@dataclass(frozen=True)
class NetcdfVariable:
    """A variable: its shape, without the records if it has some; its texts by name; where its first value stands."""

    shape: tuple[int, ...]
    attrs: Attributes
    kind: np.dtype
    begin: int
    of_records: bool

    @property
    def size(self) -> int:
        """The bytes of one record, or of the whole variable."""
        return self.kind.itemsize * int(np.prod(self.shape, dtype=object))


@dataclass(frozen=True)
class NetcdfHead:
    """Variables by name, the lengths of dimensions, and the number of records; None if a program still writes them."""

    variables: dict[str, NetcdfVariable]
    dimensions: dict[str, int]
    records: int | None

    @property
    def needed(self) -> int:
        """The bytes that the file must have at least."""
        ends = [0] + [one.begin + one.size for one in self.variables.values() if not one.of_records]
        moving = [one for one in self.variables.values() if one.of_records]
        record = sum(one.size if len(moving) == 1 else -(-one.size // 4) * 4 for one in moving)
        if self.records:
            ends += [one.begin + (self.records - 1) * record + one.size for one in moving]
        return max(ends)

    def values(self, path: Path, name: str) -> np.ndarray:
        """The values of a variable without records."""
        one = self.variables[name]
        count = int(np.prod(one.shape))
        return np.fromfile(path, one.kind, count, offset=one.begin).reshape(one.shape)


def is_classic(path: Path) -> bool:
    """Whether a file is a classic NetCDF file."""
    with path.open("rb") as file:
        return file.read(4) in (b"CDF\1", b"CDF\2", b"CDF\5")


def read_netcdf_head(path: Path) -> NetcdfHead:
    """The head of a classic NetCDF file.

    Raises:
        ValueError: the head is cut off or damaged.
    """
    with path.open("rb") as file:
        return _Parser(file, path.stat().st_size).head()


class _Parser:
    """Reads the head of a file, number by number."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self.file = file
        self.size = size
        version = file.read(4)[3]
        self.count_format = ">q" if version == 5 else ">i"
        self.place_format = ">i" if version == 1 else ">q"

    def head(self) -> NetcdfHead:
        width = struct.calcsize(self.count_format)
        records = self.bytes(width)
        dimensions = [(self.text(), self.count()) for _ in range(self.length_of_list())]
        self.attributes()
        variables = dict(self.variable(dimensions) for _ in range(self.length_of_list()))
        known = records != b"\xff" * width
        return NetcdfHead(variables, dict(dimensions), int.from_bytes(records, "big") if known else None)

    def variable(self, dimensions: list[tuple[str, int]]) -> tuple[str, NetcdfVariable]:
        name = self.text()
        numbers = [self.count() for _ in range(self.count())]
        if any(number >= len(dimensions) for number in numbers):
            raise ValueError(f"{name} has a dimension that is not there")
        shape = [dimensions[number][1] for number in numbers]
        attributes = self.attributes()
        kind = self.kind()
        self.count()  # its bytes, which follow from its shape
        begin = self.number(self.place_format)
        if begin < 0:
            raise ValueError(f"{name} begins at {begin}")
        of_records = bool(shape) and shape[0] == 0  # the length of the dimension of the records
        return name, NetcdfVariable(tuple(shape[of_records:]), attributes, kind, begin, of_records)

    def attributes(self) -> Attributes:
        """The attributes that are texts."""
        texts = {}
        for _ in range(self.length_of_list()):
            name = self.text()
            kind = self.kind()
            values = self.padded(kind.itemsize * self.count())
            if kind.kind == "S":
                texts[name] = values
        return texts

    def kind(self) -> np.dtype:
        number = self.number(">i")
        if number not in _KINDS:
            raise ValueError(f"there is no kind of number {number}")
        return np.dtype(_KINDS[number])

    def length_of_list(self) -> int:
        self.number(">i")  # what the list holds, or 0 if nothing
        return self.count()

    def text(self) -> str:
        return self.padded(self.count()).decode("utf-8", errors="replace")

    def padded(self, length: int) -> bytes:
        data = self.bytes(length)
        self.bytes(-length % 4)
        return data

    def count(self) -> int:
        number = self.number(self.count_format)
        if number < 0:
            raise ValueError(f"the count {number} is negative")
        return number

    def number(self, kind: str) -> int:
        return struct.unpack(kind, self.bytes(struct.calcsize(kind)))[0]

    def bytes(self, length: int) -> bytes:
        if length > self.size:
            raise ValueError("the head is cut off")
        data = self.file.read(length)
        if len(data) < length:
            raise ValueError("the head is cut off")
        return data

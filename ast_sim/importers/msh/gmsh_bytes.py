"""The sections of a `.msh` file of Gmsh, and the numbers in them, as text or binary."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from ast_sim.support.errors import DatasetError, counted

_VERSIONS = (1.0, 2.0, 2.1, 2.2, 4.0, 4.1)


class Section:
    """The content of a section; what is read moves `place` on. Numbers in binary files have 4 or 8 bytes."""

    def __init__(self, name: str, content: bytes, place: int, version: float, order: str | None) -> None:
        self.name_of_variant = name
        self.name = {"ParametricNodes": "Nodes", "NOD": "Nodes", "ELM": "Elements"}.get(name, name)
        self.end_mark = f"${'End' if version > 1 else 'END'}{name}".encode()
        self.content = content
        self.place = place
        self.version = version
        self.order = order
        self.tokens: list[bytes] | None = None
        self.next_token = 0
        self.end = -1

    def line(self) -> str:
        end = self.content.find(b"\n", self.place)
        if end < 0:
            raise ValueError("it ends within a section")
        line = self.content[self.place : end]
        self.place = end + 1
        try:
            return line.decode().strip()
        except UnicodeDecodeError:  # a name of a group, as Windows writes it
            return line.decode("latin-1").strip()

    def skip(self) -> None:
        self.place = self._find_end()

    def _find_end(self) -> int:
        end = self.content.find(self.end_mark, self.place)
        if end < 0:
            raise ValueError(f"the section {self.name_of_variant} has no end")
        return end

    def require(self, count: int, size: int) -> None:
        """Raise ValueError if the rest of the file is too short for `count` numbers."""
        left = len(self.content) - self.place if self.tokens is None else len(self.tokens) - self.next_token
        if count < 0 or count * (size if self.order else 1) > left:
            raise ValueError(f"it declares {counted(count, 'entry', 'entries')}, but the file does not hold them")

    def _numbers(self, count: int, kind: str) -> np.ndarray:
        self.require(count, int(kind[1]))
        if self.order is not None:
            dtype = np.dtype(self.order + kind)
            values = np.frombuffer(self.content, dtype, count, self.place)
            self.place += count * dtype.itemsize
            return values.astype(np.float64 if kind[0] == "f" else np.int64)
        if self.tokens is None:
            self.end = self._find_end()
            self.tokens = self.content[self.place : self.end].split()
            self.place = self.end
        chosen = self.tokens[self.next_token : self.next_token + count]
        if len(chosen) < count:
            raise ValueError(f"the section {self.name} ends early")
        self.next_token += count
        return np.array(chosen, np.float64) if kind[0] == "f" else np.array(chosen).astype(np.int64)

    def ints(self, count: int) -> np.ndarray:
        return self._numbers(count, "i4")

    def sizes(self, count: int) -> np.ndarray:
        return self._numbers(count, "u8")

    def reals(self, count: int) -> np.ndarray:
        return self._numbers(count, "f8")

    def records_of_nodes(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Of formats 1 and 2: the numbers [count] and points [count, 3]."""
        if self.name_of_variant == "ParametricNodes":
            return self._parametric_nodes(count)
        if self.order is None:
            rows = self._numbers(4 * count, "f8").reshape(count, 4)
            return rows[:, 0].astype(np.int64), rows[:, 1:]
        self.require(count, 28)
        dtype = np.dtype([("number", self.order + "i4"), ("point", self.order + "f8", 3)])
        rows = np.frombuffer(self.content, dtype, count, self.place)
        self.place += count * dtype.itemsize
        return rows["number"].astype(np.int64), rows["point"].astype(np.float64)

    def _parametric_nodes(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """As `records_of_nodes`; after the point stand the dimension and the number of its entity, and the parameters:
        one on a curve, two on a surface."""
        self.require(count, 36)
        numbers, points = np.zeros(count, np.int64), np.zeros((count, 3))
        for row in range(count):
            if self.order is None:
                entries = self.line().split()
                numbers[row] = int(entries[0])
                points[row] = [float(text) for text in entries[1:4]]
            else:
                numbers[row] = self.ints(1)[0]
                points[row] = self.reals(3)
                dimension = int(self.ints(2)[0])
                self.reals(dimension if dimension in (1, 2) else 0)
        return numbers, points

    def records_of_elements(self, count: int, nodes: Callable[[int], int]) -> Iterator[tuple[int, int, np.ndarray]]:
        """Of formats 1 and 2: (type, number of tags, rows) of elements alike; a row is number, tags, nodes.

        Args:
            nodes: the number of nodes of a type.
        """
        if self.order is not None:
            done = 0
            while done < count:
                kind, block, tags = self.ints(3).tolist()
                width = 1 + tags + nodes(kind)
                if not 0 < block <= count - done:
                    raise ValueError(f"a block of {counted(block, 'element')}, where {count - done:,} are left")
                yield kind, tags, self.ints(block * width).reshape(block, width)
                done += block
            return
        self.end = self._find_end()
        lines = self.content[self.place : self.end].split(b"\n")
        self.place = self.end
        by_form: dict[tuple[int, int], list[list[bytes]]] = {}
        for entries in filter(None, (line.split() for line in lines)):
            if self.version < 2:  # two tags and the number of nodes
                entries[2:5] = [b"2", *entries[2:4]]
            kind, tags = int(entries[1]), int(entries[2])
            if len(entries) != 3 + tags + nodes(kind):
                raise ValueError(f"element {int(entries[0])} has {counted(len(entries) - 3 - tags, 'node')}")
            by_form.setdefault((kind, tags), []).append([entries[0], *entries[3:]])
        if sum(map(len, by_form.values())) != count:
            held = sum(map(len, by_form.values()))
            raise ValueError(f"it says that it holds {counted(count, 'element')}, but there are {held:,}")
        for (kind, tags), rows in by_form.items():
            yield kind, tags, np.array(rows).astype(np.int64)

    def records_of_data(self, count: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
        """The numbers [count] and values [count, columns] of a field."""
        if self.order is None:
            rows = self._numbers(count * (1 + columns), "f8").reshape(count, 1 + columns)
            return rows[:, 0].astype(np.int64), rows[:, 1:]
        dtype = np.dtype([("number", self.order + "i4"), ("value", self.order + "f8", (columns,))])
        self.require(count, dtype.itemsize)
        rows = np.frombuffer(self.content, dtype, count, self.place)
        self.place += count * dtype.itemsize
        return rows["number"].astype(np.int64), rows["value"].astype(np.float64)

    def finish(self) -> int:
        """Check that the section ends where it was read to; where the next one begins."""
        if self.tokens is not None and self.next_token != len(self.tokens):
            raise ValueError(f"the section {self.name} holds more than it says")
        end = self._find_end()
        if self.content[self.place : end].strip():
            raise ValueError(f"the section {self.name} holds more than it says")
        return end + len(self.end_mark)


class Reader:
    """A `.msh` file.

    Raises:
        DatasetError: it is of another format.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.content = path.read_bytes()
        lines = self.content[: 1 << 16].split(b"\n")  # comments may come first
        start = next((row for row, line in enumerate(lines) if line.strip() in (b"$MeshFormat", b"$NOD")), None)
        try:
            assert start is not None
            first = lines[start].strip() == b"$NOD"  # the first format does not say what it is
            version, binary, _ = (b"1", b"0", b"") if first else lines[start + 1].split()
            self.version = float(version)
        except (AssertionError, ValueError, IndexError):
            raise DatasetError(
                f"{path}: cannot be read as a mesh: is no .msh file of Gmsh's format 4.1 or 2.2, or damaged"
            ) from None
        if self.version not in _VERSIONS:
            raise DatasetError(
                f"{path}: cannot be read as a mesh: is of Gmsh's format {version.decode()}; write it as 4.1 or 2.2"
                " (gmsh FILE -save -format msh41)"
            )
        self.order: str | None = None
        if binary == b"0":
            self.content = self.content.replace(b"\r\n", b"\n")
        else:
            place = sum(len(line) + 1 for line in lines[: start + 2])
            self.order = "<" if self.content[place : place + 4] == b"\1\0\0\0" else ">"

    def sections(self) -> Iterator[Section]:
        place = 0
        while True:
            start = self.content.find(b"$", place)
            if start < 0:
                return
            end = self.content.find(b"\n", start)
            if end < 0:
                raise ValueError("it ends within a section")
            name = self.content[start + 1 : end].decode(errors="replace").strip()
            section = Section(name, self.content, end + 1, self.version, self.order)
            if name in ("MeshFormat", "Comments"):
                section.skip()
            else:
                yield section
            place = section.finish()

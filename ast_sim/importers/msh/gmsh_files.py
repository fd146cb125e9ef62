"""Meshes in the files of Gmsh, `.msh` of the formats 1, 2, 4.0 and 4.1, as text or binary.

Gmsh writes an element once for each of its physical groups in formats 1 and 2; whoever makes elements of the cells
takes each once. Format 4 says the groups of geometric entities, partitioned ones among them, and each block of
elements belongs to an entity. Source: the reference manual of Gmsh, chapter "File formats".
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ast_sim.importers.formats.source_mesh import CellBlock, SourceMesh, node_count
from ast_sim.importers.msh.gmsh_bytes import Reader, Section
from ast_sim.importers.msh.gmsh_fields import GmshField, with_fields
from ast_sim.support.errors import DatasetError, counted

# Gmsh's types of elements.
_KINDS = {
    1: "line",
    2: "triangle",
    3: "quad",
    4: "tetra",
    5: "hexahedron",
    6: "wedge",
    7: "pyramid",
    8: "line3",
    9: "triangle6",
    10: "quad9",
    11: "tetra10",
    12: "hexahedron27",
    13: "wedge18",
    14: "pyramid14",
    15: "vertex",
    16: "quad8",
    17: "hexahedron20",
    18: "wedge15",
    19: "pyramid13",
    20: "triangle9",
    21: "triangle10",
    23: "triangle15",
    26: "line4",
    27: "line5",
    29: "tetra20",
    30: "tetra35",
}

# Where the nodes of VTK's order stand in Gmsh's; the corners stand alike, and so do the nodes of all other kinds.
_ORDER = {
    "tetra10": [0, 1, 2, 3, 4, 5, 6, 7, 9, 8],
    "hexahedron20": [0, 1, 2, 3, 4, 5, 6, 7, 8, 11, 13, 9, 16, 18, 19, 17, 10, 12, 14, 15],
    "wedge15": [0, 1, 2, 3, 4, 5, 6, 9, 7, 12, 14, 13, 8, 10, 11],
    "pyramid13": [0, 1, 2, 3, 4, 5, 8, 10, 6, 7, 9, 11, 12],
}


@dataclass(eq=False)
class _Content:
    """What the sections of a file hold. An element has a number, a dimension and its physical groups."""

    names: dict[tuple[int, int], str] = field(default_factory=dict)
    physical: dict[tuple[int, int], list[int]] = field(default_factory=dict)  # of entities: dimension and number
    node_numbers: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    blocks: list[_Block] = field(default_factory=list)
    data: list[GmshField] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class _Block:
    """Elements of one kind: [c] numbers, [c, k] numbers of nodes, [c] a physical group (0: none), [c] an entity."""

    kind: str
    numbers: np.ndarray
    nodes: np.ndarray
    groups: list[tuple[int, int, np.ndarray]]
    physical: np.ndarray
    entity: np.ndarray


def gmsh_frames(path: Path) -> Iterator[SourceMesh]:
    """The frames of a file, one for each step of its fields, or one. Groups are its physical groups; one without a name
    is called by its number.

    Raises:
        DatasetError: the file is damaged, or of another format, or its fields are of different steps; the text names
            it.
    """
    reader = Reader(path)
    content = _Content()
    try:
        for section in reader.sections():
            _take(section, content)
    except (ValueError, IndexError, KeyError, OverflowError, MemoryError) as error:
        told = " ".join(str(error).split()) or type(error).__name__
        raise DatasetError(f"{path}: cannot be read as a mesh: it is damaged: {told}") from error
    mesh = _source(path, content)
    blocks = [block.numbers for block in content.blocks]
    yield from with_fields(mesh, content.node_numbers, blocks, content.data)


def _take(section: Section, content: _Content) -> None:
    new = section.version >= 4
    match section.name:
        case "PhysicalNames":
            content.names = _physical_names(section)
        case "Entities":
            _entities(section, content, partitioned=False)
        case "PartitionedEntities":
            _entities(section, content, partitioned=True)
        case "Nodes":
            (_nodes_4 if new else _nodes_2)(section, content)
        case "Elements":
            (_elements_4 if new else _elements_2)(section, content)
        case "NodeData" | "ElementData":
            content.data.append(_data(section))
        case "ElementNodeData":
            name = _texts(section)[0]
            note = f"the field {name!r} has values at the nodes of each element: it is left out"
            content.notes.extend([note] if note not in content.notes else [])
            section.skip()
        case _:
            section.skip()


def _physical_names(section: Section) -> dict[tuple[int, int], str]:
    names = {}
    for _ in range(int(section.line())):
        dimension, number, name = section.line().split(None, 2)
        names[int(dimension), int(number)] = name.strip().removeprefix('"').removesuffix('"')
    return names


def _entities(section: Section, content: _Content, partitioned: bool) -> None:
    """The physical groups of each entity: its dimension, its number, a box (or a point), its groups, its boundary."""
    if partitioned:
        section.sizes(1)  # partitions
        ghosts = int(section.sizes(1)[0])
        section.ints(2 * ghosts)
    counts = section.sizes(4)
    for dimension, count in enumerate(counts.tolist()):
        for _ in range(count):
            number = int(section.ints(1)[0])
            if partitioned:
                section.ints(2)  # the entity that it is a part of
                section.ints(int(section.sizes(1)[0]))
            section.reals(3 if dimension == 0 and section.version > 4 else 6)
            groups = section.ints(int(section.sizes(1)[0]))
            content.physical[dimension, number] = np.abs(groups).tolist()
            if dimension:
                section.ints(int(section.sizes(1)[0]))


def _nodes_4(section: Section, content: _Content) -> None:
    """Format 4.0 names an entity before its dimension, and gives each node its number and point on one line."""
    old = section.version < 4.1
    blocks, total, *_ = section.sizes(2 if old else 4).tolist()
    section.require(total, 8)
    numbers, points = [np.zeros(0, np.int64)], [np.zeros((0, 3))]
    for _ in range(blocks):
        *entity, parametric = section.ints(3).tolist()
        count = int(section.sizes(1)[0])
        columns = 3 + (entity[1 if old else 0] if parametric else 0)
        if old:
            block_numbers, rows = section.records_of_data(count, columns)
        else:
            block_numbers = section.sizes(count)
            rows = section.reals(columns * count).reshape(count, columns)
        numbers.append(block_numbers)
        points.append(rows[:, :3])
    content.node_numbers = np.concatenate(numbers)
    content.points = np.concatenate(points)
    if len(content.node_numbers) != total:
        raise ValueError(f"it says that it holds {counted(total, 'node')}, but there are {len(content.node_numbers):,}")


def _elements_4(section: Section, content: _Content) -> None:
    old = section.version < 4.1
    blocks, total, *_ = section.sizes(2 if old else 4).tolist()
    section.require(total, 8)
    held = 0
    for _ in range(blocks):
        *ids, kind_number = section.ints(3).tolist()
        dimension, entity = ids[::-1] if old else ids
        kind = _kind(kind_number)
        count = int(section.sizes(1)[0])
        numbers = (section.ints if old else section.sizes)(count * (1 + node_count(kind)))
        rows = numbers.reshape(count, -1)
        groups = [(dimension, group, np.arange(count)) for group in content.physical.get((dimension, entity), [])]
        first = groups[0][1] if groups else 0
        content.blocks.append(
            _Block(kind, rows[:, 0], rows[:, 1:], groups, np.full(count, first), np.full(count, entity))
        )
        held += count
    if held != total:
        raise ValueError(f"it says that it holds {counted(total, 'element')}, but there are {held:,}")


def _nodes_2(section: Section, content: _Content) -> None:
    content.node_numbers, content.points = section.records_of_nodes(int(section.line()))


def _elements_2(section: Section, content: _Content) -> None:
    count = int(section.line())
    by_kind: dict[str, list[np.ndarray]] = defaultdict(list)
    for kind_number, tags, rows in section.records_of_elements(count, lambda number: node_count(_kind(number))):
        kind = _kind(kind_number)
        padded = np.zeros((len(rows), 3 + node_count(kind)), np.int64)
        padded[:, 0] = rows[:, 0]
        padded[:, 1 : 1 + min(tags, 2)] = rows[:, 1 : 1 + min(tags, 2)]
        padded[:, 3:] = rows[:, 1 + tags :]
        by_kind[kind].append(padded)
    for kind, parts in by_kind.items():
        rows = np.concatenate(parts)
        rows[:, 1] = np.abs(rows[:, 1])  # a negative group: its elements are turned over
        dimension = CellBlock(kind, rows[:0], kind).dimension
        groups = [
            (dimension, group, np.flatnonzero(rows[:, 1] == group)) for group in np.unique(rows[:, 1]).tolist() if group
        ]
        content.blocks.append(_Block(kind, rows[:, 0], rows[:, 3:], groups, rows[:, 1], rows[:, 2]))


def _kind(number: int) -> str:
    if number not in _KINDS:
        raise ValueError(f"elements of Gmsh's type {number} are not known here")
    return _KINDS[number]


def _data(section: Section) -> GmshField:
    texts = _texts(section)
    reals = [float(section.line()) for _ in range(int(section.line()))]
    facts = [int(section.line()) for _ in range(int(section.line()))]
    columns, count = facts[1], facts[2]
    numbers, values = section.records_of_data(count, columns)
    return GmshField(section.name == "NodeData", texts[0], facts[0], reals[0] if reals else 0.0, numbers, values)


def _texts(section: Section) -> list[str]:
    """The texts of a field, of which the first is its name; "" if there is none."""
    return [section.line().strip().strip('"') for _ in range(int(section.line()))] or [""]


def _source(path: Path, content: _Content) -> SourceMesh:
    order = np.argsort(content.node_numbers, kind="stable")
    sorted_numbers = content.node_numbers[order]
    if len(sorted_numbers) and (np.diff(sorted_numbers) == 0).any():
        twice = sorted_numbers[np.argmax(np.diff(sorted_numbers) == 0)]
        raise DatasetError(f"{path}: cannot be read as a mesh: node {twice} stands in the file twice")
    blocks = []
    groups = defaultdict(list)
    for block in content.blocks:
        row = np.minimum(np.searchsorted(sorted_numbers, block.nodes), max(len(order) - 1, 0))
        if not len(order) or (sorted_numbers[row] != block.nodes).any():
            raise DatasetError(f"{path}: cannot be read as a mesh: an element refers to a node that there is not")
        nodes = order[row]
        for dimension, number, rows in block.groups:
            groups[content.names.get((dimension, number), str(number))].append(nodes[rows].ravel())
        kind_order = _ORDER.get(block.kind)
        blocks.append(CellBlock(block.kind, nodes if kind_order is None else nodes[:, kind_order], block.kind))
    for key, name in content.names.items():
        if name not in groups:
            content.notes.append(f"the group {name!r} is empty: no element belongs to it (Mesh.SaveAll writes none)")
        groups.setdefault(name, [])
        if sum(other == name for other in content.names.values()) > 1:
            content.notes.append(
                f"the group {name!r} holds all physical groups of this name, here of dimension {key[0]}"
            )
    tags = {
        "gmsh:physical": [b.physical for b in content.blocks],
        "gmsh:geometrical": [b.entity for b in content.blocks],
    }
    return SourceMesh(
        path,
        content.points,
        blocks,
        {},
        tags,
        {name: np.unique(np.concatenate([np.zeros(0, np.int64), *parts])) for name, parts in groups.items()},
        content.notes,
        same_point=content.node_numbers,
    )

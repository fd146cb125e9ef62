"""Meshes as text of MFEM (`.mesh`), GiD and FreeFem (`.msh`).

Sources: mfem.org/mesh-format-v1.0, the reference manual of GiD (postprocess mesh format), FreeFem's documentation of
savemesh.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from ast_sim.importers.formats.source_mesh import INSTEAD, CellBlock, SourceMesh, node_count
from ast_sim.support.errors import DatasetError, counted

_KINDS_OF_MFEM = dict(enumerate(("vertex", "line", "triangle", "quad", "tetra", "hexahedron", "wedge", "pyramid")))

_KINDS_OF_GID = {
    "point": "vertex",
    "linear": "line",
    "triangle": "triangle",
    "quadrilateral": "quad",
    "tetrahedra": "tetra",
    "hexahedra": "hexahedron",
    "prism": "wedge",
    "pyramid": "pyramid",
}
_GID = re.compile(
    r'(?i)\s*MESH\b\s*("[^"]*"|(?!dimension)\S+)?\s*dimension\s*=?\s*(\d)\s*ElemType\s*=?\s*(\w+)\s*Nnode\s*=?\s*(\d+)\s*'
)

# Elements of MFEM whose points are shared by neighbours, the ones at corners first.
_SHARED = re.compile(r"H1_.*|Linear|Quadratic|Cubic")


def reader_of(ending: str, beginning: bytes) -> Callable[[Path], SourceMesh] | None:
    """What reads a file of an ending, if its first bytes are of one of these programs."""
    text = beginning.decode("latin-1")
    if ending == ".mesh" and text.startswith("MFEM "):
        return mfem_mesh
    if ending == ".msh" and re.match(r"(?i)(\s*#.*\n|\s*\n)*\s*MESH\b.*dimension", text):
        return gid_mesh
    first = [line.split() for line in text.split("\n", 2)[:2]]
    if ending == ".msh" and len(first) == 2 and len(first[0]) == 3 and len(first[1]) in (3, 4):
        return freefem_mesh if all(word.isdigit() for word in first[0]) else None
    return None


def _read(path: Path, read: Callable[[list[list[str]]], SourceMesh]) -> SourceMesh:
    """What `read` makes of the words of the lines of a file, without comments and empty lines.

    Raises:
        DatasetError: the file is damaged; the text names it.
    """
    lines = [line.partition("#")[0].split() for line in path.read_text("latin-1").splitlines()]
    try:
        return read([words for words in lines if words])
    except DatasetError:
        raise
    except (ValueError, IndexError, KeyError, StopIteration, OverflowError) as error:
        told = " ".join(str(error).split()) or "it ends early"
        raise DatasetError(
            f"{path}: cannot be read as a mesh: it is damaged: {told}; if it is whole, {INSTEAD}"
        ) from error


def _blocks(rows: dict[str, list[list[int]]], numbers: np.ndarray) -> list[CellBlock]:
    """Cells by their kind; `numbers` are the ones that the file gives its points."""
    order = np.argsort(numbers, kind="stable")
    if (np.diff(numbers[order]) == 0).any():
        raise ValueError("a point has the number of another one")
    blocks = []
    for kind, cells in rows.items():
        nodes = np.array(cells, np.int64).reshape(len(cells), node_count(kind))
        place = np.minimum(np.searchsorted(numbers[order], nodes), max(len(numbers) - 1, 0))
        if not len(numbers) or (numbers[order][place] != nodes).any():
            raise ValueError("an element refers to a point that there is not")
        blocks.append(CellBlock(kind, order[place], kind))
    return blocks


def _points(rows: list[list[str]], columns: int) -> np.ndarray:
    """[n, 3]: coordinates, of which the ones that are not given are 0."""
    points = np.array(rows, np.float64).reshape(len(rows), columns)
    return np.pad(points, ((0, 0), (0, 3 - columns)))


def mfem_mesh(path: Path) -> SourceMesh:
    """A mesh of MFEM, format 1.0 or 1.2. Groups are the attributes of its boundary. Of curved elements the corners are
    taken.

    Raises:
        DatasetError: the file is damaged, of another format (NURBS, refined on one side), or its points are not shared.
    """
    return _read(path, lambda lines: _mfem(path, lines))


def _mfem(path: Path, lines: list[list[str]]) -> SourceMesh:
    first = " ".join(lines[0])
    if first not in ("MFEM mesh v1.0", "MFEM mesh v1.2"):
        raise DatasetError(f"{path}: is of the format {first}; must be MFEM mesh v1.0: {INSTEAD}")
    at = 1
    rows: dict[str, list[list[int]]] = defaultdict(list)
    tags: dict[str, list[int]] = defaultdict(list)
    boundary: dict[str, list[int]] = defaultdict(list)
    count = 0
    points = np.zeros((0, 3))
    notes: list[str] = []
    while at < len(lines) and lines[at] != ["mfem_mesh_end"]:
        section = lines[at][0]
        if section == "dimension":
            at += 2
        elif section in ("elements", "boundary"):
            size = int(lines[at + 1][0])
            for words in lines[at + 2 : at + 2 + size]:
                tag, number, *nodes = map(int, words)
                kind = _KINDS_OF_MFEM[number]
                rows[kind].append(nodes)
                tags[kind].append(tag)
                if section == "boundary":
                    boundary[f"boundary {tag}"] += nodes
            at += 2 + size
        elif section == "vertices":
            count = int(lines[at + 1][0])
            at += 2
            if count and at < len(lines) and len(lines[at]) == 1 and lines[at][0].isdigit():
                columns = int(lines[at][0])
                points = _points(lines[at + 1 : at + 1 + count], columns)
                at += 1 + count
        elif section == "nodes":
            points, told = _corners_of_mfem(path, lines[at + 1 :], count)
            notes += told
            break
        else:
            raise DatasetError(f"{path}: has a section {section!r}, which is not read: {INSTEAD}")
    if len(points) != count:
        raise ValueError(f"it says that it holds {counted(count, 'vertex', 'vertices')}, but there are {len(points)}")
    blocks = _blocks(rows, np.arange(count))
    cell_tags = [np.array(tags[block.kind]) for block in blocks]
    groups = {name: np.unique(nodes) for name, nodes in boundary.items()}
    return SourceMesh(path, points, blocks, cell_fields={"attribute": cell_tags}, groups=groups, notes=notes)


def _corners_of_mfem(path: Path, lines: list[list[str]], count: int) -> tuple[np.ndarray, list[str]]:
    """The points of the corners of a mesh whose points are a function of finite elements, and a note on others."""
    facts = {words[0].rstrip(":"): words[1] for words in lines[:4] if len(words) == 2}
    kind = facts["FiniteElementCollection"]
    columns = int(facts["VDim"])
    if not _SHARED.fullmatch(kind):
        raise DatasetError(
            f"{path}: its elements do not share points ({kind}), as MFEM writes periodic meshes: {INSTEAD}"
        )
    values = np.array([word for words in lines[4:] if words != ["mfem_mesh_end"] for word in words], np.float64)
    if len(values) % columns or len(values) < count * columns:
        raise ValueError(f"its nodes have {len(values)} coordinates for {count} vertices")
    by_axis = facts["Ordering"] == "0"
    points = values.reshape(columns, -1).T if by_axis else values.reshape(-1, columns)
    more = len(points) - count
    are = counted(more, "point within curved elements is", "points within curved elements are")
    told = [f"{are} left out: the corners are taken"] if more else []
    return np.pad(points[:count], ((0, 0), (0, 3 - columns))), told


def gid_mesh(path: Path) -> SourceMesh:
    """A mesh of GiD: several parts on the same points; a part with a name is a group.

    Raises:
        DatasetError: the file is damaged, or holds elements that are not known.
    """
    return _read(path, lambda lines: _gid(path, lines))


def _gid(path: Path, lines: list[list[str]]) -> SourceMesh:
    numbers: list[int] = []
    points: list[list[str]] = []
    rows: dict[str, list[list[int]]] = defaultdict(list)
    parts: dict[str, list[int]] = defaultdict(list)
    name = kind = ""
    dimension = 0
    entries = iter(lines)
    for words in entries:
        if words[0].lower() == "mesh":
            head = _GID.fullmatch(" ".join(words))
            shape = _KINDS_OF_GID.get(head[3].lower()) if head else None
            if head is None or shape is None:
                raise DatasetError(f"{path}: has the line {' '.join(words)!r}, which is not read: {INSTEAD}")
            name = (head[1] or "").strip('"')
            dimension = int(head[2])
            kind = shape if int(head[4]) == node_count(shape) else f"{shape}{head[4]}"
        elif [word.lower() for word in words] == ["coordinates"]:
            for row in _until(entries, "coordinates"):
                numbers.append(int(row[0]))
                points.append([*row[1:], "0"][:3] if len(row) == 3 else row[1:])
        elif [word.lower() for word in words] == ["elements"]:
            for row in _until(entries, "elements"):
                if len(row) - 1 - node_count(kind) not in (0, 1):  # a material may stand behind
                    raise ValueError(
                        f"element {row[0]} has {counted(len(row) - 1, 'entry', 'entries')} behind its number"
                    )
                nodes = [int(word) for word in row[1 : 1 + node_count(kind)]]
                rows[kind].append(nodes)
                parts[name] += nodes
        elif words[0].lower() not in ("unit", "group", "end"):
            raise DatasetError(f"{path}: has the line {' '.join(words)!r}, which is not read: {INSTEAD}")
    if dimension not in (2, 3):
        raise ValueError("it has no mesh")
    given = np.array(numbers, np.int64)
    order = np.argsort(given)
    groups = {name: np.unique(order[np.searchsorted(given[order], nodes)]) for name, nodes in parts.items() if name}
    blocks = _blocks(rows, given)
    return SourceMesh(path, _points(points, 3), blocks, groups=groups, same_point=given)


def _until(entries: Iterator[list[str]], what: str) -> list[list[str]]:
    """The lines up to the one that ends a section."""
    rows = []
    while True:
        words = next(entries)
        if [word.lower() for word in words] in (["end", what], [f"end{what}"]):
            return rows
        rows.append(words)


def freefem_mesh(path: Path) -> SourceMesh:
    """A mesh of FreeFem: the numbers of points, cells and cells of the boundary, and a label for each. Groups are the
    labels of its boundary.

    Raises:
        DatasetError: the file is damaged.
    """
    return _read(path, lambda lines: _freefem(path, lines))


def _freefem(path: Path, lines: list[list[str]]) -> SourceMesh:
    sizes = [int(word) for word in lines[0]]
    if len(lines) != 1 + sum(sizes):
        raise ValueError(f"it says that it holds {sum(sizes)} points and cells, but there are {len(lines) - 1}")
    axes = len(lines[1]) - 1
    points = _points([words[:-1] for words in lines[1 : 1 + sizes[0]]], axes)
    cells = [[int(word) for word in words] for words in lines[1 + sizes[0] :]]
    kind, of_boundary = ("triangle", "line") if axes == 2 else ("tetra", "triangle")
    rows: dict[str, list[list[int]]] = {kind: cells[: sizes[1]], of_boundary: cells[sizes[1] :]}
    groups: dict[str, list[int]] = defaultdict(list)
    for *nodes, label in rows[of_boundary]:
        groups[f"boundary {label}"] += [node - 1 for node in nodes]
    nodes_alone = {name: [row[:-1] for row in held] for name, held in rows.items() if held}
    labels = [np.array([row[-1] for row in rows[name]]) for name in nodes_alone]
    blocks = _blocks(nodes_alone, 1 + np.arange(sizes[0]))
    marked = {name: np.unique(nodes) for name, nodes in groups.items()}
    return SourceMesh(path, points, blocks, cell_fields={"label": labels}, groups=marked)

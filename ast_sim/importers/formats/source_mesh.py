"""What a mesh file holds, before anything is made of it: every point, every cell of every kind, every field."""

from __future__ import annotations

import string
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ast_sim.number_arrays import require_nodes
from ast_sim.support.errors import DatasetError, counted

if TYPE_CHECKING:
    import meshio

# Cells by their shape: the dimension and the number of corners. The kind of a cell is its shape and, if it has further
# nodes, their number, as in meshio: "tetra", "tetra10". The nodes of a cell stand as in VTK, its corners first.
SHAPES = {
    "vertex": (0, 1),
    "line": (1, 2),
    "triangle": (2, 3),
    "quad": (2, 4),
    "tetra": (3, 4),
    "pyramid": (3, 5),
    "wedge": (3, 6),
    "hexahedron": (3, 8),
}

INSTEAD = "write it as .vtu, .vtk, .msh or .inp"  # what to do with a file of a kind that is not read

BEZIER = "Bezier "  # what the labels of such cells begin with


# What stands between the name of a field and a component: stress_xx, sigma-xz, Stress(y,y).
_SEPARATORS = " _.:([-"


def without_separator(name: str) -> str:
    """A name without the separators at its end."""
    return name.rstrip(_SEPARATORS)


def known_as(name: str, fields: Collection[str]) -> str:
    """The name of a field among all fields. A separator at the end may be left out: VTK takes disp_x, disp_y and disp_z
    of Exodus together and calls them `disp_`."""
    if name in fields:
        return name
    meant = [field for field in fields if without_separator(field) == without_separator(name)]
    return meant[0] if len(meant) == 1 else name


def node_count(kind: str) -> int:
    """The number of nodes of a cell of a kind."""
    shape = kind.rstrip(string.digits)
    return int(kind.removeprefix(shape) or SHAPES[shape][1])


@dataclass(frozen=True, eq=False)
class CellBlock:
    """Cells of one kind, [c, k] int64 numbers of points; `label` is what the file calls them."""

    kind: str
    nodes: np.ndarray
    label: str

    @property
    def shape(self) -> str:
        return self.kind.rstrip(string.digits)

    @property
    def dimension(self) -> int:
        return SHAPES[self.shape][0]

    @property
    def corners(self) -> np.ndarray:
        """[c, corners]: the cells without the nodes within their edges, faces and volumes."""
        return self.nodes[:, : SHAPES[self.shape][1]]

    @property
    def is_curved(self) -> bool:
        """Whether the cells have nodes beside their corners."""
        return self.nodes.shape[1] > SHAPES[self.shape][1]

    @property
    def has_middles(self) -> bool:
        """Whether the cells are tetrahedra with nodes in the middles of their edges. The further points of a Bezier
        cell lie beside its edges."""
        return self.kind == "tetra10" and not self.label.startswith(BEZIER)

    def rows(self, kept: np.ndarray) -> CellBlock:
        return CellBlock(self.kind, self.nodes[kept], self.label)


@dataclass(frozen=True, eq=False)
class SourceMesh:
    """A mesh as it stands in its file.

    Attributes:
        path: the file, or the name of a mesh in memory.
        points: [n, 3] float64.
        blocks: the cells.
        point_fields: [n, ...] by name.
        cell_fields: for each block [c, ...], by name.
        groups: the numbers of the points of each named group.
        notes: sentences on what was read otherwise than it stands in the file.
        time: when the frame is, if the file says so.
        columns: the names of the columns of the fields that have names for them.
        same_point: [n] int64, the numbers that the file gives its points: points with the same number are one point.
            None if it gives none.
        pieces: [n] int64, the piece of the file that each point belongs to; None if there is one.
        piece_names: the names of the pieces, "" for one without a name.
        other_way: whether its format counts the nodes of a cell with a volume the other way around than VTK. Some
            programs write it as VTK does.
    """

    path: Path
    points: np.ndarray
    blocks: list[CellBlock]
    point_fields: dict[str, np.ndarray] = field(default_factory=dict)
    cell_fields: dict[str, list[np.ndarray]] = field(default_factory=dict)
    groups: dict[str, np.ndarray] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    time: float | None = None
    columns: dict[str, tuple[str, ...]] = field(default_factory=dict)
    same_point: np.ndarray | None = None
    pieces: np.ndarray | None = None
    piece_names: tuple[str, ...] = ()
    other_way: bool = False

    @property
    def is_solid(self) -> bool:
        """Whether some cells have a volume."""
        return any(block.dimension == 3 for block in self.blocks)

    def require_consistent(self) -> None:
        """Check that cells refer to points that there are, that these are finite, and that each field has a row for
        each point or cell.

        Raises:
            DatasetError: the text names the file, and the cell, the point or the field.
        """
        used = np.zeros(len(self.points), bool)
        for block in self.blocks:
            if block.dimension and block.nodes.shape[1:] != (node_count(block.kind),):
                raise DatasetError(
                    f"{self.path}: cells of the kind {block.label} have {counted(block.nodes.shape[1], 'node')}; must"
                    f" have {node_count(block.kind)}: are lines of the file missing or cut short?"
                )
            require_nodes(str(self.path), block.label, block.nodes, len(self.points))
            used[block.nodes] = True
        bad = used & ~np.isfinite(self.points).all(axis=1)
        if bad.any():
            row = int(np.argmax(bad))
            raise DatasetError(f"{self.path}: point {row} is not finite: {self.points[row].tolist()}")
        for name, values in self.point_fields.items():
            self._require_rows(f"point field {name!r}", len(values), len(self.points))
        for name, parts in self.cell_fields.items():
            for values, block in zip(parts, self.blocks, strict=True):
                self._require_rows(f"cell field {name!r}", len(values), len(block.nodes))

    def _require_rows(self, what: str, rows: int, wanted: int) -> None:
        if rows != wanted:
            raise DatasetError(f"{self.path}: the {what} has {counted(rows, 'row')}; must have {wanted}")

    def counts(self) -> Counter[str]:
        """How many cells of each label there are."""
        counts: Counter[str] = Counter()
        for block in self.blocks:
            counts[block.label] += len(block.nodes)
        return counts


def from_meshio(mesh: meshio.Mesh, path: Path) -> SourceMesh:
    """A mesh in memory, or one that meshio has read.

    Raises:
        DatasetError: it holds cells of an unknown kind.
    """
    given = np.asarray(mesh.points, np.float64)
    if given.ndim != 2 or given.shape[1] > 3:
        raise DatasetError(f"{path}: its points have the shape {given.shape}; must be rows of up to three coordinates")
    points = np.pad(given, ((0, 0), (0, 3 - given.shape[1])))
    kept = [index for index, block in enumerate(mesh.cells) if len(block)]
    cells = [mesh.cells[index] for index in kept]
    unknown = [block.type for block in cells if block.type.rstrip(string.digits) not in SHAPES]
    if unknown:
        raise DatasetError(f"{path}: holds cells of the kind {unknown[0]}, which are not known here")
    mesh_fields = {name: [np.asarray(values[index]) for index in kept] for name, values in mesh.cell_data.items()}
    return SourceMesh(
        path,
        points,
        [CellBlock(block.type, _rows_of(path, block), block.type) for block in cells],
        {name: np.asarray(values) for name, values in mesh.point_data.items()},
        mesh_fields,
        _node_groups(mesh),
    )


def _rows_of(path: Path, block: meshio.CellBlock) -> np.ndarray:
    """[c, k]: the nodes of cells, which XDMF may have in one row."""
    nodes = np.asarray(block.data, np.int64)
    if nodes.ndim == 1 and len(nodes) % node_count(block.type) == 0:
        return nodes.reshape(-1, node_count(block.type))
    if nodes.ndim != 2:
        raise DatasetError(f"{path}: the nodes of its {block.type} cells have the shape {nodes.shape}; must be rows")
    return nodes


def _node_groups(mesh: meshio.Mesh) -> dict[str, np.ndarray]:
    """The numbers of the nodes of each named set of points or cells of the mesh."""
    groups = {name: np.asarray(nodes, np.int64).ravel() for name, nodes in mesh.point_sets.items()}
    for name, rows in mesh.cell_sets.items():
        if not name.startswith("gmsh:"):  # what meshio keeps for itself
            pairs = zip(mesh.cells, rows, strict=True)
            nodes = [block.data[np.asarray(chosen, int)].ravel() for block, chosen in pairs if chosen is not None]
            groups[name] = np.unique(np.concatenate(nodes)) if nodes else np.zeros(0, np.int64)
    return groups | _groups_of_families(mesh)


def _groups_of_families(mesh: meshio.Mesh) -> dict[str, np.ndarray]:
    """The groups of a MED file. Its points and cells belong to families, and a family to some groups."""
    tagged = [(mesh.point_data.get("point_tags"), np.arange(len(mesh.points)), getattr(mesh, "point_tags", {}))]
    for block, tags in zip(mesh.cells, mesh.cell_data.get("cell_tags", []), strict=False):
        tagged.append((tags, np.asarray(block.data), getattr(mesh, "cell_tags", {})))
    nodes: dict[str, list[np.ndarray]] = {}
    for tags, rows, families in tagged:
        for family, names in families.items() if tags is not None else ():
            for name in names:
                nodes.setdefault(name, []).append(rows[np.asarray(tags) == family].ravel())
    return {name: np.unique(np.concatenate(parts)).astype(np.int64) for name, parts in nodes.items()}

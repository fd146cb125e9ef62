"""A mesh of tetrahedra or triangles with its fields, from a file that meshio reads."""

from __future__ import annotations

import contextlib
import io
import string
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ast_sim.importers.places import Mask
from ast_sim.importers.shells import Shells, find_shells
from ast_sim.importers.vtu_sizes import require_declared_sizes
from ast_sim.scene import NodeType, Scene, connected_parts, require_nodes
from ast_sim.support.errors import DatasetError

if TYPE_CHECKING:
    import meshio

# The kinds of cells that become elements, by meshio's names, and their numbers of corners.
_CORNERS = {"tetra": 4, "triangle": 3}


@dataclass(frozen=True, eq=False)
class MeshFile:
    """Points [n, 3] float64, elements [E, 3 or 4] int64, fields by place ("point" or "cell") and name, notes on cells
    that were left out, and the numbers of the nodes of each named group.

    If there are `shells` beside the tetrahedra, their layers are among the elements and the points; see `Shells`.
    """

    path: Path
    points: np.ndarray
    elements: np.ndarray
    fields: dict[str, dict[str, np.ndarray]]
    notes: list[str]
    groups: dict[str, np.ndarray]
    shells: Shells | None = None

    @property
    def shell_nodes(self) -> np.ndarray:
        """[n] bool: the nodes of shells and those behind them."""
        nodes = np.zeros(len(self.points), bool)
        if self.shells is not None:
            nodes[self.shells.nodes] = nodes[-len(self.shells.nodes) :] = True
        return nodes

    def field(self, place: str, name: str) -> np.ndarray:
        """A field of a `place`, "point" or "cell", as [rows, columns] float64.

        Raises:
            DatasetError: there is no such field, or it does not hold numbers.
        """
        fields = self.fields[place]
        if name not in fields:
            known = ", ".join(sorted(fields)) or "none"
            raise DatasetError(f"{self.path}: there is no {place} field {name!r}; there are: {known}")
        if fields[name].dtype.kind not in "iufb":
            raise DatasetError(f"{self.path}: the {place} field {name!r} does not hold numbers")
        return fields[name].astype(np.float64).reshape(len(fields[name]), -1)

    def numbers(self, place: str, name: str) -> np.ndarray:
        """A field with one number in each row, as [rows]; see `field`."""
        value = self.field(place, name)
        if value.shape[1] != 1:
            raise DatasetError(
                f"{self.path}: the {place} field {name!r} has {value.shape[1]} components; must have one"
            )
        return value[:, 0]

    def masks(self, nodes: np.ndarray) -> tuple[Mask, Mask]:
        """For `Place.inside`: functions of a name that say at which of the nodes [k] a point field is not zero, and
        which of them belong to a group.

        Raises:
            DatasetError: when they are called, there is no such field or group.
        """

        def group(name: str) -> np.ndarray:
            if name not in self.groups:
                known = ", ".join(sorted(self.groups)) or "none"
                raise DatasetError(f"{self.path}: there is no group of nodes {name!r}; there are: {known}")
            return np.isin(nodes, self.groups[name])

        return lambda name: self.numbers("point", name)[nodes] != 0, group

    def whole_numbers(self, place: str, name: str, dtype: type) -> np.ndarray:
        """A field with one whole number in each row, as [rows] of an integer type; see `field`."""
        value, limits = self.numbers(place, name), np.iinfo(dtype)
        wrong = ~((value == np.round(value)) & (value >= limits.min) & (value <= limits.max))
        if wrong.any():
            row = int(np.argmax(wrong))
            at = f"{'node' if place == 'point' else 'element'} {row}"
            raise DatasetError(f"{self.path}: {name} at {at} is {value[row]:g}; must be a whole number")
        return value.astype(dtype)

    def columns(self, names: Sequence[str]) -> np.ndarray | None:
        """Cell fields with one number in each row as the columns of [E, m] float32; None without names."""
        return np.stack([self.numbers("cell", name) for name in names], axis=1).astype(np.float32) if names else None

    def scene(self, body_field: str | None, type_field: str | None) -> tuple[Scene, np.ndarray]:
        """The scene of the nodes that belong to an element, without material, and the numbers of these nodes; shells
        are obstacles."""
        used, elements = np.unique(self.elements, return_inverse=True)
        elements = elements.reshape(self.elements.shape).astype(np.int32)
        body = self._body(body_field)
        types = np.full(len(self.points), NodeType.NORMAL, np.uint8)
        if type_field is not None or "node_type" in self.fields["point"]:
            types = self.whole_numbers("point", type_field or "node_type", np.uint8)
        types[self.shell_nodes] = NodeType.OBSTACLE
        scene = Scene(
            rest_position=self.points[used].astype(np.float32),
            elements=elements,
            node_type=types[used],
            body=connected_parts(elements, len(used)) if body is None else body[used],
        )
        return scene, used

    def _body(self, name: str | None) -> np.ndarray | None:
        """The body of each point, [n] int32, from a point field, or from a cell field: nodes belong to the body of
        their elements."""
        wanted = name or "body"
        place = "cell" if wanted in self.fields["cell"] and wanted not in self.fields["point"] else "point"
        if name is None and wanted not in self.fields[place]:
            return None
        found = self.whole_numbers(place, wanted, np.int32)
        if place == "point":
            return found
        body = np.zeros(len(self.points), np.int32)
        body[self.elements] = found[:, None]
        shared = body[self.elements] != found[:, None]
        if shared.any():
            row, corner = np.argwhere(shared)[0]
            node = self.elements[row, corner]
            raise DatasetError(
                f"{self.path}: the bodies {found[row]} and {body[node]} share node {node}; bodies must not share"
                " nodes: give each its own, or name another body field"
            )
        return body


def read_mesh(source: Path | meshio.Mesh, curved: bool = False, path: Path = Path("mesh")) -> MeshFile:
    """The tetrahedra of a file or of a meshio mesh; its triangles if it has no three-dimensional cells.

    Triangles and quadrilaterals that touch no tetrahedron are shells. All other cells of a lower dimension are left
    out. With `curved`, elements of higher order are accepted; only their corners are kept. `path` names a mesh in
    memory in errors.

    Raises:
        DatasetError: the file is missing, damaged or of an unknown kind, or holds other elements; the text names it.
    """
    path = source if isinstance(source, Path) else path
    mesh = _read(source) if isinstance(source, Path) else source
    corners, blocks = _element_blocks(path, mesh.cells, curved)
    elements = np.concatenate([mesh.cells[block].data[:, :corners] for block in blocks]).astype(np.int64)
    points = np.zeros((len(mesh.points), 3))
    points[:, : mesh.points.shape[1]] = mesh.points
    require_nodes(str(path), "tetra" if corners == 4 else "triangle", elements, len(points))
    fields = {
        "point": {name: np.asarray(values) for name, values in mesh.point_data.items()},
        "cell": {name: np.concatenate([values[b] for b in blocks]) for name, values in mesh.cell_data.items()},
    }
    bare = MeshFile(path, points, elements, fields, _notes(mesh.cells, blocks), node_groups(mesh))
    return bare if corners == 3 else _with_shells(bare, mesh, blocks)


def node_groups(mesh: meshio.Mesh) -> dict[str, np.ndarray]:
    """The numbers of the nodes of each named set of points or cells of the mesh."""
    groups = {name: np.asarray(nodes, np.int64).ravel() for name, nodes in mesh.point_sets.items()}
    for name, rows in mesh.cell_sets.items():
        if not name.startswith("gmsh:"):  # what meshio keeps for itself
            pairs = zip(mesh.cells, rows, strict=True)
            nodes = [block.data[np.asarray(chosen, int)].ravel() for block, chosen in pairs if chosen is not None]
            groups[name] = np.unique(np.concatenate(nodes)) if nodes else np.zeros(0, np.int64)
    return groups


def _with_shells(bare: MeshFile, mesh: meshio.Mesh, blocks: list[int]) -> MeshFile:
    """The mesh with its shells; the points and fields of each node are those of the node behind it as well."""
    corners = {index: _shell_corners(block.type) for index, block in enumerate(mesh.cells) if len(block)}
    flat = [index for index, count in corners.items() if count]
    cells = [mesh.cells[index].data[:, : corners[index]].astype(np.int64) for index in flat]
    for index, block in zip(flat, cells, strict=True):
        require_nodes(str(bare.path), mesh.cells[index].type, block, len(bare.points))
    if cells and not np.isfinite(bare.points).all():
        raise DatasetError(f"{bare.path}: point {np.argmin(np.isfinite(bare.points).all(axis=1))} is not finite")
    shells = find_shells(bare.points, bare.elements, cells) if cells else None
    if shells is None:
        return bare
    kinds = np.repeat([mesh.cells[index].type for index in flat], [len(block) for block in cells])
    taken = Counter(kinds[np.unique(shells.cells)].tolist())
    rows = np.repeat(shells.cells, 3)
    points = np.concatenate([bare.points, shells.behind(bare.points)])
    fields = {
        "point": {name: np.concatenate([v, v[shells.nodes]]) for name, v in bare.fields["point"].items()},
        "cell": {
            name: np.concatenate([v, np.concatenate([mesh.cell_data[name][index] for index in flat])[rows]])
            for name, v in bare.fields["cell"].items()
        },
    }
    elements, notes = np.concatenate([bare.elements, shells.tetrahedra(points)]), _notes(mesh.cells, blocks, taken)
    return MeshFile(bare.path, points, elements, fields, notes, bare.groups, shells)


def _shell_corners(kind: str) -> int:
    """The corners of a cell that may belong to a shell; 0 for other cells."""
    return {"triangle": 3, "quad": 4}.get(kind.rstrip(string.digits), 0)


def _read(path: Path) -> meshio.Mesh:
    """Read a file by meshio. On a damaged file meshio may raise any error, print, or raise SystemExit."""
    import meshio

    if not path.is_file():
        raise DatasetError(f"{path}: there is no such file")
    if path.suffix == ".vtu":
        require_declared_sizes(path)
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            return meshio.read(path)
    except (Exception, SystemExit) as error:
        told = " ".join(f"{printed.getvalue()} {error if str(error) != '1' else ''}".split())
        raise DatasetError(f"{path}: cannot be read as a mesh: {told or type(error).__name__}") from error


def _element_blocks(path: Path, cells: list[meshio.CellBlock], curved: bool) -> tuple[int, list[int]]:
    """The number of corners of the elements, and the blocks of cells that hold them."""
    dimension = max((block.dim for block in cells if len(block)), default=0)
    blocks = [index for index, block in enumerate(cells) if block.dim == dimension and len(block)]
    kinds = {cells[index].type for index in blocks}
    kinds = {kind.rstrip(string.digits) for kind in kinds} if curved else kinds
    if len(kinds) != 1 or not kinds <= set(_CORNERS):
        found = ", ".join(dict.fromkeys(block.type for block in cells)) or "no cells"
        linear = "" if curved else " (linear)"
        raise DatasetError(
            f"{path}: holds {found}; the elements must be tetra or triangle{linear}, all of one kind: mesh the bodies"
            " with tetrahedra"
        )
    return _CORNERS[kinds.pop()], blocks


def _notes(cells: list[meshio.CellBlock], blocks: list[int], shells: Counter[str] | None = None) -> list[str]:
    """What was not taken as it is. `shells` counts the cells that became shells, by kind."""
    left_out, reduced, shells = Counter(), Counter(), shells or Counter()
    for index, block in enumerate(cells):
        if index not in blocks:
            left_out[block.type] += len(block)
        elif block.type not in _CORNERS:
            reduced[block.type] += len(block)
    told = {"are left out": left_out - shells, "keep their corners only": reduced}
    told["are shells and become obstacles"] = shells
    return [f"{n} cells of the kind {kind} {what}" for what, count in told.items() for kind, n in count.items()]

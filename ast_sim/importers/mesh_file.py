"""A mesh of tetrahedra or triangles with its fields, from a file of any format that is known, or from a mesh in memory.

Every mesh comes this way: results that are converted, a scene that is predicted, a part of an assembly.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ast_sim.importers.formats.source_mesh import SourceMesh, from_meshio
from ast_sim.importers.frames_in_file import frames_in
from ast_sim.importers.places import Mask, marked
from ast_sim.importers.shells import Shells, find_shells
from ast_sim.importers.solids.mesh_elements import Elements, elements_of, told_of_copies
from ast_sim.importers.solids.middles import NO_NODE, completed
from ast_sim.importers.solids.stitching import Stitching
from ast_sim.number_arrays import connected_parts
from ast_sim.scene import NodeType, Scene
from ast_sim.support.errors import DatasetError, counted

if TYPE_CHECKING:
    import meshio


@dataclass(frozen=True, eq=False)
class MeshFile:
    """The elements of a file.

    Attributes:
        source: what the file holds.
        points: [n, 3] float64: the points of the file, then the points behind its shells, at last the middles of edges
            that have no node there in the file.
        elements: [E, 3, 4 or 10] int64; tetrahedra have a positive volume.
        node_rows: [n] the point of the file that a point stands for: itself, the one in front of it, or an end of its
            edge.
        element_rows: [E] the cell of the file that an element is part of, counted over all blocks.
        copies: [C, 2] cells that were left out as copies, and the cells that stand for them; see `Elements`.
        notes: sentences on what was not taken as it is.
        groups: the numbers of the points of each named group.
        shells: if there are shells beside the tetrahedra; their layers are among the elements and the points.
        edges: [M, 2] the points at the ends of the edges in whose middles the last M points lie.
        mirrored: whether all elements were inside out in the file.
        reduced: whether elements keep their corners only, though they have further nodes in the file.
    """

    source: SourceMesh
    points: np.ndarray
    elements: np.ndarray
    node_rows: np.ndarray
    element_rows: np.ndarray
    copies: np.ndarray
    notes: list[str]
    groups: dict[str, np.ndarray]
    shells: Shells | None = None
    edges: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    mirrored: bool = False
    reduced: bool = False

    @property
    def path(self) -> Path:
        return self.source.path

    @cached_property
    def fields(self) -> dict[str, dict[str, np.ndarray]]:
        """The fields at a place, "point" [n, ...] or "cell" [E, ...], by name."""
        cells = {name: np.concatenate(parts)[self.element_rows] for name, parts in self.source.cell_fields.items()}
        points = {name: self._kept(np.asarray(v)[self.node_rows]) for name, v in self.source.point_fields.items()}
        return {"point": points, "cell": cells}

    @property
    def shell_nodes(self) -> np.ndarray:
        """[n] bool: the nodes of shells and the nodes behind them."""
        nodes = np.zeros(len(self.points), bool)
        if self.shells is not None:
            nodes[self.shells.nodes] = nodes[len(self.source.points) : len(nodes) - len(self.edges)] = True
        return self._kept(nodes)

    def _kept(self, marks: np.ndarray) -> np.ndarray:
        """Marks or whole numbers [n, ...] of the points; the middle of an edge has one where both ends have one."""
        if len(self.edges) and marks.dtype.kind in "iufb":
            one, other = np.moveaxis(marks[self.edges], 1, 0)
            marks = marks.copy()
            marks[-len(self.edges) :] = np.where((one != 0) & (other != 0), np.maximum(one, other), 0)
        return marks

    def between(self, values: np.ndarray) -> np.ndarray:
        """Values [n, ...] at the points; in the middle of an edge without a node in the file, the mean of its ends."""
        if len(self.edges):
            values = values.copy()
            values[-len(self.edges) :] = values[self.edges].mean(axis=1)
        return values

    def at_nodes(self, used: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """From values at the points of the file to values at the points `used`."""
        return lambda values: self.between(values[self.node_rows])[used]

    def at_elements(self, values: np.ndarray) -> np.ndarray:
        """From values at the cells of the file to values at the elements. A note says if copies have other ones."""
        told = told_of_copies(values, self.copies) if len(self.copies) else []
        self.notes.extend(note for note in told if note not in self.notes)
        return values[self.element_rows]

    def field(self, place: str, name: str) -> np.ndarray:
        """A field of a `place`, "point" or "cell", as [n or E, columns] float64.

        Raises:
            DatasetError: there is no such field, or it does not hold numbers.
        """
        values = raw_field(self.source, place, name)
        return self.between(values[self.node_rows]) if place == "point" else self.at_elements(values)

    def numbers(self, place: str, name: str) -> np.ndarray:
        """A field with one number in each row, as [rows]; see `field`."""
        value = self.field(place, name)
        if value.shape[1] != 1:
            raise DatasetError(
                f"{self.path}: the {place} field {name!r} has {counted(value.shape[1], 'component')}; must have one"
            )
        return value[:, 0]

    def masks(self, nodes: np.ndarray) -> tuple[Mask, Mask]:
        """For `Place.inside`: functions of a name that say at which of the nodes [k] a point field is not zero, and
        which of them belong to a group.

        Raises:
            DatasetError: when they are called, there is no such field or group.
        """

        def group(name: str) -> np.ndarray:
            known = {key.casefold(): key for key in self.groups}
            key = name if name in self.groups else known.get(name.casefold())
            if key is None:
                listed = ", ".join(sorted(self.groups)) or "none"
                raise DatasetError(f"{self.path}: there is no group of nodes {name!r}; there are: {listed}")
            return np.isin(nodes, self.groups[key])

        return lambda name: self.marks(name)[nodes], group

    def marks(self, name: str) -> np.ndarray:
        """[n] bool: the points at which a point field is not zero. NaN is no mark: programs fill a field with it where
        a block lacks the field. Notes say at how many points it is NaN, and negative, which may mean no mark."""
        values = self.numbers("point", name)
        used = values[np.unique(self.elements)]
        for rows, what, then in (
            (np.isnan(used), "NaN", "not marked"),
            (used < 0, "negative", "marked, as all where it is not 0"),
        ):
            told = f"the field {name!r} is {what} at {counted(rows.sum(), 'node: it is', 'nodes: they are')} {then}"
            if rows.any() and told not in self.notes:
                self.notes.append(told)
        return self._kept(marked(values))

    def whole_numbers(self, place: str, name: str, dtype: type) -> np.ndarray:
        """A field with one whole number in each row, as [rows] of an integer type; see `field`."""
        value = self.numbers(place, name)
        value = self._kept(value) if place == "point" else value
        limits = np.iinfo(dtype)
        wrong = ~((value == np.round(value)) & (value >= limits.min) & (value <= limits.max))
        if place == "point":
            wrong &= np.isin(np.arange(len(value)), self.elements)
        if wrong.any():
            row = int(np.argmax(wrong))
            at = f"{'node' if place == 'point' else 'element'} {row}"
            raise DatasetError(f"{self.path}: {name} at {at} is {value[row]:g}; must be a whole number")
        return np.where(np.isfinite(value), value, 0).clip(limits.min, limits.max).astype(dtype)

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
        number = self.whole_numbers(place, wanted, np.int32)
        if place == "point":
            return number
        body = np.zeros(len(self.points), np.int32)
        body[self.elements] = number[:, None]
        shared = body[self.elements] != number[:, None]
        if shared.any():
            row, corner = np.argwhere(shared)[0]
            node = self.elements[row, corner]
            raise DatasetError(
                f"{self.path}: the bodies {number[row]} and {body[node]} share node {node}; bodies must not share"
                " nodes: give each its own, or name another body field"
            )
        return body


def raw_field(mesh: SourceMesh, place: str, name: str) -> np.ndarray:
    """A field of a file as [points or cells, columns] float64; see `MeshFile.field`."""
    fields = mesh.point_fields if place == "point" else mesh.cell_fields
    if name not in fields:
        known = ", ".join(sorted(fields)) or "none"
        other = "cell" if place == "point" else "point"
        elsewhere = name in (mesh.cell_fields if other == "cell" else mesh.point_fields)
        told = f": {name!r} is a {other} field" if elsewhere else ""
        raise DatasetError(f"{mesh.path}: there is no {place} field {name!r}{told}; there are: {known}")
    values = mesh.point_fields[name] if place == "point" else np.concatenate(mesh.cell_fields[name])
    if values.dtype.kind not in "iufb":
        raise DatasetError(f"{mesh.path}: the {place} field {name!r} does not hold numbers")
    return values.astype(np.float64).reshape(len(values), -1)


def read_mesh(
    source: Path | meshio.Mesh,
    path: Path = Path("mesh"),
    used_fields: tuple[str, ...] = ("node_type", "body"),
    corners: bool = False,
) -> MeshFile:
    """The tetrahedra of a file or of a meshio mesh; its triangles if it has no cells with a volume.

    Hexahedra, prisms and pyramids are cut into tetrahedra, quadrilaterals into triangles. Tetrahedra of ten nodes keep
    them, and then all others get nodes in the middles of their edges; with `corners`, and in other elements of higher
    order, the corners only are taken. Triangles and quadrilaterals that touch no tetrahedron are shells. All other
    cells of a lower dimension are left out. Of a file with several frames the first is taken. `path` names a mesh in
    memory in errors. Points at one place are not joined where one of the `used_fields` says that they are not alike.

    Raises:
        DatasetError: the file is missing, damaged or of an unknown kind, or holds other elements; the text names it.
        MissingExtra: a reader of the format is not installed.
    """
    mesh = next(frames_in(source)) if isinstance(source, Path) else from_meshio(source, path)
    mesh.require_consistent()
    stitching = Stitching(mesh)
    stitching.look(mesh, used_fields)
    return mesh_of(mesh, stitching, corners)


def mesh_of(mesh: SourceMesh, stitching: Stitching, corners: bool = False) -> MeshFile:
    """The elements of a mesh, its points joined where they are one; `corners` as in `read_mesh`."""
    point_of, joined = stitching.joined()
    taken = elements_of(mesh, point_of, corners)
    unused = len(mesh.points) - len(np.unique(np.concatenate([block.nodes.ravel() for block in mesh.blocks])))
    told = [f"{counted(unused, 'point of no element is', 'points of no element are')} left out"] if unused else []
    groups = {name: np.unique(point_of[nodes]) for name, nodes in mesh.groups.items()}
    notes = [*mesh.notes, *joined]
    everyone = np.arange(len(mesh.points))
    shells, rows = _shells(mesh, point_of, taken)
    notes += _told_of_cells(mesh, taken, rows) + taken.notes + told
    points = mesh.points
    elements = taken.nodes
    node_rows = everyone
    element_rows = taken.rows
    if shells is not None:
        points = np.concatenate([points, shells.behind(points)])
        elements = np.concatenate([elements, shells.tetrahedra(points)])
        node_rows = np.concatenate([node_rows, shells.nodes])
        element_rows = np.concatenate([element_rows, np.repeat(rows, 3)])
    made = MeshFile(mesh, points, elements, node_rows, element_rows, taken.copies, notes, groups, shells)
    plain = replace(made, mirrored=taken.mirrored, reduced=taken.reduced)
    return plain if taken.middles is None else _of_second_order(plain, taken.middles)


def _of_second_order(mesh: MeshFile, middles: np.ndarray) -> MeshFile:
    """The mesh with the middles [e, 6] of its first e elements; all other edges get new points."""
    unknown = np.full((len(mesh.elements) - len(middles), middles.shape[1]), NO_NODE)
    elements, edges = completed(mesh.elements, np.concatenate([middles, unknown]), len(mesh.points))
    new = len(mesh.points) + np.arange(len(edges))
    groups = {
        name: np.concatenate([nodes, new[np.isin(edges, nodes).all(axis=1)]]) for name, nodes in mesh.groups.items()
    }
    if len(edges):
        of = "of elements that have corners only"
        get = counted(len(edges), f"edge {of} gets a node in its", f"edges {of} get a node in their")
        mesh.notes.append(f"{get} middle")
    return replace(
        mesh,
        points=np.concatenate([mesh.points, mesh.points[edges].mean(axis=1)]),
        elements=elements,
        node_rows=np.concatenate([mesh.node_rows, mesh.node_rows[edges[:, 0]]]),
        groups=groups,
        edges=edges,
    )


def _shells(mesh: SourceMesh, point_of: np.ndarray, taken: Elements) -> tuple[Shells | None, np.ndarray]:
    """The shells of a mesh, and the cell of the file that each of their triangles is made of."""
    flat = [index for index, block in enumerate(mesh.blocks) if block.dimension == 2 and index not in taken.blocks]
    starts = np.cumsum([0, *(len(block.nodes) for block in mesh.blocks)])
    numbers = [starts[index] + np.arange(len(mesh.blocks[index].nodes)) for index in flat]
    cells = [point_of[mesh.blocks[index].corners] for index in flat]
    shells = find_shells(mesh.points, taken.nodes, cells) if cells else None
    return shells, np.concatenate(numbers)[shells.cells] if shells is not None else np.zeros(0, np.int64)


def _told_of_cells(mesh: SourceMesh, taken: Elements, shell_rows: np.ndarray) -> list[str]:
    """Notes on the cells that were left out or became shells, by kind."""
    ends = np.cumsum([len(block.nodes) for block in mesh.blocks])
    shells = Counter(mesh.blocks[index].label for index in np.searchsorted(ends, np.unique(shell_rows), "right"))
    left_out: Counter[str] = Counter()
    for index, block in enumerate(mesh.blocks):
        if index not in taken.blocks:
            left_out[block.label] += len(block.nodes)
    told = [
        f"{counted(n, f'cell of the kind {kind} is', f'cells of the kind {kind} are')} left out"
        for kind, n in (left_out - shells).items()
    ]
    for kind, n in shells.items():
        of_kind = f"of the kind {kind}"
        told.append(
            counted(
                n,
                f"cell {of_kind} is a shell and becomes an obstacle",
                f"cells {of_kind} are shells and become obstacles",
            )
        )
    return told

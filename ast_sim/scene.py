"""A scene (mesh, bodies, material) and a trajectory (the positions of its nodes over time); numpy only."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ast_sim.element_topology import LOCAL_EDGES, signed_volumes, surface_triangles, unique_edges
from ast_sim.mesh_arrays import NodeType, arrays_of_mesh, deforms, joined_arrays, mesh_of_arrays, scene_arrays
from ast_sim.mesh_rules import require_deforming, require_mesh
from ast_sim.named_field import NamedField
from ast_sim.number_arrays import ascending, ranges, require_array, require_finite, require_nodes, require_numbering
from ast_sim.scene_summary import scene_drawing, scene_facts
from ast_sim.support.argument_checks import require_type, several
from ast_sim.support.errors import DatasetError
from ast_sim.support.notebook_table import html_table, one_line
from ast_sim.support.read_only_arrays import ReadOnlyArrays, kept

if TYPE_CHECKING:
    import meshio

AttributeValue = str | int | float | list[float]


@dataclass(frozen=True, eq=False)
class Scene(ReadOnlyArrays):
    """The static part of a simulation with N nodes and E elements. Its arrays are read-only.

    Attributes:
        rest_position: [N, 3] float32, the undeformed positions; in 2-D scenes z = 0.
        elements: [E, k] int32, the numbers of the nodes; k = 3 for triangles, k = 4 for tetrahedra, k = 10 for
            second-order tetrahedra (`element_topology`).
        node_type: [N] uint8, values of `NodeType`.
        body: [N] int32, the number of the body that a node belongs to.
        material: [E, m] float32, material parameters of each element, or None.
    """

    rest_position: np.ndarray
    elements: np.ndarray
    node_type: np.ndarray
    body: np.ndarray
    material: np.ndarray | None = None

    @classmethod
    def of(
        cls,
        points: Any,
        cells: Any,
        *,
        node_type: Any = None,
        body: Any = None,
        material: Any = None,
        obstacles: Iterable[int] = (),
        handles: Any = None,
        name: str = "scene",
    ) -> Scene:
        """A scene from arrays of any type of numbers, or from lists. It is checked.

        Args:
            points: [N, 3], or [N, 2] in the plane z = 0: the undeformed positions.
            cells: [E, k], as `elements`.
            node_type: [N], values of `NodeType`; None: all nodes are free.
            body: [N]; None: each connected part of the mesh is a body, numbered from 0 in the order of its lowest node.
            material: [E, m], or [m] for all elements.
            obstacles: numbers of the bodies all of whose nodes are obstacles.
            handles: [N] bool, or numbers of nodes: these are handles. Obstacles stay what they are; a warning says so.
            name: name of the scene, for messages.

        Raises:
            DatasetError: an array is wrong; the text names it and the first wrong node or element.
            ConfigError: there is no such body.
        """
        scene = cls(**scene_arrays(name, points, cells, node_type, body, material, obstacles, handles))
        scene.check(name)
        return scene

    @classmethod
    def join(cls, *scenes: Scene) -> Scene:
        """One scene with the bodies of several, side by side: the numbers of bodies and of nodes count on.

        Raises:
            DatasetError: the elements have different numbers of nodes, or the materials different columns.
            ConfigError: there is no scene.
        """
        return cls(**joined_arrays(scenes))

    @classmethod
    def from_meshio(cls, mesh: meshio.Mesh, **changes: Any) -> Scene:
        """The scene of a mesh whose cells are all triangles, or all tetrahedra of 4 or of 10 nodes, taken as they are.

        The point fields `node_type` and `body` and the cell field `material` are taken, if the mesh has them, as
        `to_meshio` writes them. `ast_sim.read_scene` takes files and all other meshes, cuts other cells into
        tetrahedra, and selects clamps by place.

        Args:
            changes: other arguments of `Scene.of`, such as obstacles=[1]; they win over the fields.

        Raises:
            DatasetError: there are other cells, or cells of several kinds, or an array is wrong.
        """
        points, cells, fields = arrays_of_mesh(mesh)
        return cls.of(points, cells, **{**fields, **changes})

    def to_meshio(self) -> meshio.Mesh:
        """The scene as a mesh of meshio, with the point fields `node_type` and `body` and the cell field `material`;
        `from_meshio` makes the same scene of it."""
        return mesh_of_arrays(self.rest_position, self.elements, self.node_type, self.body, self.material)

    def _facts(self) -> dict[str, str]:
        return scene_facts(self.rest_position, self.elements, self.node_type, self.body, self.material)

    def __repr__(self) -> str:
        return one_line("Scene", self._facts())

    def _repr_html_(self) -> str:
        drawing = scene_drawing(self.rest_position, self.elements, self.node_type, self.body)
        return html_table("Scene", self._facts(), drawing)

    @property
    def num_nodes(self) -> int:
        return len(self.rest_position)

    @property
    def num_elements(self) -> int:
        return len(self.elements)

    @property
    def prescribed(self) -> np.ndarray:
        """[N] bool: the nodes whose positions are prescribed in all frames (obstacles and handles)."""
        return self.node_type != NodeType.NORMAL

    @property
    def deforming_nodes(self) -> np.ndarray:
        """[N] bool: the nodes that belong to no obstacle. Obstacles are rigid and have no stress."""
        return deforms(self.node_type)

    @property
    def deforming_elements(self) -> np.ndarray:
        """[E] bool: the elements without a node of an obstacle. They have a stress."""
        return np.all(self.deforming_nodes[self.elements], axis=1)

    @property
    def rigid_elements(self) -> np.ndarray:
        """[E] bool: the elements all of whose nodes are of obstacles. One with other nodes, too, has elastic forces,
        since it is strained when these move, but no stress."""
        return ~np.any(self.deforming_nodes[self.elements], axis=1)

    @property
    def rigid_bodies(self) -> set[int]:
        """The bodies all of whose nodes are of obstacles."""
        return set(self.body.tolist()) - set(self.body[self.deforming_nodes].tolist())

    def deforming(self, location: str) -> np.ndarray:
        """[N] or [E] bool, one for each row of the stress: the nodes that deform, or the elements if `location` is
        "element"."""
        return self.deforming_elements if location == "element" else self.deforming_nodes

    def check(self, name: str = "scene") -> None:
        """Check shapes, dtypes, finiteness, index ranges and node types.

        Raises:
            DatasetError: something is wrong; the text names `name`, the array and the first wrong node or element.
        """
        require_array(name, "rest_position", self.rest_position, np.float32, (None, 3))
        require_array(name, "elements", self.elements, np.int32, (None, None))
        n = self.num_nodes
        e, k = self.elements.shape
        require_array(name, "node_type", self.node_type, np.uint8, (n,))
        require_array(name, "body", self.body, np.int32, (n,))
        if self.material is not None:
            require_array(name, "material", self.material, np.float32, (e, None))
        if n == 0 or e == 0:
            raise DatasetError(f"{name}: a scene needs nodes and elements, this one has {n} and {e}")
        if k not in LOCAL_EDGES:
            raise DatasetError(f"{name}: elements must have 3 nodes (triangle), 4 or 10 (tetrahedron), not {k}")
        require_finite(name, "rest_position", "node", self.rest_position)
        if self.material is not None:
            if self.material.shape[1] == 0:
                raise DatasetError(f"{name}: material has no columns; leave it out (None)")
            require_finite(name, "material", "element", self.material)
        require_nodes(name, "element", self.elements, n)
        require_mesh(name, self.elements, self.node_type, self.body)

    def require_predictable(self, name: str) -> None:
        """Raise DatasetError if no node is free, or if an element of the deforming bodies has no volume (a triangle: no
        area); the text names `name`, the first element and their number."""
        require_deforming(name, self.rest_position, self.elements, self.node_type)

    def edges(self) -> np.ndarray:
        """[M, 2] int32: each edge of the mesh once, its smaller node first, in ascending order."""
        return self._edges

    @cached_property
    def _edges(self) -> np.ndarray:
        return unique_edges(self.elements, self.num_nodes)

    @cached_property
    def rest_volumes(self) -> np.ndarray:
        """[E] float64: the volumes between the corners of the tetrahedra at rest, negative if they are inside out."""
        return kept(signed_volumes(self.rest_position, self.elements))

    def surface(self) -> np.ndarray:
        """[F, 3] int32: the triangles of the surface.

        In a scene of triangles these are all elements. In a scene of tetrahedra they are the faces that belong to one
        element only; their nodes run counter-clockwise, seen from outside. A face of six nodes is cut in four.
        """
        return self._surface

    @cached_property
    def _surface(self) -> np.ndarray:
        return surface_triangles(self.rest_position, self.elements)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A scene and its S frames.

    Attributes:
        position: [S, N, 3] float32.
        stress: [S, N, 1] (nodal) or [S, E, 1] (per element) float32, von Mises stress, or None.
        attributes: `status` ("complete" or "truncated"); the records of the solver, such as `seed`, `index`,
            `newton_iterations`, `min_gap`, `min_jacobian`; and `solve_seconds`, a list with one entry per frame, which
            a generated dataset keeps in a separate file (`ast_sim.dataset.solver_seconds`).
        cauchy_stress: [S, E, 6] float32, Cauchy stress of each element (xx, yy, zz, xy, yz, zx), or None.
        stress_location: "node" or "element", where the rows of `stress` are; None: the number of rows decides it.
        frames: the numbers of the S frames in the whole motion, ascending; None: 0 to S - 1.
        times: the times of the S frames in seconds, ascending; None: they are not known.
        length_unit: the unit of all positions, such as "mm"; None: it is not known.
        fields: other quantities of the results by name; `ast_sim.named_field.REACTION` has the nodal reactions.
    """

    scene: Scene
    position: np.ndarray
    stress: np.ndarray | None = None
    attributes: dict[str, AttributeValue] = field(default_factory=dict)
    cauchy_stress: np.ndarray | None = None
    stress_location: str | None = None
    frames: tuple[int, ...] | None = None
    times: tuple[float, ...] | None = None
    length_unit: str | None = None
    fields: dict[str, NamedField] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("frames", "times"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, tuple(several(name, getattr(self, name), "numbers")))

    def _facts(self) -> dict[str, str]:
        return {
            "frames": ranges(self.numbers),
            "nodes": f"{self.scene.num_nodes:,}",
            "stress": "none" if self.stress is None else f"at each {self.stress_location or 'node or element'}",
            "lengths": self.length_unit or "in a unit that is not known",
            "status": str(self.attributes.get("status", "complete")),
        }

    def __repr__(self) -> str:
        return one_line("Trajectory", self._facts())

    def _repr_html_(self) -> str:
        return html_table("Trajectory", self._facts(), self.scene._repr_html_())

    @property
    def num_frames(self) -> int:
        return len(self.position)

    @property
    def numbers(self) -> tuple[int, ...]:
        """The numbers of the S frames in the whole motion."""
        return tuple(range(self.num_frames)) if self.frames is None else self.frames

    def select(self, frames: Iterable[int]) -> Trajectory:
        """The frames with these numbers, ascending, as a trajectory.

        Raises:
            DatasetError: a frame is missing; the text names the frames that are there.
        """
        chosen = ascending("frames", frames)
        missing = [number for number in chosen if number not in self.numbers]
        if missing:
            raise DatasetError(f"there is no frame {missing[0]}; there are the frames {ranges(self.numbers)}")
        rows = [self.numbers.index(number) for number in chosen]
        framed = {name: getattr(self, name) for name in ("position", "stress", "cauchy_stress")}
        return replace(
            self,
            **{name: None if values is None else values[rows] for name, values in framed.items()},
            fields={name: one.select(rows) for name, one in self.fields.items()},
            frames=tuple(chosen),
            times=None if self.times is None else tuple(self.times[row] for row in rows),
        )

    @property
    def stress_at(self) -> str:
        """Where the stress is: "none", "node" or "element".

        Raises:
            DatasetError: no `stress_location` is given, and the scene has as many nodes as elements.
        """
        if self.stress is None:
            return "none"
        n = self.scene.num_nodes
        if self.stress_location is None and n == self.scene.num_elements:
            raise DatasetError(
                f"the stress may be at the {n} nodes or in the {n} elements: give the trajectory its stress_location"
            )
        return self.stress_location or ("node" if self.stress.shape[1] == n else "element")

    def check(self, name: str = "trajectory", stress_location: str | None = None) -> None:
        """Check the scene, the shapes and that every number is finite.

        Raises:
            DatasetError: something is wrong; the text names `name`, and the frame and the node if there is one.
        """
        require_type(f"{name}: its scene", self.scene, Scene, "a Scene")
        require_type(f"{name}: its fields", self.fields, Mapping, "fields by name")
        self.scene.check(name)
        n = self.scene.num_nodes
        e = self.scene.num_elements
        require_array(name, "position", self.position, np.float32, (None, n, 3))
        if self.num_frames == 0:
            raise DatasetError(f"{name}: a trajectory needs at least one frame")
        require_finite(name, "position", "node", self.position)
        require_numbering(name, self.num_frames, self.frames, self.times)
        for key, one in self.fields.items():
            require_type(f"{name}: the field {key}", one, NamedField, "a NamedField")
            one.check(name, key, self.num_frames, n, e)
        if stress_location is not None and (self.stress is None) != (stress_location == "none"):
            what = "no stress" if self.stress is None else "stress"
            raise DatasetError(f"{name}: has {what}, but stress_location is {stress_location!r}")
        if self.cauchy_stress is not None:
            require_array(name, "cauchy_stress", self.cauchy_stress, np.float32, (self.num_frames, e, 6))
            require_finite(name, "cauchy_stress", "element", self.cauchy_stress)
        if self.stress is None:
            return
        wanted = stress_location or self.stress_location
        if wanted not in (None, "node", "element"):
            raise DatasetError(f"{name}: stress_location is {wanted!r}; it must be 'node' or 'element'")
        if self.stress_location not in (None, wanted):
            raise DatasetError(f"{name}: has stress at each {self.stress_location}, but stress_location is {wanted!r}")
        require_array(name, "stress", self.stress, np.float32, (self.num_frames, None, 1))
        rows = {"node": (n,), "element": (e,), None: (n, e)}[wanted]
        if self.stress.shape[1] not in rows:
            raise DatasetError(f"{name}: stress has {self.stress.shape[1]} rows; needs {' or '.join(map(str, rows))}")
        require_finite(name, "stress", wanted or "row", self.stress)

"""A scene (mesh, bodies, material) and a trajectory (the positions of its nodes over time); numpy only."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property
from itertools import combinations

import numpy as np

from ast_sim.element_topology import FACE_TRIANGLES, LOCAL_EDGES, LOCAL_FACES
from ast_sim.support.errors import ConfigError, DatasetError

AttributeValue = str | int | float | list[float]

# The search for connected parts makes pairs of nodes from so many elements at a time, which limits its memory.
_ELEMENTS_AT_ONCE = 1 << 13


class NodeType(IntEnum):
    """How a node moves. The numbers are those of the MeshGraphNets data sets."""

    NORMAL = 0  # a free node: it follows the mechanics, and models predict it
    OBSTACLE = 1  # a node of a rigid body with a prescribed motion
    HANDLE = 3  # a node of a deforming body with a prescribed position


@dataclass(frozen=True, eq=False)
class Scene:
    """The static part of a simulation with N nodes and E elements.

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
        return self.node_type != NodeType.OBSTACLE

    @property
    def deforming_elements(self) -> np.ndarray:
        """[E] bool: the elements without a node of an obstacle."""
        return np.all(self.deforming_nodes[self.elements], axis=1)

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
        n, (e, k) = self.num_nodes, self.elements.shape
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
        pairs = combinations(range(k), 2)
        repeated = np.logical_or.reduce([self.elements[:, a] == self.elements[:, b] for a, b in pairs])
        if repeated.any():
            row = int(np.argmax(repeated))
            raise DatasetError(f"{name}: element {row} refers to a node twice: {self.elements[row].tolist()}")
        unknown = ~np.isin(self.node_type, list(NodeType))
        if unknown.any():
            node = int(np.argmax(unknown))
            known = ", ".join(f"{kind.value} {kind.name}" for kind in NodeType)
            raise DatasetError(f"{name}: node {node} has the type {self.node_type[node]}; known are {known}")

    def require_predictable(self, name: str) -> None:
        """Raise DatasetError if no node is free, or if the deforming bodies have no extent; the text names `name`."""
        if self.prescribed.all():
            raise DatasetError(f"{name}: all nodes are obstacles or handles, so nothing deforms: leave this scene out")
        if not np.ptp(self.rest_position[self.deforming_nodes], axis=0).any():
            raise DatasetError(f"{name}: all nodes that deform lie at one point at rest: give them their positions")

    def edges(self) -> np.ndarray:
        """[M, 2] int32: each edge of the mesh once, its smaller node first, in ascending order."""
        pairs = np.array(LOCAL_EDGES[self.elements.shape[1]]).T
        one, other = (self.elements[:, ends].ravel().astype(np.int64) for ends in pairs)
        keys = np.unique(np.minimum(one, other) * self.num_nodes + np.maximum(one, other))
        return np.stack([keys // self.num_nodes, keys % self.num_nodes], axis=1).astype(np.int32)

    def surface(self) -> np.ndarray:
        """[F, 3] int32: the triangles of the surface.

        In a scene of triangles these are all elements. In a scene of tetrahedra they are the faces that belong to one
        element only; their nodes run counter-clockwise, seen from outside. A face of six nodes is cut in four.
        """
        return self._surface

    @cached_property
    def _surface(self) -> np.ndarray:
        if self.elements.shape[1] == 3:
            return self.elements
        faces = self.elements.astype(np.int64)[:, np.array(LOCAL_FACES)].reshape(-1, 3)  # [4 E, 3], of corners
        one, two, three = np.ascontiguousarray(faces.T)
        low = np.minimum(np.minimum(one, two), three)
        high = np.maximum(np.maximum(one, two), three)
        upper = (one + two + three - low - high) * self.num_nodes + high
        order = np.lexsort((upper, low))  # a face of two elements stands beside its like
        low, upper = low[order], upper[order]
        like_next = np.append((low[1:] == low[:-1]) & (upper[1:] == upper[:-1]), False)
        outer = np.sort(order[~(like_next | np.roll(like_next, 1))])
        owner = self.elements[outer // 4]
        corners = self.rest_position[owner[:, :4]].astype(np.float64)
        turned = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
        local = np.array(FACE_TRIANGLES[self.elements.shape[1]])[outer % 4]  # [F, 1 or 4, 3]
        triangles = np.take_along_axis(owner[:, None, :], local, axis=2)
        surface = np.where(turned[:, None, None], triangles[:, :, ::-1], triangles).reshape(-1, 3).astype(np.int32)
        surface.setflags(write=False)
        return surface


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
            DatasetError: a frame is missing; the text names those that are there.
        """
        chosen = sorted(set(frames))
        missing = [number for number in chosen if number not in self.numbers]
        if missing:
            raise DatasetError(f"there is no frame {missing[0]}; there are the frames {ranges(self.numbers)}")
        rows = [self.numbers.index(number) for number in chosen]
        framed = {name: getattr(self, name) for name in ("position", "stress", "cauchy_stress")}
        return replace(
            self,
            **{name: None if values is None else values[rows] for name, values in framed.items()},
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
        n, e = self.scene.num_nodes, self.scene.num_elements
        if self.stress_location is None and n == e:
            raise DatasetError(
                f"the stress may be at the {n} nodes or in the {e} elements: give the trajectory its stress_location"
            )
        return self.stress_location or ("node" if self.stress.shape[1] == n else "element")

    def check(self, name: str = "trajectory", stress_location: str | None = None) -> None:
        """Check the scene, the shapes and that every number is finite.

        Raises:
            DatasetError: something is wrong; the text names `name`, and the frame and the node if there is one.
        """
        self.scene.check(name)
        n, e = self.scene.num_nodes, self.scene.num_elements
        require_array(name, "position", self.position, np.float32, (None, n, 3))
        if self.num_frames == 0:
            raise DatasetError(f"{name}: a trajectory needs at least one frame")
        require_finite(name, "position", "node", self.position)
        self._check_numbering(name)
        if stress_location is not None and (self.stress is None) != (stress_location == "none"):
            what = "no stress" if self.stress is None else "stress"
            raise DatasetError(f"{name}: has {what}, but stress_location is {stress_location!r}")
        if self.cauchy_stress is not None:
            require_array(name, "cauchy_stress", self.cauchy_stress, np.float32, (self.num_frames, e, 6))
            require_finite(name, "cauchy_stress", "element", self.cauchy_stress)
        if self.stress is None:
            return
        location = stress_location or self.stress_location
        if self.stress_location not in (None, location):
            raise DatasetError(
                f"{name}: has stress at each {self.stress_location}, but stress_location is {location!r}"
            )
        require_array(name, "stress", self.stress, np.float32, (self.num_frames, None, 1))
        rows = {"node": (n,), "element": (e,), None: (n, e)}[location]
        if self.stress.shape[1] not in rows:
            raise DatasetError(f"{name}: stress has {self.stress.shape[1]} rows; needs {' or '.join(map(str, rows))}")
        require_finite(name, "stress", location or "row", self.stress)

    def _check_numbering(self, name: str) -> None:
        """Raise DatasetError unless `frames` and `times` have a number for each frame and ascend."""
        for what, values in (("frames", self.frames), ("times", self.times)):
            if values is None:
                continue
            if len(values) != self.num_frames:
                raise DatasetError(f"{name}: {what} has {len(values)} numbers for {self.num_frames} frames")
            if not np.isfinite(values).all() or (np.diff(values) <= 0).any():
                raise DatasetError(f"{name}: {what} must be finite and ascend: {list(values)}")
        if self.frames is not None and self.frames[0] < 0:
            raise DatasetError(f"{name}: frames starts at {self.frames[0]}; the first frame of a motion is 0")


def ranges(numbers: Iterable[int]) -> str:
    """Ascending whole numbers as text: "0 to 5, 8, 10 to 12"."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(f"{run[0]}" if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs)


def connected_parts(elements: np.ndarray, num_nodes: int) -> np.ndarray:
    """[N] int32: the connected part of the mesh that each node belongs to. Parts are numbered from 0 in the order of
    their lowest nodes."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    part = np.arange(num_nodes, dtype=np.int32)
    for start in range(0, len(elements), _ELEMENTS_AT_ONCE):
        corners = part[elements[start : start + _ELEMENTS_AT_ONCE]]
        # The edges from the first corner to all others connect the element, so the other edges are not needed.
        first = np.repeat(corners[:, 0], corners.shape[1] - 1)
        other = corners[:, 1:].ravel()
        graph = coo_array((np.ones(len(first), np.int8), (first, other)), shape=(num_nodes, num_nodes))
        part = connected_components(graph, directed=False)[1].astype(np.int32)[part]
    return part


def nodes_of_body(body: np.ndarray, number: int) -> np.ndarray:
    """[N] bool: the nodes of the body with this number; `body` [N] is as in `Scene`.

    Raises:
        ConfigError: there is no such body; the text names the existing bodies.
    """
    nodes = body == number
    if not nodes.any():
        numbers, counts = np.unique(body, return_counts=True)
        known = [f"{one} ({count} nodes)" for one, count in zip(numbers[:10], counts[:10], strict=True)]
        more = ["..."] if len(numbers) > 10 else []
        raise ConfigError(f"there is no body {number}; there are: {', '.join(known + more)}")
    return nodes


def require_array(name: str, array: str, value: np.ndarray, dtype: type, shape: tuple[int | None, ...]) -> None:
    """Raise DatasetError unless `value` has the dtype and the shape; None in `shape` allows any size."""
    if value.dtype != dtype:
        raise DatasetError(f"{name}: {array} must be {np.dtype(dtype)}, not {value.dtype}")
    fits = len(value.shape) == len(shape) and all(w in (None, s) for s, w in zip(value.shape, shape, strict=True))
    if not fits:
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        raise DatasetError(f"{name}: {array} has the shape {list(value.shape)}, must be [{wanted}]")


def require_nodes(name: str, kind: str, elements: np.ndarray, count: int) -> None:
    """Raise DatasetError naming the first of the `elements` [E, k] that refers to a node beyond 0 to `count` - 1."""
    outside = (elements < 0) | (elements >= count)
    if outside.any():
        row, corner = np.unravel_index(np.argmax(outside), outside.shape)
        node = elements[row, corner]
        raise DatasetError(f"{name}: {kind} {row} refers to node {node}, but the nodes are 0 to {count - 1}")


def require_finite(name: str, array: str, row: str, value: np.ndarray, first_frame: int = 0) -> None:
    """Raise DatasetError naming the first frame and row of `value`, [S, rows, F] or [rows, F], that is not finite."""
    finite = np.isfinite(value)
    if not finite.all():
        *frame, index, _ = np.unravel_index(np.argmin(finite), finite.shape)
        at = f"in frame {first_frame + frame[0]} at {row} {index}" if frame else f"of {row} {index}"
        raise DatasetError(f"{name}: {array} {at} is not finite: {value[*frame, index].tolist()}")

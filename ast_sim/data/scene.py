"""A scene (what does not change) and a trajectory (how its nodes move); numpy only."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from ast_sim.errors import DatasetError

AttributeValue = str | int | float | list[float]

# The edges of a triangle and of a tetrahedron, as pairs of local node numbers.
LOCAL_EDGES = {3: ((0, 1), (0, 2), (1, 2)), 4: ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))}

# The faces of a tetrahedron of positive volume, their normals pointing outward.
LOCAL_FACES = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))

# The connected parts of a mesh are found with so many elements in memory as pairs of nodes.
_ELEMENTS_AT_ONCE = 1 << 13


class NodeType(IntEnum):
    """What moves a node; the numbers are those of the MeshGraphNets data sets."""

    NORMAL = 0  # moved by the mechanics: what a model predicts
    OBSTACLE = 1  # part of a rigid body with a prescribed motion
    HANDLE = 3  # a node of a deforming body whose position is prescribed


@dataclass(frozen=True, eq=False)
class Scene:
    """The static part of a simulation, for N nodes and E elements.

    Attributes:
        rest_position: [N, 3] float32, the undeformed positions; 2-D scenes carry z = 0.
        elements: [E, k] int32, node numbers; k = 3 triangles, k = 4 tetrahedra.
        node_type: [N] uint8, values of `NodeType`.
        body: [N] int32, the body that each node belongs to.
        material: [E, m] float32, material parameters per element, or None.
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
        """[N] bool: the nodes whose positions are given at all times (obstacles and handles)."""
        return self.node_type != NodeType.NORMAL

    def check(self, name: str = "scene") -> None:
        """Check shapes, dtypes, finiteness, index ranges and node types.

        Raises:
            DatasetError: naming `name`, the array and the first offending node or element.
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
            raise DatasetError(f"{name}: elements must have 3 nodes (triangle) or 4 (tetrahedron), not {k}")
        _require_finite(name, "rest_position", "node", self.rest_position)
        if self.material is not None:
            if self.material.shape[1] == 0:
                raise DatasetError(f"{name}: material has no columns; leave it out (None)")
            _require_finite(name, "material", "element", self.material)
        if self.elements.min() < 0 or self.elements.max() >= n:
            outside = (self.elements < 0) | (self.elements >= n)
            row = int(np.argmax(outside.any(axis=1)))
            node = self.elements[row, np.argmax(outside[row])]
            raise DatasetError(f"{name}: element {row} refers to node {node}, but the nodes are 0 to {n - 1}")
        pairs = LOCAL_EDGES[k]
        repeated = np.logical_or.reduce([self.elements[:, a] == self.elements[:, b] for a, b in pairs])
        if repeated.any():
            row = int(np.argmax(repeated))
            raise DatasetError(f"{name}: element {row} refers to a node twice: {self.elements[row].tolist()}")
        unknown = ~np.isin(self.node_type, list(NodeType))
        if unknown.any():
            node = int(np.argmax(unknown))
            known = ", ".join(f"{kind.value} {kind.name}" for kind in NodeType)
            raise DatasetError(f"{name}: node {node} has the type {self.node_type[node]}; known are {known}")

    def edges(self) -> np.ndarray:
        """[M, 2] int32: every edge of every element once, smaller node first, in ascending order."""
        pairs = np.concatenate([self.elements[:, list(pair)] for pair in LOCAL_EDGES[self.elements.shape[1]]])
        pairs = np.sort(pairs.astype(np.int64), axis=1)
        keys = np.unique(pairs[:, 0] * self.num_nodes + pairs[:, 1])
        return np.stack([keys // self.num_nodes, keys % self.num_nodes], axis=1).astype(np.int32)

    def surface(self) -> np.ndarray:
        """[F, 3] int32: the boundary triangles, counter-clockwise seen from outside.

        Triangles of a scene are their own surface. For tetrahedra these are the faces of one element only.
        """
        if self.elements.shape[1] == 3:
            return self.elements
        corners = self.rest_position[self.elements].astype(np.float64)
        volume = np.linalg.det(corners[:, 1:] - corners[:, :1])
        faces = self.elements[:, np.array(LOCAL_FACES)]  # [E, 4, 3]
        faces = np.where((volume < 0)[:, None, None], faces[:, :, ::-1], faces).reshape(-1, 3)
        _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
        return faces[np.sort(first[count == 1])]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A scene and its S frames.

    Attributes:
        position: [S, N, 3] float32.
        stress: [S, N, 1] (nodal) or [S, E, 1] (per element) float32, von Mises stress, or None.
        attributes: `status` ("complete" or "truncated") and the records of the solver, such as `seed`, `index`,
            `newton_iterations`, `min_gap`, `min_jacobian`; and `solve_seconds` (a list with one entry per frame),
            which a generated dataset keeps in a file of its own (`ast_sim.data.seconds`).
        cauchy_stress: [S, E, 6] float32, Cauchy stress of each element (xx, yy, zz, xy, yz, zx), or None.
    """

    scene: Scene
    position: np.ndarray
    stress: np.ndarray | None = None
    attributes: dict[str, AttributeValue] = field(default_factory=dict)
    cauchy_stress: np.ndarray | None = None

    @property
    def num_frames(self) -> int:
        return len(self.position)

    def check(self, name: str = "trajectory", stress_location: str | None = None) -> None:
        """Check the scene, the shapes and that every number is finite.

        Raises:
            DatasetError: naming `name`, and the frame and node where there is one.
        """
        self.scene.check(name)
        n, e = self.scene.num_nodes, self.scene.num_elements
        require_array(name, "position", self.position, np.float32, (None, n, 3))
        if self.num_frames == 0:
            raise DatasetError(f"{name}: a trajectory needs at least one frame")
        require_finite_frames(name, "position", "node", self.position)
        if (self.stress is None) != (stress_location == "none") and stress_location is not None:
            found = "no stress" if self.stress is None else "stress"
            raise DatasetError(f"{name}: has {found}, but stress_location is {stress_location!r}")
        if self.cauchy_stress is not None:
            require_array(name, "cauchy_stress", self.cauchy_stress, np.float32, (self.num_frames, e, 6))
            require_finite_frames(name, "cauchy_stress", "element", self.cauchy_stress)
        if self.stress is None:
            return
        rows = {"node": (n,), "element": (e,), None: (n, e)}[stress_location]
        if self.stress.ndim == 3 and self.stress.shape[1] not in rows:
            raise DatasetError(f"{name}: stress has {self.stress.shape[1]} rows; needs {' or '.join(map(str, rows))}")
        require_array(name, "stress", self.stress, np.float32, (self.num_frames, None, 1))
        require_finite_frames(name, "stress", stress_location or "row", self.stress)


def connected_parts(elements: np.ndarray, num_nodes: int) -> np.ndarray:
    """[N] int32: the number of the connected part of the mesh that each node lies in, counted by their lowest nodes."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    part = np.arange(num_nodes, dtype=np.int32)
    for start in range(0, len(elements), _ELEMENTS_AT_ONCE):
        corners = part[elements[start : start + _ELEMENTS_AT_ONCE]]
        # The first corner with each of the others: that connects an element as all its edges do.
        first, other = np.repeat(corners[:, 0], corners.shape[1] - 1), corners[:, 1:].ravel()
        graph = coo_array((np.ones(len(first), np.int8), (first, other)), shape=(num_nodes, num_nodes))
        part = connected_components(graph, directed=False)[1].astype(np.int32)[part]
    return part


def require_array(name: str, array: str, value: np.ndarray, dtype: type, shape: tuple[int | None, ...]) -> None:
    """Raise DatasetError unless `value` has the dtype and the shape; None in `shape` stands for any size."""
    if value.dtype != dtype:
        raise DatasetError(f"{name}: {array} must be {np.dtype(dtype)}, not {value.dtype}")
    fits = len(value.shape) == len(shape) and all(w in (None, s) for s, w in zip(value.shape, shape, strict=True))
    if not fits:
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        raise DatasetError(f"{name}: {array} has the shape {list(value.shape)}, must be [{wanted}]")


def require_finite_frames(name: str, array: str, row: str, value: np.ndarray, first_frame: int = 0) -> None:
    """Raise DatasetError naming the first frame and row of `value` [S, rows, F] that is not finite."""
    finite = np.isfinite(value)
    if not finite.all():
        frame, index, _ = np.unravel_index(np.argmin(finite), finite.shape)
        numbers = value[frame, index].tolist()
        raise DatasetError(f"{name}: {array} in frame {first_frame + frame} at {row} {index} is not finite: {numbers}")


def _require_finite(name: str, array: str, row: str, value: np.ndarray) -> None:
    finite = np.isfinite(value).all(axis=1)
    if not finite.all():
        index = int(np.argmin(finite))
        raise DatasetError(f"{name}: {array} of {row} {index} is not finite: {value[index].tolist()}")

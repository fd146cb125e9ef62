"""A random simulation: bricks of elements, some of them tools, that move; and what a reader must make of it.

Legend: n points of the file, S frames.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

# Corners of a hexahedron in VTK's order, as steps along the axes.
_HEXAHEDRON = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)])
_TETRAHEDRA = [(0, 1, 2, 6), (0, 2, 3, 6), (0, 3, 7, 6), (0, 7, 4, 6), (0, 4, 5, 6), (0, 5, 1, 6)]
_WEDGES = [(0, 1, 2, 4, 5, 6), (0, 2, 3, 4, 6, 7)]
_QUADS = [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]

# The edges with a node in their middle, in the order of VTK, Abaqus and CalculiX.
MIDDLES = {
    "tetra10": [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)],
    "hexahedron20": [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)],
    "wedge15": [(0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3), (0, 3), (1, 4), (2, 5)],
    "pyramid13": [(0, 1), (1, 2), (2, 3), (3, 0), (0, 4), (1, 4), (2, 4), (3, 4)],
}
SECOND = {"tetra": "tetra10", "hexahedron": "hexahedron20", "wedge": "wedge15", "pyramid": "pyramid13"}
CORNERS = {"tetra": 4, "hexahedron": 8, "wedge": 6, "pyramid": 5}

Blocks = list[tuple[str, np.ndarray]]


@dataclass
class Body:
    """A brick: points [n, 3], one block of cells for each kind, whether it is a tool."""

    points: np.ndarray
    blocks: Blocks
    tool: bool


@dataclass
class Simulation:
    """What is written.

    Attributes:
        bodies: each with points of its own.
        displacement: [S, n, 3] of all points, body by body; the first frame is at rest.
        stress: [S, n] at the points; the corners of cells have whole numbers.
        times: [S].
        fixed: [n] bool, prescribed points of bodies that deform.
        defects: what the file shall have: "inside out", "twice", "unused", "unstitched", "order".
        corners_only: whether the reader is told to take the corners only of tetrahedra of ten nodes.
    """

    bodies: list[Body]
    displacement: np.ndarray
    stress: np.ndarray
    times: np.ndarray
    fixed: np.ndarray
    defects: set[str] = field(default_factory=set)
    corners_only: bool = False

    @property
    def points(self) -> np.ndarray:
        return np.concatenate([body.points for body in self.bodies])

    @property
    def starts(self) -> np.ndarray:
        """[bodies + 1]: where the points of each body begin."""
        return np.cumsum([0, *(len(body.points) for body in self.bodies)])

    @property
    def blocks(self) -> list[tuple[int, str, np.ndarray]]:
        """(body, kind, numbers of points among all) of each block."""
        return [
            (number, kind, cells + start)
            for number, (body, start) in enumerate(zip(self.bodies, self.starts, strict=False))
            for kind, cells in body.blocks
        ]

    @property
    def body_of_point(self) -> np.ndarray:
        return np.repeat(np.arange(len(self.bodies)), np.diff(self.starts))

    @property
    def tool(self) -> np.ndarray:
        """[n] bool"""
        return np.array([body.tool for body in self.bodies])[self.body_of_point]

    @property
    def corners(self) -> np.ndarray:
        """The points that are corners of cells, ascending."""
        return np.unique(np.concatenate([cells[:, : corners_of(kind)].ravel() for _, kind, cells in self.blocks]))

    @property
    def ten_nodes(self) -> bool:
        """Whether the elements of the scene have ten nodes."""
        return "tetra10" in self.kinds and not self.corners_only

    @property
    def nodes(self) -> np.ndarray:
        """The points that are nodes of the scene, ascending."""
        middles = [cells.ravel() for _, kind, cells in self.blocks if kind == "tetra10" and self.ten_nodes]
        return np.unique(np.concatenate([self.corners, *middles]))

    @property
    def size(self) -> float:
        return float(np.ptp(self.points, axis=0).max())

    @property
    def kinds(self) -> set[str]:
        return {kind for _, kind, _ in self.blocks}


def corners_of(kind: str) -> int:
    return CORNERS[kind.rstrip("0123456789")]


def draw_simulation(rng: np.random.Generator, kinds: tuple[str, ...], frames: int = 3) -> Simulation:
    """A simulation of one to three bricks of random size, place and kind of cells; the last of several is a tool."""
    count = int(rng.integers(1, 4))
    scale, place = 10.0 ** rng.integers(-3, 3), rng.integers(-2, 3, 3).astype(float)
    bodies, height = [], 0.0
    for number in range(count):
        cells = rng.integers(1, 4, 3)
        body = _brick(rng, cells, str(rng.choice(kinds)), number == count - 1 > 0)
        body.points[:, 2] += height
        height += cells[2] + 0.3 + float(rng.random())
        body.points = scale * (body.points + place)
        bodies.append(body)
    n = sum(len(body.points) for body in bodies)
    points = np.concatenate([body.points for body in bodies])
    tool = np.repeat([body.tool for body in bodies], [len(body.points) for body in bodies])
    travel = 0.1 * scale * np.linspace(0, 1, frames)[:, None, None]
    bent = points / scale @ rng.normal(0, 0.2, (3, 3)) + np.sin(points[:, ::-1] / scale)
    displacement = np.where(tool[:, None], np.array([0.2, 0.0, -1.0]), bent) * travel
    stress = np.arange(frames)[:, None] * 100.0 + rng.permutation(n) % 89
    times = np.cumsum(rng.uniform(0.01, 1, frames)) - 0.01
    fixed = (points[:, 0] <= points[:, 0].min() + 1e-6 * scale) & ~tool
    return Simulation(bodies, displacement, stress, times, fixed)


def bend_edges(rng: np.random.Generator, simulation: Simulation) -> None:
    """Move the nodes in the middles of edges within bricks of tetrahedra of ten nodes, by a few percent of the edge."""
    for body in simulation.bodies:
        for kind, cells in body.blocks:
            if kind == "tetra10":
                middles, first = np.unique(cells[:, 4:], return_index=True)
                ends = body.points[cells[:, MIDDLES[kind]].reshape(-1, 2)[first]]
                low, high = body.points.min(axis=0), body.points.max(axis=0)
                margin = 1e-3 * (high - low)
                at = body.points[middles]
                inner = ((at > low + margin) & (at < high - margin)).all(axis=1)
                length = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)[:, None]
                body.points[middles[inner]] += (rng.uniform(-0.05, 0.05, at.shape) * length)[inner]


def _brick(rng: np.random.Generator, cells: np.ndarray, kind: str, tool: bool) -> Body:
    """A brick of unit cells, each of them one hexahedron or cut; of a second order if the kind says so."""
    nodes = np.stack(np.meshgrid(*[np.arange(k + 1.0) for k in cells], indexing="ij"), axis=-1).reshape(-1, 3)
    index = np.arange(len(nodes)).reshape(cells + 1)
    where = np.stack(np.meshgrid(*[np.arange(k) for k in cells], indexing="ij"), axis=-1).reshape(-1, 3)
    hexahedra = index[tuple((where[:, None] + _HEXAHEDRON).transpose(2, 0, 1))]
    shape = kind.rstrip("0123456789")
    inner = (nodes > 0).all(axis=1) & (nodes < cells).all(axis=1)
    nodes[inner] += rng.uniform(-0.1, 0.1, (int(inner.sum()), 3))
    if shape == "tetra":
        cut = hexahedra[:, _TETRAHEDRA].reshape(-1, 4)
    elif shape == "wedge":
        cut = hexahedra[:, _WEDGES].reshape(-1, 6)
    elif shape == "pyramid":
        centre = len(nodes) + np.arange(len(hexahedra))
        nodes = np.concatenate([nodes, nodes[hexahedra].mean(axis=1)])
        cut = np.concatenate([np.column_stack([hexahedra[:, quad[::-1]], centre]) for quad in _QUADS])
    else:
        cut = hexahedra
    if kind != shape:
        nodes, cut = _with_middles(nodes, cut, MIDDLES[kind])
    return Body(nodes, [(kind, cut[rng.permutation(len(cut))])], tool)


def _with_middles(nodes: np.ndarray, cells: np.ndarray, edges: list[tuple[int, int]]) -> tuple[np.ndarray, np.ndarray]:
    ends = np.sort(cells[:, edges], axis=2)
    unique, number = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
    middles = len(nodes) + number.reshape(len(cells), len(edges))
    return np.concatenate([nodes, nodes[unique].mean(axis=1)]), np.concatenate([cells, middles], axis=1)

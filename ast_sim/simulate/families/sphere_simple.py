"""Scene family `sphere_simple`: a sheet of cloth that hangs from two corners, and a sphere that moves to and fro.

The scene is `conf/sphere.json` of ARCSim (Narain et al. 2012, figure 2b). Pfaff et al. 2021 made their data set of this
name with that solver and scenes of this kind. A square sheet of about a metre is held at its two upper corners
(HANDLE). It starts tilted out of the plane in which it will hang, swings down, and meets a sphere (OBSTACLE, triangles,
radius 0.1 to 0.2 m). The sphere passes through that plane several times at up to 1.5 m/s.
A sheet that is not held would slide off and fall out of any domain within the five seconds. There is no friction and no
air.

500 frames are stored, as in that data set: the start, and the ends of 499 steps of 0.01 s. Every draw comes from the
generator that is passed in, in a fixed order.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay

from ast_sim.dataset.layout import DatasetInfo
from ast_sim.mechanics import Checkpoint, ClothCase, ClothMaterial, ContactSettings, implicit_euler
from ast_sim.scene import NodeType, Scene, Trajectory

FRAMES = 500
DEFAULT_NODES = 2000
MINIMUM_NODES = 200
STIFFNESS = 300.0  # of the barrier in pascal: some hundred times the weight of the cloth per area
INFO = DatasetInfo(
    family="sphere_simple",
    integration="dynamic",
    stress_location="none",
    domain_center=(0.0, 0.0, 0.0),
    domain_half_width=1.5,
    contact_radius=0.05,
    time_step=0.01,
)


def draw(rng: np.random.Generator, nodes: int = DEFAULT_NODES) -> ClothCase:
    """Draw a scene of about `nodes` nodes, including the sphere's."""
    ball, ball_triangles = icosphere(next(level for level in (3, 2, 1, 0) if 10 * 4**level + 2 <= nodes / 4))
    size = rng.uniform(0.9, 1.1, 2)
    flat, triangles = sheet(tuple(size), nodes - len(ball), rng)
    spacing = _spacing(size, nodes - len(ball))
    corner = np.abs(flat) > size / 2 - 1.6 * spacing
    held = corner.all(axis=1) & (flat[:, 1] > 0)
    tilt = np.radians(rng.uniform(15, 75))
    side = rng.choice([-1.0, 1.0])
    down = flat[:, 1] - size[1] / 2
    cloth = np.stack([flat[:, 0], -side * down * np.sin(tilt), size[1] / 2 + down * np.cos(tilt)], axis=1)
    radius = rng.uniform(0.1, 0.2)
    path = _draw_path(rng, radius) * np.array([1, side, 1])
    material = ClothMaterial(
        stretch=float(np.exp(rng.uniform(*np.log([60, 200])))),
        poisson=0.3,
        bending=float(np.exp(rng.uniform(*np.log([5e-5, 5e-4])))),
        density=rng.uniform(0.15, 0.3),
        compression=0.1,
    )
    node_type = np.full(len(cloth) + len(ball), NodeType.OBSTACLE, np.uint8)
    node_type[: len(cloth)] = np.where(held, NodeType.HANDLE, NodeType.NORMAL)
    elements = np.concatenate([triangles, ball_triangles + len(cloth)]).astype(np.int32)
    columns = np.zeros((len(elements), 3), np.float32)
    columns[: len(triangles)] = material.stretch, material.bending, material.density
    scene = Scene(
        rest_position=np.concatenate([cloth, radius * ball + path[0]]).astype(np.float32),
        elements=elements,
        node_type=node_type,
        body=np.repeat([0, 1], [len(cloth), len(ball)]).astype(np.int32),
        material=columns,
    )
    moved = np.where((scene.body == 1)[:, None], (path - path[0])[:, None, :], 0)
    return ClothCase(
        scene=scene,
        prescribed_position=scene.rest_position.astype(np.float64) + moved,
        material=material,
        contact=ContactSettings(_distance(nodes), STIFFNESS, self_contact=True),
        time_step=INFO.time_step,
        attributes={"radius": float(radius), "tilt": float(side * np.degrees(tilt))},
    )


def solve(case: ClothCase, checkpoint: Checkpoint | None = None, patient: bool = False) -> Trajectory:
    """Solve a drawn scene."""
    return implicit_euler(case, checkpoint=checkpoint, patient=patient)


def _spacing(size: np.ndarray, nodes: int) -> float:
    """Side s of the equilateral triangles with which `nodes` nodes cover a rectangle.

    There are 2 h / (sqrt(3) s) + 1 rows of w / s + 3/2 nodes each, on average.
    """
    rows = 2 / np.sqrt(3) * size[1]
    area, edge = size[0] * rows, size[0] + 1.5 * rows
    return float(2 * area / (np.sqrt(edge**2 + 4 * area * (nodes - 1.5)) - edge))


def _distance(nodes: int) -> float:
    """Contact distance in metres for scenes of `nodes` nodes. Nodes that share no triangle are further apart."""
    return min(0.006, 0.25 * _spacing(np.ones(2), nodes))


def _draw_path(rng: np.random.Generator, radius: float) -> np.ndarray:
    """Centre of the sphere in each frame [S,3]. It starts at rest at y < -radius; the cloth is at y >= 0."""
    time = INFO.time_step * np.arange(FRAMES)[:, None]
    start = rng.uniform([-0.25, -radius - 0.35, -0.3], [0.25, -radius - 0.1, 0.1])
    reach = rng.uniform([-0.25, 0.5, -0.15], [0.25, 1.0, 0.15])
    period = rng.uniform([2.5, 2.2, 2.5], [5.0, 4.0, 5.0])
    return start + reach * (1 - np.cos(2 * np.pi * time / period)) / 2


def sheet(size: tuple[float, float], nodes: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A rectangle around the origin without preferred directions: about `nodes` nodes [N,2], triangles [T,3].

    Inner nodes of a grid of equilateral triangles are moved at random, because a regular grid would fold along its
    lines.
    """
    spacing = _spacing(np.array(size), nodes)
    across, up = max(2, round(size[0] / spacing)), max(2, round(size[1] / spacing * 2 / np.sqrt(3)))
    ends = np.linspace(-0.5, 0.5, across + 1)
    between = np.concatenate([[-0.5], (ends[1:] + ends[:-1]) / 2, [0.5]])
    rows = [between if row % 2 else ends for row in range(up + 1)]
    height = np.repeat(np.linspace(-0.5, 0.5, up + 1), [len(row) for row in rows])
    position = np.stack([np.concatenate(rows), height], axis=1) * size
    inner = (np.abs(position) < 0.499 * np.array(size)).all(axis=1)
    position[inner] += 0.15 * spacing * rng.uniform(-1, 1, (int(inner.sum()), 2))
    triangles = Delaunay(position).simplices
    first, second = (position[triangles[:, k]] - position[triangles[:, 0]] for k in (1, 2))
    turned = first[:, 0] * second[:, 1] < first[:, 1] * second[:, 0]
    triangles[turned] = triangles[turned][:, ::-1]
    return position, triangles


def icosphere(level: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit sphere: nodes [N,3] and triangles [F,3], with N = 10 4^level + 2.

    It is an icosahedron whose triangles are cut in four, `level` times.
    """
    golden = (1 + np.sqrt(5)) / 2
    a = np.array([[-1, golden, 0], [1, golden, 0], [-1, -golden, 0], [1, -golden, 0]])
    position = np.concatenate([np.roll(a, shift, axis=1) for shift in (0, 1, 2)])
    position /= np.linalg.norm(position[0])
    triangles = _hull(position)
    for _ in range(level):
        pairs = np.sort(np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)]), axis=1)
        edges, edge_of = np.unique(pairs, axis=0, return_inverse=True)
        middle = position[edges].sum(axis=1)
        a, b, c = len(position) + edge_of.reshape(3, -1)
        position = np.concatenate([position, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
        corners = zip(triangles.T, (a, b, c), (c, a, b), strict=True)
        triangles = np.concatenate([*(np.stack(corner, axis=1) for corner in corners), np.stack([a, b, c], axis=1)])
    return position, triangles


def _hull(position: np.ndarray) -> np.ndarray:
    """The triangles [20,3] of the icosahedron: all triples of nearest nodes, counter-clockwise seen from outside."""
    distance = np.linalg.norm(position[:, None] - position, axis=2)
    near = (distance > 0) & (distance < 1.1 * distance[distance > 0].min())
    i, j, k = np.nonzero(near[:, :, None] & near[:, None, :] & near[None])
    triangles = np.stack([i, j, k], axis=1)[(i < j) & (j < k)]
    outward = np.linalg.det(position[triangles]) > 0
    triangles[~outward] = triangles[~outward][:, ::-1]
    return triangles

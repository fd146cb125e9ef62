"""Scene family `deforming_plate`: a clamped plate that a rigid obstacle presses in and lets go.

The plate lies in the plane z = 0 around the origin, both short ends clamped (HANDLE); the obstacle (OBSTACLE, all of
its nodes) stands above it, moves down along a straight slanted way and returns to its start within 41 frames.
Every draw comes from the generator that is passed in, in a fixed order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ast_sim.data.file import DatasetInfo
from ast_sim.data.scene import NodeType, Scene, Trajectory
from ast_sim.simulate import mesh
from ast_sim.simulate.case import SolidCase
from ast_sim.simulate.checkpoint import Checkpoint
from ast_sim.simulate.contact import ContactSettings
from ast_sim.simulate.material import NeoHookean
from ast_sim.simulate.trajectory import quasi_static

FRAMES = 41
DEFAULT_NODES = 400
MINIMUM_NODES = 80
MATERIAL = NeoHookean(young=1e6, poisson=0.4)
CONTACT = ContactSettings(dhat=1e-3, stiffness=MATERIAL.young)
CLAMP_MARGIN = 0.05  # metres that the obstacle stays away from the clamps, seen from above
SHAPES = ("ball", "cylinder", "block")
INFO = DatasetInfo(
    family="deforming_plate",
    integration="quasi_static",
    stress_location="node",
    domain_center=(0.0, 0.0, 0.0),
    domain_half_width=1.0,
    contact_radius=0.03,
    time_step=0.0,
)


def simulate(rng: np.random.Generator, nodes: int = DEFAULT_NODES, checkpoint: Checkpoint | None = None) -> Trajectory:
    """Draw a scene and solve it.

    Args:
        rng: where all draws come from.
        nodes: about how many nodes the scene has, obstacle included.
        checkpoint: where unfinished frames are kept.
    """
    case = draw(rng, nodes)
    obstacle = (case.scene.body == 1)[:, None]
    targets = np.where(obstacle, case.scene.rest_position + case.travel[:, None, :], case.scene.rest_position)
    solid = SolidCase(case.scene, targets, MATERIAL, CONTACT, INFO.stress_location, {"obstacle": case.shape})
    return quasi_static(solid, checkpoint=checkpoint)


@dataclass(frozen=True)
class PlateCase:
    """One drawn scene.

    Attributes:
        scene: plate (body 0, its nodes ordered along its length) and obstacle (body 1).
        travel: [S,3] displacement of the obstacle in each frame, in metres.
        shape: shape of the obstacle.
    """

    scene: Scene
    travel: np.ndarray
    shape: str


def draw(rng: np.random.Generator, nodes: int = DEFAULT_NODES) -> PlateCase:
    """Draw a scene of 0.75 to 1.5 times `nodes` nodes, obstacle included."""
    while True:
        case = _try_draw(rng, nodes)
        if case is not None and 0.75 * nodes <= case.scene.num_nodes <= 1.5 * nodes:
            return case


def _try_draw(rng: np.random.Generator, nodes: int) -> PlateCase | None:
    """One draw; None if its holes overlap, or if the obstacle does not fit or would come down on a hole."""
    refinement = np.sqrt(DEFAULT_NODES / nodes)  # two layers of elements: nodes grow with the area
    spacing = rng.uniform(0.036, 0.044) * refinement
    size = rng.uniform([0.42, 0.24, 0.025], [0.54, 0.40, 0.045])
    cells = np.maximum(np.rint(size / spacing).astype(int), (4, 2, 2))
    holes = _draw_holes(rng, size, spacing)
    if len(holes) == 2 and np.hypot(*(holes[0] - holes[1])[:2]) < holes[:, 2].sum() + 2.4 * spacing:
        return None
    position, elements = mesh.plate(tuple(size), tuple(cells), holes)
    shape, obstacle, obstacle_elements = _draw_obstacle(rng, max(2, round(3 / refinement)))
    travel = _draw_travel(rng)
    lowest = obstacle[np.argmin(obstacle[:, 2])]
    # `aim`: where the lowest point of the obstacle meets the plate. It is solid, and the obstacle stays well between
    # the clamps: nothing gives way where it would press on a clamped node.
    first, last = obstacle[:, 0].min() + travel[:, 0].min(), obstacle[:, 0].max() + travel[:, 0].max()
    left, right = CLAMP_MARGIN - size[0] / 2 - first, size[0] / 2 - CLAMP_MARGIN - last
    if left > right:
        return None
    along = (left + right) / 2 + 0.35 * rng.uniform(-1, 1) * (right - left)
    aim = np.array([along + lowest[0], 0.35 * rng.uniform(-1, 1) * size[1]])
    if not all(np.hypot(*(aim - hole[:2])) >= hole[2] + spacing / 2 for hole in holes):
        return None
    gap = rng.uniform(0.004, 0.015)
    direction = travel[np.argmin(travel[:, 2])]
    start = np.array([*aim, size[2] / 2 + gap]) - [*(direction[:2] * gap / -direction[2]), 0]
    travel = travel * (1 + gap / -direction[2])
    obstacle = obstacle + start - lowest
    node_type = np.full(len(position) + len(obstacle), NodeType.NORMAL, np.uint8)
    node_type[: len(position)][np.isclose(np.abs(position[:, 0]), size[0] / 2)] = NodeType.HANDLE
    node_type[len(position) :] = NodeType.OBSTACLE
    scene = Scene(
        rest_position=np.concatenate([position, obstacle]).astype(np.float32),
        elements=np.concatenate([elements, obstacle_elements + len(position)]).astype(np.int32),
        node_type=node_type,
        body=np.repeat([0, 1], [len(position), len(obstacle)]).astype(np.int32),
    )
    return PlateCase(scene, travel, shape)


def _draw_holes(rng: np.random.Generator, size: np.ndarray, spacing: float) -> np.ndarray:
    """No hole in half of the plates, else one or two, more than a cell from the sides: [H,3] centre x, y, radius."""
    count = rng.choice([0, 1, 2], p=[0.5, 0.4, 0.1])
    margin = 1.2 * spacing
    radius = np.minimum(rng.uniform(0.035, 0.07, count), size[1] / 2 - margin)
    centre = rng.uniform(-1, 1, (count, 2)) * (size[:2] / 2 - radius[:, None] - margin)
    return np.column_stack([centre, radius])


def _draw_obstacle(rng: np.random.Generator, cells: int) -> tuple[str, np.ndarray, np.ndarray]:
    """Shape, positions [N,3] around the origin and tetrahedra of an obstacle, turned by a yaw and a small tilt."""
    shape = SHAPES[rng.integers(len(SHAPES))]
    size = rng.uniform(0.035, 0.075, 3)
    if shape == "ball":
        position, elements = mesh.ball(size[0], cells)
    elif shape == "cylinder":
        position, elements = mesh.cylinder(size[0], size[1], cells)
    else:
        position, elements = mesh.block(tuple(size), cells)
    yaw, tilt, about = rng.uniform(0, np.pi), rng.uniform(0, 0.2), rng.uniform(0, 2 * np.pi)
    axis = np.array([np.cos(about), np.sin(about), 0])
    return shape, position @ _rotation(np.array([0, 0, 1]), yaw).T @ _rotation(axis, tilt).T, elements


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation matrix about a unit axis (Rodrigues)."""
    cross = np.cross(np.eye(3), -axis)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _draw_travel(rng: np.random.Generator) -> np.ndarray:
    """Displacements [S,3] of the obstacle below its first touch: pressed in, then released, ending where it began."""
    depth = rng.uniform(0.02, 0.06)
    direction = np.array([*rng.uniform(-0.25, 0.25, 2), -1.0])
    press = int(rng.integers(22, 30))
    frame = np.arange(FRAMES)
    way = np.where(frame <= press, frame / press, (FRAMES - 1 - frame) / (FRAMES - 1 - press))
    if rng.random() < 0.5:
        way = (1 - np.cos(np.pi * way)) / 2
    return depth * way[:, None] * direction

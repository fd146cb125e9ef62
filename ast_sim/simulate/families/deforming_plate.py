"""Scene family `deforming_plate`: a clamped plate that a rigid obstacle presses in and lets go.

The plate lies in the plane z = 0 around the origin. Both ends are clamped (HANDLE); in half of the scenes the clamps
drift. The obstacle (all of its nodes are OBSTACLE) starts above the plate, moves down along a slanted line, and returns
to its start. Meanwhile it follows the drift. Every draw comes from the generator that is passed in, in a fixed order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ast_sim.dataset.layout import DatasetInfo
from ast_sim.element_topology import MIDDLES
from ast_sim.mechanics import Checkpoint, ContactSettings, Drawn, NeoHookean, SolidCase, SolverSettings, quasi_static
from ast_sim.scene import AttributeValue, NodeType, Scene, Trajectory
from ast_sim.simulate.shapes import plate_mesh
from ast_sim.simulate.shapes.mesh import second_order
from ast_sim.simulate.shapes.mesh_check import BadMesh
from ast_sim.simulate.shapes.obstacles import draw_obstacle
from ast_sim.simulate.shapes.plate_outline_and_holes import Outline, distance_to, draw_outline
from ast_sim.support.errors import ConfigError

FRAMES = 400
DEFAULT_NODES = 1300
MINIMUM_NODES = 80
SECOND_ORDER_NODES = 400  # at least, of a scene of second-order elements
MINIMUM_FRAMES = 3  # a press and its release need this many
YOUNG = 1e6  # pascal
MATERIAL = NeoHookean(YOUNG, poisson=0.4)
CONTACT = ContactSettings(dhat=1e-3, stiffness=YOUNG)
SETTINGS = SolverSettings()
LAYERS = {1: 2, 2: 1}  # of elements through the thickness, by their order: three nodes lie across it either way
ACROSS = 3
OBSTACLE_SHARE = 0.16  # share of the nodes that belong to the obstacle
SECOND_ORDER_CELLS = 4  # at least, along each side of an obstacle of second-order elements, which are two cells long
SMALLEST_ANGLE = np.radians(22)  # smallest angle of a triangle of the middle plane
COARSE_ANGLE = np.radians(10)  # the same for other meshes of the plate: they need not be that good, but must exist
CLAMP_MARGIN = 0.05  # distance in metres, seen from above, between the obstacle and the clamps
INFO = DatasetInfo(
    family="deforming_plate",
    integration="quasi_static",
    stress_location="node",
    domain_center=(0.0, 0.0, 0.0),
    domain_half_width=1.0,
    contact_radius=0.03,
    time_step=0.0,
)


def solve(case: SolidCase, checkpoint: Checkpoint | None = None, patient: bool = False) -> Trajectory:
    """All frames of a drawn scene, or all before the first that cannot be solved."""
    return quasi_static(case, SETTINGS, checkpoint, patient)


@dataclass(frozen=True)
class _Shape:
    """The geometry of a plate, without a mesh.

    Attributes:
        outline: the middle plane.
        columns: about how many nodes the mesh of the middle plane has, with the nodes within its edges.
        area, perimeter: of the middle plane.
        length: distance between the clamps of the unsheared plate.
        thickness: where x = 0.
        taper: by which share the thickness grows from there to x = length.
        order: of the elements.
    """

    outline: Outline
    columns: float
    area: float
    perimeter: float
    length: float
    thickness: float
    taper: float = 0.0
    order: int = 1

    def spacing(self, share: float = 1.0) -> float:
        """Length of the edges of a mesh with that share of the columns."""
        return self.order * plate_mesh.spacing_for(share * self.columns, self.area, self.perimeter)

    def flat_mesh(self, share: float, smallest_angle: float) -> plate_mesh.PlaneMesh | None:
        """The mesh of the middle plane with that share of the columns; None if it has a triangle of poor shape."""
        mesh = plate_mesh.triangulate(self.outline.pieces, self.outline.holes, self.spacing(share))
        return None if mesh is None or plate_mesh.smallest_angle(mesh) < smallest_angle else mesh


@dataclass(frozen=True)
class _Plate:
    """A meshed plate.

    Attributes:
        shape: what was meshed.
        position, elements: [N,3] and [E,k].
        clamps: [N] 1 for nodes of the left clamp, 2 for nodes of the right clamp, 0 elsewhere.
    """

    shape: _Shape
    position: np.ndarray
    elements: np.ndarray
    clamps: np.ndarray


@dataclass(frozen=True)
class _Press:
    """What presses the plate, and how everything moves.

    Attributes:
        obstacle, elements: [N,3] at the start and [E,k].
        travel: displacement [S,3] of the obstacle.
        drift: displacements [2,S,3] of the clamps.
        attributes: what is recorded of the drawing.
    """

    obstacle: np.ndarray
    elements: np.ndarray
    travel: np.ndarray
    drift: np.ndarray
    attributes: dict[str, AttributeValue]


def draw(rng: np.random.Generator, nodes: int = DEFAULT_NODES, frames: int = FRAMES, order: int = 1) -> SolidCase:
    """The case of `draw_geometry`."""
    return draw_geometry(rng, nodes, frames, order).case


def draw_geometry(rng: np.random.Generator, nodes: int = DEFAULT_NODES, frames: int = FRAMES, order: int = 1) -> Drawn:
    """Draw a scene.

    Args:
        rng: where all draws come from.
        nodes: about how many nodes a scene of the dataset has, obstacle included. The drawn scene has 0.5 to 1.7 times
            as many.
        frames: how many frames the press and the release take.
        order: 1 for linear tetrahedra, 2 for tetrahedra of ten nodes.

    Raises:
        ConfigError: there are too few frames for a press and a release.
    """
    if frames < MINIMUM_FRAMES:
        raise ConfigError(f"frames is {frames}; a press and its release need at least {MINIMUM_FRAMES}")
    while True:
        drawn = _try_draw(rng, nodes, frames, order)
        if drawn is not None and 0.5 * nodes <= drawn.case.scene.num_nodes <= 1.7 * nodes:
            return drawn


def _try_draw(rng: np.random.Generator, nodes: int, frames: int, order: int) -> Drawn | None:
    """One draw; None if the plate cannot be meshed well, or if the obstacle does not fit or comes down on a hole."""
    wanted = nodes * rng.triangular(0.53, 0.95, 1.6)
    cells = _obstacle_cells(OBSTACLE_SHARE * wanted, order)
    plate = _draw_plate(rng, wanted - (cells + 1) ** 3, order)
    if plate is None:
        return None
    shape, obstacle, obstacle_elements = draw_obstacle(rng, cells, order)
    progress = draw_progress(rng, frames)
    depth = rng.uniform(0.02, 0.065)
    direction = np.array([*rng.uniform(-0.25, 0.25, 2), -1.0])
    touch = _draw_touch(rng, plate, obstacle, depth * direction)
    if touch is None:
        return None
    gap = rng.uniform(0.004, 0.015)
    drift = draw_drift(rng, progress)
    lowest = obstacle[np.argmin(obstacle[:, 2])]
    start = np.array([*touch, plate.position[:, 2].max()]) - gap * direction
    obstacle = obstacle + start - lowest
    travel = (depth + gap) * progress[:, None] * direction + _follow(plate, touch, drift)
    attributes: dict[str, AttributeValue] = {
        "obstacle": shape,
        "outline": plate.shape.outline.kind,
        "holes": " ".join(plate.shape.outline.hole_kinds),
        "thickness": float(np.ptp(plate.position[:, 2])),
        "depth": depth,
        "drift": [float(np.linalg.norm(moves, axis=1).max()) for moves in drift],
    }
    press = _Press(obstacle, obstacle_elements, travel, drift, attributes)
    return Drawn(_case(plate, press), lambda share: _case(_remeshed(plate.shape, share), press))


def _obstacle_cells(nodes: float, order: int) -> int:
    """Cells along each side of an obstacle of about that many nodes; an even number for second-order elements."""
    side = nodes ** (1 / 3) - 1
    return max(2, round(side)) if order == 1 else max(SECOND_ORDER_CELLS, 2 * int(side / 2))


def _case(plate: _Plate, press: _Press) -> SolidCase:
    n, frames = len(plate.position), len(press.travel)
    scene = _assemble(plate, press.obstacle, press.elements)
    prescribed_position = np.repeat(scene.rest_position.astype(np.float64)[None], frames, axis=0)
    prescribed_position[:, n:] += press.travel[:, None]
    for clamp, moves in enumerate(press.drift, 1):
        prescribed_position[:, :n][:, plate.clamps == clamp] += moves[:, None]
    return SolidCase(scene, prescribed_position, MATERIAL, CONTACT, INFO.stress_location, press.attributes)


def _draw_plate(rng: np.random.Generator, nodes: float, order: int) -> _Plate | None:
    """A plate of about `nodes` nodes; None if it has an element of poor shape."""
    length, width, thickness = rng.uniform([0.42, 0.24, 0.025], [0.54, 0.40, 0.045])
    columns = nodes / ACROSS
    spacing = order * plate_mesh.spacing_for(columns, length * width, 2 * (length + width))
    outline = draw_outline(rng, length, width, spacing)
    loops = [np.concatenate(outline.pieces), *outline.holes]
    area = sum(abs(plate_mesh.area(loop)) * (1 if loop is loops[0] else -1) for loop in loops)
    shape = _Shape(outline, columns, area, sum(map(plate_mesh.length, loops)), length, thickness, order=order)
    mesh = shape.flat_mesh(1.0, SMALLEST_ANGLE)
    if mesh is None:
        return None
    shape = replace(shape, taper=rng.uniform(-0.3, 0.3) if rng.random() < 0.4 else 0.0)
    return _extruded(shape, mesh)


def _extruded(shape: _Shape, mesh: plate_mesh.PlaneMesh) -> _Plate:
    thickness = shape.thickness * (1 + shape.taper * mesh.points[:, 0] / shape.length)
    layers = LAYERS[shape.order]
    position, elements = plate_mesh.extrude(mesh, thickness, layers)
    clamps = np.zeros(len(mesh.points), int)
    for clamp, piece in enumerate(shape.outline.ends, 1):
        clamps[mesh.pieces[piece]] = clamp
    plate = _Plate(shape, position, elements, np.repeat(clamps, layers + 1))
    return plate if shape.order == 1 else _raised(plate)


def _raised(plate: _Plate) -> _Plate:
    """The plate in second-order elements. A middle is clamped where both ends of its edge are, by the same clamp."""
    position, elements = second_order(plate.position, plate.elements)
    ends = plate.clamps[elements[:, np.array(MIDDLES)]]  # [E,6,2]
    clamps = np.zeros(len(position), int)
    clamps[elements[:, :4]] = plate.clamps[elements[:, :4]]
    clamps[elements[:, 4:]] = np.where(ends[..., 0] == ends[..., 1], ends[..., 0], 0)
    return _Plate(plate.shape, position, elements, clamps)


def _remeshed(shape: _Shape, share: float) -> _Plate:
    """The plate with about that share of its nodes, in as many layers; with fewer, it could not bend.

    Raises:
        BadMesh: the curves of the plate come too close to each other for edges that long.
    """
    mesh = shape.flat_mesh(share, COARSE_ANGLE)
    if mesh is None:
        raise BadMesh(f"a mesh with {share:g} of the nodes has triangles of poor shape: holes and sides are too close")
    return _extruded(shape, mesh)


def _draw_touch(rng: np.random.Generator, plate: _Plate, obstacle: np.ndarray, press: np.ndarray) -> np.ndarray | None:
    """The point [2] where the obstacle's lowest point meets the plate. None if it does not fit, or meets a hole.

    The plate is solid at this point, and the obstacle stays well between the clamps on its whole path. A clamped node
    could not give way under it.
    """
    x, y = obstacle[:, :2].T - obstacle[np.argmin(obstacle[:, 2]), :2][:, None]
    ends = [plate.position[plate.clamps == clamp, 0] for clamp in (1, 2)]
    left = ends[0].max() + CLAMP_MARGIN - min(x.min(), (x + press[0]).min())
    right = ends[1].min() - CLAMP_MARGIN - max(x.max(), (x + press[0]).max())
    if left > right:
        return None
    along, across = rng.uniform(-1, 1, 2)
    side = np.abs(plate.position[:, 1]).max()
    touch = np.array([(left + right) / 2 + 0.35 * along * (right - left), 0.7 * across * side])
    sides = np.concatenate(plate.shape.outline.pieces)
    holes = plate.shape.outline.holes
    solid = distance_to(sides, touch) < -0.2 * side
    return touch if solid and all(distance_to(hole, touch) >= plate.shape.spacing() / 2 for hole in holes) else None


def draw_progress(rng: np.random.Generator, frames: int) -> np.ndarray:
    """Share of the press in each frame [S].

    It rises from 0 to 1, stays there for some frames in some scenes, and falls back to 0; linearly or like a cosine.
    """
    last = frames - 1
    peak = min(round(rng.triangular(0.7, 0.9, 0.93) * last), last - 1)
    hold = min(round(rng.uniform(0.02, 0.06) * last), peak - 1) if rng.random() < 0.3 else 0
    progress = np.interp(np.arange(frames), [0, peak - hold, peak, last], [0, 1, 1, 0])
    return (1 - np.cos(np.pi * progress)) / 2 if rng.random() < 0.5 else progress


def draw_drift(rng: np.random.Generator, progress: np.ndarray) -> np.ndarray:
    """Displacements [2,S,3] of the left and the right clamp in metres. None, one or both drift, by 0.02 to 0.06.

    They drift outwards, sideways, up and down, but not inwards, because a plate that is pushed together buckles. A
    drift grows smoothly until the last frame, or comes and goes with the press.
    """
    drift = np.zeros((2, len(progress), 3))
    moving = rng.choice(4, p=[0.5, 0.15, 0.15, 0.2])  # none, left, right, both
    for clamp, outwards in ((0, -1), (1, 1)):
        direction = np.array([outwards * rng.uniform(0, 0.7), *rng.uniform(-1, 1, 2)])
        size = rng.uniform(0.02, 0.06)
        if moving in (clamp + 1, 3):
            drift[clamp] = size * direction / np.linalg.norm(direction)
    returns = rng.random() < 0.5
    share = progress if returns else (1 - np.cos(np.pi * np.linspace(0, 1, len(progress)))) / 2
    return drift * share[:, None]


def _follow(plate: _Plate, touch: np.ndarray, drift: np.ndarray) -> np.ndarray:
    """Displacement [S,3] of a clamped beam where the obstacle touches it, while its ends drift."""
    left, right = (plate.position[plate.clamps == clamp, 0].mean() for clamp in (1, 2))
    s = (touch[0] - left) / (right - left)
    share = s * s * (3 - 2 * s)
    return (1 - share) * drift[0] + share * drift[1]


def _assemble(plate: _Plate, obstacle: np.ndarray, obstacle_elements: np.ndarray) -> Scene:
    n = len(plate.position)
    node_type = np.full(n + len(obstacle), NodeType.OBSTACLE, np.uint8)
    node_type[:n] = np.where(plate.clamps > 0, NodeType.HANDLE, NodeType.NORMAL)
    return Scene(
        rest_position=np.concatenate([plate.position, obstacle]).astype(np.float32),
        elements=np.concatenate([plate.elements, obstacle_elements + n]).astype(np.int32),
        node_type=node_type,
        body=np.repeat([0, 1], [n, len(obstacle)]).astype(np.int32),
    )

"""Put two parts together: turn them, lower one onto the other until they almost touch, and clamp their far ends.

Legend: N nodes, E tetrahedra, F triangles of a surface.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ast_sim.mechanics.contact_and_friction import Contact, ContactSettings
from ast_sim.simulate.shapes.mesh_check import boundary
from ast_sim.simulate.shapes.parts import Part
from ast_sim.support.errors import SimulationError

HALF_EXTENT = 0.9  # half of the longest side of a pair
SLENDEREST = 1.25  # largest height of a standing part, relative to the shorter side of its base
FARTHEST = 0.3  # largest offset of the parts along each axis, relative to the smaller extent
LEAST_OVERLAP = 0.3  # smallest overlap of the two shadows, relative to the smaller shadow
RASTER = 64  # cells along the longer side of the raster on which shadows are measured
START = 0.1  # height above the lower part at which the upper one starts to go down
PLACEMENTS = 30  # tries to place one part above the other
LEAST_CLAMP = 0.1  # smallest area of a clamped face, relative to the shadow of its part
CLAMP_BANDS = (0.02, 0.05, 0.1)  # depths that a clamped face may have, relative to the height of its part
CLAMP_COSINE = 0.5  # smallest cosine of the angle between the normals of a clamped face and the vertical


class Unsuitable(SimulationError):
    """Two parts that cannot be put together this way. Another draw may succeed."""


@dataclass(frozen=True, eq=False)
class PairOfParts:
    """Two parts as they stand: the upper one above the lower, both within [-1,1].

    Attributes:
        position: [N,3] float64, nodes of the lower part first.
        elements: [E,4].
        faces: [F,3], the surfaces of both parts.
        body: [N] 0 lower, 1 upper.
        clamped: [N] bool, the nodes at the lower end of the lower part and at the upper end of the upper part.
        height: distance between these two ends, without the gap between the parts.
        overlap: overlap of the two shadows, relative to the smaller shadow.
        scale: lengths of the parts were multiplied by this.
    """

    position: np.ndarray
    elements: np.ndarray
    faces: np.ndarray
    body: np.ndarray
    clamped: np.ndarray
    height: float
    overlap: float
    scale: float


def put_together(rng: np.random.Generator, lower: Part, upper: Part, gap: float) -> PairOfParts:
    """Turn both parts, put one above the other and clamp their far ends.

    Args:
        rng: where the orientations and the offset come from.
        lower: the lower part, at any position.
        upper: the upper part, at any position.
        gap: distance between the parts after the pair is scaled.

    Raises:
        Unsuitable: no placement has enough overlap, the parts do not meet, or an end has no face to clamp.
    """
    count = len(lower.position)
    elements = np.concatenate([lower.elements, upper.elements + count])
    body = np.repeat([0, 1], [count, len(upper.position)])
    low_faces, high_faces = boundary(lower.elements), boundary(upper.elements)
    faces = np.concatenate([low_faces, high_faces + count])
    low, high = turned(rng, lower.position), turned(rng, upper.position)
    low_clamp, high_clamp = _end_face(low, low_faces, -1), _end_face(high, high_faces, 1)
    high, overlap = _place(rng, low, low_faces, high, high_faces)
    position = _lowered(np.concatenate([low, high]), faces, body)
    scale = 2 * HALF_EXTENT / np.ptp(position, axis=0).max()
    position = _spaced(position * scale, faces, body, gap)
    position -= (position.max(axis=0) + position.min(axis=0)) / 2
    clamped = np.concatenate([low_clamp, high_clamp])
    if min(clamped[:count].sum(), clamped[count:].sum()) < 3:
        raise Unsuitable("an end of a part has no three nodes to clamp")
    height = float(np.ptp(position[clamped, 2])) - gap
    return PairOfParts(position, elements, faces, body, clamped, height, overlap, float(scale))


def put_likewise(
    pair: PairOfParts, drawn: tuple[Part, Part], parts: tuple[Part, Part], gap: float
) -> tuple[PairOfParts, float]:
    """Put other meshes of the same two parts where these parts stand.

    Args:
        pair: how the parts stand.
        drawn: the meshes that it was put together from.
        parts: the other meshes.
        gap: smallest distance between the parts. A coarse surface may lie outside the fine one, so the upper part is
            raised where it would be closer.

    Returns:
        The pair of the other meshes, and how far its upper part was raised.

    Raises:
        Unsuitable: an end has no face to clamp, or the parts stay too close.
    """
    positions, clamps, faces = [], [], []
    for body, (old, new) in enumerate(zip(drawn, parts, strict=True)):
        positions.append(_carried(old.position, pair.position[pair.body == body], new.position))
        faces.append(boundary(new.elements))
        clamps.append(_end_face(positions[-1], faces[-1], 2 * body - 1))
        if clamps[-1].sum() < 3:
            raise Unsuitable("an end of a part has no three nodes to clamp")
    count = len(positions[0])
    body = np.repeat([0, 1], [count, len(positions[1])])
    surface = np.concatenate([faces[0], faces[1] + count])
    position = _spaced(np.concatenate(positions), surface, body, gap)
    other = replace(
        pair,
        position=position,
        elements=np.concatenate([parts[0].elements, parts[1].elements + count]),
        faces=surface,
        body=body,
        clamped=np.concatenate(clamps),
    )
    return other, float(position[-1, 2] - positions[1][-1, 2])


def _carried(start: np.ndarray, end: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points [n,3] after the affine map that takes the positions `start` to the positions `end` [N,3]."""
    extended = np.column_stack([start, np.ones(len(start))])
    return np.column_stack([points, np.ones(len(points))]) @ np.linalg.lstsq(extended, end)[0]


def turned(rng: np.random.Generator, position: np.ndarray) -> np.ndarray:
    """Turn a part: positions [N,3] with one side of its box down, turned about the vertical.

    The part is centred over the origin, and its lowest point is at z = 0. A side on which the part would stand too
    slender to be squeezed is not used.
    """
    extent = np.ptp(position, axis=0)
    upright = [axis for axis in range(3) if extent[axis] <= SLENDEREST * np.delete(extent, axis).min()]
    axis = int(rng.choice(upright))
    sign = int(rng.choice([-1, 1]))
    yaw = rng.uniform(0, 2 * np.pi)
    result = sign * np.roll(position, 2 - axis, axis=1)  # a cyclic change of axes is a rotation
    result[:, 0] *= sign  # and so is reversing two axes
    c = np.cos(yaw)
    s = np.sin(yaw)
    result[:, :2] = result[:, :2] @ np.array([[c, s], [-s, c]])
    result[:, :2] -= (result[:, :2].max(axis=0) + result[:, :2].min(axis=0)) / 2
    result[:, 2] -= result[:, 2].min()
    return result


def _end_face(position: np.ndarray, faces: np.ndarray, side: int) -> np.ndarray:
    """[N] bool: the nodes of the surface that faces down (side -1) or up (1) within a band at that end.

    The band is the thinnest of `CLAMP_BANDS` that holds at least `LEAST_CLAMP` of the part's shadow.
    """
    a, b, c = np.moveaxis(position[faces], 1, 0)
    normal = np.cross(b - a, c - a) / 2  # its length is the area
    shadow = np.maximum(normal[:, 2], 0).sum()
    facing = side * normal[:, 2] >= CLAMP_COSINE * np.linalg.norm(normal, axis=1)
    depth = np.abs(position[:, 2] - (position[:, 2].max() if side > 0 else position[:, 2].min()))
    for band in CLAMP_BANDS:
        inside = facing & (depth[faces].max(axis=1) <= band * np.ptp(position[:, 2]))
        if np.abs(normal[inside, 2]).sum() >= LEAST_CLAMP * shadow:
            nodes = np.zeros(len(position), bool)
            nodes[faces[inside]] = True
            return nodes
    raise Unsuitable("an end of a part is too pointed to clamp")


def _place(
    rng: np.random.Generator, low: np.ndarray, low_faces: np.ndarray, high: np.ndarray, high_faces: np.ndarray
) -> tuple[np.ndarray, float]:
    """Move the upper part above the lower one so that their shadows overlap enough; return positions and overlap."""
    extent = np.minimum(np.ptp(low[:, :2], axis=0), np.ptp(high[:, :2], axis=0))
    cell = max(np.ptp(low[:, :2]), np.ptp(high[:, :2])) / RASTER
    low_shadow = shadow_cells(low[:, :2], low_faces, cell)
    for _ in range(PLACEMENTS):
        moved = high + [*(rng.uniform(-FARTHEST, FARTHEST, 2) * extent), low[:, 2].max() + START]
        high_shadow = shadow_cells(moved[:, :2], high_faces, cell)
        common = len(np.intersect1d(low_shadow, high_shadow, assume_unique=True))
        overlap = common / min(len(low_shadow), len(high_shadow))
        if overlap >= LEAST_OVERLAP:
            return moved, overlap
    raise Unsuitable(f"no placement of {PLACEMENTS} with an overlap of {LEAST_OVERLAP:.0%}")


def shadow_cells(points: np.ndarray, faces: np.ndarray, cell: float) -> np.ndarray:
    """The cells of a square raster that the triangles [F,3] over points [N,2] cover, as ascending numbers.

    Each triangle is sampled more finely than the raster. The number of a cell is 2^20 x + y.
    """
    corners = points[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    level = np.ceil(np.log2(np.maximum(2 * longest / cell, 1))).astype(int)
    cells = []
    for power in np.unique(level):
        parts = 2**power
        i, j = np.array([(i, j) for i in range(parts + 1) for j in range(parts + 1 - i)]).T / parts
        weights = np.stack([1 - i - j, i, j])
        samples = np.einsum("ks,fkd->fsd", weights, corners[level == power]).reshape(-1, 2)
        index = np.floor(samples / cell).astype(np.int64)
        cells.append(np.unique(index[:, 0] * 2**20 + index[:, 1]))
    return np.unique(np.concatenate(cells))


def _lowered(position: np.ndarray, faces: np.ndarray, body: np.ndarray) -> np.ndarray:
    """Positions after the upper part has gone down until it is about to touch the lower one."""
    contact = Contact(position, faces, body, ContactSettings(dhat=1e-3, stiffness=1.0))
    down = np.where(body == 1, -np.ptp(position[:, 2]), 0.0)[:, None] * [0.0, 0.0, 1.0]
    fraction = 1.0
    while fraction * np.abs(down).max() > 1e-5:  # each pass goes most of the remaining way
        fraction = contact.collision_free_fraction(position, position + down)
        if fraction >= 1:
            raise Unsuitable("the upper part passes the lower one without touching it")
        position = position + fraction * down
    return position


def _spaced(position: np.ndarray, faces: np.ndarray, body: np.ndarray, gap: float) -> np.ndarray:
    """Positions after the upper part has gone up until the parts are `gap` apart."""
    contact = Contact(position, faces, body, ContactSettings(dhat=gap, stiffness=1.0))
    upper = body == 1
    for _ in range(100):
        distance = contact.gap(position)
        if distance >= gap:
            return position
        position = position + np.where(upper, gap - distance + 0.01 * gap, 0.0)[:, None] * [0.0, 0.0, 1.0]
    raise Unsuitable("the parts are too close to each other side by side")

"""Outlines and holes of plates as dense polylines, drawn at random; lengths in metres."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from ast_sim.simulate.shapes.plate_mesh import inside, resample

OUTLINES = ("straight", "tapered", "waisted", "bulged", "wavy", "notched")
HOLES = ("round", "slot", "ellipse")
DENSE = 400  # points of a curve
STEP = 1e-3  # metres between the points at which distances are measured
HOLE_TRIES = 8


@dataclass(frozen=True)
class Outline:
    """The middle plane of a plate around the origin, its clamped ends along x.

    Attributes:
        kind: one of OUTLINES.
        pieces: polylines [K,2], counter-clockwise.
        ends: indices in `pieces` of the two clamped pieces: left, right.
        holes: closed polylines [K,2].
        hole_kinds: the kind of each hole, one of HOLES.
    """

    kind: str
    pieces: list[np.ndarray]
    ends: tuple[int, int]
    holes: list[np.ndarray]
    hole_kinds: list[str]


def draw_outline(rng: np.random.Generator, length: float, width: float, spacing: float) -> Outline:
    """Draw a plate of about this length and width with up to two holes. Holes keep apart from the sides and each other.

    Args:
        rng: where the draws come from.
        length: distance between the clamps.
        width: width of a plate with straight sides.
        spacing: length of the edges of the mesh that is made next.
    """
    kind = OUTLINES[rng.integers(len(OUTLINES))]
    plain = rng.choice(3, p=[0.2, 0.2, 0.6])  # this side (0 or 1) stays straight; 2: neither
    lower, upper = (_draw_side(rng, "straight" if side == plain else kind, length, width / 2) for side in (0, 1))
    lower = [piece * (1, -1) for piece in lower]
    upper = [piece[::-1] for piece in upper[::-1]]
    right, left = (np.stack([a[-1], b[0]]) for a, b in ((lower[-1], upper[0]), (upper[-1], lower[0])))
    pieces = [*lower, right, *upper, left]
    if rng.random() < 0.4:
        pieces = [_sheared(piece, slope) for slope in [rng.uniform(-0.2, 0.2)] for piece in pieces]
    curves, hole_kinds = [np.concatenate(pieces)], []
    for _ in range(rng.choice([0, 1, 2], p=[0.4, 0.4, 0.2])):
        for _ in range(HOLE_TRIES):
            hole_kind, hole = _draw_hole(rng, length, width)
            if encloses(curves[0], hole[:1])[0] and _is_apart(hole, curves, 1.2 * spacing):
                curves.append(hole)
                hole_kinds.append(hole_kind)
                break
    return Outline(kind, pieces, (len(pieces) - 1, len(lower)), curves[1:], hole_kinds)


def _sheared(piece: np.ndarray, slope: float) -> np.ndarray:
    return piece + np.outer(piece[:, 1], [slope, 0])


def _draw_side(rng: np.random.Generator, kind: str, length: float, half_width: float) -> list[np.ndarray]:
    """The upper side of a plate from left to right, in pieces."""
    if kind == "notched":
        return _draw_notched_side(rng, length, half_width)
    s = np.linspace(-1, 1, DENSE)
    profile: Callable[[], np.ndarray] = {
        "straight": lambda: np.ones(DENSE),
        "tapered": lambda: 1 + rng.choice([-1, 1]) * rng.uniform(0.08, 0.25) * s,
        "waisted": lambda: 1 - rng.uniform(0.12, 0.35) * np.cos(np.pi * s / 2) ** 2,
        "bulged": lambda: 0.9 - rng.uniform(0.1, 0.3) * (np.abs(s) ** rng.uniform(2, 4) - 0.5),
        "wavy": lambda: 1 + rng.uniform(0.05, 0.12) * np.sin(np.pi * rng.uniform(1, 2) * (s + rng.uniform(-1, 1))),
    }[kind]
    return [np.stack([s * length / 2, half_width * profile()], axis=1)]


def _draw_notched_side(rng: np.random.Generator, length: float, half_width: float) -> list[np.ndarray]:
    """A straight side with one round notch. The centre of the notch lies on the side."""
    radius = rng.uniform(0.15, 0.4) * half_width
    middle = rng.uniform(-1, 1) * (0.36 * length - radius)
    angle = np.linspace(np.pi, 2 * np.pi, DENSE)
    arc = np.stack([middle + radius * np.cos(angle), half_width + radius * np.sin(angle)], axis=1)
    left, right = np.array([-length / 2, half_width]), np.array([length / 2, half_width])
    return [np.stack([left, arc[0]]), arc, np.stack([arc[-1], right])]


def _draw_hole(rng: np.random.Generator, length: float, width: float) -> tuple[str, np.ndarray]:
    """Kind and closed polyline of a hole somewhere in the plate, turned at random."""
    kind = HOLES[rng.integers(len(HOLES))]
    radius, ratio = rng.uniform(0.025, 0.065), rng.uniform(0.4, 0.75)
    angle = np.linspace(0, 2 * np.pi, DENSE)
    circle = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    if kind == "ellipse":
        circle *= (1, ratio)
    elif kind == "slot":
        circle = ratio * circle
        circle[:, 0] += np.where(np.cos(angle) > 0, 1, -1) * (1 - ratio) * radius
        circle[-1] = circle[0]
    turn = rng.uniform(0, np.pi)
    cosine = np.cos(turn)
    sine = np.sin(turn)
    centre = rng.uniform(-1, 1, 2) * (0.42 * length, 0.42 * width)
    return kind, circle @ np.array([[cosine, sine], [-sine, cosine]]) + centre


def _is_apart(curve: np.ndarray, others: list[np.ndarray], distance: float) -> bool:
    """Whether a curve keeps this distance from all others."""
    return KDTree(np.concatenate([_dense(other) for other in others])).query(curve)[0].min() >= distance


def _dense(curve: np.ndarray) -> np.ndarray:
    """The polyline with points on its long straight parts too."""
    return resample(curve, STEP)


def encloses(loop: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether each point [P,2] lies inside a closed polyline [K,2]: bool [P]."""
    return inside(points, loop, np.roll(loop, -1, axis=0))


def distance_to(loop: np.ndarray, point: np.ndarray) -> float:
    """Distance of a point from a closed polyline; negative inside."""
    distance = float(np.linalg.norm(_dense(loop) - point, axis=1).min())
    return -distance if encloses(loop, point[None])[0] else distance

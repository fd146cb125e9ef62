"""The nearest points of a closed surface, for those of many points that are near it. A positive gap is the distance, a
negative one the depth inside."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

TOUCHING = 1e-9  # a gap below this share of the range says nothing about the direction


class Nearest(NamedTuple):
    """The n points that are near.

    Attributes:
        rows: [n] which of the points they are.
        gap: [n].
        normal: [n, 3], outward unit normals at the nearest points.
        triangles: [n, 3], the corners of the triangles that the nearest points are on.
        place: [n, 3], the nearest points.
    """

    rows: np.ndarray
    gap: np.ndarray
    normal: np.ndarray
    triangles: np.ndarray
    place: np.ndarray


def nearest_surface(
    points: np.ndarray, position: np.ndarray, triangles: np.ndarray, inside: float, outside: float
) -> Nearest:
    """The points [P, 3] with a gap between -inside and outside.

    Args:
        position: [N, 3], the nodes of the surface.
        triangles: [F, 3], counter-clockwise seen from outside.
        inside, outside: in the unit of length.
    """
    import igl  # takes 0.2 s

    # All triangles around a nearest point are kept, so the sign is that of the whole surface.
    margin = max(inside, outside)
    kind = igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    close = np.flatnonzero(beside(points, position[triangles], margin))
    triangles = triangles[beside(position[triangles], points[close], margin)]
    if not len(triangles):
        return Nearest(close[:0], np.zeros(0), np.zeros((0, 3)), triangles, np.zeros((0, 3)))
    nearest = igl.signed_distance(points[close], position, triangles, kind, -inside, outside)
    gap, face, place, outward = map(np.asarray, nearest)
    near = (gap < outside) & (gap > -inside)  # NaN where the surface is farther away
    rows, gap, place = close[near], gap[near], place[near]
    touching = np.abs(gap) <= TOUCHING * margin
    away = (points[rows] - place) / np.where(touching, 1, gap)[:, None]
    return Nearest(rows, gap, np.where(touching[:, None], outward[near], away), triangles[face[near]], place)


def beside(things: np.ndarray, others: np.ndarray, distance: float) -> np.ndarray:
    """[n] bool: which points [n, 3] or triangles [n, 3, 3] come as near as `distance` to the box around the others."""
    if not len(others):
        return np.zeros(len(things), bool)
    box = others.reshape(-1, 3).min(axis=0) - distance, others.reshape(-1, 3).max(axis=0) + distance
    low, high = (things, things) if things.ndim == 2 else (things.min(axis=1), things.max(axis=1))
    return ((high >= box[0]) & (low <= box[1])).all(axis=1)

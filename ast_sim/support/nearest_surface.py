"""The nearest places of a closed surface, for all points that are near it. A positive gap is the distance, a negative
one the depth inside."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

TOUCHING = 1e-9  # a gap below this share of the range says nothing about the direction


class Nearest(NamedTuple):
    """The n points that are near.

    Attributes:
        rows: [n] which of the points they are.
        gap: [n].
        normal: [n, 3], outward unit normals at the nearest places.
        triangles: [n, 3], the corners of the triangles that the nearest places are on.
        place: [n, 3], the nearest places.
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

    margin = max(inside, outside)
    kind = igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    corners = position.T[:, triangles.T]  # [3, 3, F]: component, corner
    low, high = corners.min(axis=1), corners.max(axis=1)
    across = np.ascontiguousarray(points.T)
    close = np.flatnonzero(beside(across, across, low, high, margin))
    # All triangles around a nearest place are kept, so the sign is right for the whole surface.
    triangles = triangles[beside(low, high, across[:, close], across[:, close], margin)]
    if not len(triangles):
        return Nearest(close[:0], np.zeros(0), np.zeros((0, 3)), triangles, np.zeros((0, 3)))
    nearest = igl.signed_distance(points[close], position, triangles, kind, -inside, outside)
    gap, face, place, outward = map(np.asarray, nearest)
    near = (gap < outside) & (gap > -inside)  # NaN where the surface is farther away
    rows, gap, place = close[near], gap[near], place[near]
    touching = np.abs(gap) <= TOUCHING * margin
    away = (points[rows] - place) / np.where(touching, 1, gap)[:, None]
    return Nearest(rows, gap, np.where(touching[:, None], outward[near], away), triangles[face[near]], place)


def beside(
    low: np.ndarray, high: np.ndarray, low_others: np.ndarray, high_others: np.ndarray, distance: float
) -> np.ndarray:
    """[n] bool: which boxes from low to high [3, n] come as near as `distance` to the box around the other ones."""
    if not low_others.size:
        return np.zeros(low.shape[1], bool)
    least, most = low_others.min(axis=1) - distance, high_others.max(axis=1) + distance
    return ((high >= least[:, None]) & (low <= most[:, None])).all(axis=0)


def near_boxes(
    low: np.ndarray, high: np.ndarray, low_others: np.ndarray, high_others: np.ndarray, distance: float
) -> tuple[np.ndarray, np.ndarray]:
    """The rows of pairs of boxes from low to high [A, 3] and of other ones [B, 3] that come as near as `distance`."""
    from scipy.spatial import KDTree

    none = np.zeros(0, np.int64)
    if not len(low) or not len(low_others):
        return none, none
    mine = np.flatnonzero(beside(low.T, high.T, low_others.T, high_others.T, distance))
    theirs = np.flatnonzero(beside(low_others.T, high_others.T, low.T, high.T, distance))
    if not len(mine) or not len(theirs):
        return none, none
    sizes = (high - low)[mine], (high_others - low_others)[theirs]
    # Boxes that are apart by the distance along each axis are farther apart by the root of three.
    reach = sum(np.linalg.norm(size, axis=1).max() / 2 for size in sizes) + np.sqrt(3) * distance
    tree = KDTree((low_others + high_others)[theirs] / 2)
    lists = tree.query_ball_point((low + high)[mine] / 2, reach)
    first = np.repeat(mine, [len(one) for one in lists])
    second = theirs[np.concatenate([np.asarray(one, np.int64) for one in lists])]
    meet = ((low[first] <= high_others[second] + distance) & (low_others[second] <= high[first] + distance)).all(axis=1)
    return first[meet], second[meet]

"""Where edges of two surfaces pass each other: corners and rims touch so, with no node near a face.

Two edges are at p + s d and q + t e, with s and t from 0 to 1, and r = p - q. Where they are nearest, their normal is
d x e. Of two flat surfaces nodes and faces say all; so one of the two edges must be sharp.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ast_sim.element_topology import triangle_sides, unit_normals
from ast_sim.support.nearest_surface import near_boxes

SHARP = 0.9  # cosine between the normals of the two faces of a sharp edge, at most
FACING = 0.6  # cosine between the normal of a pair and the outward normals of its edges, at least
PARALLEL = 0.1  # sine between two edges, at least: nodes and faces see parallel ones


class PlacedEdges(NamedTuple):
    """The edges of a closed surface at one position.

    Attributes:
        nodes: [E, 2].
        ends: [E, 2, 3], where their nodes are.
        outward: [E, 3], the mean of the unit normals of their two faces, with a length of 1.
        sharp: [E] bool.
    """

    nodes: np.ndarray
    ends: np.ndarray
    outward: np.ndarray
    sharp: np.ndarray

    def of(self, rows: np.ndarray) -> PlacedEdges:
        """Some of the edges."""
        return PlacedEdges(*(values[rows] for values in self))


class NearPlaces(NamedTuple):
    """Pairs of near places: on two edges, or at a node and on a triangle.

    Attributes:
        nodes: [P, 4], two of each edge; or the node and the corners.
        shares: [P, 4] of these nodes in the distance: on the first surface they add up to 1, on the second to -1.
        normal: [P, 3], from the second surface to the first.
        gap: [P], negative where the surfaces overlap.
    """

    nodes: np.ndarray
    shares: np.ndarray
    normal: np.ndarray
    gap: np.ndarray

    def of(self, rows: np.ndarray) -> NearPlaces:
        """Some of the pairs."""
        return NearPlaces(*(values[rows] for values in self))


class SurfaceEdges:
    """The edges of a surface [F, 3] at which two faces meet; made once, because its triangles do not change."""

    def __init__(self, faces: np.ndarray) -> None:
        self._faces = faces
        edges, of_side, count = np.unique(triangle_sides(faces), axis=0, return_inverse=True, return_counts=True)
        face = np.argsort(of_side.ravel(), kind="stable") // 3
        two = count == 2
        self._nodes = edges[two]
        self._sides = face[(np.cumsum(count) - count)[two][:, None] + np.arange(2)]

    def at(self, position: np.ndarray) -> PlacedEdges:
        """The edges at positions [N, 3]."""
        normals = unit_normals(position[self._faces])[self._sides]  # [E, 2, 3]
        outward = normals.sum(axis=1)
        outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), np.finfo(float).tiny)
        bend = np.einsum("ei,ei->e", normals[:, 0], normals[:, 1])
        return PlacedEdges(self._nodes, position[self._nodes], outward, bend < SHARP)


def passing(one: PlacedEdges, other: PlacedEdges, inside: float, outside: float) -> NearPlaces:
    """The pairs of edges of two surfaces, one of them sharp, with a gap between -inside and outside."""
    first, second = _near(one, other, max(inside, outside))
    d = first.ends[:, 1] - first.ends[:, 0]
    e = second.ends[:, 1] - second.ends[:, 0]
    r = first.ends[:, 0] - second.ends[:, 0]
    dd, ee, de, dr, er = (np.einsum("pi,pi->p", a, b) for a, b in ((d, d), (e, e), (d, e), (d, r), (e, r)))
    area = dd * ee - de * de  # the square of |d x e|
    apart = area > PARALLEL**2 * dd * ee
    s, t = (np.where(apart, value / np.where(apart, area, 1), -1) for value in (de * er - dr * ee, dd * er - de * dr))
    normal = np.cross(d, e) / np.sqrt(np.where(apart, area, 1))[:, None]
    normal *= np.sign(np.einsum("pi,pi->p", second.outward - first.outward, normal))[:, None]
    gap = np.einsum("pi,pi->p", r, normal)
    facing = np.minimum(np.einsum("pi,pi->p", second.outward, normal), -np.einsum("pi,pi->p", first.outward, normal))
    near = (s > 0) & (s < 1) & (t > 0) & (t < 1) & (gap < outside) & (gap > -inside) & (facing > FACING)
    shares = np.stack([1 - s, s, t - 1, -t], axis=1)
    return NearPlaces(np.concatenate([first.nodes, second.nodes], axis=1), shares, normal, gap).of(near)


def _near(one: PlacedEdges, other: PlacedEdges, distance: float) -> tuple[PlacedEdges, PlacedEdges]:
    """The pairs of which one edge is sharp and whose boxes come as near as that."""
    sharp, theirs = np.flatnonzero(one.sharp), np.flatnonzero(other.sharp)
    rows = []
    for mine, others in ((sharp, np.arange(len(other.nodes))), (np.flatnonzero(~one.sharp), theirs)):
        ends = one.ends[mine]
        facing = other.ends[others]
        near = near_boxes(ends.min(axis=1), ends.max(axis=1), facing.min(axis=1), facing.max(axis=1), distance)
        rows.append((mine[near[0]], others[near[1]]))
    first, second = (np.concatenate(numbers) for numbers in zip(*rows, strict=True))
    return one.of(first), other.of(second)

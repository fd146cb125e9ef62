"""Where the surface of a body comes near itself: nodes in front of its faces, and edges that pass each other.

Neighbours on a surface are always near, and so are the two sides of a thin wall. So two places that face each other now
count only if they were far apart at rest, or faced each other then, too, as the walls of a slot do.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial import KDTree

from ast_sim.element_topology import node_normals, triangle_sides, unit_normals
from ast_sim.mechanics.linearised.near_edges import NearPlaces, PlacedEdges, passing
from ast_sim.support.nearest_surface import near_boxes

APART = 1.0  # places of one body that were farther apart at rest are no neighbours, in mean edge lengths
CLOSER = 0.8  # nodes near which the body touches itself are nearer than this part of their distance at rest
FACING = 0.3  # cosine between the normal of a surface and the direction of a place that it faces, at least


class SelfContact:
    """The surface of one body; made once, because its triangles do not change.

    Args:
        faces: [F, 3], counter-clockwise seen from outside.
        rest: [N, 3].
        length: the mean edge length of the surfaces.
    """

    def __init__(self, faces: np.ndarray, rest: np.ndarray, length: float) -> None:
        self._faces = faces
        self._rest = rest
        self._apart = APART * length
        self._nodes = np.unique(faces)
        self._outward = node_normals(rest, faces)
        sides = rest[triangle_sides(faces)]
        self._longest = float(np.linalg.norm(sides[:, 1] - sides[:, 0], axis=1).max())

    def places(self, position: np.ndarray, edges: PlacedEdges, inside: float, outside: float) -> Iterator[NearPlaces]:
        """The pairs with a gap between -inside and outside at positions [N, 3], where the body has these edges."""
        outward = node_normals(position, self._faces)
        folded = self._folded(position, outward, outside)
        if not folded.any():
            return
        faces = self._faces[folded[self._faces].any(axis=1)]
        yield self._strangers(_facing(faces, position, outward, inside, outside))
        near = edges.of(np.flatnonzero(folded[edges.nodes].any(axis=1)))
        pairs = passing(near, near, inside, outside)
        yield self._strangers(pairs.of(pairs.nodes[:, 0] < pairs.nodes[:, 2]))

    def _folded(self, position: np.ndarray, outward: np.ndarray, outside: float) -> np.ndarray:
        """[N] bool: the nodes that have come near others and turn towards them; most bodies have none."""
        reach = outside + self._longest
        one, other = self._nodes[KDTree(position[self._nodes]).query_pairs(reach, output_type="ndarray")].T
        turned = np.einsum("pi,pi->p", outward[one], outward[other]) < 0
        one, other = one[turned], other[turned]
        now, before = (np.linalg.norm(x[one] - x[other], axis=1) for x in (position, self._rest))
        folded = np.zeros(len(position), bool)
        folded[one[now < CLOSER * before]] = folded[other[now < CLOSER * before]] = True
        return folded

    def _strangers(self, near: NearPlaces) -> NearPlaces:
        """The pairs of places that were far apart at rest, or faced each other."""
        apart = np.einsum("pk,pki->pi", near.shares, self._rest[near.nodes])  # from the second place to the first
        distance = np.linalg.norm(apart, axis=1)
        towards = -near.shares * np.einsum("pi,pki->pk", apart, self._outward[near.nodes])
        first = near.shares > 0
        faced = np.minimum(np.where(first, towards, 0).sum(axis=1), np.where(first, 0, towards).sum(axis=1))
        return near.of((distance > self._apart) | (faced > FACING * distance))


def _facing(faces: np.ndarray, position: np.ndarray, outward: np.ndarray, inside: float, outside: float) -> NearPlaces:
    """The pairs of a node, with the normals `outward` [N, 3], and one of the faces [F, 3] that it is in front of, or a
    little behind."""
    import igl  # takes 0.2 s

    nodes = np.unique(faces)
    corners, points = position[faces], position[nodes]
    normals = unit_normals(corners)
    node, face = near_boxes(points, points, corners.min(axis=1), corners.max(axis=1), max(inside, outside))
    opposed = np.einsum("pi,pi->p", outward[nodes[node]], normals[face]) < -FACING
    node, face = node[opposed], face[opposed]
    gap = np.einsum("pi,pi->p", points[node] - corners[face, 0], normals[face])
    near = (gap < outside) & (gap > -inside)
    node, face, gap = node[near], face[near], gap[near]
    if not len(node):
        return NearPlaces(np.zeros((0, 4), int), np.zeros((0, 4)), np.zeros((0, 3)), gap)
    below = igl.barycentric_coordinates(points[node], *(np.ascontiguousarray(corners[face, i]) for i in range(3)))
    shares = np.insert(-np.asarray(below), 0, 1, axis=1)
    above: np.ndarray = np.all(shares[:, 1:] <= 0, axis=1)  # not beside it
    of_pair = np.concatenate([nodes[node, None], faces[face]], axis=1)
    return NearPlaces(of_pair, shares, normals[face], gap).of(above)

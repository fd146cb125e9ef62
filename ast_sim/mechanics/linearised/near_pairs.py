"""Pairs of a surface node and its nearest place on another body, of edges that pass each other, and of places where a
body touches itself: how their gaps and slips follow the positions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import scipy.sparse

from ast_sim.mechanics.linearised.near_edges import NearPlaces, PlacedEdges, SurfaceEdges, passing
from ast_sim.mechanics.linearised.self_contact import SelfContact
from ast_sim.scene import Scene
from ast_sim.support.nearest_surface import nearest_surface

NEAR = 0.5  # pairs with a gap below this may touch, in mean edge lengths of the surfaces
DEEP = 2.0  # a node deeper inside another body than this is not taken for one in contact with it, in the same
SHALLOW = 0.2  # the same of two edges, and of places of one body: farther in it is not known which side they are on
SLID = 0.02  # surfaces have slid along this last part of the path from rest to x, if nothing else is known


@dataclass(frozen=True, eq=False)
class NearPairs:
    """Surface nodes near triangles of other bodies, and edges near edges.

    Attributes:
        directions: [3 P, F] sparse, the derivatives by F dofs of each pair's gap, then of its slip along one tangent,
            then along the other.
        gap: [P], negative where the bodies overlap.
        slip: [2 P], how far each pair has slid along one tangent, then along the other.
    """

    directions: scipy.sparse.csr_array
    gap: np.ndarray
    slip: np.ndarray


class NearSurfaces:
    """The surfaces of the bodies of a scene; made once for each scene.

    Args:
        dofs: [F] the degrees of freedom by which pairs are derived; a pair that none of them moves is left out.

    Attributes:
        length: the mean edge length of the surfaces that deform: a tool may be meshed much finer.
    """

    def __init__(self, scene: Scene, dofs: np.ndarray) -> None:
        self._rest = scene.rest_position.astype(np.float64)
        self._count = len(dofs)
        self._number = np.full(3 * scene.num_nodes, -1)
        self._number[dofs] = np.arange(len(dofs))
        faces = scene.surface().astype(np.int64)
        owner = scene.body[faces[:, 0]]
        soft = faces[scene.deforming_nodes[faces[:, 0]]]
        self.length = float(np.linalg.norm(self._rest[soft[:, 0]] - self._rest[soft[:, 1]], axis=1).mean())
        nodes = np.unique(faces)
        bodies = np.unique(owner)
        self._surfaces = [(faces[owner == body], nodes[scene.body[nodes] != body]) for body in bodies]
        self._edges = {int(body): SurfaceEdges(faces[owner == body]) for body in bodies}
        deforming = [body for body in self._edges if body not in scene.rigid_bodies]
        self._themselves = {body: SelfContact(faces[owner == body], self._rest, self.length) for body in deforming}
        self._may_touch = [pair for pair in combinations(self._edges, 2) if not scene.rigid_bodies.issuperset(pair)]

    def pairs(self, position: np.ndarray, stuck: np.ndarray | None = None) -> NearPairs:
        """The pairs that may touch at `position` [N, 3]. They have slid from where they were at `stuck` [N, 3]; if it
        is None, as `SLID` says."""
        edges = {body: edges.at(position) for body, edges in self._edges.items()}
        parts = [*self._nodes_and_faces(position), *self._edges_and_edges(edges)]
        for body, itself in self._themselves.items():
            parts += itself.places(position, edges[body], SHALLOW * self.length, NEAR * self.length)
        if not parts:
            return NearPairs(scipy.sparse.csr_array((0, self._count)), np.zeros(0), np.zeros(0))
        slid = SLID * (position - self._rest) if stuck is None else position - stuck
        return self._pairs(*(np.concatenate(values) for values in zip(*parts, strict=True)), slid=slid)

    def _nodes_and_faces(self, position: np.ndarray) -> Iterator[NearPlaces]:
        """The pairs of a node and its nearest place on another body."""
        import igl  # takes 0.2 s

        for faces, others in self._surfaces:
            inside, outside = DEEP * self.length, NEAR * self.length
            nearest = nearest_surface(position[others], position, faces, inside=inside, outside=outside)
            if not len(nearest.rows):
                continue
            corners = (position[nearest.triangles[:, i]] for i in range(3))
            shares = -np.asarray(igl.barycentric_coordinates(nearest.place, *corners))
            nodes = np.concatenate([others[nearest.rows, None], nearest.triangles], axis=1)
            yield NearPlaces(nodes, np.insert(shares, 0, 1, axis=1), nearest.normal, nearest.gap)

    def _edges_and_edges(self, edges: Mapping[int, PlacedEdges]) -> Iterator[NearPlaces]:
        """The pairs of edges of two bodies that pass each other, from the edges by body."""
        for one, other in self._may_touch:
            yield passing(edges[one], edges[other], SHALLOW * self.length, NEAR * self.length)

    def _pairs(
        self, nodes: np.ndarray, shares: np.ndarray, normals: np.ndarray, gaps: np.ndarray, slid: np.ndarray
    ) -> NearPairs:
        """Pairs of four nodes [P, 4] with their shares [P, 4] in the distance, their normals [P, 3] and gaps [P]; the
        nodes have moved by `slid` [N, 3] since the pairs stuck."""
        columns = self._number[3 * nodes[:, :, None] + np.arange(3)]  # [P, 4, 3]
        movable = (columns >= 0).any(axis=(1, 2))
        nodes, columns, shares, normals = nodes[movable], columns[movable], shares[movable], normals[movable]
        tangents = tangents_of(normals)
        axes = np.concatenate([normals, *tangents])
        values = np.tile(shares, (3, 1))[:, :, None] * axes[:, None, :]
        columns = np.tile(columns, (3, 1, 1))
        rows = np.broadcast_to(np.arange(len(axes))[:, None, None], columns.shape)
        free = columns >= 0
        entries = values[free], (rows[free], columns[free])
        directions = scipy.sparse.csr_array(entries, shape=(len(axes), self._count))
        relative = np.einsum("pk,pki->pi", shares, slid[nodes])
        slip = np.concatenate([np.einsum("pi,pi->p", relative, tangent) for tangent in tangents])
        return NearPairs(directions, gaps[movable], slip)


def tangents_of(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors [P, 3] that are perpendicular to each of the normals [P, 3] and to each other."""
    across = np.eye(3)[np.abs(normals).argmin(axis=1)]
    first = np.cross(normals, across)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(normals, first)

"""Pairs of a surface node and its nearest place on another body: how their gaps and slips follow the positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse

from ast_sim.scene import Scene
from ast_sim.support.nearest_surface import nearest_surface

NEAR = 0.5  # pairs with a gap below this may touch, in mean edge lengths of the surfaces
DEEP = 2.0  # a node deeper inside another body than this is not taken for one in contact with it, in the same
SLID = 0.02  # surfaces have slid along this last part of the path from rest to x, if nothing else is known


@dataclass(frozen=True, eq=False)
class NearPairs:
    """Surface nodes near triangles of other bodies.

    Attributes:
        directions: [3 P, F] sparse, the derivatives by F dofs of each pair's gap, then of its slip along one tangent,
            then along the other.
        gap: [P], negative where the node lies inside the other body.
        slip: [2 P], how far the node has slid along one tangent, then along the other.
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
        self._surfaces = [(faces[owner == body], nodes[scene.body[nodes] != body]) for body in np.unique(owner)]

    def pairs(self, position: np.ndarray, stuck: np.ndarray | None = None) -> NearPairs:
        """The pairs that may touch at `position` [N, 3]: a surface node and its nearest point of another body. They
        have slid from where they were at `stuck` [N, 3]; if it is None, as `SLID` says."""
        import igl  # takes 0.2 s

        nodes, corners, normals, shares, gaps = [], [], [], [], []
        for faces, others in self._surfaces:
            nearest = nearest_surface(
                position[others], position, faces, inside=DEEP * self.length, outside=NEAR * self.length
            )
            if not len(nearest.rows):
                continue
            corner_positions = (position[nearest.triangles[:, i]] for i in range(3))
            nodes.append(others[nearest.rows])
            corners.append(nearest.triangles)
            normals.append(nearest.normal)
            shares.append(igl.barycentric_coordinates(nearest.place, *corner_positions))
            gaps.append(nearest.gap)
        if not gaps:
            return NearPairs(scipy.sparse.csr_array((0, self._count)), np.zeros(0), np.zeros(0))
        joined = (np.concatenate(parts) for parts in (nodes, corners, normals, shares, gaps))
        slid = SLID * (position - self._rest) if stuck is None else position - stuck
        return self._pairs(*joined, slid=slid)

    def _pairs(
        self,
        nodes: np.ndarray,
        corners: np.ndarray,
        normals: np.ndarray,
        shares: np.ndarray,
        gaps: np.ndarray,
        slid: np.ndarray,
    ) -> NearPairs:
        """Pairs of nodes [P] and triangles [P, 3] with their normals, barycentric coordinates [P, 3] and gaps [P]; the
        nodes have moved by `slid` [N, 3] since the pairs stuck."""
        of_pair = np.concatenate([nodes[:, None], corners], axis=1)  # [P, 4]
        weight = np.concatenate([np.ones((len(nodes), 1)), -shares], axis=1)
        columns = self._number[3 * of_pair[:, :, None] + np.arange(3)]  # [P, 4, 3]
        movable = (columns >= 0).any(axis=(1, 2))
        of_pair, columns, weight, normals = of_pair[movable], columns[movable], weight[movable], normals[movable]
        tangents = tangents_of(normals)
        axes = np.concatenate([normals, *tangents])
        rows = np.arange(3 * len(normals))
        values = np.tile(weight, (3, 1))[:, :, None] * axes[:, None, :]
        columns = np.tile(columns, (3, 1, 1))
        free = columns >= 0
        rows = np.broadcast_to(rows[:, None, None], columns.shape)
        entries = values[free], (rows[free], columns[free])
        directions = scipy.sparse.csr_array(entries, shape=(len(axes), self._count))
        relative = np.einsum("pk,pki->pi", weight, slid[of_pair])
        slip = np.concatenate([np.einsum("pi,pi->p", relative, tangent) for tangent in tangents])
        return NearPairs(directions, gaps[movable], slip)


def tangents_of(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors [P, 3] that are perpendicular to each of the normals [P, 3] and to each other."""
    across = np.eye(3)[np.abs(normals).argmin(axis=1)]
    first = np.cross(normals, across)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(normals, first)

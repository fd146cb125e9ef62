"""Where the surfaces of parts are too near to each other, or lie in each other.

Legend: N nodes, F triangles.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ast_sim.element_topology import equal_rows, triangle_sides
from ast_sim.mechanics.contact_and_friction import load_ipctk
from ast_sim.plausibility import overlaps

CREASE = np.radians(50)  # facets that meet at a larger angle do not belong to a curved surface

BodyPair = tuple[int, int]


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The surfaces of all parts at their current places.

    Attributes:
        position: [N,3] float64 of the nodes of all parts.
        faces: [F,3], normals pointing out.
        body: [N] the part of each node.
        rigid: of each part.
    """

    position: np.ndarray
    faces: np.ndarray
    body: np.ndarray
    rigid: tuple[bool, ...]

    @cached_property
    def normals(self) -> np.ndarray:
        """[F,3] of length one."""
        return self._areas / np.linalg.norm(self._areas, axis=1, keepdims=True)

    @cached_property
    def _areas(self) -> np.ndarray:
        """[F,3] normal to the triangles, as long as twice their areas."""
        a, b, c = np.moveaxis(self.position[self.faces], 1, 0)
        return np.cross(b - a, c - a)

    @cached_property
    def at_node(self) -> dict[int, set[int]]:
        """The triangles at each node of a surface."""
        rows: dict[int, set[int]] = {}
        for row, corners in enumerate(self.faces.tolist()):
            for node in corners:
                rows.setdefault(node, set()).add(row)
        return rows

    @cached_property
    def arcs(self) -> np.ndarray:
        """[F] the height of the arc over each triangle: h t / 8 for an angle of t between facets of the width h."""
        edges = triangle_sides(self.faces)
        length = np.linalg.norm(self.position[edges[:, 0]] - self.position[edges[:, 1]], axis=1)
        width = np.repeat(np.linalg.norm(self._areas, axis=1), 3) / length
        one, other = equal_rows(edges)
        cosine = np.einsum("ei,ei->e", self.normals[one // 3], self.normals[other // 3])
        angle = np.arccos(np.clip(cosine, -1, 1))
        height = np.where(angle < CREASE, np.maximum(width[one], width[other]) * angle / 8, 0)
        arcs = np.zeros(len(self.faces))
        np.maximum.at(arcs, one // 3, height)
        np.maximum.at(arcs, other // 3, height)
        return arcs

    def of(self, part: int) -> np.ndarray:
        """[f] the rows of the triangles of a part."""
        return np.flatnonzero(self.body[self.faces[:, 0]] == part)

    def opposed(self, group: list[int], other: list[int]) -> tuple[int, int]:
        """A triangle with all nodes of one group, and a triangle with all nodes of the other: the two that face each
        other most."""
        mine, theirs = (sorted(set.intersection(*(self.at_node[node] for node in nodes))) for nodes in (group, other))
        cosine = self.normals[mine] @ self.normals[theirs].T
        row, column = np.unravel_index(cosine.argmin(), cosine.shape)
        return mine[row], theirs[column]


@dataclass(frozen=True)
class Near:
    """Two places of two parts that are too near to each other.

    Attributes:
        group, other: one to three nodes of each.
        triangle, opposite: a triangle at each.
        gap: the distance; negative where one lies inside of the other.
    """

    group: tuple[int, ...]
    other: tuple[int, ...]
    triangle: int
    opposite: int
    gap: float

    @classmethod
    def of(cls, surfaces: Surfaces, group: list[int], other: list[int], gap: float) -> Near:
        """The place where these two groups of nodes are near to each other."""
        return cls(tuple(group), tuple(other), *surfaces.opposed(group, other), gap)

    def pair(self, surfaces: Surfaces) -> BodyPair:
        """The two parts."""
        first, second = sorted((int(surfaces.body[self.group[0]]), int(surfaces.body[self.other[0]])))
        return first, second


def places_nearer(surfaces: Surfaces, distance: float, limit: float, pairs: Collection[BodyPair]) -> list[Near]:
    """The places of these pairs of parts that are nearer than the limit, or where parts lie in each other; none if no
    place is nearer than the distance."""
    ipctk = load_ipctk()
    nodes, local = np.unique(surfaces.faces, return_inverse=True)
    vertices = np.asfortranarray(surfaces.position[nodes] / distance)  # ipctk takes small numbers for zero
    faces = np.asfortranarray(local.reshape(-1, 3), dtype=np.int32)
    edges = ipctk.edges(faces)
    mesh = ipctk.CollisionMesh(vertices, edges, faces)
    together = np.where(np.array(surfaces.rigid)[surfaces.body], -1, surfaces.body)
    mesh.can_collide = ipctk.VertexPatchesCanCollide(together[nodes].astype(np.int32))
    collisions = ipctk.NormalCollisions()
    collisions.build(mesh, vertices, limit / distance, broad_phase=ipctk.LBVH())
    near = []
    for kind in ("vv", "ev", "fv", "ee"):
        of_first = 2 if kind == "ee" else 1
        for one in getattr(collisions, f"{kind}_collisions"):
            group = nodes[[node for node in one.vertex_ids(edges, faces) if node >= 0]].tolist()
            gap = distance * float(np.sqrt(one.compute_distance(one.dof(vertices, edges, faces))))
            near.append(Near.of(surfaces, group[:of_first], group[of_first:], gap))
    near = near if any(one.gap < distance for one in near) else []
    near += [one for pair in pairs for one in nodes_inside(surfaces, pair)]
    if not near and ipctk.has_intersections(mesh, vertices, ipctk.LBVH()):
        phase = ipctk.LBVH()
        phase.build(vertices, edges, faces, 1e-9)
        for one in phase.detect_edge_face_candidates():
            a = edges[one.edge_id]
            b = faces[one.face_id]
            apart = together[nodes[a[0]]] != together[nodes[b[0]]]
            if apart and ipctk.is_edge_intersecting_triangle(*vertices[a], *vertices[b]):
                near.append(Near.of(surfaces, nodes[a].tolist(), nodes[b].tolist(), 0.0))
    return [one for one in near if one.pair(surfaces) in pairs]


def nodes_inside(surfaces: Surfaces, pair: BodyPair) -> Iterator[Near]:
    """The nodes of one part that lie inside of the other."""
    if surfaces.rigid[pair[0]] and surfaces.rigid[pair[1]]:
        return
    for mine, other in (pair, pair[::-1]):
        theirs = surfaces.faces[surfaces.of(other)]
        inside = overlaps.nodes_inside(surfaces.position, surfaces.faces[surfaces.of(mine)], theirs)
        for node, depth, row in zip(*inside, strict=True):
            yield Near.of(surfaces, [int(node)], theirs[row].tolist(), -float(depth))

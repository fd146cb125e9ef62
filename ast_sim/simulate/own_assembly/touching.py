"""Parts that touch at rest, as those of CAD assemblies do: their surfaces are set back until contact can begin there.

The solver keeps surfaces apart by the contact distance, so faces at one place move into their parts: each by half of
what is missing, beside a rigid part by all of it. Surfaces that are curved alike, as those of a pin and its bore,
overlap once they are facets, by no more than the arcs over the facets are high; this is set back, too. A larger overlap
stays.

Legend: N nodes, F triangles, K constraints.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, pairwise

import numpy as np

from ast_sim.mechanics.contact_and_friction import load_ipctk
from ast_sim.simulate.shapes.mesh_check import boundary
from ast_sim.simulate.shapes.parts import smallest_dihedral, volumes

MARGIN = 1.02  # of the contact distance: float32 rounds positions
ROUNDS = 50  # in which surfaces are set back: what is moved may come near to something else
FACING = -0.5  # cosine between the normals of triangles that lie on each other
ALIKE = 0.2  # directions of constraints whose combinations are this short are one direction
CREASE = np.radians(50)  # facets that meet at a larger angle are not those of a curved surface
ARCS = 1.5  # an overlap of so many heights of arcs may come from facets
SMALLEST_ANGLE = 1.0  # degrees between two faces of a tetrahedron that is left

Pair = tuple[int, int]


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
        a, b, c = np.moveaxis(self.position[self.faces], 1, 0)
        normal = np.cross(b - a, c - a)
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    @cached_property
    def at_node(self) -> dict[int, set[int]]:
        """The triangles at each node of a surface."""
        found: dict[int, set[int]] = {}
        for row, corners in enumerate(self.faces.tolist()):
            for node in corners:
                found.setdefault(node, set()).add(row)
        return found

    @cached_property
    def arcs(self) -> np.ndarray:
        """[F] the height of the arc over each triangle: h t / 8 for an angle of t between facets of the width h."""
        a, b, c = np.moveaxis(self.position[self.faces], 1, 0)
        twice_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        edges = np.sort(self.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        length = np.linalg.norm(self.position[edges[:, 0]] - self.position[edges[:, 1]], axis=1)
        width, owner = np.repeat(twice_area, 3) / length, np.repeat(np.arange(len(self.faces)), 3)
        order = np.lexsort(edges.T)
        same = (edges[order[1:]] == edges[order[:-1]]).all(axis=1)
        one, other = order[:-1][same], order[1:][same]
        cosine = np.einsum("ei,ei->e", self.normals[owner[one]], self.normals[owner[other]])
        angle = np.arccos(np.clip(cosine, -1, 1))
        height = np.where(angle < CREASE, np.maximum(width[one], width[other]) * angle / 8, 0)
        arcs = np.zeros(len(self.faces))
        np.maximum.at(arcs, owner[one], height)
        np.maximum.at(arcs, owner[other], height)
        return arcs

    def of(self, part: int) -> np.ndarray:
        """[f] the rows of the triangles of a part."""
        return np.flatnonzero(self.body[self.faces[:, 0]] == part)

    def opposed(self, group: list[int], other: list[int]) -> tuple[int, int]:
        """Of the triangles that hold all nodes of a group, and of those of the other, the two that face each other
        most."""
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
        """The place where these nodes are near to those."""
        return cls(tuple(group), tuple(other), *surfaces.opposed(group, other), gap)

    def pair(self, surfaces: Surfaces) -> Pair:
        """The two parts."""
        first, second = sorted((int(surfaces.body[self.group[0]]), int(surfaces.body[self.other[0]])))
        return first, second


def set_back(
    bodies: list[tuple[np.ndarray, np.ndarray]], names: list[str], rigid: tuple[bool, ...], distance: float, unit: str
) -> tuple[list[np.ndarray], list[str]]:
    """Where the nodes of parts go whose surfaces are set back where they touch, and notes on it, a sentence each.

    Args:
        bodies: positions [n,3] and tetrahedra [e,4] of each part.
        names: of the parts.
        rigid: which parts are rigid; they stay as they are.
        distance: what must lie between two parts, unless both are rigid.
        unit: of lengths, for the notes.
    """
    offset = np.cumsum([0, *(len(position) for position, _ in bodies)])
    start = np.concatenate([position for position, _ in bodies])
    faces = np.concatenate([boundary(cells) + first for (_, cells), first in zip(bodies, offset, strict=False)])
    surfaces = Surfaces(start, faces, np.repeat(np.arange(len(bodies)), np.diff(offset)), rigid)
    depth, moved = _overlaps(surfaces, distance), dict[Pair, set[int]]()
    for _ in range(ROUNDS):
        near = _near(surfaces, distance, depth)
        if not near:
            break
        for one in near:
            moved.setdefault(one.pair(surfaces), set()).update((*one.group, *one.other))
        surfaces = replace(surfaces, position=surfaces.position + _way(surfaces, near, MARGIN * distance))
    after = [surfaces.position[low:high] for low, high in pairwise(offset)]
    for (before, cells), position in zip(bodies, after, strict=True):
        if _turned(cells, before, position):
            return [position for position, _ in bodies], []
    notes, way = [], np.linalg.norm(surfaces.position - start, axis=1)
    for pair, nodes in moved.items():
        over = f", where facets overlap by up to {depth[pair]:.2g} {unit}" if depth[pair] > distance else ""
        notes.append(
            f"{' and '.join(names[number] for number in pair)} touch at rest{over}: surfaces are set back by up to"
            f" {way[list(nodes)].max():.2g} {unit} there, so that contact begins at the contact distance {distance:g}"
        )
    return after, notes


def _turned(cells: np.ndarray, before: np.ndarray, after: np.ndarray) -> bool:
    """Whether tetrahedra have become too sharp or are turned over."""
    changed = cells[(before != after).any(axis=1)[cells].any(axis=1)]
    angle = smallest_dihedral(after, changed) < np.minimum(SMALLEST_ANGLE, smallest_dihedral(before, changed))
    return bool(angle.any() or (volumes(after, changed) <= 0).any())


def _overlaps(surfaces: Surfaces, distance: float) -> dict[Pair, float]:
    """How deep each two parts lie in each other; without those that overlap more than facets do."""
    depths: dict[Pair, float] = {}
    for pair in combinations(range(len(surfaces.rigid)), 2):
        inside = list(_inside(surfaces, pair))
        allowed = [ARCS * surfaces.arcs[[one.triangle, one.opposite]].sum() + distance for one in inside]
        if all(-one.gap <= limit for one, limit in zip(inside, allowed, strict=True)):
            depths[pair] = max((-one.gap for one in inside), default=0.0)
    return depths


def _near(surfaces: Surfaces, distance: float, pairs: Collection[Pair]) -> list[Near]:
    """The places of these pairs of parts that are nearer than the distance; if there are any, those that are nearly so,
    too. Where no place is near, parts may still cross each other."""
    ipctk = load_ipctk()
    nodes, local = np.unique(surfaces.faces, return_inverse=True)
    vertices = np.asfortranarray(surfaces.position[nodes] / distance)  # ipctk takes small numbers for zero
    faces = np.asfortranarray(local.reshape(-1, 3), dtype=np.int32)
    edges = ipctk.edges(faces)
    mesh = ipctk.CollisionMesh(vertices, edges, faces)
    together = np.where(np.array(surfaces.rigid)[surfaces.body], -1, surfaces.body)
    mesh.can_collide = ipctk.VertexPatchesCanCollide(together[nodes].astype(np.int32))
    candidates = ipctk.Candidates()
    candidates.build(mesh, vertices, MARGIN / 2, ipctk.LBVH())
    beside = np.array([(one.vertex_id, *faces[one.face_id]) for one in candidates.fv_candidates], int).reshape(-1, 4)
    across = np.array([(*edges[one.edge0_id], *edges[one.edge1_id]) for one in candidates.ee_candidates], int)
    found = [*_above(vertices, beside), *_along(vertices, across.reshape(-1, 4))]
    near = [Near.of(surfaces, nodes[a].tolist(), nodes[b].tolist(), distance * gap) for a, b, gap in found]
    near = near if any(one.gap < distance for one in near) else []
    near += [one for pair in pairs for one in _inside(surfaces, pair)]
    if not near and ipctk.has_intersections(mesh, vertices, ipctk.LBVH()):
        phase = ipctk.LBVH()
        phase.build(vertices, edges, faces, 1e-9)
        for one in phase.detect_edge_face_candidates():
            a, b = edges[one.edge_id], faces[one.face_id]
            apart = together[nodes[a[0]]] != together[nodes[b[0]]]
            if apart and ipctk.is_edge_intersecting_triangle(*vertices[a], *vertices[b]):
                near.append(Near.of(surfaces, nodes[a].tolist(), nodes[b].tolist(), 0.0))
    return [one for one in near if one.pair(surfaces) in pairs]


Places = Iterator[tuple[np.ndarray, np.ndarray, float]]  # vertices on one side and on the other, and their distance


def _above(x: np.ndarray, pairs: np.ndarray) -> Places:
    """Vertices and triangles [n,4] that they lie above or below, nearer than `MARGIN`."""
    p, a, b, c = np.moveaxis(x[pairs], 1, 0)
    normal = np.cross(b - a, c - a)
    square = np.einsum("ni,ni->n", normal, normal)
    height = np.einsum("ni,ni->n", p - a, normal) / np.sqrt(square)
    around = ((b, c), (c, a), (a, b))
    weights = np.array([np.einsum("ni,ni->n", np.cross(v - u, p - u), normal) for u, v in around]) / square
    for row in np.flatnonzero((np.abs(height) < MARGIN) & (weights >= 0).all(axis=0)):
        yield pairs[row, :1], pairs[row, 1:], abs(float(height[row]))


def _along(x: np.ndarray, pairs: np.ndarray) -> Places:
    """Edges and edges [n,4] that are nearer than `MARGIN`, or an end of one if that is nearest.

    The nearest points a + s u and b + t v follow in turn: t for the best s, then s for this t (Ericson 2005, 5.1.9).
    """
    a, b = x[pairs[:, 0]], x[pairs[:, 2]]
    u, v, w = x[pairs[:, 1]] - a, x[pairs[:, 3]] - b, a - b
    uu, vv, uv, uw, vw = (np.einsum("ni,ni->n", *one) for one in ((u, u), (v, v), (u, v), (u, w), (v, w)))
    across = uu * vv - uv**2
    s = np.clip((uv * vw - uw * vv) / np.where(across > 1e-12 * uu * vv, across, np.inf), 0, 1)
    t = np.clip((uv * s + vw) / vv, 0, 1)
    s = np.clip((uv * t - uw) / uu, 0, 1)
    gap = np.linalg.norm(w + s[:, None] * u - t[:, None] * v, axis=1)
    for row in np.flatnonzero(gap < MARGIN):
        first, second = pairs[row, :2], pairs[row, 2:]
        sides = ((first, s[row]), (second, t[row]))
        ends = [one[int(share) :][:1] if share in (0, 1) else one for one, share in sides]
        yield ends[0], ends[1], float(gap[row])


def _inside(surfaces: Surfaces, pair: Pair) -> Iterator[Near]:
    """The nodes of one part that lie inside of the other."""
    import igl  # takes 0.2 s

    if surfaces.rigid[pair[0]] and surfaces.rigid[pair[1]]:
        return
    for mine, other in (pair, pair[::-1]):
        rows = surfaces.of(other)
        nodes, used = np.unique(surfaces.faces[surfaces.of(mine)]), np.unique(surfaces.faces[rows])
        low, high = surfaces.position[used].min(axis=0), surfaces.position[used].max(axis=0)
        nodes = nodes[((surfaces.position[nodes] > low) & (surfaces.position[nodes] < high)).all(axis=1)]
        if not len(nodes):
            continue
        corners = np.searchsorted(used, surfaces.faces[rows])
        distance, nearest = igl.signed_distance(surfaces.position[nodes], surfaces.position[used], corners)[:2]
        for row in np.flatnonzero(distance < 0):
            node = int(nodes[row])
            corners_of = surfaces.faces[int(rows[nearest[row]])].tolist()
            yield Near.of(surfaces, [node], corners_of, float(distance[row]))


def _way(surfaces: Surfaces, near: list[Near], wanted: float) -> np.ndarray:
    """[N,3]: how nodes move, so that all these places are as far apart as wanted: the shortest way of each that goes
    far enough against the normal of each of its triangles that face another part."""
    constraints: dict[int, list[np.ndarray]] = {}
    for one in near:
        normals = surfaces.normals[one.triangle], surfaces.normals[one.opposite]
        missing = wanted - one.gap
        sides = (one.group, one.triangle, normals[0]), (one.other, one.opposite, normals[1])
        rigid = [surfaces.rigid[surfaces.body[nodes[0]]] for nodes, _, _ in sides]
        facing = normals[0] @ normals[1] < FACING
        between = _between(one, *normals)
        for (nodes, triangle, normal), way, fixed, other in zip(
            sides, (between, -between), rigid, rigid[::-1], strict=True
        ):
            if fixed:
                continue
            amount = missing if other else missing / 2
            for node in surfaces.faces[triangle].tolist() if facing else nodes:
                constraints.setdefault(node, []).append(amount * (-normal if facing else way))
    result = np.zeros_like(surfaces.position)
    for node, rows in constraints.items():
        result[node] = _shortest(np.array(rows))
    return result


def _between(near: Near, normal: np.ndarray, opposite: np.ndarray) -> np.ndarray:
    """[3]: the way in which the first group leaves the other, of length one."""
    way = opposite if len(near.other) == 3 else -normal if len(near.group) == 3 else opposite - normal
    return way / max(np.linalg.norm(way), np.finfo(float).tiny)


def _shortest(rows: np.ndarray) -> np.ndarray:
    """[3]: the shortest vector that goes as far as each of the rows [K,3] in its direction, nearly; of rows in about
    one direction the longest counts."""
    lengths = np.linalg.norm(rows, axis=1)
    directions, amounts = [], []
    for row in np.argsort(-lengths, kind="stable"):
        direction = rows[row] / lengths[row]
        if all(direction @ known < 1 - ALIKE**2 / 2 for known in directions):
            directions.append(direction)
            amounts.append(lengths[row])
    return np.linalg.lstsq(np.array(directions), np.array(amounts), rcond=ALIKE)[0]

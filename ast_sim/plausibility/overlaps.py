"""Bodies that stand inside each other at rest."""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

from ast_sim.element_topology import triangle_sides, unit_normals
from ast_sim.number_arrays import point
from ast_sim.plausibility.findings import Finding
from ast_sim.scene import Scene
from ast_sim.support.nearest_surface import near_boxes

# Depths below this share of the mean edge of the surfaces are left to rounding and to the softness of contact.
_TOLERATED = 0.02

# The largest number of bodies of which each pair is looked at.
_MOST_BODIES = 60


class Overlap(NamedTuple):
    """Two bodies that overlap: how deep a node of one lies in the other (0 if only edges cut faces, infinite if one
    body stands twice, or faces lie on each other with both bodies on one side), and where."""

    depth: float
    where: np.ndarray


def overlaps(scene: Scene) -> list[Finding]:
    """One finding for each pair of bodies of tetrahedra that overlap."""
    rest = scene.rest_position.astype(np.float64)
    if not _may_overlap(scene, rest):
        return []
    surface = scene.surface()
    owner = scene.body[surface[:, 0]]
    bodies = np.unique(owner)  # nodes may have the number of a body without a face
    if len(bodies) > _MOST_BODIES:
        return []
    faces = {body: surface[owner == body] for body in bodies.tolist()}
    rigid = scene.rigid_bodies
    boxes = {body: (rest[f].min(axis=(0, 1)), rest[f].max(axis=(0, 1))) for body, f in faces.items()}
    edge = _mean_edge(rest, surface)
    findings = []
    for one, other in combinations(faces, 2):
        if (one in rigid and other in rigid) or not _meet(boxes[one], boxes[other]):
            continue
        overlap = deepest(rest, faces[one], faces[other], _TOLERATED * edge)
        if overlap is not None:
            inner, outer = (other, one) if other in rigid or other > one else (one, other)
            told = f"lies {overlap.depth:.3g} inside body {outer}" if overlap.depth else f"cuts body {outer}"
            told = f"stands where body {outer} stands, wholly or in part," if overlap.depth == np.inf else told
            meaning = f"body {inner} {told} at the start; scenes that can be solved have no overlap: move one of them"
            findings.append(Finding("pairs of bodies that overlap", 1, f"at {point(overlap.where)}", meaning))
    return findings


def _may_overlap(scene: Scene, rest: np.ndarray) -> bool:
    """Whether the boxes around the nodes of two bodies meet, of which one deforms. This takes a tenth of what a look at
    their surfaces takes."""
    order = np.argsort(scene.body, kind="stable")
    starts = np.flatnonzero(np.diff(scene.body[order], prepend=-1))
    low, high = (extreme.reduceat(rest[order], starts, axis=0) for extreme in (np.minimum, np.maximum))
    deforms = np.maximum.reduceat(scene.deforming_nodes[order], starts)
    meet: np.ndarray = np.all((low[:, None] <= high) & (low <= high[:, None]), axis=2)
    np.fill_diagonal(meet, False)
    return bool((meet & (deforms[:, None] | deforms)).any())


def deepest(rest: np.ndarray, first: np.ndarray, second: np.ndarray, tolerated: float) -> Overlap | None:
    """How deep two closed surfaces [F, 3] lie in each other; None if they do not overlap by more than `tolerated`."""
    one, other = (np.unique(rest[np.unique(faces)], axis=0) for faces in (first, second))
    if np.array_equal(one, other):
        return Overlap(np.inf, one.mean(axis=0))
    depth, where = deepest_node(rest, first, second)
    if depth > tolerated:
        return Overlap(depth, where)
    cut = _cut(rest, first, second, tolerated)
    return below_faces(rest, first, second, tolerated) if cut is None else Overlap(0.0, cut)


def deepest_node(rest: np.ndarray, first: np.ndarray, second: np.ndarray) -> tuple[float, np.ndarray]:
    """How deep a node of one closed surface [F, 3] lies inside the other, and where; 0 if none does."""
    depth = 0.0
    where = np.zeros(3)
    for mine, other in ((first, second), (second, first)):
        nodes, depths, _ = nodes_inside(rest, mine, other)
        if len(nodes) and depths.max() > depth:
            depth = float(depths.max())
            where = rest[nodes[np.argmax(depths)]]
    return depth, where


def nodes_inside(rest: np.ndarray, mine: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nodes of one surface [F, 3] that lie inside another, closed one: their numbers [n], how deep each lies [n],
    and the row [n] of the triangle of the other that is nearest."""
    used, faces = np.unique(other, return_inverse=True)
    nodes = np.unique(mine)
    rows, depths, nearest = _inside(rest[nodes], rest[used], faces.reshape(-1, 3))
    return nodes[rows], depths, nearest


def _inside(points: np.ndarray, corners: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The rows [n] of the points that lie inside a closed surface [F, 3] between corners, how deep each lies, and the
    row of the triangle that is nearest."""
    import igl  # takes 0.2 s

    rows = np.flatnonzero(((points > corners.min(axis=0)) & (points < corners.max(axis=0))).all(axis=1))
    if not len(rows):
        return rows, np.empty(0), rows
    distance, nearest = igl.signed_distance(points[rows], corners, faces)[:2]
    inside = np.flatnonzero(np.asarray(distance) < 0)
    return rows[inside], -np.asarray(distance)[inside], np.asarray(nearest)[inside]


def below_faces(rest: np.ndarray, first: np.ndarray, second: np.ndarray, tolerated: float) -> Overlap | None:
    """Where a point just below the middle of a face of one surface lies in the other: of bodies whose faces lie on each
    other, as where one stands twice in two meshes, no node lies inside and no edge cuts."""
    for mine, other in ((first, second), (second, first)):
        points = rest[mine].mean(axis=1) - 2 * tolerated * unit_normals(rest[mine])
        for faces in (other, mine):  # below a face of a thin wall there may be nothing of it
            used, numbers = np.unique(faces, return_inverse=True)
            rows, depths, _ = _inside(points, rest[used], numbers.reshape(-1, 3))
            points = points[rows[depths > tolerated]]
        if len(points):
            return Overlap(np.inf, points.mean(axis=0))
    return None


def _cut(rest: np.ndarray, first: np.ndarray, second: np.ndarray, tolerated: float) -> np.ndarray | None:
    """Where an edge of one surface goes through a face of the other, farther than `tolerated` from all nodes of
    both."""
    for mine, other in ((first, second), (second, first)):
        edges = np.unique(triangle_sides(mine), axis=0)
        edge, face = _near(rest[edges], rest[other])
        if not len(edge):
            continue
        a, b = rest[edges[edge, 0]], rest[edges[edge, 1]]
        p, q, r = (rest[other[face, corner]] for corner in range(3))
        normal = np.cross(q - p, r - p)
        length = np.linalg.norm(normal, axis=1)
        above, below = (np.einsum("ij,ij->i", x - p, normal) / np.maximum(length, 1e-300) for x in (a, b))
        crosses = (above * below < 0) & (np.minimum(np.abs(above), np.abs(below)) > tolerated)
        share = above / np.where(crosses, above - below, 1)
        x = a + share[:, None] * (b - a)
        inside = crosses
        for start, end in ((p, q), (q, r), (r, p)):
            height = np.einsum("ij,ij->i", np.cross(end - start, x - start), normal) / np.maximum(length, 1e-300)
            inside = inside & (height > tolerated * np.linalg.norm(end - start, axis=1))
        if inside.any():
            return x[np.argmax(inside)]
    return None


def _near(edges: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of edges [e, 2, 3] and faces [f, 3, 3] whose boxes meet."""
    return near_boxes(edges.min(axis=1), edges.max(axis=1), faces.min(axis=1), faces.max(axis=1), 0.0)


def _meet(one: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    return np.asarray(((one[0] <= other[1]) & (other[0] <= one[1])).all(axis=-1))


def _mean_edge(rest: np.ndarray, surface: np.ndarray) -> float:
    corners = rest[surface]
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean()) if len(surface) else 0.0

"""Parts that touch at rest, as in CAD assemblies: their surfaces are set back until contact can begin there.

The solver keeps surfaces apart by the contact distance, so faces at one place move into their parts: each by half of
what is missing, beside a rigid part by all of it. Surfaces that are curved alike, such as a pin and its bore, overlap
once they are facets, by no more than the arcs over the facets are high; this is set back, too. A larger overlap stays.

Legend: N nodes, K constraints.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np

from ast_sim.element_topology import MIDDLES
from ast_sim.simulate.own_assembly.surface_gaps import BodyPair, Near, Surfaces, nodes_inside, places_nearer
from ast_sim.simulate.shapes.mesh_check import boundary
from ast_sim.simulate.shapes.parts import quarters, smallest_dihedral

MARGIN = 1.02  # of the contact distance: float32 rounds positions
ROUNDS = 50  # in which surfaces are set back: what is moved may come near to something else
FACING = -0.5  # cosine between the normals of triangles that lie on each other
ALIKE = 0.2  # directions of constraints whose combinations are this short are one direction
ARCS = 1.5  # overlap that may come from facets, in heights of arcs
SMALLEST_ANGLE = 1.0  # degrees between two faces of a tetrahedron that is left


def set_back(
    bodies: list[tuple[np.ndarray, np.ndarray]], names: list[str], rigid: tuple[bool, ...], distance: float, unit: str
) -> tuple[list[np.ndarray], list[str]]:
    """Where the nodes of parts go whose surfaces are set back where they touch, and notes on it, a sentence each.

    Args:
        bodies: positions [n,3] and tetrahedra [e,4] or [e,10] of each part.
        names: of the parts.
        rigid: which parts are rigid; they stay as they are.
        distance: what must lie between two parts, unless both are rigid.
        unit: of lengths, for the notes.
    """
    offset = np.cumsum([0, *(len(position) for position, _ in bodies)])
    start = np.concatenate([position for position, _ in bodies])
    faces = np.concatenate([boundary(cells) + first for (_, cells), first in zip(bodies, offset, strict=False)])
    surfaces = Surfaces(start, faces, np.repeat(np.arange(len(bodies)), np.diff(offset)), rigid)
    depth = _overlaps(surfaces, distance)
    moved = dict[BodyPair, set[int]]()
    for _ in range(ROUNDS):
        near = places_nearer(surfaces, distance, MARGIN * distance, depth)
        if not near:
            break
        for one in near:
            moved.setdefault(one.pair(surfaces), set()).update((*one.group, *one.other))
        surfaces = replace(surfaces, position=surfaces.position + _way(surfaces, near, MARGIN * distance))
    after = [surfaces.position[low:high] for low, high in pairwise(offset)]
    after = [_with_middles(*body, position) for body, position in zip(bodies, after, strict=True)]
    for (before, cells), position in zip(bodies, after, strict=True):
        if _turned(cells, before, position):
            return [position for position, _ in bodies], []
    notes = []
    set_back = np.linalg.norm(surfaces.position - start, axis=1)
    for pair, nodes in moved.items():
        over = f", where facets overlap by up to {depth[pair]:.2g} {unit}" if depth[pair] > distance else ""
        notes.append(
            f"{' and '.join(names[number] for number in pair)} touch at rest{over}: surfaces are set back by up to"
            f" {set_back[list(nodes)].max():.2g} {unit} there, so that contact begins at the contact distance"
            f" {distance:g}"
        )
    return after, notes


def _with_middles(before: np.ndarray, cells: np.ndarray, after: np.ndarray) -> np.ndarray:
    """The positions after, where nodes in the middles of edges inside of a part follow the ends of their edges."""
    if cells.shape[1] == 4:
        return after
    moved = after - before
    middles, first = np.unique(cells[:, 4:], return_index=True)
    ends = cells[:, np.array(MIDDLES)].reshape(-1, 2)[first]
    inside = ~np.isin(middles, boundary(cells))
    moved[middles[inside]] = moved[ends[inside]].mean(axis=1)
    return before + moved


def _turned(cells: np.ndarray, before: np.ndarray, after: np.ndarray) -> bool:
    """Whether tetrahedra have become too sharp or are turned over."""
    changed = cells[(before != after).any(axis=1)[cells].any(axis=1)]
    angle = smallest_dihedral(after, changed) < np.minimum(SMALLEST_ANGLE, smallest_dihedral(before, changed))
    return bool(angle.any() or (quarters(after, changed) <= 0).any())


def _overlaps(surfaces: Surfaces, distance: float) -> dict[BodyPair, float]:
    """How deep each two parts lie in each other, without pairs that overlap more than facets do."""
    depths: dict[BodyPair, float] = {}
    for pair in combinations(range(len(surfaces.rigid)), 2):
        inside = list(nodes_inside(surfaces, pair))
        allowed = [ARCS * surfaces.arcs[[one.triangle, one.opposite]].sum() + distance for one in inside]
        if all(-one.gap <= limit for one, limit in zip(inside, allowed, strict=True)):
            depths[pair] = max((-one.gap for one in inside), default=0.0)
    return depths


def _way(surfaces: Surfaces, near: list[Near], wanted: float) -> np.ndarray:
    """[N,3]: how nodes move, so that all these places are as far apart as wanted: the shortest vector of each that goes
    far enough against the normal of each of its triangles that face another part."""
    constraints: dict[int, list[np.ndarray]] = {}
    for one in near:
        normals = surfaces.normals[one.triangle], surfaces.normals[one.opposite]
        missing = max(0, wanted - one.gap)
        sides = (one.group, one.triangle, normals[0]), (one.other, one.opposite, normals[1])
        rigid = [surfaces.rigid[surfaces.body[nodes[0]]] for nodes, _, _ in sides]
        facing = normals[0] @ normals[1] < FACING
        between = _between(one, *normals)
        for (nodes, triangle, normal), towards, fixed, other in zip(
            sides, (between, -between), rigid, rigid[::-1], strict=True
        ):
            if fixed:
                continue
            amount = missing if other else missing / 2
            for node in surfaces.faces[triangle].tolist() if facing else nodes:
                constraints.setdefault(node, []).append(amount * (-normal if facing else towards))
    result = np.zeros_like(surfaces.position)
    for node, rows in constraints.items():
        result[node] = _shortest(np.array(rows))
    return result


def _between(near: Near, normal: np.ndarray, opposite: np.ndarray) -> np.ndarray:
    """[3]: the direction in which the first group leaves the other, of length one."""
    towards = opposite if len(near.other) == 3 else -normal if len(near.group) == 3 else opposite - normal
    return towards / max(np.linalg.norm(towards), np.finfo(float).tiny)


def _shortest(rows: np.ndarray) -> np.ndarray:
    """[3]: the shortest vector that goes as far as each of the rows [K,3] in its direction, nearly; of rows in about
    one direction the longest counts."""
    lengths = np.linalg.norm(rows, axis=1)
    directions, amounts = [], []
    for row in np.argsort(-lengths, kind="stable")[: np.count_nonzero(lengths)]:
        direction = rows[row] / lengths[row]
        if all(direction @ known < 1 - ALIKE**2 / 2 for known in directions):
            directions.append(direction)
            amounts.append(lengths[row])
    return np.linalg.lstsq(np.array(directions).reshape(-1, 3), np.array(amounts), rcond=ALIKE)[0]

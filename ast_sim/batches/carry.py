"""Carrying along: the free nodes of a body follow the motion that is prescribed for its other nodes.

A jump starts from here. The bodies then stand where their handles bring them, they meet or overlap, and a model sees
where; it predicts what is missing.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.linalg import splu

from ast_sim.element_topology import LOCAL_EDGES, linear_elements
from ast_sim.mechanics.elements.neo_hookean import cofactor, determinant
from ast_sim.scene import Scene

RIGID = 1e-3  # prescribed nodes move as a rigid body if no node is farther off, as a share of the largest displacement
LOOSE = 1e-13  # is added to the diagonal, as a share of the largest entry: far below the rounding of positions
PLANAR = 1e-6  # points lie on a line if their second extent, as a share of the first, is below this


class Carrier:
    """Carries the free nodes of a scene along; made once for each scene.

    Where the prescribed nodes of a body move rigidly, its free nodes move with them. Otherwise their displacement is
    the harmonic extension over the mesh at rest, by linear finite elements. Nodes that no element joins to a prescribed
    node stay.
    """

    def __init__(self, scene: Scene) -> None:
        self._prescribed = scene.prescribed
        bodies = self._bodies = [
            (np.flatnonzero(body & scene.prescribed), np.flatnonzero(body & ~scene.prescribed))
            for body in (scene.body == number for number in np.unique(scene.body))
            if (body & scene.prescribed).any() and (body & ~scene.prescribed).any()
        ]
        self._extension = cache(lambda number: harmonic_extension(scene, *bodies[number]))

    def __call__(self, position: np.ndarray, prescribed_position: np.ndarray) -> np.ndarray:
        """Move a state to where the prescribed nodes will be.

        Args:
            position: [N, 3], the state.
            prescribed_position: [N, 3], of the prescribed nodes. Other rows are not read.

        Returns:
            [N, 3] float32.
        """
        there = np.where(self._prescribed[:, None], prescribed_position, position).astype(np.float32)
        for number, (held, free) in enumerate(self._bodies):
            before, after = position[held].astype(np.float64), prescribed_position[held].astype(np.float64)
            if np.array_equal(before, after):
                continue
            move = rigid_motion(before, after)
            if move is not None:
                rotation, shift = move
                there[free] = position[free].astype(np.float64) @ rotation.T + shift
            else:
                there[free] = position[free] + self._extension(number)(after - before)
        return there


def rigid_motion(before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """The rotation [3, 3] and shift [3] with after = before R^T + shift; None if the points [P, 3] do not move rigidly,
    or if they lie on a line and turn, since then any rotation about the line would do.

    The rotation is the best one in the sense of least squares (Kabsch 1976).
    """
    way = after - before
    allowed = RIGID * np.abs(way).max()
    if np.abs(way - way.mean(axis=0)).max() <= allowed:
        return np.eye(3), way.mean(axis=0)
    center, center_after = before.mean(axis=0), after.mean(axis=0)
    left, extents, right = np.linalg.svd((before - center).T @ (after - center_after))
    if extents[1] <= PLANAR * extents[0]:
        return None
    turn = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = (left @ turn @ right).T
    shift = center_after - rotation @ center
    return (rotation, shift) if np.abs(before @ rotation.T + shift - after).max() <= allowed else None


def harmonic_extension(scene: Scene, held: np.ndarray, free: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """A function from the displacements [H, 3] of the held nodes of a body to those [F, 3] of its free nodes."""
    count = len(free)
    stiffness = _stiffness(scene, np.concatenate([free, held]))
    # Symmetric and positive definite: its transpose holds it by columns, no pivoting, an ordering for such matrices.
    inner, symmetric = stiffness[:count, :count].T, {"SymmetricMode": True}
    solver = splu(inner, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)

    def extend(way: np.ndarray) -> np.ndarray:
        pull = stiffness @ np.concatenate([np.zeros((count, 3)), way])
        return solver.solve(-pull[:count])

    return extend


def _stiffness(scene: Scene, nodes: np.ndarray) -> csr_array:
    """[n, n]: the integrals of grad N_a . grad N_b over the mesh at rest for `nodes` [n] with linear shape functions N.

    Let o_a be the side opposite to node a of an element, as a vector: the edge of a triangle, or of a tetrahedron the
    normal of the face, as long as twice its area. All of them are taken in one sense, so they add up to 0. Then the
    integral over the element is o_a . o_b / (4 area), or o_a . o_b / (36 volume). Rows add up to 0, too.

    Nodes that no element joins to a held one are pulled by nothing. What `LOOSE` adds to the diagonal lets them stay.
    """
    elements = linear_elements(scene.elements).T  # [k, E]
    corners = scene.rest_position.astype(np.float64)[elements].swapaxes(1, 2)  # [k, 3, E]
    sides = corners[1:] - corners[:1]
    if len(elements) == 3:
        opposite = np.roll(corners, 1, axis=0) - np.roll(corners, -1, axis=0)
        size = 2 * np.linalg.norm(np.cross(*sides, axis=0), axis=0)
    else:
        normals = cofactor(sides)
        opposite = np.concatenate([-normals.sum(axis=0, keepdims=True), normals])
        size = 6 * np.abs(determinant(sides, normals))
    count = len(nodes)
    number = np.full(scene.num_nodes, -1)
    number[nodes] = np.arange(count)
    ends = np.array(LOCAL_EDGES[len(elements)]).T
    one, other = number[elements[ends]]  # [2, edges, E]
    among = (one >= 0) & (other >= 0)
    integrals = (np.einsum("pie,pie->pe", *opposite[ends]) / size)[among]
    # One sort brings the elements at an edge together; another one puts both places of an edge, and the diagonal, in
    # the order of a matrix by rows.
    keys = (np.minimum(one, other) * count + np.maximum(one, other))[among]
    order = np.argsort(keys)
    keys = keys[order]
    first = np.flatnonzero(np.diff(keys, prepend=-1))
    of_edges = np.add.reduceat(integrals[order], first) if len(first) else integrals
    low, high = np.divmod(keys[first], count)
    diagonal = np.bincount(np.concatenate([low, high]), np.tile(-of_edges, 2), minlength=count)
    diagonal += LOOSE * diagonal.max(initial=np.finfo(float).tiny)
    keys = np.concatenate([keys[first], high * count + low, np.arange(count) * (count + 1)])
    order = np.argsort(keys)
    rows, columns = np.divmod(keys[order], count)
    values = np.concatenate([of_edges, of_edges, diagonal])[order]
    return csr_array((values, columns, np.searchsorted(rows, np.arange(count + 1))), shape=(count, count))

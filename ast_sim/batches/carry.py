"""Carrying along: the free nodes of a body follow the motion that is prescribed for its other nodes.

A jump starts from here. The bodies then stand where their handles bring them, they meet or overlap, and a model sees
where; it predicts what is missing.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import scipy.sparse
import torch
from scipy.linalg import get_lapack_funcs
from scipy.sparse.linalg import splu

from ast_sim.element_topology import LOCAL_EDGES, linear_elements
from ast_sim.mechanics.elements.neo_hookean import cofactor, determinant
from ast_sim.ops import breadth_first
from ast_sim.scene import Scene

RIGID = 1e-3  # prescribed nodes move as a rigid body if no node is farther off, as a share of the largest displacement
LOOSE = 1e-13  # is added to the diagonal, as a share of the largest entry: far below the rounding of positions
LARGEST_BAND = 50_000_000  # numbers, of 8 bytes
PLANAR = 1e-6  # points lie on a line if their second extent, as a share of the first, is below this

_factor_of_band, _solution_of_band = get_lapack_funcs(("pbtrf", "pbtrs"))


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
    displacement = after - before
    allowed = RIGID * np.abs(displacement).max()
    if np.abs(displacement - displacement.mean(axis=0)).max() <= allowed:
        return np.eye(3), displacement.mean(axis=0)
    center, center_after = before.mean(axis=0), after.mean(axis=0)
    left, extents, right = np.linalg.svd((before - center).T @ (after - center_after))
    if extents[1] <= PLANAR * extents[0]:
        return None
    turn = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = (left @ turn @ right).T
    shift = center_after - rotation @ center
    return (rotation, shift) if np.abs(before @ rotation.T + shift - after).max() <= allowed else None


def harmonic_extension(scene: Scene, held: np.ndarray, free: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """A function from displacements [H, 3] of the held nodes of a body to displacements [F, 3] of its free nodes.

    Nodes of an element are near each other in the order of the free nodes, so their matrix has a narrow band. Its
    Cholesky factor takes a quarter of the time of a sparse LU factor. The LU factor keeps fewer numbers; it is taken
    where the band would hold more than `LARGEST_BAND`, or where rounding makes the matrix of flat elements indefinite.
    """
    count = len(free)
    elements = linear_elements(scene.elements).astype(np.int64)
    wanted = np.zeros(scene.num_nodes, np.int64)
    wanted[free] = 1
    number = breadth_first(torch.from_numpy(elements), torch.from_numpy(wanted)).numpy()
    place = number[free]
    number[held] = count + np.arange(len(held))
    one, other, integrals = _integrals(scene.rest_position, elements, number)
    low = np.minimum(one, other)
    high = np.maximum(one, other)
    diagonal = np.bincount(np.concatenate([low, high]), np.tile(-integrals, 2), minlength=count)[:count]
    inner = high < count
    outer = (low < count) & (high >= count)
    width = 1 + int((high - low)[inner].max(initial=0))
    diagonal += LOOSE * diagonal.max(initial=np.finfo(float).tiny)
    upper = low[inner], high[inner], integrals[inner]
    solve = _solver_of_band(diagonal, *upper, width) if count * width <= LARGEST_BAND else None
    solve = solve or _solver_of_sparse(diagonal, *upper)
    pulled = low[outer]
    pulling = high[outer] - count
    strength = integrals[outer]

    def extend(displacement: np.ndarray) -> np.ndarray:
        pull = [np.bincount(pulled, strength * component[pulling], minlength=count) for component in displacement.T]
        return solve(-np.stack(pull).T)[place]

    return extend


def _solver_of_band(
    diagonal: np.ndarray, low: np.ndarray, high: np.ndarray, values: np.ndarray, width: int
) -> Callable[[np.ndarray], np.ndarray] | None:
    """Solves with a symmetric matrix of `width` diagonals; None if it is not positive definite.

    Args:
        diagonal: [F].
        low, high, values: [M], row, column and value of entries above the diagonal, which add up.
    """
    count = len(diagonal)
    band = np.bincount(low * width + high - low, values, minlength=count * width).reshape(count, width)
    band[:, 0] = diagonal
    factor, failed = _factor_of_band(band.T, lower=1, overwrite_ab=1)
    return None if failed else lambda right: _solution_of_band(factor, right, lower=1)[0]


def _solver_of_sparse(
    diagonal: np.ndarray, low: np.ndarray, high: np.ndarray, values: np.ndarray
) -> Callable[[np.ndarray], np.ndarray]:
    """The same by a sparse factor."""
    upper = scipy.sparse.csc_array((values, (low, high)), shape=(len(diagonal), len(diagonal)))
    whole = (upper + upper.T + scipy.sparse.diags_array(diagonal)).tocsc()
    return splu(whole, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}).solve


def _integrals(rest: np.ndarray, elements: np.ndarray, number: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The integrals of grad N_a . grad N_b over each of the elements [E, k] with linear shape functions N, at rest.

    Let o_a be the side opposite to node a of an element, as a vector: the edge of a triangle, or of a tetrahedron the
    normal of the face, as long as twice its area. All of them are taken in one sense, so they add up to 0. Then the
    integral over the element is o_a . o_b / (4 area), or o_a . o_b / (36 volume). The rows of their matrix add up to 0,
    too. An element without a size pulls nothing. Nodes that no element joins to a held one are pulled by nothing,
    either; what `LOOSE` adds to the diagonal lets them stay.

    Args:
        rest: [N, 3].
        number: [N], what stands for a node, or -1: it does not count.

    Returns:
        The numbers of a and b, and the integrals, for each edge of each element.
    """
    elements = elements.T  # [k, E]
    number = number[elements]
    counted = number.max(axis=0) >= 0
    elements, number = elements[:, counted], number[:, counted]
    corners = rest.astype(np.float64)[elements].swapaxes(1, 2)  # [k, 3, E]
    sides = corners[1:] - corners[:1]
    if len(elements) == 3:
        opposite = np.roll(corners, 1, axis=0) - np.roll(corners, -1, axis=0)
        size = 2 * np.linalg.norm(np.cross(*sides, axis=0), axis=0)
    else:
        normals = cofactor(sides)
        opposite = np.concatenate([-normals.sum(axis=0, keepdims=True), normals])
        size = 6 * np.abs(determinant(sides, normals))
    ends = np.array(LOCAL_EDGES[len(elements)]).T
    one, other = number[ends]  # [2, edges, E]
    integrals = np.einsum("pie,pie->pe", *opposite[ends]) / np.where(size > 0, size, np.inf)
    among = (one >= 0) & (other >= 0)
    return one[among], other[among], integrals[among]

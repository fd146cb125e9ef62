"""The forces between pairs of surfaces in one Newton step with linearised contact, from how a body gives way to them.

With K the stiffness and a row of C the direction of a force, B = C K^-1 C^T says how far each force moves each gap. See
`linearised_contact`.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.sparse
from scipy.optimize import nnls

from ast_sim.mechanics.linear_system import Factorization
from ast_sim.support.errors import SimulationError

AT_ONCE = 2**25  # numbers in the right sides that are solved for together
ROUNDING = 1e-10  # is added to the diagonal of B, relative to its mean: equal pairs make B singular
SWEEPS, CHANGE = 100, 1e-3  # forces of friction are found when a sweep over the pairs changes them by less
TINY = 1e-300  # instead of zero in a denominator


class Compliance:
    """B of directions that come one after another, and the displacement by forces along them.

    With the factorization K = L L^T, B is the product of L^-1 C^T with itself. A column of it is zero but for the
    unknowns that are eliminated after those of the direction and depend on them: a tenth of all if the directions lie
    side by side. Only the rows with other numbers are kept, and multiplied.

    Args:
        factor: of K.
        directions: [P, F], of which some will be wanted.

    Attributes:
        matrix: B [A, A] of the wanted ones, in the order in which they came; exactly symmetric, without zero
            eigenvalues.
    """

    def __init__(self, factor: Factorization, directions: scipy.sparse.csr_array) -> None:
        self._factor, self._directions = factor, directions
        self._parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []  # unknowns, lefts and rights of some columns
        self._products = np.zeros((0, 0))

    @property
    def matrix(self) -> np.ndarray:
        ridge = ROUNDING * np.trace(self._products) / len(self._products)
        return self._products + ridge * np.eye(len(self._products))

    def want(self, wanted: np.ndarray) -> None:
        """Some more directions, by their numbers [n]."""
        together = max(1, AT_ONCE // self._directions.shape[1])
        for start in range(0, len(wanted), together):
            left, right = self._factor.halves(self._directions[wanted[start : start + together]].toarray())
            beside = [lefts @ right[:, unknowns].T for unknowns, lefts, _ in self._parts]
            unknowns = np.flatnonzero(right.any(axis=0))
            shared = left is right
            right = np.ascontiguousarray(right[:, unknowns])
            left = right if shared else np.ascontiguousarray(left[:, unknowns])
            own = left @ right.T
            between = np.concatenate([np.zeros((0, len(own))), *beside])
            self._products = np.block([[self._products, between], [between.T, (own + own.T) / 2]])
            self._parts.append((unknowns, left, right))

    def displacement(self, forces: np.ndarray) -> np.ndarray:
        """K^-1 C^T times the forces [A]: [F]."""
        rights, first = np.zeros(self._directions.shape[1]), 0
        for unknowns, _, right in self._parts:
            rights[unknowns] += forces[first : first + len(right)] @ right
            first += len(right)
        return self._factor.other_half(rights)


def pressed(compliance: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """The forces [P] >= 0 of contact without friction: with B = L L^T they minimise |L^T l + L^-1 b|."""
    try:
        lower = np.linalg.cholesky(compliance)
        return nnls(lower.T, -np.linalg.solve(lower, offset), maxiter=30 * len(offset))[0]
    except (np.linalg.LinAlgError, RuntimeError) as error:
        raise SimulationError(f"the forces of contact were not found: {error}") from error


def rubbed(compliance: np.ndarray, offset: np.ndarray, forces: np.ndarray, friction: float) -> np.ndarray:
    """The forces [3, P] of contact with Coulomb friction, from those [P] without, by nonlinear block Gauss-Seidel
    (Jourdan, Alart and Jean 1998): each pair in turn gets the force that is right if the others stay.

    Args:
        compliance: B [3 P, 3 P], normals first, then the first and the second tangents.
        offset: b [3 P].
    """
    count = len(forces)
    all_forces = np.concatenate([forces, np.zeros(2 * len(forces))])
    of_pair = np.ascontiguousarray(compliance.reshape(3, count, 3 * count).swapaxes(0, 1))  # the three rows of each
    by_normal = of_pair[np.arange(count), :, np.arange(count)].tolist()  # what a pair's own normal force moves
    stiffest = compliance.diagonal().reshape(3, count)[1:].max(axis=0).tolist()
    pairs = list(zip(of_pair, offset.reshape(3, count).T, by_normal, stiffest, strict=True))
    for _ in range(SWEEPS):
        before = all_forces.copy()
        for pair, (rows, gap, (own, first_by_normal, second_by_normal), tangential) in enumerate(pairs):
            components = slice(pair, None, count)
            distance, first, second = (rows @ all_forces + gap).tolist()
            normal_before, one, other = all_forces[components].tolist()
            normal = max(0.0, normal_before - distance / own)
            one -= (first + first_by_normal * (normal - normal_before)) / tangential
            other -= (second + second_by_normal * (normal - normal_before)) / tangential
            share = min(1.0, friction * normal / max(math.hypot(one, other), TINY))
            all_forces[components] = normal, share * one, share * other
        if np.abs(all_forces - before).max() <= CHANGE * np.abs(all_forces).max():
            break
    return all_forces

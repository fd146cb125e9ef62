"""How bodies give way to forces along some directions: B = C K^-1 C^T. K is the stiffness, a row of C a direction."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse

from ast_sim.mechanics.linear_algebra.factorization import Factorization

COLUMNS, NUMBERS = 64, 2**23  # right sides that are solved for together: 64, or more while they have fewer numbers
ROUNDING = 1e-10  # is added to the diagonal of B, relative to its mean: equal pairs make B singular


class Compliance:
    """B of directions that come one after another, and the displacement by forces along them.

    With the factorization K = L L^T, B is the product of L^-1 C^T with itself. A column of it is zero but for the
    unknowns that are eliminated after the unknowns of the direction and depend on them: a tenth if the directions lie
    side by side. Only the rows with other numbers are kept, and multiplied.

    Args:
        factor: of K.
        directions: [P, F], of which some will be wanted.
        watch: is called with the number of the wanted ones so far, before more of them are computed. It may raise.

    Attributes:
        matrix: B [A, A] of the wanted ones, in the order in which they came; exactly symmetric, without zero
            eigenvalues.
    """

    def __init__(self, factor: Factorization, directions: scipy.sparse.csr_array, watch: Callable[[int], None]) -> None:
        self._factor, self._directions, self._watch = factor, directions, watch
        self._parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []  # unknowns, lefts and rights of some columns
        self._products = np.zeros((0, 0))

    @property
    def matrix(self) -> np.ndarray:
        ridge = ROUNDING * np.trace(self._products) / len(self._products)
        return self._products + ridge * np.eye(len(self._products))

    def want(self, wanted: np.ndarray) -> None:
        """Some more directions, by their numbers [n]."""
        together = max(COLUMNS, NUMBERS // self._directions.shape[1])
        for start in range(0, len(wanted), together):
            self._watch(len(self._products))
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
        rights = np.zeros(self._directions.shape[1])
        first = 0
        for unknowns, _, right in self._parts:
            rights[unknowns] += forces[first : first + len(right)] @ right
            first += len(right)
        return self._factor.other_half(rights)

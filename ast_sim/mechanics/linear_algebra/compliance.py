"""How bodies give way to forces along some directions: B = C K^-1 C^T. K is the stiffness, a row of C a direction.

There are two ways to B. With the factorization K = L L^T, B is the product of L^-1 C^T with itself, and each column of
it costs half a solution with K. Or all unknowns are eliminated but those that have a part in any direction (static
condensation). What is left of K is a dense matrix, the Schur complement S, and B = C S^-1 C^T costs no solution.
Columns are faster for few directions, condensation for many.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
import scipy.sparse
from scipy.linalg import get_lapack_funcs

from ast_sim.mechanics.linear_algebra.factorization import Factorization
from ast_sim.mechanics.linear_algebra.linear_system import LinearSystem

COLUMNS, NUMBERS = 64, 2**23  # right sides that are solved for together: 64, or more while they have fewer numbers
ROUNDING = 1e-10  # is added to the diagonal of B, relative to its mean: equal pairs make B singular
# What condensation costs, in columns (docs/log.md, 2026-11-28): 70 for a new symbolic factorization, and one for each
# 1,000 multiplications of dense matrices per eliminated unknown. About a third of the directions is wanted.
ANALYSIS = 70
MULTIPLICATIONS = 1000
WANTED = 1 / 3

_cholesky, _inverse_of_factor = get_lapack_funcs(("potrf", "potri"))


class Compliance(Protocol):
    """B of directions that come one after another, and displacements by forces along them.

    Attributes:
        is_whole: all of B is known; a wanted direction costs nothing.
    """

    is_whole: bool

    @property
    def matrix(self) -> np.ndarray:
        """B [A, A] of the wanted directions, in the order in which they came; exactly symmetric, without zero
        eigenvalues."""
        ...

    def want(self, wanted: np.ndarray) -> None:
        """Some more directions, by their numbers [n]."""

    def solution(self, load: np.ndarray) -> np.ndarray:
        """K^-1 times a load [F]: [F]."""
        ...

    def displacement(self, forces: np.ndarray) -> np.ndarray:
        """K^-1 C^T times the forces [A] along the wanted directions: [F]."""
        ...

    def along(self, forces: np.ndarray) -> np.ndarray:
        """This displacement along all directions: [P]."""
        ...


def compliance_of(
    system: LinearSystem, values: np.ndarray, directions: scipy.sparse.csr_array, watch: Callable[[int], None]
) -> Compliance | None:
    """By the way that is faster; None if the stiffness is not positive definite.

    Args:
        system: of K.
        values: of the entries of K.
        directions: [P, F], of which some will be wanted.
        watch: is called with the number of the wanted ones so far, before more of them are computed. It may raise.
    """
    touched = np.unique(directions.indices)
    count = len(directions.indptr) - 1
    if not (system.condenses and condensation_pays(count, len(touched), len(system.free))):
        factor = system.factorise(values)
        return None if factor is None else ByColumns(factor, directions, watch)
    condensed = system.condense(values, touched)
    if condensed is None:
        return None
    inverse = _inverse(condensed[1])
    return None if inverse is None else ByCondensation(condensed[0], touched, inverse, directions, watch)


def condensation_pays(directions: int, touched: int, unknowns: int) -> bool:
    """Whether condensation takes less time than columns. It never does where all unknowns are touched."""
    return (WANTED * directions - ANALYSIS) * MULTIPLICATIONS * (unknowns - touched) > touched**3


class ByColumns:
    """By columns of L^-1 C^T. A column is zero but for the unknowns that are eliminated after the unknowns of the
    direction and depend on them: a tenth of all if the directions lie side by side. Only the rows with other numbers
    are kept, and multiplied.

    Args:
        factor: of K.
        directions, watch: see `compliance_of`.
    """

    is_whole = False

    def __init__(self, factor: Factorization, directions: scipy.sparse.csr_array, watch: Callable[[int], None]) -> None:
        self._factor = factor
        self._directions = directions
        self._watch = watch
        self._unknowns = directions.shape[1]  # pyright: ignore[reportOptionalSubscript], of scipy
        self._parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []  # unknowns, lefts and rights of some columns
        self._products = np.zeros((0, 0))

    @property
    def matrix(self) -> np.ndarray:
        return _regular(self._products)

    def want(self, wanted: np.ndarray) -> None:
        together = max(COLUMNS, NUMBERS // self._unknowns)
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

    def solution(self, load: np.ndarray) -> np.ndarray:
        return self._factor.other_half(self._factor.halves(load[None])[1][0])

    def displacement(self, forces: np.ndarray) -> np.ndarray:
        rights = np.zeros(self._unknowns)
        first = 0
        for unknowns, _, right in self._parts:
            rights[unknowns] += forces[first : first + len(right)] @ right
            first += len(right)
        return self._factor.other_half(rights)

    def along(self, forces: np.ndarray) -> np.ndarray:
        return self._directions @ self.displacement(forces)


class ByCondensation:
    """By K^-1 between the unknowns that any direction touches.

    Args:
        factor: of K, without the touched unknowns.
        touched: [m] these unknowns.
        inverse: [m, m] K^-1 between them.
        directions, watch: see `compliance_of`.
    """

    is_whole = True

    def __init__(
        self,
        factor: Factorization,
        touched: np.ndarray,
        inverse: np.ndarray,
        directions: scipy.sparse.csr_array,
        watch: Callable[[int], None],
    ) -> None:
        self._factor = factor
        self._touched = touched
        self._inverse = inverse
        self._directions = directions
        self._watch = watch
        on_touched = directions[:, touched]
        products = on_touched @ (on_touched @ inverse).T
        self._products = (products + products.T) / 2
        self._wanted = np.zeros(0, int)

    @property
    def matrix(self) -> np.ndarray:
        return _regular(self._products[np.ix_(self._wanted, self._wanted)])

    def want(self, wanted: np.ndarray) -> None:
        self._watch(len(self._wanted))
        self._wanted = np.concatenate([self._wanted, wanted])

    def solution(self, load: np.ndarray) -> np.ndarray:
        half = self._factor.halves(load[None])[1][0]
        half[self._touched] = self._inverse @ half[self._touched]
        return self._factor.other_half(half)

    def displacement(self, forces: np.ndarray) -> np.ndarray:
        return self.solution(self._directions[self._wanted].T @ forces)

    def along(self, forces: np.ndarray) -> np.ndarray:
        return self._products[:, self._wanted] @ forces


def _regular(products: np.ndarray) -> np.ndarray:
    """B from products of its directions; equal directions make no zero eigenvalue."""
    return products + ROUNDING * np.trace(products) / len(products) * np.eye(len(products))


def _inverse(matrix: np.ndarray) -> np.ndarray | None:
    """The inverse of a symmetric matrix whose bodies are not coupled; None if it is not positive definite."""
    _, part = scipy.sparse.csgraph.connected_components(scipy.sparse.csr_array(matrix))
    inverse = np.zeros_like(matrix)
    for members in (np.flatnonzero(part == number) for number in range(part.max() + 1)):
        block = np.ix_(members, members)
        lower, failure = _cholesky(matrix[block], lower=True)
        if failure:
            return None
        lower = np.tril(_inverse_of_factor(lower, lower=True)[0])
        inverse[block] = lower + np.tril(lower, -1).T
    return inverse

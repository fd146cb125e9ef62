"""The sparse system of a Newton step. Small ones: Cholesky. Large ones: conjugate gradients with an earlier factor.

From one Newton step to the next, a matrix changes little except for a few pairs in contact. With the factor of an
earlier matrix, conjugate gradients therefore converge in about ten iterations. At 100,000 nodes such a solution costs a
hundredth of a factorization, and iterating is far faster. At 4,000 nodes it costs a fifteenth, and iterating is not
faster. If the iterations do not suffice, the matrix itself is factorised.

Elements couple the same unknowns at all times; contact couples more as it spreads. The sparsity pattern holds the
entries of the elements and of every contact since the last `restart`. As long as no new entries come, the symbolic
factorization is used again.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import numpy as np
import scipy.sparse

from ast_sim.mechanics.linear_algebra.factorization import Factorization, factorization
from ast_sim.mechanics.linear_algebra.sparsity import Entries, Sparsity, entry_dofs

ITERATE_FROM = 50_000  # systems with at least this many unknowns keep a factor and iterate with it
RELATIVE_RESIDUAL = 1e-3  # of conjugate gradients, to the right side; a Newton step reduces the error by as much
MAX_ITERATIONS = 40  # then a new factor is cheaper

NO_CONTACT = np.zeros(0, int), np.zeros(0, int), np.zeros(0)


def conjugate_gradients(
    upper: scipy.sparse.csr_array, right_side: np.ndarray, precondition: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray | None, bool]:
    """Preconditioned conjugate gradients for a symmetric matrix given by its upper triangle.

    Returns:
        The solution, or None if the allowed iterations do not suffice; and whether a direction of negative curvature
        was met. A positive definite matrix has no such direction.
    """
    diagonal = upper.diagonal()
    solution = np.zeros_like(right_side)
    residual = right_side.copy()
    goal = RELATIVE_RESIDUAL * np.linalg.norm(right_side)
    if goal == 0:
        return solution, False
    direction = preconditioned = precondition(residual)
    product = residual @ preconditioned
    for _ in range(MAX_ITERATIONS):
        image = upper @ direction + upper.T @ direction - diagonal * direction
        curvature = direction @ image
        if curvature <= 0:
            return None, True
        solution += product / curvature * direction
        residual -= product / curvature * image
        if np.linalg.norm(residual) <= goal:
            return solution, False
        preconditioned = precondition(residual)
        before = product
        product = residual @ preconditioned
        direction = preconditioned + product / before * direction
    return None, False


class LinearSystem:
    """Symmetric system for the free degrees of freedom; a dof is 3 node + component.

    Args:
        entries: that elements add, with P values in all.
        prescribed: [N] nodes whose rows and columns are left out.

    Attributes:
        free: [F] the dofs that are not left out.
    """

    def __init__(self, entries: Sequence[Entries], prescribed: np.ndarray) -> None:
        free = np.repeat(~prescribed, 3)
        self.free = np.flatnonzero(free)
        self._count = len(self.free)
        self._number = np.where(free, np.cumsum(free) - 1, -1).astype(np.int32)
        self._entries = entries
        sparsity = Sparsity(entries, self._number[::3] // 3)  # -1 stays -1
        rows = np.repeat(np.arange(self._count), np.diff(sparsity.starts))
        self._own = rows * self._count + sparsity.columns
        self._slot = sparsity.slot
        self._factorization = factorization()
        self.factorizations = 0
        self._has_factor = False
        self._set_pattern(self._own)

    @property
    def solver_name(self) -> str:
        """Name and version of the library that factorises."""
        return self._factorization.name

    def restart(self) -> None:
        """Forget the factor and all contacts so far. What follows does not depend on them."""
        self._has_factor = False
        if self._pattern is not self._own:
            self._set_pattern(self._own)

    def _keys(self, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which entries lie between free dofs, and the places row * count + column of these in the upper triangle."""
        rows, columns = self._number[rows], self._number[columns]
        inside = (rows >= 0) & (columns >= 0)
        rows, columns = rows[inside].astype(np.int64), columns[inside].astype(np.int64)
        return inside, np.minimum(rows, columns) * self._count + np.maximum(rows, columns)

    def _set_pattern(self, pattern: np.ndarray) -> None:
        self._pattern = pattern
        self._is_new = True
        self._position = None if len(pattern) == len(self._own) else np.searchsorted(pattern, self._own)
        rows, self._columns = np.divmod(pattern, self._count)
        self._columns = self._columns.astype(np.int32)
        self._starts = np.searchsorted(rows, np.arange(self._count + 1)).astype(np.int32)

    def solve(
        self, values: np.ndarray, contact: tuple[np.ndarray, np.ndarray, np.ndarray], right_side: np.ndarray
    ) -> np.ndarray | None:
        """Solve with the sum of the elements' values [P] and the contact's rows, columns and values (all entries).

        Returns:
            [N,3]: the solution for the free rows of the right side [N,3], and zero at prescribed nodes. None if the
            matrix is found not to be positive definite. Not every such matrix is found, but the solution is a direction
            of descent in any case.
        """
        matrix = self._assemble(values, contact)
        right = right_side.ravel()[self.free]
        free = None
        if self._has_factor and self._count >= ITERATE_FROM:
            free, is_indefinite = conjugate_gradients(matrix, right, self._factorization.solve)
            if is_indefinite:
                return None
        if free is None:
            self.factorizations += 1
            self._has_factor = self._factorization.factorise(matrix, self._is_new)
            self._is_new = False
            if not self._has_factor:
                return None
            free = self._factorization.solve(right)
        solution = np.zeros(right_side.size)
        solution[self.free] = free
        return solution.reshape(-1, 3)

    def factorise(self, values: np.ndarray) -> Factorization | None:
        """Factorise the sum of the elements' values [P] alone, without contact. `free` has the unknowns of the
        factorization. None if the matrix is not positive definite."""
        self.factorizations += 1
        self._has_factor = self._factorization.factorise(self._assemble(values, NO_CONTACT), self._is_new)
        self._is_new = False
        return self._factorization if self._has_factor else None

    @property
    def condenses(self) -> bool:
        """Whether the library that factorises can `condense`."""
        return self._factorization.condenses

    def condense(self, values: np.ndarray, kept: np.ndarray) -> tuple[Factorization, np.ndarray] | None:
        """As `factorise`, but the unknowns `kept` [m] are left: also the Schur complement [m, m]."""
        self.factorizations += 1
        schur = self._factorization.condense(self._assemble(values, NO_CONTACT), kept, self._is_new)
        self._is_new = self._has_factor = False
        return None if schur is None else (self._factorization, schur)

    def _assemble(
        self, values: np.ndarray, contact: tuple[np.ndarray, np.ndarray, np.ndarray]
    ) -> scipy.sparse.csr_array:
        """The upper triangle of the sum of the elements' and the contact's matrices."""
        rows, columns, contact_values = contact
        upper = rows <= columns
        inside, keys = self._keys(rows[upper], columns[upper])
        place = np.searchsorted(self._pattern, keys)
        missing = keys[self._pattern[np.minimum(place, len(self._pattern) - 1)] != keys]
        if len(missing):
            # A stable sort merges two sorted runs in linear time.
            self._set_pattern(np.sort(np.concatenate([self._pattern, np.unique(missing)]), kind="stable"))
            place = np.searchsorted(self._pattern, keys)
        data = np.bincount(self._slot, values, minlength=len(self._own) + 1)[:-1]
        if self._position is not None:
            spread = np.zeros(len(self._pattern))
            spread[self._position] = data
            data = spread
        if len(keys):
            data += np.bincount(place, contact_values[upper][inside], minlength=len(data))
        return scipy.sparse.csr_array((data, self._columns, self._starts), shape=(self._count, self._count))

    @functools.cached_property
    def _mixed(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The entries between a free and a prescribed dof: their numbers, rows and columns."""
        rows, columns = entry_dofs(self._entries)
        mixed = np.flatnonzero((self._number[rows] < 0) != (self._number[columns] < 0))
        return mixed, rows[mixed], columns[mixed]

    def coupling(
        self, values: np.ndarray, contact: tuple[np.ndarray, np.ndarray, np.ndarray], increment: np.ndarray
    ) -> np.ndarray:
        """Change of the forces on free nodes [N,3], to first order, when prescribed nodes move by `increment` [N,3]."""
        mixed, rows, columns = self._mixed
        increment = increment.ravel()
        total = np.zeros(len(increment))
        total += np.bincount(contact[0], contact[2] * increment[contact[1]], minlength=len(increment))
        total += np.bincount(rows, values[mixed] * increment[columns], minlength=len(increment))
        total += np.bincount(columns, values[mixed] * increment[rows], minlength=len(increment))
        return total.reshape(-1, 3)

"""The sparse system of a Newton step: Cholesky, or for large ones conjugate gradients with a factor that is kept.

From one Newton step to the next a matrix changes little but for a few pairs in contact, so a factor of one before
brings conjugate gradients home in about ten iterations. A solution with it costs a hundredth of a factorization at
100,000 nodes, where iterating is the faster way by far, and a fifteenth at 4,000, where it is not. Where the
iterations do not suffice the matrix itself is factorised.

Elements couple the same unknowns at all times; contact couples more as it spreads. The pattern holds the entries of
the elements and of every contact since the last `restart`: while no new ones come the symbolic factorization serves
again. PARDISO (of MKL) factorises where it is installed, CHOLMOD (of cholespy) elsewhere; both with one thread, and
both report a matrix that is not positive definite.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
import weakref
from collections.abc import Callable
from typing import Protocol

import numpy as np
import scipy.sparse

from ast_sim.errors import MissingExtra, SimulationError, require

# From so many unknowns on a factor is kept and iterated with.
ITERATE_FROM = 50_000
# Conjugate gradients end at this residual relative to the right side: Newton's error falls by as much in a step.
RELATIVE_RESIDUAL = 1e-3
# After so many iterations a new factor is the cheaper way.
MAX_ITERATIONS = 40


class Factorization(Protocol):
    """Cholesky factorization of symmetric matrices that are given by their upper triangles."""

    name: str

    def factorise(self, upper: scipy.sparse.csr_array, is_new_pattern: bool) -> bool:
        """Factorise; False if the matrix is not positive definite."""

    def solve(self, right_side: np.ndarray) -> np.ndarray:
        """Solution for the matrix last factorised."""


class Pardiso:
    """PARDISO in Intel's MKL; the symbolic factorization is made for new patterns only."""

    _NOT_POSITIVE_DEFINITE = -4

    def __init__(self) -> None:
        # One thread, and no OpenMP runtime beside that of another library; the same bits wherever arrays lie.
        for name, value in (("MKL_THREADING_LAYER", "SEQUENTIAL"), ("MKL_CBWR", "AVX2")):
            os.environ.setdefault(name, value)
        # Left to itself, pypardiso looks for the library in the whole Python installation, at its import already.
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            for file in importlib.metadata.files("mkl") or ():
                if "mkl_rt" in file.name:
                    os.environ.setdefault("PYPARDISO_MKL_RT", str(file.locate()))
        (pypardiso,) = require("simulate", "pypardiso")
        self._error = pypardiso.pardiso_wrapper.PyPardisoError
        self._solver = pypardiso.PyPardisoSolver(mtype=2)  # real, symmetric, positive definite
        weakref.finalize(self, self._solver.free_memory, everything=True)  # MKL keeps the factor until it is told
        self.name = f"PARDISO (pypardiso {importlib.metadata.version('pypardiso')})"

    def factorise(self, upper: scipy.sparse.csr_array, is_new_pattern: bool) -> bool:
        self._matrix, nothing = upper, np.zeros(upper.shape[0])
        try:
            for phase in (11, 22) if is_new_pattern else (22,):
                self._solver.set_phase(phase)
                self._solver._call_pardiso(upper, nothing)
        except self._error as error:
            if error.value == self._NOT_POSITIVE_DEFINITE:
                return False
            raise SimulationError(f"PARDISO failed with error {error.value} ({upper.shape[0]} unknowns)") from error
        return True

    def solve(self, right_side: np.ndarray) -> np.ndarray:
        self._solver.set_phase(33)
        return self._solver._call_pardiso(self._matrix, right_side)


class Cholmod:
    """CHOLMOD through cholespy, which factorises symbolically each time."""

    name = "CHOLMOD (cholespy)"

    def __init__(self) -> None:
        (self._cholespy,) = require("simulate", "cholespy")

    def factorise(self, upper: scipy.sparse.csr_array, is_new_pattern: bool) -> bool:
        whole = (upper + scipy.sparse.triu(upper, 1).T).tocsc()
        try:
            self._solver = self._cholespy.CholeskySolverD(
                whole.shape[0],
                whole.indptr.astype(np.int32),
                whole.indices.astype(np.int32),
                whole.data,
                self._cholespy.MatrixType.CSC,
            )
        except ValueError:
            return False
        return True

    def solve(self, right_side: np.ndarray) -> np.ndarray:
        solution = np.zeros_like(right_side)
        self._solver.solve(right_side, solution)
        return solution


def factorization() -> Factorization:
    """The fastest that is installed.

    Raises:
        MissingExtra: none is.
    """
    try:
        return Pardiso()
    except MissingExtra:
        return Cholmod()


def conjugate_gradients(
    upper: scipy.sparse.csr_array, right_side: np.ndarray, precondition: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray | None, bool]:
    """Preconditioned conjugate gradients for a symmetric matrix given by its upper triangle.

    Returns:
        The solution, None if there is none after the allowed iterations; whether a direction of negative curvature
        was met, which no positive definite matrix has.
    """
    diagonal, lower = upper.diagonal(), upper.T
    solution, residual = np.zeros_like(right_side), right_side.copy()
    goal = RELATIVE_RESIDUAL * np.linalg.norm(right_side)
    if goal == 0:
        return solution, False
    direction = preconditioned = precondition(residual)
    product = residual @ preconditioned
    for _ in range(MAX_ITERATIONS):
        image = upper @ direction + lower @ direction - diagonal * direction
        curvature = direction @ image
        if curvature <= 0:
            return None, True
        solution += product / curvature * direction
        residual -= product / curvature * image
        if np.linalg.norm(residual) <= goal:
            return solution, False
        preconditioned = precondition(residual)
        product, before = residual @ preconditioned, product
        direction = preconditioned + product / before * direction
    return None, False


class LinearSystem:
    """Symmetric system for the free degrees of freedom; a dof is 3 node + component.

    Args:
        rows, columns: [P] dofs of the entries that elements add, each pair of dofs (r, c) standing for (c, r) too.
        prescribed: [N] nodes whose rows and columns are left out.
    """

    def __init__(self, rows: np.ndarray, columns: np.ndarray, prescribed: np.ndarray) -> None:
        free = np.repeat(~prescribed, 3)
        self._free = np.flatnonzero(free)
        self._count = len(self._free)
        self._number = np.where(free, np.cumsum(free) - 1, -1)
        inside, keys = self._keys(rows, columns)
        diagonal = np.arange(self._count) * (self._count + 1)
        self._own, slots = np.unique(np.concatenate([keys, diagonal]), return_inverse=True)
        self._slot = np.full(len(rows), len(self._own), np.int32)  # one spare for what is left out
        self._slot[inside] = slots[: len(keys)]
        mixed = np.flatnonzero(free[rows] != free[columns])
        self._mixed = mixed, rows[mixed], columns[mixed]
        self._factorization = factorization()
        self.factorizations, self._has_factor = 0, False
        self._set_pattern(self._own)

    @property
    def solver_name(self) -> str:
        """What factorises, with its version."""
        return self._factorization.name

    def restart(self) -> None:
        """Forget the factor and the contacts so far: what follows does not depend on them."""
        self._has_factor = False
        if self._pattern is not self._own:
            self._set_pattern(self._own)

    def _keys(self, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which entries lie between free dofs, and the position row * count + column of these in the upper triangle."""
        rows, columns = self._number[rows], self._number[columns]
        inside = (rows >= 0) & (columns >= 0)
        rows, columns = rows[inside].astype(np.int64), columns[inside].astype(np.int64)
        return inside, np.minimum(rows, columns) * self._count + np.maximum(rows, columns)

    def _set_pattern(self, pattern: np.ndarray) -> None:
        self._pattern, self._is_new = pattern, True
        self._position = None if len(pattern) == len(self._own) else np.searchsorted(pattern, self._own)
        rows, self._columns = np.divmod(pattern, self._count)
        self._columns = self._columns.astype(np.int32)
        self._starts = np.searchsorted(rows, np.arange(self._count + 1)).astype(np.int32)

    def solve(
        self, values: np.ndarray, contact: tuple[np.ndarray, np.ndarray, np.ndarray], right_side: np.ndarray
    ) -> np.ndarray | None:
        """Solution for the sum of the elements' values [P] and the contact's rows, columns and values (all entries).

        Returns:
            [N,3], for the free rows of the right side [N,3] and zero at prescribed nodes; None if the matrix is found
            not to be positive definite. It need not be found: what comes is a direction of descent in any case.
        """
        matrix, right = self._assemble(values, contact), right_side.ravel()[self._free]
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
        solution[self._free] = free
        return solution.reshape(-1, 3)

    def _assemble(
        self, values: np.ndarray, contact: tuple[np.ndarray, np.ndarray, np.ndarray]
    ) -> scipy.sparse.csr_array:
        """The upper triangle of the sum."""
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

    def coupling(
        self, values: np.ndarray, contact: tuple[np.ndarray, np.ndarray, np.ndarray], increment: np.ndarray
    ) -> np.ndarray:
        """What increments [N,3] of prescribed nodes change in the forces on free ones [N,3], to first order."""
        mixed, rows, columns = self._mixed
        increment, values = increment.ravel(), values[mixed]
        total = np.zeros(len(increment))
        total += np.bincount(contact[0], contact[2] * increment[contact[1]], minlength=len(increment))
        total += np.bincount(rows, values * increment[columns], minlength=len(increment))
        total += np.bincount(columns, values * increment[rows], minlength=len(increment))
        return total.reshape(-1, 3)

"""Cholesky factorizations of sparse matrices by the fastest library that there is: PARDISO where there is MKL, CHOLMOD
elsewhere. Both use one thread, and both report a matrix that is not positive definite."""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import os
import weakref
from types import ModuleType
from typing import Protocol

import numpy as np
import scipy.sparse

from ast_sim.support.errors import SimulationError, interrupted

# How PARDISO orders the unknowns. Nested dissection leaves fewer entries in the factor of a large compact body, minimum
# degree takes two thirds of the time to find (docs/log.md, 2026-11-29).
MINIMUM_DEGREE, DISSECTION = 0, 3
DISSECT_FROM = 5_000  # unknowns


class Factorization(Protocol):
    """Cholesky factorization K = L L^T of symmetric matrices that are given by their upper triangles."""

    name: str
    condenses: bool  # whether it can `condense`

    def factorise(self, upper: scipy.sparse.csr_array, is_new_pattern: bool) -> bool:
        """Factorise; return False if the matrix is not positive definite."""
        ...

    def condense(self, upper: scipy.sparse.csr_array, kept: np.ndarray, is_new_pattern: bool) -> np.ndarray | None:
        """Eliminate all unknowns but those `kept` [m], ascending, and return what is left of the matrix, the Schur
        complement [m, m]; None if the matrix is not positive definite. `halves` of solutions then stop at the kept
        unknowns, and `other_half` goes on from where these are solved for."""
        ...

    def solve(self, right_side: np.ndarray) -> np.ndarray:
        """Solution for the matrix last factorised, to the last bits."""
        ...

    def halves(self, loads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """For loads [A, F] what half of a solution makes of them, left and right [A, F] each: the products of the left
        with the right are P K^-1 P^T. With a library that gives L both are the same array, P L^-T."""
        ...

    def other_half(self, rights: np.ndarray) -> np.ndarray:
        """K^-1 P^T f [F], where `rights` [F] is the sum of the rights of the loads times the forces f."""
        ...


@functools.cache
def _pypardiso() -> tuple[ModuleType, str]:
    """The module, ready for use, and its name and version."""
    # One thread, no second OpenMP runtime in this process, and the same bits wherever arrays lie in memory.
    os.environ.setdefault("MKL_THREADING_LAYER", "SEQUENTIAL")
    os.environ.setdefault("MKL_CBWR", "AVX2")
    # Without this variable, the import of pypardiso searches the whole Python installation for the library.
    if "PYPARDISO_MKL_RT" not in os.environ:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            for file in importlib.metadata.files("mkl") or ():
                if "mkl_rt" in file.name:
                    os.environ["PYPARDISO_MKL_RT"] = str(file.locate())
    import pypardiso

    return pypardiso, f"PARDISO (pypardiso {importlib.metadata.version('pypardiso')})"


class Pardiso:
    """PARDISO in Intel's MKL; the symbolic factorization is made for new patterns only."""

    condenses = True
    _NOT_POSITIVE_DEFINITE = -4

    def __init__(self) -> None:
        self._pypardiso, self.name = _pypardiso()
        self._error = self._pypardiso.pardiso_wrapper.PyPardisoError
        self._kept: np.ndarray | None = None  # unknowns that the symbolic factorization leaves

    def factorise(self, upper: scipy.sparse.csr_array, is_new_pattern: bool) -> bool:
        return self._factorised(upper, np.zeros(0, int), is_new_pattern) is not None

    def condense(self, upper: scipy.sparse.csr_array, kept: np.ndarray, is_new_pattern: bool) -> np.ndarray | None:
        return self._factorised(upper, kept, is_new_pattern)

    def _factorised(self, upper: scipy.sparse.csr_array, kept: np.ndarray, is_new_pattern: bool) -> np.ndarray | None:
        """See `condense`; without kept unknowns there is nothing in the array."""
        self._matrix = upper
        is_new = is_new_pattern or self._kept is None or not np.array_equal(kept, self._kept)
        unknowns = len(upper.indptr) - 1
        try:
            if is_new:
                self._analyse(upper, kept)
            # PARDISO writes the Schur complement where it writes solutions, in the shape of the right sides.
            return self._called(22, np.zeros((len(kept), len(kept))) if len(kept) else np.zeros(unknowns))
        except self._error as error:
            if error.value == self._NOT_POSITIVE_DEFINITE:
                return None
            raise SimulationError(f"PARDISO failed with error {error.value} ({unknowns} unknowns)") from error

    def _analyse(self, upper: scipy.sparse.csr_array, kept: np.ndarray) -> None:
        """Symbolic factorization, by a solver of its own: one that has left unknowns crashes when it leaves others."""
        if self._kept is not None:
            self._free()
        self._kept = kept
        unknowns = len(upper.indptr) - 1
        self._solver = self._pypardiso.PyPardisoSolver(mtype=2)  # real, symmetric, positive definite
        # MKL keeps the factor until it is told.
        self._free = weakref.finalize(self, self._solver.free_memory, everything=True)
        is_small = not len(kept) and unknowns < DISSECT_FROM
        for parameter, value in ((1, 1), (2, MINIMUM_DEGREE if is_small else DISSECTION), (34, 1)):
            self._solver.set_iparm(parameter, value)
        if len(kept):
            for parameter, value in ((24, 1), (36, 2)):  # two levels, and a Schur complement
                self._solver.set_iparm(parameter, value)
            self._solver.perm = np.zeros(unknowns, np.int32)
            self._solver.perm[kept] = 1
        self._called(11, np.zeros(unknowns))

    def solve(self, right_side: np.ndarray) -> np.ndarray:
        # PARDISO refines it twice, which triples the time: barriers make the matrices of the solver stiff.
        return self._applied(33, right_side, refinements=2)

    def halves(self, loads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        half = self._applied(331, loads.T).T  # L^-1
        return half, half

    def other_half(self, rights: np.ndarray) -> np.ndarray:
        return self._applied(333, rights)  # L^-T

    def _applied(self, phase: int, columns: np.ndarray, refinements: int = 0) -> np.ndarray:
        self._solver.set_iparm(8, refinements)
        return self._called(phase, np.asfortranarray(columns))

    def _called(self, phase: int, right_sides: np.ndarray) -> np.ndarray:
        self._solver.set_phase(phase)
        return self._solver._call_pardiso(self._matrix, right_sides)


class Cholmod:
    """CHOLMOD through cholespy, which factorises symbolically each time."""

    name = "CHOLMOD (cholespy)"
    condenses = False

    def factorise(self, upper: scipy.sparse.csr_array, is_new_pattern: bool) -> bool:
        import cholespy

        solver = cholespy.CholeskySolverD  # pyright: ignore[reportAttributeAccessIssue], of C++
        kind = cholespy.MatrixType  # pyright: ignore[reportAttributeAccessIssue], of C++
        whole = (upper + scipy.sparse.triu(upper, 1).T).tocsc()
        try:
            self._solver = solver(
                whole.shape[0],
                whole.indptr.astype(np.int32),
                whole.indices.astype(np.int32),
                whole.data,
                kind.CSC,
            )
        except ValueError:
            return False
        return True

    def condense(self, upper: scipy.sparse.csr_array, kept: np.ndarray, is_new_pattern: bool) -> np.ndarray | None:
        raise SimulationError(f"{self.name} makes no Schur complement")

    def solve(self, right_side: np.ndarray) -> np.ndarray:
        solution = np.zeros_like(right_side)
        self._solver.solve(right_side, solution)
        return solution

    def halves(self, loads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Loads and solutions, since cholespy does not give L."""
        return loads, np.stack([self.solve(load) for load in np.ascontiguousarray(loads)])

    def other_half(self, rights: np.ndarray) -> np.ndarray:
        return rights


def factorization() -> Factorization:
    """The fastest library that there is for this machine."""
    try:
        return Pardiso()
    except ImportError as error:
        if interrupted(error):  # by Ctrl-C
            raise KeyboardInterrupt from error
        return Cholmod()

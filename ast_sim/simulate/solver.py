"""Quasi-static equilibrium of an elastic body in contact, load step by load step.

A load step brings the prescribed nodes to new positions and finds positions of the free nodes where the total energy,
elastic plus barrier, is smallest:

1. move: the Newton direction with the whole remaining increment of the prescribed nodes, shortened so that nothing
   collides (CCD) and no element inverts, until the prescribed nodes are at their targets;
2. equilibrate: Newton with a line search on the total energy.

The Hessian is factorised as it is and made positive definite, element by element and pair by pair, only where that
fails. With one free body and rigid obstacles a pair in contact couples no free nodes but those of one triangle, so the
contact leaves the sparsity of the body alone: a banded Cholesky serves. A step that does not converge is halved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from ast_sim.errors import SimulationError
from ast_sim.simulate.contact import Contact, ContactState
from ast_sim.simulate.elasticity import Deformation, Elasticity


class NotConverged(SimulationError):
    """A load step without an equilibrium within the allowed iterations and halvings."""


@dataclass(frozen=True)
class SolverSettings:
    """When a load step has converged and when it is given up.

    Attributes:
        force_tolerance: largest component of the residual of the free nodes, relative to the mean element force.
        step_tolerance: largest component of a Newton step that is rounding and ends the iteration, in metres.
        max_moves: Newton steps to bring the prescribed nodes to their targets.
        max_iterations: Newton steps to equilibrium.
        max_halvings: how often a load step is halved.
    """

    force_tolerance: float = 1e-4
    step_tolerance: float = 1e-9
    max_moves: int = 8
    max_iterations: int = 60
    max_halvings: int = 5


@dataclass(frozen=True)
class _State:
    """Positions [N,3] with all that is derived from them before the derivatives are asked for."""

    position: np.ndarray
    deformation: Deformation
    contact: ContactState
    energy: float


class QuasiStatic:
    """An elastic body with contact at its current equilibrium; `advance` moves it on.

    Args:
        elasticity: the deforming body.
        contact: its surface and that of the obstacles.
        prescribed: [N] nodes whose positions are given: clamps and obstacles. Free nodes must be those of elements.
        position: [N,3] positions at the start, free of intersections and in equilibrium.
    """

    def __init__(
        self,
        elasticity: Elasticity,
        contact: Contact,
        prescribed: np.ndarray,
        position: np.ndarray,
        settings: SolverSettings | None = None,
    ) -> None:
        self.elasticity, self.contact, self.prescribed = elasticity, contact, prescribed
        self.settings = settings or SolverSettings()
        self.newton_iterations = 0
        self._system = BandedSystem(elasticity, prescribed)
        contact.collision_free_fraction(position, position)
        self._state = self._evaluate(np.array(position, float))

    @property
    def position(self) -> np.ndarray:
        """Current positions [N,3]."""
        return self._state.position

    @property
    def deformation(self) -> Deformation:
        """Deformation of the elements at the current positions."""
        return self._state.deformation

    def advance(self, target: np.ndarray) -> None:
        """Bring the prescribed nodes to `target` [N,3] (rows of free nodes are ignored) and the others to equilibrium.

        Raises:
            NotConverged: after the allowed halvings; the state is then that of the last converged part of the step.
        """
        start = self.position.copy()
        done, part, halvings = 0.0, 1.0, 0
        while done < 1:
            reached = min(1.0, done + part)
            before = self._state
            try:
                goal = target if reached == 1 else start + reached * (target - start)
                self._move(goal)
                self._equilibrate()
                done = reached
            except NotConverged as error:
                self._state = before
                halvings += 1
                if halvings > self.settings.max_halvings:
                    raise NotConverged(f"{error}, also after {halvings - 1} halvings of the load step") from error
                part /= 2

    def reactions(self) -> np.ndarray:
        """Forces [N,3] in newton that hold the prescribed nodes where they are; the residual at free nodes."""
        forces, _ = self._gradient(self._state)
        return forces

    def _evaluate(self, position: np.ndarray) -> _State:
        deformation = self.elasticity.deformation(position)
        elastic = self.elasticity.energy(deformation)
        contact = self.contact.at(position)
        return _State(position, deformation, contact, elastic + contact.energy())

    def _gradient(self, state: _State) -> tuple[np.ndarray, float]:
        """Derivative of the energy [N,3] and the residual up to which it counts as zero."""
        element_forces = self.elasticity.element_forces(state.deformation)
        gradient = self.elasticity.assemble(element_forces) + state.contact.gradient()
        scale = self.elasticity.material.young * self.elasticity.force_per_stress
        mean_force = np.abs(element_forces).mean()
        return gradient, max(self.settings.force_tolerance * mean_force, 1e-8 * scale)

    def _direction(self, state: _State, gradient: np.ndarray, increment: np.ndarray | None) -> np.ndarray:
        """Newton direction [N,3]; prescribed nodes take `increment` [N,3] (zero if None)."""
        for project in (False, True):
            stiffness = self.elasticity.stiffness(state.deformation, project)
            contact = state.contact.hessian(project)
            if self._system.factorise(stiffness, contact):
                break
        else:
            raise NotConverged("the projected Hessian is singular")
        if increment is None:
            return self._system.solve(-gradient)
        rows, columns, values = contact
        coupling = np.bincount(rows, values * increment.ravel()[columns], minlength=increment.size)
        return self._system.solve(-gradient - coupling.reshape(-1, 3)) + increment

    def _move(self, target: np.ndarray) -> None:
        """Bring the prescribed nodes to `target`, the free nodes along the tangent."""
        state = self._state
        for _ in range(self.settings.max_moves):
            increment = np.where(self.prescribed[:, None], target - state.position, 0)
            if not increment.any():
                break
            if state.contact.is_empty and not increment[self.elasticity.elements].any():
                direction = increment
            else:
                self.newton_iterations += 1
                direction = self._direction(state, self._gradient(state)[0], increment)
            end = state.position + direction
            end[self.prescribed] = target[self.prescribed]
            fraction = self.contact.collision_free_fraction(state.position, end)
            state = self._evaluate(end if fraction == 1 else state.position + fraction * direction)
            while state.deformation.J.min() <= 0:
                fraction /= 2
                state = self._evaluate(self._state.position + fraction * direction)
            self._state = state
        else:
            raise NotConverged(f"obstacle or clamp not at its target after {self.settings.max_moves} moves")

    def _equilibrate(self) -> None:
        """Newton with line search from the current state until the residual or the step is within tolerance."""
        for _ in range(self.settings.max_iterations):
            gradient, tolerance = self._gradient(self._state)
            gradient[self.prescribed] = 0
            if np.abs(gradient).max() <= tolerance:
                return
            self.newton_iterations += 1
            direction = self._direction(self._state, gradient, None)
            self._state = self._line_search(gradient, direction)
            if np.abs(direction).max() <= self.settings.step_tolerance:
                return
        raise NotConverged(f"no equilibrium after {self.settings.max_iterations} Newton iterations")

    def _line_search(self, gradient: np.ndarray, direction: np.ndarray) -> _State:
        """First state along the direction that lowers the energy enough (Armijo), within the collision-free part."""
        start = self._state
        slope = float(np.vdot(gradient, direction))
        rounding = 1e-14 * self.elasticity.material.young * float(self.elasticity.volume.sum())
        fraction = self.contact.collision_free_fraction(start.position, start.position + direction)
        while fraction > 1e-9:
            state = self._evaluate(start.position + fraction * direction)
            if state.energy <= start.energy + 1e-4 * fraction * slope + rounding:
                return state
            fraction /= 2
        raise NotConverged("no lower energy along the Newton direction")


class BandedSystem:
    """The stiffness matrix of the free nodes in LAPACK's lower band storage, and its Cholesky factor.

    Entry (i, j), i >= j, of the n free degrees of freedom stands at [j, i - j] of an array [n, width + 1].
    """

    def __init__(self, elasticity: Elasticity, prescribed: np.ndarray) -> None:
        free = np.repeat(~prescribed, 3)
        self._free = np.flatnonzero(free)
        self._number = np.where(free, np.cumsum(free) - 1, -1)
        rows, columns = (self._number[dofs] for dofs in elasticity.entry_dofs())
        inside = (rows >= 0) & (columns >= 0)
        self._width = int(np.abs(rows - columns)[inside].max(initial=0))
        self._size = len(self._free) * (self._width + 1)
        self._slot = np.where(inside, self._position(rows, columns), self._size).ravel()  # one spare for the rest
        self._factor = np.zeros(0)

    def _position(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        return np.minimum(rows, columns) * (self._width + 1) + np.abs(rows - columns)

    def factorise(self, stiffness: np.ndarray, contact: tuple[np.ndarray, np.ndarray, np.ndarray]) -> bool:
        """Cholesky factor of the element entries [78,E] plus those of the contact; False if not positive definite."""
        band = np.bincount(self._slot, stiffness.ravel(), minlength=self._size + 1)[: self._size]
        rows, columns = self._number[contact[0]], self._number[contact[1]]
        lower = (rows >= columns) & (columns >= 0)
        rows, columns = rows[lower], columns[lower]
        if (rows - columns).max(initial=0) > self._width:
            raise SimulationError(
                "contact couples free nodes of different triangles: two free bodies are not supported"
            )
        np.add.at(band, self._position(rows, columns), contact[2][lower])
        self._factor, info = lapack.dpbtrf(band.reshape(-1, self._width + 1).T, lower=1, overwrite_ab=1)
        return info == 0

    def solve(self, right_side: np.ndarray) -> np.ndarray:
        """Solution [N,3] for the free rows of the right side [N,3]; zero at prescribed nodes."""
        solution = np.zeros(right_side.size)
        solution[self._free], _ = lapack.dpbtrs(self._factor, right_side.ravel()[self._free], lower=1)
        return solution.reshape(-1, 3)

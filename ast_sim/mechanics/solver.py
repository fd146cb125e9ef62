"""Newton's method for the positions at which the energy of a potential and of contact is smallest.

A step brings the prescribed nodes to new positions and finds the positions of the free nodes:

1. move: the Newton direction with the whole remaining increment of the prescribed nodes, shortened so that nothing
   collides (CCD) and no element inverts, until the prescribed nodes are at their targets;
2. equilibrate: Newton with a line search on the total energy, until no free node carries a residual force.

The Hessian is factorised as it is and made positive definite, element by element and pair by pair, only where that
fails. Friction acts with the normal forces of the last equilibrium and is brought up to date after each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ast_sim.mechanics.contact_and_friction import Contact, ContactState
from ast_sim.mechanics.linear_algebra.linear_system import LinearSystem
from ast_sim.mechanics.linear_algebra.sparsity import Entries
from ast_sim.support.errors import SimulationError


class Potential(Protocol):
    """An energy of the positions [N,3] of all nodes, in joule. A state is what `evaluate` returns.

    Every state has `energy`. It is infinite where the positions are impossible (an inverted element).
    """

    @property
    def unit_force(self) -> float:
        """A nodal force in newton under a strain of order one. It is the scale for the rounding of forces."""
        ...

    @property
    def unit_energy(self) -> float:
        """An energy in joule under a strain of order one. Energies that differ by its rounding count as equal."""
        ...

    def evaluate(self, position: np.ndarray) -> Any:
        """The state at positions [N,3]."""

    def gradient(self, state: Any, /) -> tuple[np.ndarray, float]:
        """Derivative by the positions [N,3], in newton; and the mean magnitude of the forces of an element."""
        ...

    def hessian(self, state: Any, /, project: bool = False) -> np.ndarray:
        """Values [P] of the second derivative's `entries`. Several values may belong to one place.

        Args:
            project: make the contribution of each element positive semi-definite.
        """
        ...

    def entries(self) -> tuple[Entries, ...]:
        """The entries of the second derivative."""
        ...


class NotConverged(SimulationError):
    """A step did not reach an equilibrium within the allowed iterations."""


@dataclass(frozen=True)
class SolverSettings:
    """When a step has converged and when it is given up.

    Attributes:
        force_tolerance: largest component of the residual of the free nodes, relative to the mean element force.
        max_moves: Newton steps to bring the prescribed nodes to their targets.
        max_iterations: Newton steps to equilibrium.
        max_halvings: how often a load step is halved.
        friction_passes: how often friction is brought up to date in a step.
    """

    force_tolerance: float = 1e-4
    max_moves: int = 8
    max_iterations: int = 60
    max_halvings: int = 5
    friction_passes: int = 1


@dataclass(frozen=True, eq=False)
class Iterate:
    """Positions [N,3] with the states of the potential and of contact there, and their energy in joule."""

    position: np.ndarray
    potential: Any
    contact: ContactState
    energy: float


class Newton:
    """Free nodes at rest under a potential, contact and prescribed nodes; `step` moves them on.

    What a step does depends on the positions at its start alone: a solve that goes on from stored positions finds
    what it would have found.

    Args:
        potential: energy of the positions; every free node must be in it.
        contact: between the surfaces.
        prescribed: [N] nodes whose positions are given.
        position: [N,3] positions at the start, free of intersections.
        settings: tolerances.
        system: the system of the potential and the prescribed nodes, if it has been made already.

    Attributes:
        state: where it stands.
        iterations: Newton steps so far.
        dissipation: work in joule lost to friction so far.
        watch: is called before each Newton step.
    """

    def __init__(
        self,
        potential: Potential,
        contact: Contact,
        prescribed: np.ndarray,
        position: np.ndarray,
        settings: SolverSettings | None = None,
        system: LinearSystem | None = None,
    ) -> None:
        self.potential = potential
        self.contact = contact
        self.prescribed = prescribed
        self.settings = settings or SolverSettings()
        self.system = system or LinearSystem(potential.entries(), prescribed)
        self.iterations = 0
        self.dissipation = 0.0
        self.watch: Callable[[], None] = lambda: None
        self.restart(position)

    @property
    def position(self) -> np.ndarray:
        """Current positions [N,3]."""
        return self.state.position

    @property
    def factorizations(self) -> int:
        """Factorizations so far."""
        return self.system.factorizations

    def restart(self, position: np.ndarray) -> None:
        """Go on from positions [N,3], free of intersections, as if nothing had been before."""
        self.contact.restart()
        self.system.restart()
        position = np.array(position, float)
        self.contact.collision_free_fraction(position, position)
        self.state = self._evaluate(position)

    def adopt(self, position: np.ndarray) -> None:
        """Stand at positions [N,3] that another solve with the same contact has just reached."""
        self.state = self._evaluate(position)

    def step(self, target: np.ndarray) -> None:
        """Bring the prescribed nodes to `target` [N,3] (rows of free nodes are ignored) and the others to equilibrium.

        Raises:
            NotConverged: there is no equilibrium; the state is then between rest and the target.
        """
        self.restart(self.position)
        start = self.position
        if not self.contact.settings.has_friction:
            self._move(target)
            self._equilibrate()
            return
        self._lag_friction(start)
        self._move(target)
        self._equilibrate()
        for _ in range(self.settings.friction_passes):
            self._lag_friction(start)
            self._equilibrate()
        self.dissipation += self.state.contact.dissipation()

    def equilibrate_near(self, position: np.ndarray, stuck: np.ndarray | None = None) -> None:
        """Find the equilibrium near positions [N,3] at which the prescribed nodes already are.

        The equilibrium without friction comes first: far from equilibrium, normal forces may be far too large, and
        friction would hold the surfaces there.

        Args:
            stuck: [N,3] where surfaces in contact stuck to each other before; not read without friction.

        Raises:
            NotConverged: surfaces cut each other, an element is inverted, or there is no equilibrium.
        """
        if self.contact.intersects(position):
            raise NotConverged("surfaces cut each other at the start")
        self.restart(position)
        if not np.isfinite(self.state.energy):
            raise NotConverged("an element is inverted at the start")
        self._equilibrate()
        if stuck is None or not self.contact.settings.has_friction:
            return
        for _ in range(1 + self.settings.friction_passes):
            self._lag_friction(stuck)
            self._equilibrate()

    def residual(self) -> float:
        """Largest component of the forces on free nodes, relative to what counts as zero: at most 1 at equilibrium."""
        gradient, tolerance = self._gradient(self.state)
        gradient[self.prescribed] = 0
        return float(np.abs(gradient).max() / tolerance)

    def reactions(self) -> np.ndarray:
        """Forces [N,3] in newton that hold the prescribed nodes where they are; the residual at free nodes."""
        return self._gradient(self.state)[0]

    def _evaluate(self, position: np.ndarray) -> Iterate:
        potential = self.potential.evaluate(position)
        contact = self.contact.at(position)
        return Iterate(position, potential, contact, potential.energy + contact.energy())

    def _count(self) -> None:
        self.iterations += 1
        self.watch()

    def _lag_friction(self, start: np.ndarray) -> None:
        self.contact.lag_friction(self.state.contact, start)
        self.state = self._evaluate(self.position)

    def _gradient(self, state: Iterate) -> tuple[np.ndarray, float]:
        """Derivative of the energy [N,3] and the residual up to which it counts as zero."""
        gradient, element_force = self.potential.gradient(state.potential)
        rounding = 1e-8 * self.potential.unit_force
        return gradient + state.contact.gradient(), max(self.settings.force_tolerance * element_force, rounding)

    def _direction(self, state: Iterate, gradient: np.ndarray, increment: np.ndarray | None) -> np.ndarray:
        """Newton direction [N,3]; prescribed nodes take `increment` [N,3] (zero if None)."""
        for project in (False, True):
            values, contact = self.potential.hessian(state.potential, project), state.contact.hessian(project)
            right_side = -gradient
            if increment is not None:
                right_side = right_side - self.system.coupling(values, contact, increment)
            solution = self.system.solve(values, contact, right_side)
            if solution is not None:
                return solution if increment is None else solution + increment
        raise NotConverged("the projected Hessian is singular")

    def _move(self, target: np.ndarray) -> None:
        """Bring the prescribed nodes to `target`, the free nodes along the tangent."""
        state = self.state
        for _ in range(self.settings.max_moves):
            increment = np.where(self.prescribed[:, None], target - state.position, 0)
            if not increment.any():
                break
            self._count()
            direction = self._direction(state, self._gradient(state)[0], increment)
            end = state.position + direction
            end[self.prescribed] = target[self.prescribed]
            fraction = self.contact.collision_free_fraction(state.position, end)
            state = self._evaluate(end if fraction == 1 else state.position + fraction * direction)
            while not np.isfinite(state.energy):
                fraction /= 2
                state = self._evaluate(self.position + fraction * direction)
            self.state = state
        else:
            raise NotConverged(f"obstacle or clamp not at its target after {self.settings.max_moves} moves")

    def _equilibrate(self) -> None:
        """Newton with line search from the current state until the residual is within tolerance."""
        for _ in range(self.settings.max_iterations):
            gradient, tolerance = self._gradient(self.state)
            gradient[self.prescribed] = 0
            if np.abs(gradient).max() <= tolerance:
                return
            self._count()
            direction = self._direction(self.state, gradient, None)
            self.state = self._line_search(gradient, direction)
        raise NotConverged(f"no equilibrium after {self.settings.max_iterations} Newton iterations")

    def _line_search(self, gradient: np.ndarray, direction: np.ndarray) -> Iterate:
        """First state along the direction that lowers the energy enough (Armijo), within the collision-free part."""
        start = self.state
        slope = float(np.vdot(gradient, direction))
        rounding = 1e-14 * (self.potential.unit_energy + abs(start.energy))
        fraction = self.contact.collision_free_fraction(start.position, start.position + direction)
        while fraction > 1e-9:
            state = self._evaluate(start.position + fraction * direction)
            if state.energy <= start.energy + 1e-4 * fraction * slope + rounding:
                return state
            fraction /= 2
        raise NotConverged("no lower energy along the Newton direction")

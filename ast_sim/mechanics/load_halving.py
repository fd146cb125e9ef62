"""Quasi-static load steps. Steps that do not converge are halved; if halving does not help, they are damped.

After a step has converged, the next step is twice as large.
A damped step is backward Euler from rest. Inertia keeps the body from leaping over an equilibrium that it cannot reach
directly, for example where it buckles. The step is repeated with less and less inertia until the body rests without
any. The result is an equilibrium like any other.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ast_sim.mechanics.contact_and_friction import Contact
from ast_sim.mechanics.elements.elasticity import Elasticity
from ast_sim.mechanics.elements.inertia import Inertia
from ast_sim.mechanics.linear_algebra.linear_system import LinearSystem
from ast_sim.mechanics.solver import Newton, NotConverged, SolverSettings

MAX_DAMPED_STEPS = 60


class QuasiStatic:
    """Elastic bodies in contact at their current equilibrium; `advance` moves them on.

    Args:
        elasticity: the deforming bodies.
        contact: contact of their surfaces and the obstacles' surfaces.
        prescribed: [N] nodes whose positions are given: clamps and obstacles. Every free node must belong to an
            element.
        position: [N,3] positions at the start, free of intersections and in equilibrium.
        settings: tolerances.
        system: as for `Newton`.
    """

    def __init__(
        self,
        elasticity: Elasticity,
        contact: Contact,
        prescribed: np.ndarray,
        position: np.ndarray,
        settings: SolverSettings | None = None,
        system: LinearSystem | None = None,
    ) -> None:
        self.elasticity = elasticity
        self.newton = Newton(elasticity, contact, prescribed, position, settings, system)
        self._inertia = Inertia(elasticity, np.zeros(len(position)), 1.0)
        self._damped: Newton | None = None
        self.halvings = 0
        self.load_steps = 0  # that converged

    @property
    def iterations(self) -> int:
        """Newton iterations so far."""
        return self.newton.iterations + (self._damped.iterations if self._damped else 0)

    @property
    def factorizations(self) -> int:
        """Factorizations so far."""
        return self.newton.factorizations + (self._damped.factorizations if self._damped else 0)

    @property
    def dissipation(self) -> float:
        """Work in joule lost to friction so far."""
        return self.newton.dissipation + (self._damped.dissipation if self._damped else 0.0)

    def advance(
        self, target: np.ndarray, first: float = 1.0, along: Callable[[float], np.ndarray] | None = None
    ) -> None:
        """Bring the prescribed nodes to `target` [N,3] (rows of free nodes are ignored) and the others to equilibrium.

        The first load step goes the share `first` of the path; at 1 the whole path is tried in one step. `along` gives
        the positions at a share of the path; without it, the path is straight.

        Raises:
            NotConverged: there is no equilibrium after the allowed halvings and damped steps.
        """
        start = self.newton.position
        done = 0.0
        part = first
        smallest = 0.5**self.newton.settings.max_halvings
        while done < 1:
            reached = min(1.0, done + part)
            between = start + reached * (target - start) if along is None else along(reached)
            goal = target if reached == 1 else between
            before = self.newton.position
            try:
                self.newton.step(goal)
                part *= 2
            except NotConverged as error:
                self.newton.restart(before)
                if part > smallest:
                    self.halvings += 1
                    part /= 2
                    continue
                self._advance_damped(goal, str(error))
            done = reached
            self.load_steps += 1

    def _advance_damped(self, goal: np.ndarray, reason: str) -> None:
        """Take steps of backward Euler from rest, each with less inertia, until there is equilibrium without any."""
        newton = self.newton
        elasticity = self.elasticity
        volume = elasticity.lumped_volume()
        if self._damped is None:
            self._damped = Newton(self._inertia, newton.contact, newton.prescribed, newton.position, newton.settings)
        extent = np.linalg.norm(np.ptp(newton.position, axis=0))
        # This inertia resists a motion as large as the bodies with forces as large as strains of order one give.
        weight = elasticity.unit_energy / volume.sum() / extent**2 * volume
        self._damped.watch = newton.watch
        self._damped.restart(newton.position)
        for _ in range(MAX_DAMPED_STEPS):
            self._inertia.weight = weight
            self._inertia.predicted = self._damped.position
            before = self._damped.position
            try:
                self._damped.step(goal)
                weight = weight / 4
            except NotConverged:
                self._damped.restart(before)
                weight = 4 * weight
            newton.adopt(self._damped.position)
            if newton.residual() <= 1 and not (newton.prescribed[:, None] & (newton.position != goal)).any():
                return
        raise NotConverged(f"{reason}, also after {self.halvings} halvings and {MAX_DAMPED_STEPS} damped steps")

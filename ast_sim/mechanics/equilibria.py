"""Frames to the stop test of the bundled solver, for an answer that must be exact.

Without friction an equilibrium does not depend on the load path, unless something snaps. So the solver may start from
positions that are nearly right, such as a model's answer after a Newton step: a few iterations are left of the many
from rest. Where bodies overlap there or an element is turned over, and always with friction, it follows the load path
from rest, frame by frame.
"""

from __future__ import annotations

from typing import Self

import numpy as np

from ast_sim.mechanics.case import SolidCase
from ast_sim.mechanics.frames import MAX_FRAME_ITERATIONS, CheckFailed, GivenUp
from ast_sim.mechanics.linearised.linearised_contact import NewtonSteps
from ast_sim.mechanics.physics_check import Law
from ast_sim.mechanics.solid_frames import SolidFrames
from ast_sim.mechanics.solver import SolverSettings
from ast_sim.scene import Scene

# Where a part snaps over, its energy falls for a hundred iterations. Halved load steps would only meet the same fall,
# or lead to another equilibrium.
SNAPPING = SolverSettings(max_iterations=200)


class Equilibria:
    """Equilibria of a case; made once for each scene and motion.

    Args:
        case: the scene and its motion.
        prepared: the Newton steps of the scene: what they have prepared is used.
        settings: tolerances.
    """

    def __init__(self, case: SolidCase, prepared: NewtonSteps, settings: SolverSettings = SNAPPING) -> None:
        self._frames = SolidFrames(case, settings, prepared)
        self._last_frame = 0  # that is solved along the load path
        self._reached = case.scene.rest_position.astype(np.float64)
        self._before = 0
        self._frames.watch(self._require_patience)

    @classmethod
    def of(cls, scene: Scene, law: Law, prescribed_position: np.ndarray, prepared: NewtonSteps) -> Self:
        """The equilibria of tetrahedra under a law. Bodies are kept from passing through themselves, unless one has a
        wall or a slit at rest that is thinner than the range of contact.

        Args:
            prescribed_position: [S, N, 3], of the prescribed nodes in each frame. Other rows are not read.

        Raises:
            ConfigError: the law of the material is not known.
            SimulationError: the constants of the material or of contact are not allowed.
        """
        known = np.where(scene.prescribed[:, None], prescribed_position, scene.rest_position.astype(np.float64))
        return cls(SolidCase(scene, known, law.of_elements(scene), law.contact(scene), "node"), prepared)

    @property
    def iterations(self) -> int:
        """Newton iterations so far."""
        return self._frames.solver.iterations

    def solve(self, frame: int, start: np.ndarray | None) -> tuple[np.ndarray, bool]:
        """The positions [N, 3] of a frame, float64, and whether they were found along the load path.

        Args:
            start: [N, 3] nearly right positions; None: there are none.

        Raises:
            SimulationError: there is no equilibrium on the way, or it failed the checks of a frame that is stored.
        """
        if start is not None and not self._frames.case.contact.has_friction and self._stands_free(start):
            return self._finished(frame, start), False
        while self._last_frame < frame:
            self._restart(self._reached)
            for leg in self._frames.case.legs(self._last_frame + 1):
                self._frames.solver.advance(leg.end, along=leg.along)
            self._reached = self._checked()
            self._last_frame += 1
        return self._reached, True

    def finish(self, frame: int, start: np.ndarray) -> np.ndarray:
        """The positions [N, 3] of a frame from nearly right ones [N, 3].

        Raises:
            SimulationError: bodies overlap at the start or an element is turned over; or as for `solve`.
        """
        self._check(start)
        return self._finished(frame, start)

    def _stands_free(self, position: np.ndarray) -> bool:
        """Whether no bodies overlap and no element is turned over."""
        try:
            self._check(position)
        except CheckFailed:
            return False
        return True

    def _finished(self, frame: int, start: np.ndarray) -> np.ndarray:
        self._restart(start)
        self._frames.solver.advance(self._frames.case.prescribed_position[frame])
        return self._checked()

    def _restart(self, position: np.ndarray) -> None:
        self._frames.solver.newton.restart(position)
        self._before = self.iterations

    def _checked(self) -> np.ndarray:
        """Where the solver stands, if it passes the checks of a frame that is stored."""
        position = self._frames.solver.newton.position
        self._check(position.astype(np.float32))
        return position

    def _check(self, position: np.ndarray) -> None:
        self._frames.check({"position": position})

    def _require_patience(self, iterations: int) -> None:
        if iterations - self._before > MAX_FRAME_ITERATIONS:
            raise GivenUp(f"more than {MAX_FRAME_ITERATIONS} Newton iterations")

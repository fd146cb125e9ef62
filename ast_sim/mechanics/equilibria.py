"""Frames to the stop test of the bundled solver, for an answer that must be exact.

Without friction an equilibrium does not depend on the way to it, unless something snaps. So the solver may start from
positions that are nearly right, such as those of a model after a Newton step: a few iterations are left of the many
from rest. Where bodies overlap there or an element is turned over, and always with friction, it goes the load
path from rest, frame by frame.
"""

from __future__ import annotations

import numpy as np

from ast_sim.mechanics.case import SolidCase
from ast_sim.mechanics.frames import MAX_FRAME_ITERATIONS, GivenUp
from ast_sim.mechanics.linearised_contact import NewtonSteps
from ast_sim.mechanics.physics_check import Law
from ast_sim.mechanics.quasi_static import SolidFrames
from ast_sim.scene import Scene


class Equilibria:
    """Equilibria of a scene in the frames of a motion; made once for each scene and motion.

    Args:
        scene: tetrahedra.
        law: of its material and of contact. Bodies are not kept from passing through themselves.
        targets: [S, N, 3], the positions of the prescribed nodes in each frame. Other rows are not read.
        prepared: the Newton steps of the scene: what they have prepared is used.

    Raises:
        ConfigError: the law of the material is not known.
        SimulationError: the constants of the material or of contact are not allowed.
    """

    def __init__(self, scene: Scene, law: Law, targets: np.ndarray, prepared: NewtonSteps) -> None:
        rest = scene.rest_position.astype(np.float64)
        prescribed = scene.prescribed[:, None]
        case = SolidCase(scene, np.where(prescribed, targets, rest), law.of_elements(scene), law.contact(scene), "node")
        self._frames = SolidFrames(case, None, prepared)
        self._walked = 0
        self._reached = rest
        self._before = 0
        self._frames.watch(self._require_patience)

    def solve(self, frame: int, start: np.ndarray | None) -> tuple[np.ndarray, bool]:
        """The positions [N, 3] of a frame, float64, and whether they were found along the load path.

        Args:
            start: [N, 3] nearly right positions; None: there are none.

        Raises:
            SimulationError: there is no equilibrium on the way, or it failed the checks of a frame that is stored.
        """
        if start is not None and not self._frames.case.contact.has_friction and self._stands_free(start):
            self._go_on(start, frame)
            return self._checked(), False
        while self._walked < frame:
            self._go_on(self._reached, self._walked + 1)
            self._reached = self._checked()
            self._walked += 1
        return self._reached, True

    def _stands_free(self, position: np.ndarray) -> bool:
        """Whether no bodies overlap and no element is turned over."""
        contact = self._frames.contact
        upright = self._frames.jacobian(position).min() > 0
        return bool(upright) and contact.gap(position) > 0 and not contact.intersects(position)

    def _go_on(self, position: np.ndarray, frame: int) -> None:
        """Have the solver start from these positions and bring the prescribed nodes to their places in a frame."""
        solver = self._frames.solver
        solver.newton.restart(position)
        self._before = solver.iterations
        for leg in self._frames.case.legs(frame):
            solver.advance(leg.end, along=leg.along)

    def _checked(self) -> np.ndarray:
        position = self._frames.solver.newton.position
        self._frames.check({"position": position.astype(np.float32)})
        return position

    def _require_patience(self, iterations: int) -> None:
        if iterations - self._before > MAX_FRAME_ITERATIONS:
            raise GivenUp(f"more than {MAX_FRAME_ITERATIONS} Newton iterations")

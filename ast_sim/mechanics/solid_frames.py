"""From a drawn quasi-static case to a checked trajectory, or straight to one frame of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from time import process_time

import numpy as np

from ast_sim.mechanics.case import SolidCase
from ast_sim.mechanics.contact_and_friction import Contact
from ast_sim.mechanics.elements.neo_hookean import von_mises
from ast_sim.mechanics.elements.second_order import deforming_body
from ast_sim.mechanics.frames import MAX_FRAME_ITERATIONS, FrameRecord, Frames, GivenUp
from ast_sim.mechanics.linearised.linearised_contact import NewtonSteps
from ast_sim.mechanics.load_halving import QuasiStatic
from ast_sim.mechanics.solver import SolverSettings
from ast_sim.mechanics.unfinished import Checkpoint
from ast_sim.named_field import REACTION
from ast_sim.scene import AttributeValue, Trajectory
from ast_sim.support.errors import SimulationError

# Components of a stress tensor as they are stored: xx, yy, zz, xy, yz, zx.
COMPONENTS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0))


@dataclass(frozen=True, kw_only=True)
class SolidRecord(FrameRecord):
    """A record with the balance of forces. Its work is the trapezoidal rule over the legs of the motion.

    Attributes:
        imbalance: magnitude of the sum of the forces on all prescribed nodes, divided by the sum of their magnitudes; 0
            without body forces.
    """

    imbalance: float


@dataclass(frozen=True, kw_only=True)
class TurnedRecord(SolidRecord):
    """A record where the nodes that the reaction is of turn.

    Attributes:
        torque: of the reaction in newton metres, around the axis of the turn and positive in its sense.
    """

    torque: float


def quasi_static(
    case: SolidCase,
    settings: SolverSettings | None = None,
    checkpoint: Checkpoint | None = None,
    patient: bool = False,
) -> Trajectory:
    """Solve a case frame by frame, to the tolerances of `settings`; see `Frames.trajectory`.

    The checkpoint keeps unfinished frames. If it holds some already, the solve goes on from them.
    """
    return SolidFrames(case, settings).trajectory(checkpoint, patient)


@dataclass(frozen=True, eq=False)
class OneFrame:
    """A frame that was solved straight from rest, or why it was not.

    Attributes:
        position: [N,3] float64; None if there is no solution.
        failure: why there is none; empty if there is one.
        seconds: processor time of the solution on one thread, with the steps that did not converge.
        setup_seconds: processor time in which the solver was set up for the mesh.
        load_steps, newton_iterations, halvings: how many of them the solution took.
    """

    position: np.ndarray | None
    failure: str
    seconds: float
    setup_seconds: float
    load_steps: int
    newton_iterations: int
    halvings: int


def solve_frame(
    case: SolidCase,
    frame: int,
    settings: SolverSettings | None = None,
    first: float = 1.0,
    most_iterations: int = MAX_FRAME_ITERATIONS,
    most_seconds: float = math.inf,
) -> OneFrame:
    """Solve a case from rest to one of its frames. What was found is checked like a frame that is stored.

    Args:
        case: what to solve.
        frame: number of the frame.
        settings: tolerances.
        first: share of the path in the first load step; 0: each frame before is solved, too. A step that does not
            converge is halved.
        most_iterations, most_seconds: Newton iterations and processor time after which the solution is given up.
    """
    started = process_time()
    frames = SolidFrames(case, settings)
    solver = frames.solver
    began = process_time()

    def watch(iterations: int) -> None:
        if iterations > most_iterations:
            raise GivenUp(f"more than {most_iterations} Newton iterations")
        if process_time() - began > most_seconds:
            raise GivenUp(f"more than {most_seconds:.3g} s of processor time")

    frames.watch(watch)
    position = None
    failure = ""
    try:
        for legs in [case.straight(frame)] if first else map(case.legs, range(1, frame + 1)):
            for leg in legs:
                solver.advance(leg.end, first or 1.0, leg.along)
    except SimulationError as error:
        failure = str(error)
    seconds = process_time() - began
    if not failure:
        try:
            frames.check({"position": solver.newton.position.astype(np.float32)})
            position = solver.newton.position
        except SimulationError as error:
            failure = str(error)
    counts = solver.load_steps, solver.iterations, solver.halvings
    return OneFrame(position, failure, seconds, began - started, *counts)


class SolidFrames(Frames[SolidRecord]):
    """The frames of a quasi-static case and its solver.

    Args:
        case, settings: as for `quasi_static`.
        prepared: the Newton steps of the same bodies, if they have been made already: what they have prepared is used.
    """

    case: SolidCase
    solver: QuasiStatic

    def __init__(self, case: SolidCase, settings: SolverSettings | None, prepared: NewtonSteps | None = None) -> None:
        if case.hardening:
            bodies = ", ".join(map(str, case.hardening))
            raise SimulationError(f"the bundled solver knows elastic laws only, but body {bodies} yields: use CalculiX")
        scene = case.scene
        rest = case.scene.rest_position.astype(np.float64)
        self._deforming = np.flatnonzero(~case.scene.rigid_elements)
        if prepared is None:
            self._elasticity = deforming_body(scene, self._deforming, case.material)
            system = None
        else:
            self._elasticity = prepared.elasticity
            system = prepared.system
        contact = Contact(rest, scene.surface(), scene.body, case.contact, ~scene.deforming_nodes)
        solver = QuasiStatic(self._elasticity, contact, scene.prescribed, rest, settings, system)
        super().__init__(case, solver, contact)
        self._reactions = np.zeros_like(rest)
        self._work = 0.0

    @property
    def record_type(self) -> type[SolidRecord]:
        """See `Frames`."""
        return SolidRecord if self.driven.axis is None else TurnedRecord

    def motion(self) -> np.ndarray:
        """See `Frames`: frames may not show how far nodes turn, nor which way."""
        return self.case.on_legs()

    def next_frame(self) -> tuple[dict[str, np.ndarray], SolidRecord]:
        """See `Frames`."""
        newton = self.solver.newton
        self._work = 0.0
        cost = self.advance()
        if not self.records:
            self._reactions = self._held()
        arrays = self._stored()
        checked = self.check(arrays)
        reactions = self._reactions
        nodes = self.driven.nodes
        axis = self.driven.axis
        turned = {} if axis is None else {"torque": axis.torque(newton.position[nodes], reactions[nodes])}
        return arrays, self.record_type(
            **cost,
            **checked,
            **turned,
            residual=newton.residual(),
            contact_area=self.contact.area(newton.state.contact),
            reaction=float(np.linalg.norm(reactions[nodes].sum(axis=0))),
            imbalance=self._imbalance(reactions),
            elastic_energy=newton.state.potential.energy,
            contact_energy=newton.state.contact.barrier_energy(),
            work=self.last("work") + self._work,
        )

    def bring(self, frame: int) -> None:
        """See `Frames`. The work of a leg follows by the trapezoidal rule."""
        for leg in self.case.legs(frame):
            start = self.solver.newton.position
            self._steps_before = self.solver.iterations
            self.solver.advance(leg.end, along=leg.along)
            reactions = self._held()
            self._work += 0.5 * float(np.vdot(reactions + self._reactions, self.solver.newton.position - start))
            self._reactions = reactions

    def _held(self) -> np.ndarray:
        """[N,3]: the forces that hold the prescribed nodes; 0 at others."""
        return np.where(self.case.scene.prescribed[:, None], self.solver.newton.reactions(), 0)

    def _stored(self) -> dict[str, np.ndarray]:
        """The arrays of a frame as they are stored."""
        elasticity = self._elasticity
        deformation = self.solver.newton.state.potential
        common = {
            "position": self.solver.newton.position.astype(np.float32),
            REACTION: self._reactions.astype(np.float32),
        }
        if self.case.stress_location == "node":
            return common | {"stress": elasticity.von_mises(deformation, "node").astype(np.float32)[:, None]}
        tensor = elasticity.cauchy(deformation)
        components = np.stack([tensor[i, j] for i, j in COMPONENTS], axis=1)
        return common | {
            "stress": self._of_all_elements(von_mises(tensor)[:, None]),
            "cauchy_stress": self._of_all_elements(components),
        }

    def _imbalance(self, reactions: np.ndarray) -> float:
        """See `SolidRecord`. If there are hardly any forces, the divisor is the force of a strain of 1e-3."""
        magnitude = max(float(np.linalg.norm(reactions, axis=1).sum()), 1e-3 * self._elasticity.unit_force)
        return float(np.linalg.norm(reactions.sum(axis=0))) / magnitude

    def _of_all_elements(self, values: np.ndarray) -> np.ndarray:
        """Values [D, F] of the D deforming elements as [E, F] float32, with 0 for rigid elements."""
        result = np.zeros((self.case.scene.num_elements, values.shape[1]), np.float32)
        result[self._deforming] = values
        return result

    def jacobian(self, position: np.ndarray) -> np.ndarray:
        """See `Frames`."""
        return self._elasticity.evaluate(position).J

    def exact_state(self) -> dict[str, np.ndarray]:
        """See `Frames`."""
        return {"position": self.solver.newton.position, "reactions": self._reactions}

    def go_on_from(self, state: dict[str, np.ndarray]) -> None:
        """See `Frames`."""
        self._reactions = state["reactions"]
        self.solver.newton.restart(state["position"])

    def watch(self, progress: Callable[[int], None]) -> None:
        """See `Frames`."""
        self.solver.newton.watch = lambda: progress(self.solver.iterations)

    def attributes(self) -> dict[str, AttributeValue]:
        """See `Frames`."""
        material = self.case.material
        stored = np.add(self.recorded("elastic_energy"), self.recorded("contact_energy"))
        imbalance = self.recorded("work") - stored + stored[0] - self.recorded("dissipation")
        return {
            **self.summary(self.solver.newton.system.solver_name),
            "max_imbalance": max(self.recorded("imbalance")),
            "work_balance": float(np.abs(imbalance).max() / max(stored.max(), np.finfo(float).tiny)),
            "young": _distinct(material.young),
            "poisson": _distinct(material.poisson),
        }


def _distinct(values: float | np.ndarray) -> float | list[float]:
    distinct = np.unique(values).tolist()
    return distinct[0] if len(distinct) == 1 else distinct

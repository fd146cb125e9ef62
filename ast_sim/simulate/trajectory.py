"""From a drawn quasi-static case to a checked trajectory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import process_time

import numpy as np

from ast_sim.data.scene import AttributeValue, NodeType, Trajectory
from ast_sim.simulate.case import SolidCase
from ast_sim.simulate.checkpoint import Checkpoint
from ast_sim.simulate.contact import Contact
from ast_sim.simulate.elasticity import Elasticity
from ast_sim.simulate.frames import CheckFailed, Frames
from ast_sim.simulate.load_step import QuasiStatic
from ast_sim.simulate.material import von_mises
from ast_sim.simulate.solver import SolverSettings

# Components of a stress tensor as they are stored: xx, yy, zz, xy, yz, zx.
COMPONENTS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0))


@dataclass(frozen=True)
class FrameRecord:
    """What the solver did for a frame and what its checks measured; every field becomes a list with one entry a frame.

    Attributes:
        solve_seconds: processor time of the solution, which takes one thread.
        newton_iterations, factorizations, halvings: what the solution took.
        gap: smallest distance between surfaces that are held apart, in metres.
        jacobian: smallest determinant of a deformation gradient.
        residual: largest force component on a free node over that of the stop test: at most 1.
        contact_area: rest area in square metres around the surface nodes on which contact acts, the mean of both sides.
        reaction: magnitude of the force in newton on the prescribed nodes of the body that is moved farthest.
        imbalance: sum of the forces on all prescribed nodes over the sum of their magnitudes; without body forces 0.
        elastic_energy, contact_energy: in joule.
        dissipation: lost to friction so far in joule.
        work: of all prescribed nodes so far in joule (trapezoidal rule over the frames).
    """

    solve_seconds: float
    newton_iterations: int
    factorizations: int
    halvings: int
    gap: float
    jacobian: float
    residual: float
    contact_area: float
    reaction: float
    imbalance: float
    elastic_energy: float
    contact_energy: float
    dissipation: float
    work: float


def quasi_static(
    case: SolidCase, settings: SolverSettings | None = None, checkpoint: Checkpoint | None = None
) -> Trajectory:
    """Solve a case frame by frame.

    Args:
        case: what to solve.
        settings: tolerances of the solver.
        checkpoint: where unfinished frames are kept, and taken from if there are any.

    Returns:
        The frames up to the first that did not converge or failed a check, with the records as attributes.

    Raises:
        SimulationError: the scene at rest already fails its checks.
    """
    frames = SolidFrames(case, settings)
    status = frames.run(checkpoint)
    return Trajectory(case.scene, attributes={**status, **case.attributes, **frames.attributes()}, **frames.stacked())


class SolidFrames(Frames):
    """The frames of a quasi-static case and its solver; arguments as for `quasi_static`."""

    record_type = FrameRecord

    def __init__(self, case: SolidCase, settings: SolverSettings | None) -> None:
        super().__init__(len(case.targets))
        self.case, scene = case, case.scene
        rest = scene.rest_position.astype(np.float64)
        self._deforming = np.flatnonzero(case.deforming)
        self._elasticity = Elasticity(rest, scene.elements[self._deforming], case.material.of(self._deforming))
        rigid = scene.node_type == NodeType.OBSTACLE
        self._contact = Contact(rest, scene.surface(), scene.body, case.contact, rigid)
        self.solver = QuasiStatic(self._elasticity, self._contact, scene.prescribed, rest, settings)
        travel = np.where(scene.prescribed, np.abs(case.targets - case.targets[0]).max(axis=(0, 2)), 0)
        self._driven = scene.prescribed & (scene.body == scene.body[np.argmax(travel)])
        self._reactions = np.zeros_like(rest)

    def next_frame(self) -> tuple[dict[str, np.ndarray], FrameRecord]:
        """See `Frames`."""
        solver, newton, started = self.solver, self.solver.newton, process_time()
        before = solver.iterations, solver.factorizations, solver.halvings, solver.dissipation
        start = newton.position
        if self.records:
            solver.advance(self.case.targets[len(self.records)])
        seconds = process_time() - started
        arrays = self._stored()
        gap, jacobian = self._check(arrays)
        reactions = np.where(self.case.scene.prescribed[:, None], newton.reactions(), 0)
        work = 0.5 * float(np.vdot(reactions + self._reactions, newton.position - start))
        self._reactions = reactions
        return arrays, FrameRecord(
            solve_seconds=seconds,
            newton_iterations=solver.iterations - before[0],
            factorizations=solver.factorizations - before[1],
            halvings=solver.halvings - before[2],
            gap=gap,
            jacobian=jacobian,
            residual=newton.residual(),
            contact_area=self._contact.area(newton.state.contact),
            reaction=float(np.linalg.norm(reactions[self._driven].sum(axis=0))),
            imbalance=self._imbalance(reactions),
            elastic_energy=newton.state.potential.energy,
            contact_energy=newton.state.contact.barrier_energy(),
            dissipation=self.last("dissipation") + solver.dissipation - before[3],
            work=self.last("work") + work,
        )

    def _stored(self) -> dict[str, np.ndarray]:
        """The arrays of a frame as they are stored."""
        elasticity, deformation = self._elasticity, self.solver.newton.state.potential
        position = self.solver.newton.position.astype(np.float32)
        tensor = elasticity.cauchy(deformation)
        mises = von_mises(tensor)
        if self.case.stress_location == "node":
            return {"position": position, "stress": elasticity.nodal_mean(mises).astype(np.float32)[:, None]}
        components = np.stack([tensor[i, j] for i, j in COMPONENTS], axis=1)
        return {
            "position": position,
            "stress": self._of_all_elements(mises[:, None]),
            "cauchy_stress": self._of_all_elements(components),
        }

    def _imbalance(self, reactions: np.ndarray) -> float:
        """See `FrameRecord`; relative to the forces of a strain of 1e-3 where there are hardly any."""
        magnitude = max(float(np.linalg.norm(reactions, axis=1).sum()), 1e-3 * self._elasticity.unit_force)
        return float(np.linalg.norm(reactions.sum(axis=0))) / magnitude

    def _of_all_elements(self, values: np.ndarray) -> np.ndarray:
        """Values [D, F] of the deforming elements as [E, F] float32, 0 in rigid ones."""
        result = np.zeros((self.case.scene.num_elements, values.shape[1]), np.float32)
        result[self._deforming] = values
        return result

    def _check(self, arrays: dict[str, np.ndarray]) -> tuple[float, float]:
        """Smallest gap and determinant of a frame as it is stored.

        Raises:
            CheckFailed: naming the check and its value.
        """
        for name, array in arrays.items():
            if not np.isfinite(array).all():
                raise CheckFailed(f"{name} is not finite")
        position = arrays["position"].astype(np.float64)
        gap, jacobian = self._contact.gap(position), float(self._elasticity.evaluate(position).J.min())
        if gap <= 0 or self._contact.intersects(position):
            raise CheckFailed(f"surfaces intersect (gap {gap:.3g} m)")
        if jacobian <= 0:
            raise CheckFailed(f"an element is inverted (det F = {jacobian:.3g})")
        return gap, jacobian

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
        """What the frames say together, and the constants of the solution."""
        contact, material = self.case.contact, self.case.material
        stored = np.add(self.recorded("elastic_energy"), self.recorded("contact_energy"))
        imbalance = self.recorded("work") - stored + stored[0] - self.recorded("dissipation")
        return {
            "min_gap": min(self.recorded("gap")),
            "min_jacobian": min(self.recorded("jacobian")),
            "max_residual": max(self.recorded("residual")),
            "max_imbalance": max(self.recorded("imbalance")),
            "work_balance": float(np.abs(imbalance).max() / max(stored.max(), np.finfo(float).tiny)),
            "young": _distinct(material.young),
            "poisson": _distinct(material.poisson),
            "dhat": contact.dhat,
            "kappa": contact.stiffness,
            "friction": contact.friction,
            "solver": self.solver.newton.system.solver_name,
        }


def _distinct(values: float | np.ndarray) -> float | list[float]:
    distinct = np.unique(values).tolist()
    return distinct[0] if len(distinct) == 1 else distinct

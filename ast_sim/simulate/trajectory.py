"""From a drawn quasi-static case to a checked trajectory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ast_sim.data.scene import AttributeValue, NodeType, Trajectory
from ast_sim.simulate.case import SolidCase
from ast_sim.simulate.checkpoint import Checkpoint
from ast_sim.simulate.contact import Contact
from ast_sim.simulate.elasticity import Elasticity
from ast_sim.simulate.frames import CheckFailed, FrameRecord, Frames
from ast_sim.simulate.load_step import QuasiStatic
from ast_sim.simulate.material import von_mises
from ast_sim.simulate.solver import SolverSettings

# Components of a stress tensor as they are stored: xx, yy, zz, xy, yz, zx.
COMPONENTS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0))


@dataclass(frozen=True, kw_only=True)
class SolidRecord(FrameRecord):
    """A record with the balance of forces; work is that of the trapezoidal rule over the frames.

    Attributes:
        imbalance: sum of the forces on all prescribed nodes over the sum of their magnitudes; without body forces 0.
    """

    imbalance: float


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

    record_type = SolidRecord

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

    def next_frame(self) -> tuple[dict[str, np.ndarray], SolidRecord]:
        """See `Frames`."""
        newton, start = self.solver.newton, self.solver.newton.position
        cost = self.measured(self.solver, self._solve)
        arrays = self._stored()
        gap, jacobian = self._check(arrays)
        reactions = np.where(self.case.scene.prescribed[:, None], newton.reactions(), 0)
        work = 0.5 * float(np.vdot(reactions + self._reactions, newton.position - start))
        self._reactions = reactions
        return arrays, SolidRecord(
            **cost,
            gap=gap,
            jacobian=jacobian,
            residual=newton.residual(),
            contact_area=self._contact.area(newton.state.contact),
            reaction=float(np.linalg.norm(reactions[self._driven].sum(axis=0))),
            imbalance=self._imbalance(reactions),
            elastic_energy=newton.state.potential.energy,
            contact_energy=newton.state.contact.barrier_energy(),
            work=self.last("work") + work,
        )

    def _solve(self) -> None:
        if self.records:  # the first frame is at rest
            self.solver.advance(self.case.targets[len(self.records)])

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
        material = self.case.material
        stored = np.add(self.recorded("elastic_energy"), self.recorded("contact_energy"))
        imbalance = self.recorded("work") - stored + stored[0] - self.recorded("dissipation")
        return {
            **self.summary(self.case.contact, self.solver.newton.system.solver_name),
            "max_imbalance": max(self.recorded("imbalance")),
            "work_balance": float(np.abs(imbalance).max() / max(stored.max(), np.finfo(float).tiny)),
            "young": _distinct(material.young),
            "poisson": _distinct(material.poisson),
        }


def _distinct(values: float | np.ndarray) -> float | list[float]:
    distinct = np.unique(values).tolist()
    return distinct[0] if len(distinct) == 1 else distinct

"""From a drawn case to a checked trajectory.

A frame is stored only if it converged and passed its checks, which are made on the float32 positions as they are
stored: no surface intersects, bodies are apart, no element is inverted, everything is finite. At the first frame that
fails the trajectory ends, with status "truncated".
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from time import perf_counter

import numpy as np

from ast_sim.data.scene import AttributeValue, Trajectory
from ast_sim.errors import SimulationError
from ast_sim.simulate.case import SolidCase
from ast_sim.simulate.checkpoint import Checkpoint
from ast_sim.simulate.contact import Contact
from ast_sim.simulate.elasticity import Elasticity
from ast_sim.simulate.load_step import QuasiStatic
from ast_sim.simulate.material import von_mises
from ast_sim.simulate.solver import SolverSettings

# Components of a stress tensor as they are stored: xx, yy, zz, xy, yz, zx.
COMPONENTS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0))


class CheckFailed(SimulationError):
    """A converged frame that must not be stored."""


@dataclass(frozen=True)
class FrameRecord:
    """What the solver did for a frame and what its checks measured; every field becomes a list with one entry a frame.

    Attributes:
        solve_seconds: time of the solution.
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
    checkpoint = checkpoint or Checkpoint()
    solve = _Solve(case, settings)
    solve.restore(checkpoint.load())
    status: dict[str, AttributeValue] = {"status": "complete"}
    solve.watch(checkpoint.progress)
    while solve.num_frames < len(case.targets):
        try:
            solve.add_frame()
        except SimulationError as error:
            if solve.num_frames == 0:
                raise
            status = {"status": "truncated", "stopped_by": f"frame {solve.num_frames}: {error}"}
            break
        if checkpoint.is_due:
            checkpoint.save(solve.arrays())
    return solve.trajectory(status)


class _Solve:
    """The solver of a case and the frames so far."""

    def __init__(self, case: SolidCase, settings: SolverSettings | None) -> None:
        self.case = case
        scene = case.scene
        rest = scene.rest_position.astype(np.float64)
        self._deforming = np.flatnonzero(case.deforming)
        self._elasticity = Elasticity(rest, scene.elements[self._deforming], case.material.of(self._deforming))
        self._contact = Contact(rest, scene.surface(), scene.body, case.contact)
        self._solver = QuasiStatic(self._elasticity, self._contact, scene.prescribed, rest, settings)
        travel = np.where(scene.prescribed, np.abs(case.targets - case.targets[0]).max(axis=(0, 2)), 0)
        self._driven = scene.prescribed & (scene.body == scene.body[np.argmax(travel)])
        self._frames: dict[str, list[np.ndarray]] = {}
        self._records: list[FrameRecord] = []
        self._reactions = np.zeros_like(rest)

    @property
    def num_frames(self) -> int:
        return len(self._records)

    def watch(self, progress: Callable[[int, int, int], None]) -> None:
        """Call `progress` after each Newton iteration with the frames so far, their final number and the iterations."""
        solver = self._solver
        solver.newton.watch = lambda: progress(self.num_frames, len(self.case.targets), solver.iterations)

    def add_frame(self) -> None:
        """Solve for the next frame, check it and keep it.

        Raises:
            SimulationError: no equilibrium, or a check that failed.
        """
        solver, index = self._solver, self.num_frames
        started = perf_counter()
        before = solver.iterations, solver.factorizations, solver.halvings, solver.dissipation
        start = solver.newton.position
        if index > 0:
            solver.advance(self.case.targets[index])
        seconds = perf_counter() - started
        arrays = self._stored()
        gap, jacobian = self._check(arrays)
        reactions = np.where(self.case.scene.prescribed[:, None], solver.newton.reactions(), 0)
        work = 0.5 * float(np.vdot(reactions + self._reactions, solver.newton.position - start))
        self._reactions = reactions
        state = solver.newton.state
        self._records.append(
            FrameRecord(
                seconds,
                solver.iterations - before[0],
                solver.factorizations - before[1],
                solver.halvings - before[2],
                gap,
                jacobian,
                solver.newton.residual(),
                self._contact.area(state.contact),
                float(np.linalg.norm(reactions[self._driven].sum(axis=0))),
                self._imbalance(reactions),
                state.potential.energy,
                state.contact.barrier_energy(),
                (self._records[-1].dissipation if self._records else 0.0) + solver.dissipation - before[3],
                (self._records[-1].work if self._records else 0.0) + work,
            )
        )
        for name, array in arrays.items():
            self._frames.setdefault(name, []).append(array)

    def _stored(self) -> dict[str, np.ndarray]:
        """The arrays of a frame as they are stored."""
        elasticity, deformation = self._elasticity, self._solver.newton.state.potential
        position = self._solver.newton.position.astype(np.float32)
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

    def arrays(self) -> dict[str, np.ndarray]:
        """All that `restore` needs to go on."""
        return {
            **{name: np.stack(frames) for name, frames in self._frames.items()},
            "exact_position": self._solver.newton.position,
            "reactions": self._reactions,
            "records": np.array(json.dumps([asdict(record) for record in self._records])),
        }

    def restore(self, arrays: dict[str, np.ndarray] | None) -> None:
        """Go on from what `arrays` gave."""
        if arrays is None:
            return
        self._records = [FrameRecord(**record) for record in json.loads(str(arrays.pop("records")))]
        self._reactions = arrays.pop("reactions")
        self._solver.newton.restart(arrays.pop("exact_position"))
        self._frames = {name: list(array) for name, array in arrays.items()}

    def trajectory(self, status: dict[str, AttributeValue]) -> Trajectory:
        """The frames so far with all records."""
        records = {name: [getattr(record, name) for record in self._records] for name in asdict(self._records[0])}
        contact, material = self.case.contact, self.case.material
        stored = np.add(records["elastic_energy"], records["contact_energy"])
        imbalance = records["work"] - stored + stored[0] - records["dissipation"]
        attributes: dict[str, AttributeValue] = {
            **status,
            **self.case.attributes,
            **records,
            "min_gap": min(records["gap"]),
            "min_jacobian": min(records["jacobian"]),
            "max_residual": max(records["residual"]),
            "max_imbalance": max(records["imbalance"]),
            "work_balance": float(np.abs(imbalance).max() / max(stored.max(), np.finfo(float).tiny)),
            "young": _distinct(material.young),
            "poisson": _distinct(material.poisson),
            "dhat": contact.dhat,
            "kappa": contact.stiffness,
            "friction": contact.friction,
            "solver": self._solver.newton.system.solver_name,
        }
        return Trajectory(
            scene=self.case.scene,
            attributes=attributes,
            **{name: np.stack(frames) for name, frames in self._frames.items()},
        )


def _distinct(values: float | np.ndarray) -> float | list[float]:
    distinct = np.unique(values).tolist()
    return distinct[0] if len(distinct) == 1 else distinct

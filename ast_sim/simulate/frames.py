"""The frames of a sample, one by one: kept with their records, saved, gone on from, ended at the first failure.

A frame is stored only if it converged and passed its checks, which are made on the float32 positions as they are
stored. At the first frame that fails the trajectory ends, with status "truncated" and the reason.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict, dataclass
from time import process_time
from typing import Protocol

import numpy as np

from ast_sim.data.scene import AttributeValue, Scene, Trajectory
from ast_sim.errors import SimulationError
from ast_sim.simulate.checkpoint import Checkpoint
from ast_sim.simulate.contact import Contact, ContactSettings

_EXACT, _RECORDS = "exact_", "records"


class CheckFailed(SimulationError):
    """A converged frame that must not be stored."""


@dataclass(frozen=True, kw_only=True)
class FrameRecord:
    """What the solver did for a frame and what its checks measured; every field becomes a list with one entry a frame.

    Attributes:
        solve_seconds: processor time of the solution, which takes one thread.
        newton_iterations, factorizations, halvings: what the solution took.
        gap: smallest distance between surfaces that are held apart, in metres.
        jacobian: smallest volume (of cloth: area) of an element over that at rest.
        residual: what is left over what the stop test allows: at most 1.
        contact_area: rest area in square metres around the surface nodes on which contact acts, the mean of both sides.
        reaction: magnitude of the force in newton on the prescribed nodes of the body that is moved farthest.
        elastic_energy, contact_energy: in joule.
        dissipation: lost to friction so far in joule.
        work: of all prescribed nodes so far in joule.
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
    elastic_energy: float
    contact_energy: float
    dissipation: float
    work: float


class Case(Protocol):
    """A scene, [S,N,3] positions of its prescribed nodes in each frame, contact, and what the drawing has recorded."""

    scene: Scene
    targets: np.ndarray
    contact: ContactSettings
    attributes: dict[str, AttributeValue]


class Solver(Protocol):
    """What moves on to given positions [N,3] of the prescribed nodes and counts its effort: Newton steps,
    factorizations, halved steps, and work in joule lost to friction."""

    iterations: int
    factorizations: int
    halvings: int
    dissipation: float

    def advance(self, target: np.ndarray) -> None: ...


class Frames(ABC):
    """The frames so far of a sample, and what makes the next one.

    Args:
        case: what is solved.
        solver: stands at the first frame.
        contact: between the surfaces of the scene.

    Attributes:
        record_type: what is recorded for each frame.
        records: one for each frame.
        arrays: the stored arrays by name, a list with one entry a frame.
        driven: [N] bool, the prescribed nodes of the body that is moved farthest.
    """

    record_type: type[FrameRecord]

    def __init__(self, case: Case, solver: Solver, contact: Contact) -> None:
        self.case, self.solver, self.contact = case, solver, contact
        self.records: list[FrameRecord] = []
        self.arrays: dict[str, list[np.ndarray]] = {}
        scene = case.scene
        travel = np.where(scene.prescribed, np.abs(case.targets - case.targets[0]).max(axis=(0, 2)), 0)
        self.driven = scene.prescribed & (scene.body == scene.body[np.argmax(travel)])

    @abstractmethod
    def next_frame(self) -> tuple[dict[str, np.ndarray], FrameRecord]:
        """Solve for the next frame and check it: its arrays and its record.

        Raises:
            SimulationError: no equilibrium, or a check that failed.
        """

    @abstractmethod
    def jacobian(self, position: np.ndarray) -> np.ndarray:
        """Volume (of cloth: area) of each element at the positions [N,3] over that at rest."""

    @abstractmethod
    def attributes(self) -> dict[str, AttributeValue]:
        """What the frames say together, and the constants of the solution."""

    @abstractmethod
    def exact_state(self) -> dict[str, np.ndarray]:
        """All that the next frame depends on, in full precision."""

    @abstractmethod
    def go_on_from(self, state: dict[str, np.ndarray]) -> None:
        """Stand where `exact_state` was taken."""

    @abstractmethod
    def watch(self, progress: Callable[[int], None]) -> None:
        """Have `progress` called with the number of Newton steps so far, before each."""

    def trajectory(self, checkpoint: Checkpoint | None) -> Trajectory:
        """Make all frames, those that the checkpoint holds excepted.

        Returns:
            The frames up to the first that did not converge or failed a check. Its attributes are `status` ("complete"
            or "truncated"), `stopped_by`, all records as lists, those of the case and those of the frames.

        Raises:
            SimulationError: the scene at rest already fails its checks.
        """
        checkpoint, count = checkpoint or Checkpoint(), len(self.case.targets)
        self._restore(checkpoint.load())
        self.watch(lambda steps: checkpoint.progress(len(self.records), count, steps))
        status: dict[str, AttributeValue] = {"status": "complete"}
        while len(self.records) < count:
            try:
                arrays, record = self.next_frame()
            except SimulationError as error:
                if not self.records:
                    raise
                status = {"status": "truncated", "stopped_by": f"frame {len(self.records)}: {error}"}
                break
            self.records.append(record)
            for name, array in arrays.items():
                self.arrays.setdefault(name, []).append(array)
            if checkpoint.is_due:
                checkpoint.save(self._saved())
        records = {name: self.recorded(name) for name in asdict(self.records[0])}
        attributes = {**status, **records, **self.case.attributes, **self.attributes()}
        return Trajectory(self.case.scene, attributes=attributes, **self._stacked())

    def advance(self) -> dict[str, float]:
        """Solve for the next frame, the first being that at which the solver stands; the fields of its record that say
        what it cost."""
        names, started = ("iterations", "factorizations", "halvings", "dissipation"), process_time()
        before = [getattr(self.solver, name) for name in names]
        if self.records:
            self.solver.advance(self.case.targets[len(self.records)])
        seconds = process_time() - started
        steps, factorizations, halvings, lost = (
            getattr(self.solver, name) - value for name, value in zip(names, before, strict=True)
        )
        return {
            "solve_seconds": seconds,
            "newton_iterations": steps,
            "factorizations": factorizations,
            "halvings": halvings,
            "dissipation": self.last("dissipation") + lost,
        }

    def check(self, arrays: dict[str, np.ndarray]) -> dict[str, float]:
        """Check a frame as it is stored: finite, surfaces apart, no element inverted; the fields of its record that say
        how far it was from failing.

        Raises:
            CheckFailed: naming the check and its value.
        """
        for name, array in arrays.items():
            if not np.isfinite(array).all():
                raise CheckFailed(f"{name} is not finite")
        position = arrays["position"].astype(np.float64)
        gap, jacobian = self.contact.gap(position), float(self.jacobian(position).min())
        if gap <= 0 or self.contact.intersects(position):
            raise CheckFailed(f"surfaces intersect (gap {gap:.3g} m)")
        if jacobian <= 0:
            raise CheckFailed(f"an element is inverted or has vanished (ratio to its size at rest {jacobian:.3g})")
        return {"gap": gap, "jacobian": jacobian}

    def summary(self, solver: str) -> dict[str, AttributeValue]:
        """The worst of the records and what holds for all frames, found by the linear solver of that name."""
        contact = self.case.contact
        return {
            "min_gap": min(self.recorded("gap")),
            "min_jacobian": min(self.recorded("jacobian")),
            "max_residual": max(self.recorded("residual")),
            "dhat": contact.dhat,
            "kappa": contact.stiffness,
            "friction": contact.friction,
            "solver": solver,
        }

    def recorded(self, name: str) -> list[float]:
        """One number of the records for each frame."""
        return [getattr(record, name) for record in self.records]

    def last(self, name: str) -> float:
        """A number of the last record; 0 before the first."""
        return getattr(self.records[-1], name) if self.records else 0.0

    def _stacked(self) -> dict[str, np.ndarray]:
        """The stored arrays by name, frames first."""
        return {name: np.stack(frames) for name, frames in self.arrays.items()}

    def _saved(self) -> dict[str, np.ndarray]:
        exact = {_EXACT + name: array for name, array in self.exact_state().items()}
        records = np.array(json.dumps([asdict(record) for record in self.records]))
        return {**self._stacked(), **exact, _RECORDS: records}

    def _restore(self, saved: dict[str, np.ndarray] | None) -> None:
        if saved is None:
            return
        self.records = [self.record_type(**record) for record in json.loads(str(saved.pop(_RECORDS)))]
        exact = [name for name in saved if name.startswith(_EXACT)]
        self.go_on_from({name.removeprefix(_EXACT): saved.pop(name) for name in exact})
        self.arrays = {name: list(array) for name, array in saved.items()}

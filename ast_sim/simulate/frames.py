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

from ast_sim.data.scene import AttributeValue
from ast_sim.errors import SimulationError
from ast_sim.simulate.checkpoint import Checkpoint
from ast_sim.simulate.contact import ContactSettings

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


class Solver(Protocol):
    """What counts its effort: Newton steps, factorizations, halved steps, and work in joule lost to friction."""

    iterations: int
    factorizations: int
    halvings: int
    dissipation: float


class Frames(ABC):
    """The frames so far of a sample, and what makes the next one.

    Attributes:
        count: how many frames there will be.
        record_type: what is recorded for each frame.
        records: one for each frame.
        arrays: the stored arrays by name, a list with one entry a frame.
    """

    record_type: type[FrameRecord]

    def __init__(self, count: int) -> None:
        self.count = count
        self.records: list[FrameRecord] = []
        self.arrays: dict[str, list[np.ndarray]] = {}

    @abstractmethod
    def next_frame(self) -> tuple[dict[str, np.ndarray], FrameRecord]:
        """Solve for the next frame and check it: its arrays and its record.

        Raises:
            SimulationError: no equilibrium, or a check that failed.
        """

    @abstractmethod
    def exact_state(self) -> dict[str, np.ndarray]:
        """All that the next frame depends on, in full precision."""

    @abstractmethod
    def go_on_from(self, state: dict[str, np.ndarray]) -> None:
        """Stand where `exact_state` was taken."""

    @abstractmethod
    def watch(self, progress: Callable[[int], None]) -> None:
        """Have `progress` called with the number of Newton steps so far, before each."""

    def run(self, checkpoint: Checkpoint | None) -> dict[str, AttributeValue]:
        """Make all frames, those that the checkpoint holds excepted.

        Returns:
            Attributes of the trajectory: `status` ("complete" or "truncated"), `stopped_by`, and all records as lists.

        Raises:
            SimulationError: the scene at rest already fails its checks.
        """
        checkpoint = checkpoint or Checkpoint()
        self._restore(checkpoint.load())
        self.watch(lambda steps: checkpoint.progress(len(self.records), self.count, steps))
        status: dict[str, AttributeValue] = {"status": "complete"}
        while len(self.records) < self.count:
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
        return {**status, **{name: self.recorded(name) for name in asdict(self.records[0])}}

    def measured(self, solver: Solver, solve: Callable[[], None]) -> dict[str, float]:
        """Run `solve` and give what it cost, as fields of a record."""
        names, started = ("iterations", "factorizations", "halvings", "dissipation"), process_time()
        before = [getattr(solver, name) for name in names]
        solve()
        seconds = process_time() - started
        steps, factorizations, halvings, lost = (
            getattr(solver, name) - value for name, value in zip(names, before, strict=True)
        )
        return {
            "solve_seconds": seconds,
            "newton_iterations": steps,
            "factorizations": factorizations,
            "halvings": halvings,
            "dissipation": self.last("dissipation") + lost,
        }

    def summary(self, contact: ContactSettings, solver: str) -> dict[str, AttributeValue]:
        """The worst of the records and what holds for all frames, as attributes of the trajectory."""
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

    def stacked(self) -> dict[str, np.ndarray]:
        """The stored arrays by name, frames first."""
        return {name: np.stack(frames) for name, frames in self.arrays.items()}

    def _saved(self) -> dict[str, np.ndarray]:
        exact = {_EXACT + name: array for name, array in self.exact_state().items()}
        records = np.array(json.dumps([asdict(record) for record in self.records]))
        return {**self.stacked(), **exact, _RECORDS: records}

    def _restore(self, saved: dict[str, np.ndarray] | None) -> None:
        if saved is None:
            return
        self.records = [self.record_type(**record) for record in json.loads(str(saved.pop(_RECORDS)))]
        exact = [name for name in saved if name.startswith(_EXACT)]
        self.go_on_from({name.removeprefix(_EXACT): saved.pop(name) for name in exact})
        self.arrays = {name: list(array) for name, array in saved.items()}

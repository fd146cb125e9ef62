"""The frames of a sample, made one by one. They are kept with their records and saved, and a killed solve goes on.

A frame is stored only if it converged and passed its checks. The checks use the float32 positions, as they are stored.
The trajectory ends at the first frame that fails; its status is then "truncated", and the reason is recorded.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property
from time import process_time
from typing import Generic, Protocol, TypedDict, TypeVar

import numpy as np

from ast_sim.mechanics.contact_and_friction import Contact, ContactSettings
from ast_sim.mechanics.driven import Driven
from ast_sim.mechanics.unfinished import Checkpoint
from ast_sim.named_field import REACTION, NamedField
from ast_sim.scene import AttributeValue, Scene, Trajectory
from ast_sim.support.errors import SimulationError

# Newton iterations after which a frame is given up. Of 1,620 pairs of parts of 400 nodes, one needs more in some frame
# (1,972); the next needs 294.
MAX_FRAME_ITERATIONS = 500

_EXACT, _RECORDS = "exact_", "records"


class CheckFailed(SimulationError):
    """A converged frame that must not be stored."""


class GivenUp(SimulationError):
    """A frame that needs too many Newton iterations. Halving its load step would cost even more."""


@dataclass(frozen=True, kw_only=True)
class FrameRecord:
    """The solver's effort for a frame, and what its checks measured. Every field becomes a list with one entry a frame.

    Attributes:
        solve_seconds: processor time of the solution on one thread.
        newton_iterations, factorizations, halvings: how many of them the solution took.
        gap: smallest distance between surfaces that are kept apart, in metres.
        jacobian: smallest volume (of cloth: area) of an element, divided by its value at rest.
        residual: residual divided by the largest one that the stop test allows: at most 1.
        contact_area: rest area in square metres around the surface nodes on which contact acts; the mean of both sides.
        reaction: magnitude in newton of the force on the prescribed nodes that move farthest together (`Driven`).
        elastic_energy, contact_energy: energies in joule.
        dissipation: energy lost to friction so far, in joule.
        work: work of all prescribed nodes so far, in joule.
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
    """A scene, positions [S,N,3] of its prescribed nodes in each frame, its contact, and what its drawing records."""

    @property
    def scene(self) -> Scene: ...
    @property
    def prescribed_position(self) -> np.ndarray: ...
    @property
    def contact(self) -> ContactSettings: ...
    @property
    def attributes(self) -> dict[str, AttributeValue]: ...


class Solver(Protocol):
    """Moves the bodies on to given positions [N,3] of the prescribed nodes, and counts its effort.

    The counts are Newton steps, factorizations, halved steps, and the work in joule lost to friction.
    """

    @property
    def iterations(self) -> int: ...
    @property
    def factorizations(self) -> int: ...
    @property
    def halvings(self) -> int: ...
    @property
    def dissipation(self) -> float: ...
    def advance(self, target: np.ndarray, /) -> None: ...


class Cost(TypedDict):
    """The fields of a record that say what the solution cost."""

    solve_seconds: float
    newton_iterations: int
    factorizations: int
    halvings: int
    dissipation: float


R = TypeVar("R", bound=FrameRecord)


class Frames(ABC, Generic[R]):
    """The frames of a sample so far, and the making of the next one.

    Args:
        case: the case to solve.
        solver: a solver that stands at the first frame.
        contact: contact between the surfaces of the scene.

    Attributes:
        records: one record for each frame.
        arrays: the stored arrays by name: lists with one entry a frame.
    """

    def __init__(self, case: Case, solver: Solver, contact: Contact) -> None:
        self.case = case
        self.solver = solver
        self.contact = contact
        self.records: list[R] = []
        self.arrays: dict[str, list[np.ndarray]] = {}
        self._steps_before = 0

    @property
    @abstractmethod
    def record_type(self) -> type[R]:
        """The type of the record of each frame."""

    @cached_property
    def driven(self) -> Driven:
        """The nodes that the reaction is of."""
        return Driven.of(self.case.scene, self.motion())

    def motion(self) -> np.ndarray:
        """[S,N,3]: where the prescribed nodes are, as far as their motion must be known to tell what drives it."""
        return self.case.prescribed_position

    @abstractmethod
    def next_frame(self) -> tuple[dict[str, np.ndarray], R]:
        """Solve for the next frame and check it; return its arrays and its record.

        Raises:
            SimulationError: there is no equilibrium, or a check failed.
        """

    @abstractmethod
    def jacobian(self, position: np.ndarray) -> np.ndarray:
        """Volume (of cloth: area) of each element at the positions [N,3], divided by its value at rest."""

    @abstractmethod
    def attributes(self) -> dict[str, AttributeValue]:
        """Summaries of all frames, and the constants of the solution."""

    @abstractmethod
    def exact_state(self) -> dict[str, np.ndarray]:
        """All that the next frame depends on, in full precision."""

    @abstractmethod
    def go_on_from(self, state: dict[str, np.ndarray]) -> None:
        """Go back to the state in which `exact_state` was called."""

    @abstractmethod
    def watch(self, progress: Callable[[int], None]) -> None:
        """Have `progress` called before each Newton step, with the number of Newton steps so far."""

    def trajectory(self, checkpoint: Checkpoint | None, patient: bool = False) -> Trajectory:
        """Make all frames that the checkpoint does not hold yet.

        A frame that needs more than `MAX_FRAME_ITERATIONS` Newton iterations is given up, unless `patient`.

        Returns:
            The frames before the first that was given up, did not converge or failed a check. The attributes are
            `status` ("complete" or "truncated"), `stopped_by`, all records as lists, and the attributes of the case and
            of the frames.

        Raises:
            SimulationError: the scene at rest fails its checks.
        """
        checkpoint = checkpoint or Checkpoint()
        count = len(self.case.prescribed_position)
        self._restore(checkpoint.load())

        def before_step(steps: int) -> None:
            checkpoint.progress(len(self.records), count, steps)
            if not patient and steps - self._steps_before > MAX_FRAME_ITERATIONS:
                raise GivenUp(
                    f"more than {MAX_FRAME_ITERATIONS} Newton iterations; patient=True (--patient) has no limit"
                )

        self.watch(before_step)
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
        arrays = self._stacked()
        forces = arrays.get(REACTION)
        return Trajectory(
            self.case.scene,
            position=arrays["position"],
            stress=arrays.get("stress"),
            cauchy_stress=arrays.get("cauchy_stress"),
            attributes=attributes,
            fields={} if forces is None else {REACTION: NamedField(forces, "node", "N")},
        )

    def advance(self) -> Cost:
        """Solve for the next frame; the first frame is where the solver stands."""
        solver = self.solver
        started = process_time()
        steps = solver.iterations
        factorizations = solver.factorizations
        halvings = solver.halvings
        dissipation = solver.dissipation
        self._steps_before = steps
        if self.records:
            self.bring(len(self.records))
        return {
            "solve_seconds": process_time() - started,
            "newton_iterations": solver.iterations - steps,
            "factorizations": solver.factorizations - factorizations,
            "halvings": solver.halvings - halvings,
            "dissipation": self.last("dissipation") + (solver.dissipation - dissipation),
        }

    def bring(self, frame: int) -> None:
        """Bring the bodies from the frame before to this one."""
        self.solver.advance(self.case.prescribed_position[frame])

    def check(self, arrays: dict[str, np.ndarray]) -> dict[str, float]:
        """Check a frame as it is stored: its numbers are finite, surfaces are apart, no element is inverted.

        Returns the fields of the record that say how far the frame was from failing.

        Raises:
            CheckFailed: a check failed; the text names it and its value.
        """
        for name, array in arrays.items():
            if not np.isfinite(array).all():
                raise CheckFailed(f"{name} is not finite")
        position = arrays["position"].astype(np.float64)
        gap = self.contact.gap(position)
        jacobian = float(self.jacobian(position).min())
        if gap <= 0 or self.contact.intersects(position):
            raise CheckFailed(f"surfaces intersect (gap {gap:.3g} m)")
        if jacobian <= 0:
            raise CheckFailed(f"an element is inverted or has vanished (ratio to its size at rest {jacobian:.3g})")
        return {"gap": gap, "jacobian": jacobian}

    def summary(self, solver: str) -> dict[str, AttributeValue]:
        """The worst values of the records, and what holds for all frames; `solver` is the name of the linear solver."""
        contact = self.case.contact
        frictions = contact.frictions(self.case.scene)
        return {
            "min_gap": min(self.recorded("gap")),
            "min_jacobian": min(self.recorded("jacobian")),
            "max_residual": max(self.recorded("residual")),
            "dhat": contact.dhat,
            "kappa": contact.stiffness,
            "friction": frictions if len(frictions) > 1 else frictions[0],
            "solver": solver,
        }

    def recorded(self, name: str) -> list[float]:
        """The values of one field of the records, one a frame."""
        return [getattr(record, name) for record in self.records]

    def last(self, name: str) -> float:
        """The value of a field in the last record; 0 before the first record."""
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

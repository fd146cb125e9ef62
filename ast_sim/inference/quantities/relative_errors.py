"""Relative errors of one frame: of the displacement, the force, the stress."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np

from ast_sim.scene import Trajectory
from ast_sim.support.errors import ConfigError

if TYPE_CHECKING:
    from ast_sim.inference.answer import Answer


def relative_error(position: np.ndarray, truth: Trajectory, frame: int) -> float:
    """The root mean square error of the free nodes at positions [N, 3] in a frame, divided by the root mean square of
    their displacement, which must not be 0."""
    free = ~truth.scene.prescribed
    true = truth.position[frame]
    return rms(position - true, free) / rms(true - truth.position[0], free)


def moves(truth: Trajectory) -> bool:
    """Whether a free node is displaced in any frame."""
    return bool((truth.position[1:, ~truth.scene.prescribed] != truth.position[0, ~truth.scene.prescribed]).any())


def rms(difference: np.ndarray, rows: np.ndarray) -> float:
    """The root mean square of the rows of a difference, in float64."""
    return float(np.sqrt(np.mean(np.square(difference[rows], dtype=np.float64))))


def stress_errors(
    truth: Trajectory, stress: np.ndarray | None, frame: int, location: str
) -> tuple[float | None, float | None]:
    """The error of the stress on what deforms, relative to the error of the frame's true mean; and by how much the
    largest is off, relative to the true one. None where they say nothing."""
    if stress is None or truth.stress is None:
        return None, None
    rows = truth.scene.deforming(location)
    there = truth.stress[frame].astype(np.float64)
    given = stress.astype(np.float64)
    spread = float(there[rows].std())
    largest = float(there[rows].max())
    share = rms(given - there, rows) / spread if spread else None
    return share, abs(float(given[rows].max()) - largest) / largest if largest else None


def errors_of(answer: Answer, truth: Trajectory) -> dict[str, float]:
    """See `Answer.errors`."""
    row = len(answer.frames) - 1
    frame = answer.frames[row]
    errors = {"displacement": relative_error(answer.position[row], truth, frame)}
    fields = {name: dataclasses.replace(one, values=one.values[[frame]]) for name, one in truth.fields.items()}
    last = {name: dataclasses.replace(one, values=one.values[[row]]) for name, one in answer.fields.items()}
    ours = dataclasses.replace(answer, position=answer.position[[row]], frames=(frame,), fields=last)
    true = dataclasses.replace(answer, position=truth.position[[frame]], frames=(frame,), fields=fields)
    with contextlib.suppress(ConfigError):  # a figure that this scene has not
        errors["reaction"] = relative_distance(ours.reaction(), true.reaction())
    stress = None if answer.stress is None else answer.stress[row]
    _, largest = stress_errors(truth, stress, frame, answer.stress_location or "node")
    return errors if largest is None else {**errors, "stress": largest}


def relative_distance(ours: np.ndarray, true: np.ndarray) -> float:
    """The distance of two vectors over the true one: 0 where both are 0, infinite where only the true one is."""
    size = float(np.linalg.norm(true))
    distance = float(np.linalg.norm(ours - true))
    return distance / size if size else (math.inf if distance else 0.0)

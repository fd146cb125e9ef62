"""Relative errors of one frame: of the displacement, the force, the stress."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Container
from typing import TYPE_CHECKING

import numpy as np

from ast_sim.named_field import REACTION
from ast_sim.scene import Trajectory
from ast_sim.support.argument_checks import require_type
from ast_sim.support.errors import ConfigError
from ast_sim.view.fields import require_same_scene

if TYPE_CHECKING:
    from ast_sim.inference.answer import Answer
    from ast_sim.models.model_config import ModelConfig

QUANTITIES = ("displacement", "reaction", "stress")  # as `errors_of` names them
SAME = 1e-4  # of the size of a scene: positions that are no farther apart differ by rounding


def relative_error(position: np.ndarray, truth: Trajectory, frame: int) -> float:
    """The root mean square error of the free nodes at positions [N, 3] in a frame, divided by the root mean square of
    their displacement, which must not be 0."""
    return rms(position - truth.position[frame], ~truth.scene.prescribed) / displacement(truth, frame)


def displacement(truth: Trajectory, frame: int) -> float:
    """The root mean square of the displacement of the free nodes in a frame."""
    return rms(truth.position[frame] - truth.position[0], ~truth.scene.prescribed)


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
    require_type("truth", truth, Trajectory, "a Trajectory")
    if not answer.frames:
        raise ConfigError(f"{answer.name}: the answer has no frame to compare")
    row = len(answer.frames) - 1
    number = answer.frames[row]
    truth = truth.select([0, number])  # by their numbers: frames between may be missing
    frame = truth.num_frames - 1
    _require_same_question(answer, row, truth)
    errors = {"displacement": relative_error(answer.position[row], truth, frame)}
    last = {name: dataclasses.replace(one, values=one.values[[row]]) for name, one in answer.fields.items()}
    ours = dataclasses.replace(answer, position=answer.position[[row]], frames=(number,), fields=last)
    true = dataclasses.replace(truth_in_place(answer, truth, [frame]), frames=(number,))
    with contextlib.suppress(ConfigError):  # a figure that this scene has not
        errors["reaction"] = relative_distance(ours.reaction(), true.reaction())
    stress = None if answer.stress is None else answer.stress[row]
    _, largest = stress_errors(truth, stress, frame, answer.stress_location or "node")
    return errors if largest is None else {**errors, "stress": largest}


def judging_fields(config: ModelConfig) -> list[str]:
    """The fields of the truth that answers of a model are compared with: the ones it predicts, and reactions."""
    return [REACTION, *(name for name, *_ in config.data.fields)]


def truth_in_place(answer: Answer, truth: Trajectory, rows: list[int]) -> Answer:
    """An answer with these rows of the truth in place of its own. Its force is the one that was stored, where one was:
    positions do not show forces that go from one held node straight to another, and the data may follow another law
    than ours."""
    fields = {name: one.select(rows) for name, one in truth.fields.items()}
    stress = None if truth.stress is None else truth.stress[rows]
    return dataclasses.replace(answer, position=truth.position[rows], stress=stress, fields=fields, last_steps=())


def _require_same_question(answer: Answer, row: int, truth: Trajectory) -> None:
    """Raise AstSimError unless the last frame of `truth` and a row of the answer have the same scene, unit and
    prescribed positions; ConfigError if nothing is displaced there."""
    _require_same_frame(answer, row, truth)
    free = ~truth.scene.prescribed
    if not (truth.position[-1] - truth.position[0])[free].any():
        raise ConfigError(
            f"{answer.name}: in frame {truth.numbers[-1]} of the truth nothing is displaced: there is no share of 0"
        )


def _require_same_frame(answer: Answer, row: int, truth: Trajectory) -> None:
    """Raise AstSimError unless the last frame of `truth` and a row of the answer have the same scene, unit and
    prescribed positions."""
    require_same_scene(truth, answer.trajectory)
    number = truth.numbers[-1]
    unit = None if answer.info is None else answer.info.length_unit
    if unit is not None and truth.length_unit not in (None, unit):
        raise ConfigError(f"{answer.name} is in {unit}, but the truth is in {truth.length_unit}")
    there = truth.position[-1]
    away = np.abs(answer.position[row] - there)[truth.scene.prescribed].max(initial=0.0)
    if away > SAME * np.ptp(there, axis=0).max():
        raise ConfigError(
            f"{answer.name}: its prescribed nodes and the ones of the truth are up to {away:.3g} apart in frame"
            f" {number}: compare with a simulation of the same motion"
        )


def require_same_motion(answer: Answer, truth: Trajectory | None) -> None:
    """Raise AstSimError unless the last frame of the answer is of the same scene, unit and motion in the truth, if one
    is known."""
    if truth is None:
        return
    require_type("truth", truth, Trajectory, "a Trajectory")
    if answer.frames:
        _require_same_frame(answer, len(answer.frames) - 1, truth.select([answer.frames[-1]]))


def require_quantity(quantity: str, more: Container[str] = ()) -> None:
    """Raise ConfigError unless a band of this quantity may be known, or it is one of `more`."""
    if quantity not in QUANTITIES and quantity not in more:
        raise ConfigError(f"a band of {quantity!r} is not known; known are {', '.join(QUANTITIES)}")


def relative_distance(ours: np.ndarray, true: np.ndarray) -> float:
    """The distance of two vectors over the true one: 0 where both are 0, infinite where only the true one is."""
    size = float(np.linalg.norm(true))
    distance = float(np.linalg.norm(ours - true))
    return distance / size if size else (math.inf if distance else 0.0)

"""Relative errors of an answer: of the displacement, the force, the stress."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Container, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ast_sim.named_field import REACTION
from ast_sim.number_arrays import ranges
from ast_sim.scene import Trajectory
from ast_sim.simulate.jobs.fastest_solver import deepest_frame
from ast_sim.support.argument_checks import require_type
from ast_sim.support.errors import ConfigError
from ast_sim.view.fields import require_same_scene

if TYPE_CHECKING:
    from ast_sim.inference.answer import Answer
    from ast_sim.models.model_config import ModelConfig

QUANTITIES = ("displacement", "reaction", "stress")  # as `errors_of` names them
ROUNDING = float(np.finfo(np.float32).eps)  # share of a number that single precision does not keep
SAME = 1e-4  # of the size of a scene: positions that are no farther apart differ by rounding


def relative_error(position: np.ndarray, truth: Trajectory, frame: int) -> float:
    """The root mean square error of the free nodes at positions [N, 3] in a frame, divided by the root mean square of
    their displacement, which must not be 0."""
    return rms(position - truth.position[frame], ~truth.scene.prescribed) / displacement(truth, frame)


def displacement(truth: Trajectory, frame: int) -> float:
    """The root mean square of the displacement of the free nodes in a frame."""
    return rms(truth.position[frame] - truth.position[0], ~truth.scene.prescribed)


def moves(truth: Trajectory) -> bool:
    """Whether free nodes are displaced in any frame, by more than single precision rounds."""
    return displacement(truth, deepest_frame(truth)) > ROUNDING * np.abs(truth.position).max()


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
    number = _deepest_of_both(answer, truth)
    row, frame = answer.frames.index(number), truth.numbers.index(number)
    errors = {"displacement": relative_error(answer.position[row], truth, frame)}
    try:
        ours = _only(answer, row).reaction()[0]
        forces = truth_in_place(answer, truth, list(range(truth.num_frames))).reaction()
    except ConfigError:  # a figure that this scene has not
        pass
    else:
        if not _rounds_to_zero(np.linalg.norm(forces, axis=1), frame):
            errors["reaction"] = relative_distance(ours, forces[frame])
    if answer.stress is not None and truth.stress is not None:
        location = answer.stress_location or "node"
        rows = truth.scene.deforming(location)
        _, largest = stress_errors(truth, answer.stress[row], frame, location)
        if largest is not None and not _rounds_to_zero(truth.stress[:, rows].max(axis=(1, 2), initial=0.0), frame):
            errors["stress"] = largest
    return errors


def _only(answer: Answer, row: int) -> Answer:
    """The answer with this frame alone."""
    fields = {name: one.select([row]) for name, one in answer.fields.items()}
    return dataclasses.replace(answer, position=answer.position[[row]], frames=(answer.frames[row],), fields=fields)


def _rounds_to_zero(sizes: np.ndarray, frame: int) -> bool:
    """Whether the size in a frame, of the sizes in all frames [S], is 0 but for rounding to single precision."""
    return bool(sizes[frame] <= ROUNDING * sizes.max())


def _deepest_of_both(answer: Answer, truth: Trajectory) -> int:
    """The number of the frame, of the predicted ones that both have, in which the truth is displaced most.

    Raises:
        AstSimError: they share no frame, or not the motion; or nothing is displaced in these frames.
    """
    predicted = sorted(number for number in answer.frames if number >= answer.given)
    both = [number for number in predicted if number in truth.numbers]
    if not both:
        raise ConfigError(
            f"{answer.name}: the answer and the truth share no predicted frame: the answer has"
            f" {ranges(predicted) or 'none'}, the truth has the frames {ranges(truth.numbers)}"
        )
    require_same_motion(answer, truth, both)
    known = truth.select([0, *both])  # by their numbers: frames between may be missing
    if not moves(known):
        raise ConfigError(
            f"{answer.name}: nothing is displaced in the truth, but for rounding, in the frames that both have"
            f" ({ranges(both)}): there is no share of 0. Predict a frame in which something is displaced, too"
        )
    return known.numbers[deepest_frame(known)]


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


def require_same_motion(answer: Answer, truth: Trajectory | None, numbers: Sequence[int]) -> None:
    """Raise AstSimError unless the truth, if one is known, has the scene and the unit of the answer, and in the frames
    with these numbers its prescribed positions."""
    if truth is None:
        return
    require_type("truth", truth, Trajectory, "a Trajectory")
    require_same_scene(truth.scene, answer.scene)
    unit = None if answer.info is None else answer.info.length_unit
    if unit is not None and truth.length_unit not in (None, unit):
        raise ConfigError(f"{answer.name} is in {unit}, but the truth is in {truth.length_unit}")
    for number in numbers:
        there = truth.select([number]).position[0]
        ours = answer.position[answer.frames.index(number)]
        away = np.abs(ours - there)[truth.scene.prescribed].max(initial=0.0)
        if away > SAME * np.ptp(there, axis=0).max():
            raise ConfigError(
                f"{answer.name}: its prescribed nodes and the ones of the truth are up to {away:.3g} apart in frame"
                f" {number}: compare with a simulation of the same motion"
            )


def require_quantity(quantity: str, more: Container[str] = ()) -> None:
    """Raise ConfigError unless a band of this quantity may be known, or it is one of `more`."""
    if quantity not in QUANTITIES and quantity not in more:
        raise ConfigError(f"a band of {quantity!r} is not known; known are {', '.join(QUANTITIES)}")


def relative_distance(ours: np.ndarray, true: np.ndarray) -> float:
    """The distance of two vectors over the true one: 0 where both are 0, infinite where only the true one is."""
    size = float(np.linalg.norm(true))
    distance = float(np.linalg.norm(ours - true))
    return distance / size if size else (math.inf if distance else 0.0)

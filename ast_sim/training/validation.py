"""Validation during training: errors of rollouts of validation scenes, and of the prediction that nothing moves."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from ast_sim.dataset.reader import Dataset
from ast_sim.inference.effort import (
    FIRST_CALL,
    Effort,
    EffortErrors,
    cheapest_good,
    mean_errors,
    to_measure,
)
from ast_sim.inference.evaluation.deepest_frames import errors_by_effort
from ast_sim.inference.evaluation.measures import SquaredError, rmse_sequence
from ast_sim.inference.predicting.jump import answer_steps
from ast_sim.inference.predicting.question import Question
from ast_sim.inference.predicting.rollout import rollouts
from ast_sim.models.simulator import Simulator
from ast_sim.number_arrays import percent
from ast_sim.scene import Trajectory
from ast_sim.support.progress import ShowProgress

MORE_CALLS = 2  # further calls in the validation of a model that is trained to correct its answers
ENOUGH = 0.01  # a further call must lower the error by this share
EFFORT_SCENES = 10  # validation scenes, at most, on which the default effort is chosen, at the deepest frame
JUMPS = 4  # frames of a scene at which a model that jumps is validated, evenly spread, the last one included


@dataclass(frozen=True)
class Validated:
    """The errors of one validation scene.

    Attributes:
        index: number of the scene in its split.
        errors: error of the network's prediction, for a model that jumps after each call; empty if it failed.
        hold: error of the prediction that nothing moves.
        failure: why the prediction failed; None if it did not.
        by_effort: the errors of answers at the deepest frame, as `errors_by_effort` gives them; empty if they were not
            measured.
    """

    index: int
    errors: list[SquaredError]
    hold: SquaredError
    failure: str | None
    by_effort: list[EffortErrors]


class Verdict(NamedTuple):
    """What a validation says of a checkpoint.

    Attributes:
        error: of the network alone after its corrections, without Newton steps: it chooses the checkpoint. With Newton
            steps all checkpoints look alike. None: a prediction failed.
        effort: the default effort of the run, if this checkpoint is chosen: the cheapest that leads to good answers.
        by_effort: the errors of answers by effort.
        record: for `metrics.jsonl`.
        text: for people.
    """

    error: float | None
    effort: Effort
    by_effort: list[EffortErrors]
    record: dict[str, Any]
    text: str


def validate(
    model: Simulator,
    dataset: Dataset,
    split: str,
    indices: Iterable[int],
    corrections: int = 0,
    progress: ShowProgress = False,
    efforts: bool = True,
) -> list[Validated]:
    """Predict scenes of a split together; `progress` counts the frames of a model that goes step by
    step; a function may raise to stop.

    Args:
        corrections: how many calls correct the first one in training.
        efforts: measure the errors of answers by effort, too, for a model that jumps.
    """
    indices = list(indices)
    truths = [dataset.load(split, index) for index in indices]
    names = [f"{split}/{index:06d}" for index in indices]
    if not truths:
        return []
    if not model.config.scheme.jumps:
        return _by_rollouts(model, indices, names, truths, progress)
    return _by_jumps(model, indices, names, truths, corrections, efforts)


def _by_rollouts(
    model: Simulator,
    indices: list[int],
    names: list[str],
    truths: list[Trajectory],
    progress: ShowProgress,
) -> list[Validated]:
    given = model.config.data.given_frames
    questions = [Question.of(truth, name) for name, truth in zip(names, truths, strict=True)]
    validated = []
    for index, truth, answer in zip(indices, truths, rollouts(model, questions, progress), strict=True):
        frames = np.arange(given, truth.num_frames)
        errors = [] if answer.failure else [_motion_error(answer.position[given:], truth, frames)]
        hold = _motion_error(truth.position[given - 1], truth, frames)
        validated.append(Validated(index, errors, hold, answer.failure, []))
    return validated


def _by_jumps(
    model: Simulator,
    indices: list[int],
    names: list[str],
    truths: list[Trajectory],
    corrections: int,
    efforts: bool,
) -> list[Validated]:
    frames = [validation_frames(truth.num_frames) for truth in truths]
    scenes = zip(names, truths, frames, strict=True)
    questions = [Question.of(truth, name, numbers.tolist()) for name, truth, numbers in scenes]
    outcomes = answer_steps(model, questions, Effort(corrections + MORE_CALLS if corrections else 0))
    validated = []
    for index, truth, numbers, outcome in zip(indices, truths, frames, outcomes, strict=True):
        hold = _motion_error(truth.position[0], truth, numbers)
        if isinstance(outcome, str):
            validated.append(Validated(index, [], hold, outcome, []))
            continue
        errors = [_motion_error(position, truth, numbers) for position in outcome.after_calls]
        measured = to_measure(model.config, corrections) if efforts and index < EFFORT_SCENES else ()
        by_effort = errors_by_effort(model, truth, measured)
        validated.append(Validated(index, errors, hold, None, by_effort))
    return validated


def validation_frames(count: int) -> np.ndarray:
    """The numbers of up to `JUMPS` frames, evenly spread over `count` frames; never the first, which is given."""
    spread = np.unique(np.linspace(0, count - 1, JUMPS + 1).round().astype(int)[1:])
    return spread[spread > 0]


def verdict(validated: list[Validated], best: float, unit: str) -> Verdict:
    """What the scenes say together; `best` is the lowest error of a checkpoint before."""
    failure = next((scene.failure for scene in validated if scene.failure), None)
    if failure is not None:
        record = {"valid_rmse": None, "failure": failure}
        return Verdict(None, FIRST_CALL, [], record, f"prediction failed: {failure}")
    validated = sorted(validated, key=lambda scene: scene.index)
    errors, hold = _errors_and_hold(validated)
    network = _enough(errors)
    error = errors[network]
    by_effort = mean_errors([scene.by_effort for scene in validated if scene.by_effort])
    effort = cheapest_good(by_effort) if by_effort else network
    share = f" = {error / hold:.2f} of the error of hold still" if hold else ""
    after = f" after {network.text}" if len(errors) > 1 else ""
    text = f"network alone: error {error:.3g} {unit}{share}{after}{', the best so far' if error < best else ''}"
    reached = next((one.error for one in by_effort if one.effort == effort), None)
    if reached is not None:
        text += f"; answers at the deepest frame: error {percent(reached, 3)} of the displacement after {effort.text}"
    record: dict[str, Any] = {"valid_rmse": error, "valid_hold_still": hold}
    if len(errors) > 1:
        record["valid_by_calls"] = list(errors.values())
    if by_effort:
        record["valid_by_effort"] = [asdict(one) for one in by_effort]
    if len(errors) > 1 or by_effort:
        record["effort"] = asdict(effort)
    return Verdict(error, effort, by_effort, record, text)


def _errors_and_hold(validated: list[Validated]) -> tuple[dict[Effort, float], float]:
    """The error of all scenes after each number of corrections, and the one of the prediction that nothing moves."""
    after_calls = zip(*(scene.errors for scene in validated), strict=True)
    errors = {Effort(corrections): rmse_sequence(same) for corrections, same in enumerate(after_calls)}
    return errors, rmse_sequence([scene.hold for scene in validated])


def _enough(errors: Mapping[Effort, float]) -> Effort:
    """The least effort after which no further call lowers the error by more than `ENOUGH`."""
    rest = list(errors.items())
    while min(error for _, error in rest) < (1 - ENOUGH) * rest[0][1]:
        rest = rest[1:]
    return rest[0][0]


def _motion_error(position: np.ndarray, truth: Trajectory, frames: np.ndarray) -> SquaredError:
    """Error on NORMAL nodes of `position` [S, N, 3] in these S frames of the truth; or [N, 3] for all."""
    return SquaredError.between(position, truth.position[frames], ~truth.scene.prescribed)


def error_share(validated: list[Validated]) -> float | None:
    """The network's smallest error over its calls, relative to the prediction that nothing moves; None if a prediction
    failed or nothing moves."""
    if not validated or any(scene.failure for scene in validated):
        return None
    errors, hold = _errors_and_hold(validated)
    return min(errors.values()) / hold if hold else None

"""Validation during training: errors of rollouts of validation scenes, and of the prediction that nothing moves."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

from ast_sim.dataset.reader import Dataset
from ast_sim.inference.asked_frame import errors_by_effort
from ast_sim.inference.effort import MOST_NEWTON_STEPS, Effort, cheapest_good, knows_material
from ast_sim.inference.jump import calls
from ast_sim.inference.measures import SquaredError, rmse_sequence
from ast_sim.inference.question import Question
from ast_sim.inference.rollout import rollouts
from ast_sim.models.simulator import Simulator
from ast_sim.scene import Trajectory

MORE_CALLS = 2  # a model that jumps is validated with so many more calls than it is trained with
ENOUGH = 0.01  # a further call must lower the error by this share
EFFORT_SCENES = 10  # the default effort is chosen on at most so many validation scenes, at the deepest frame
JUMPS = 4  # a model that jumps is validated at so many frames of a scene, evenly spread, the last one included


class Validated(NamedTuple):
    """The errors of one validation scene.

    Attributes:
        index: number of the scene in its split.
        errors: error of the prediction, for a model that jumps after each call; empty if the prediction failed.
        hold: error of the prediction that nothing moves.
        failure: why the prediction failed; None if it did not.
        efforts: [4, calls, Newton steps + 1], the errors of displacement and stress at the deepest frame, the Newton
            steps made and whether they did not end, as `errors_by_effort` gives them; None if they were not measured.
    """

    index: int
    errors: list[SquaredError]
    hold: SquaredError
    failure: str | None
    efforts: np.ndarray | None = None


def validate(
    model: Simulator,
    dataset: Dataset,
    indices: Iterable[int],
    most_calls: int = 1,
    progress: Callable[[int], None] | None = None,
) -> list[Validated]:
    """Predict validation scenes together; `progress` is called after each step and may raise to stop.

    Args:
        most_calls: so many calls correct one another in training.
    """
    truths = {index: dataset.load("valid", index) for index in indices}
    if not truths:
        return []
    if model.config.jumps:
        return _validate_jumps(model, truths, most_calls + MORE_CALLS if most_calls > 1 else 1)
    questions = [Question.of(truth, _name(index)) for index, truth in truths.items()]
    found = []
    for (index, truth), answer in zip(truths.items(), rollouts(model, questions, progress), strict=True):
        after = slice(answer.given, None)
        errors = [] if answer.failure else [_motion_error(answer.position[after], truth, after)]
        hold = _motion_error(truth.position[answer.given - 1], truth, after)
        found.append(Validated(index, errors, hold, answer.failure))
    return found


def _validate_jumps(model: Simulator, truths: dict[int, Trajectory], most_calls: int) -> list[Validated]:
    frames = {index: frames_asked(truth.num_frames) for index, truth in truths.items()}
    questions = [Question.of(truth, _name(index), frames[index].tolist()) for index, truth in truths.items()]
    found = []
    for (index, truth), after in zip(truths.items(), calls(model, questions, Effort(most_calls - 1)), strict=True):
        failure = after if isinstance(after, str) else None
        positions = () if isinstance(after, str) else after.position
        errors = [_motion_error(position, truth, frames[index]) for position in positions]
        hold = _motion_error(truth.position[0], truth, frames[index])
        efforts = None
        if failure is None and index < EFFORT_SCENES:
            steps = MOST_NEWTON_STEPS if knows_material(model.config) else 0
            efforts = errors_by_effort(model, truth, Effort(max(0, most_calls - MORE_CALLS - 1), steps))
        found.append(Validated(index, errors, hold, failure, efforts))
    return found


def frames_asked(count: int) -> np.ndarray:
    """The numbers of up to `JUMPS` frames that are evenly spread over so many; never the first, which is given."""
    spread = np.unique(np.linspace(0, count - 1, JUMPS + 1).round().astype(int)[1:])
    return spread[spread > 0]


def verdict(found: list[Validated], best: float, unit: str) -> tuple[dict[str, Any], str]:
    """The record of a validation for `metrics.jsonl`, and its text; `best` is the lowest error before."""
    failure = next((scene.failure for scene in found if scene.failure), None)
    if failure is not None:
        return {"valid_rmse": None, "failure": failure}, f"prediction failed: {failure}"
    found = sorted(found, key=lambda scene: scene.index)
    by_calls = [rmse_sequence(errors) for errors in zip(*(scene.errors for scene in found), strict=True)]
    hold = rmse_sequence([scene.hold for scene in found])
    effort = Effort(_corrections(by_calls))
    error = by_calls[effort.corrections]
    share = f" = {error / hold:.2f} of the error of hold still" if hold else ""
    after = f" after {effort.text}" if len(by_calls) > 1 else ""
    text = f"error {error:.3g} {unit}{share}{after}{', the best so far' if error < best else ''}"
    record: dict[str, Any] = {"valid_rmse": error, "valid_hold_still": hold}
    measured = [scene.efforts for scene in found if scene.efforts is not None]
    if measured:
        by_effort, stress_by_effort, steps, unsettled = means = np.mean(measured, axis=0)
        if by_effort.shape[1] > 1:
            effort = cheapest_good(means)
        record["valid_by_effort"], record["valid_stress_by_effort"] = _as_lists(by_effort), _as_lists(stress_by_effort)
        record["valid_newton_steps"], record["valid_unsettled"] = _as_lists(steps), _as_lists(unsettled)
        if effort.corrections < len(by_effort) and not np.isnan(by_effort[effort]):
            text += f"; at the deepest frame {100 * by_effort[effort]:.2g} % of the displacement after {effort.text}"
    if len(by_calls) > 1 or measured:
        record |= {"valid_by_calls": by_calls, **effort._asdict()}
    return record, text


def _as_lists(errors: np.ndarray) -> list[list[float | None]]:
    """For JSON, which has no NaN."""
    return [[None if np.isnan(error) else float(error) for error in row] for row in errors]


def _corrections(by_calls: list[float]) -> int:
    """The number of corrections after which no further call lowers the error by more than `ENOUGH`."""
    return next(i for i, error in enumerate(by_calls) if min(by_calls[i:]) >= (1 - ENOUGH) * error)


def _name(index: int) -> str:
    return f"valid/{index:06d}"


def _motion_error(position: np.ndarray, truth: Trajectory, frames: slice | np.ndarray) -> SquaredError:
    """Error on NORMAL nodes of `position` [S, N, 3] in these S frames of the truth; or [N, 3] for all."""
    return SquaredError.between(position, truth.position[frames], ~truth.scene.prescribed)

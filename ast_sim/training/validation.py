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
    indices = list(indices)
    truths = [dataset.load("valid", index) for index in indices]
    if not truths:
        return []
    jumps, given = model.config.jumps, model.config.given_frames
    most_calls += MORE_CALLS if most_calls > 1 else 0
    frames = [frames_asked(truth.num_frames) if jumps else np.arange(given, truth.num_frames) for truth in truths]
    questions = [
        Question.of(truth, f"valid/{index:06d}", asked.tolist() if jumps else None)
        for index, truth, asked in zip(indices, truths, frames, strict=True)
    ]
    if jumps:
        ways = calls(model, questions, Effort(most_calls - 1))
        predicted = [(way, ()) if isinstance(way, str) else (None, way.position) for way in ways]
    else:
        answers = rollouts(model, questions, progress)
        predicted = [(a.failure, () if a.failure else a.position[None, given:]) for a in answers]
    found = []
    for index, truth, asked, (failure, positions) in zip(indices, truths, frames, predicted, strict=True):
        errors = [_motion_error(position, truth, asked) for position in positions]
        hold = _motion_error(truth.position[given - 1], truth, asked)
        efforts = None
        if jumps and failure is None and index < EFFORT_SCENES:
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
        means = np.mean(measured, axis=0)
        by_effort = means[0]
        if by_effort.shape[1] > 1:
            effort = cheapest_good(means)
        keys = ("valid_by_effort", "valid_stress_by_effort", "valid_newton_steps", "valid_unsettled")
        record |= zip(keys, np.where(np.isnan(means), None, means).tolist(), strict=True)  # JSON has no NaN
        if effort.corrections < len(by_effort) and not np.isnan(by_effort[effort]):
            text += f"; at the deepest frame {100 * by_effort[effort]:.2g} % of the displacement after {effort.text}"
    if len(by_calls) > 1 or measured:
        record |= {"valid_by_calls": by_calls, **effort._asdict()}
    return record, text


def _corrections(by_calls: list[float]) -> int:
    """The number of corrections after which no further call lowers the error by more than `ENOUGH`."""
    return next(i for i, error in enumerate(by_calls) if min(by_calls[i:]) >= (1 - ENOUGH) * error)


def _motion_error(position: np.ndarray, truth: Trajectory, frames: np.ndarray) -> SquaredError:
    """Error on NORMAL nodes of `position` [S, N, 3] in these S frames of the truth; or [N, 3] for all."""
    return SquaredError.between(position, truth.position[frames], ~truth.scene.prescribed)

"""Validation during training: errors of rollouts of validation scenes, and of the prediction that nothing moves."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

from ast_sim.dataset.reader import Dataset
from ast_sim.inference.measures import SquaredError, rmse_sequence
from ast_sim.inference.rollout import Question, rollouts
from ast_sim.models.simulator import Simulator
from ast_sim.scene import Trajectory


class Validated(NamedTuple):
    """The errors of one validation scene.

    Attributes:
        index: number of the scene in its split.
        error: error of the rollout; None if the rollout failed.
        hold: error of the prediction that nothing moves.
        failure: why the rollout failed; None if it did not.
    """

    index: int
    error: SquaredError | None
    hold: SquaredError
    failure: str | None


def validate(
    model: Simulator, dataset: Dataset, indices: Iterable[int], progress: Callable[[int], None] | None = None
) -> list[Validated]:
    """Roll out validation scenes together; `progress` is called after each step and may raise to stop."""
    truths = {index: dataset.load("valid", index) for index in indices}
    if not truths:
        return []
    questions = [Question.of(truth, f"valid/{index:06d}") for index, truth in truths.items()]
    found = []
    for (index, truth), answer in zip(truths.items(), rollouts(model, questions, progress), strict=True):
        error = None if answer.failure else _motion_error(answer.position[answer.given :], truth, answer.given)
        hold = _motion_error(truth.position[answer.given - 1], truth, answer.given)
        found.append(Validated(index, error, hold, answer.failure))
    return found


def verdict(found: list[Validated], best: float, unit: str) -> tuple[dict[str, Any], str]:
    """The record of a validation for `metrics.jsonl`, and its text; `best` is the lowest error before."""
    failure = next((scene.failure for scene in found if scene.failure), None)
    if failure is not None:
        return {"valid_rmse": None, "failure": failure}, f"rollout failed: {failure}"
    found = sorted(found, key=lambda scene: scene.index)
    error, hold = (rmse_sequence([getattr(scene, key) for scene in found]) for key in ("error", "hold"))
    share = f" = {error / hold:.2f} of the error of hold still" if hold else ""
    text = f"rollout error {error:.3g} {unit}{share}{', the best so far' if error < best else ''}"
    return {"valid_rmse": error, "valid_hold_still": hold}, text


def _motion_error(position: np.ndarray, truth: Trajectory, given: int) -> SquaredError:
    """Error on NORMAL nodes of `position` [S - given, N, 3], the frames after the given ones; or [N, 3] for all."""
    return SquaredError.between(position, truth.position[given:], ~truth.scene.prescribed)

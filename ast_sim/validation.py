"""How far a model in training is: its rollouts of validation scenes beside holding still."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from ast_sim.data.file import Dataset
from ast_sim.data.scene import Trajectory
from ast_sim.measures import SquaredError
from ast_sim.model.simulator import Simulator
from ast_sim.rollout import rollouts


class Validated(NamedTuple):
    """A validation scene: the error of its rollout and that of holding still, or why there is none."""

    index: int
    error: SquaredError | None
    hold: SquaredError | None
    failure: str | None


def validate(
    model: Simulator, dataset: Dataset, indices: Iterable[int], progress: Callable[[int], None] | None = None
) -> list[Validated]:
    """Roll out validation scenes together; `progress` is called after each step and may raise to stop."""
    truths = {index: dataset.load("valid", index) for index in indices}
    if not truths:
        return []
    names = [f"valid/{index:06d}" for index in truths]
    results = rollouts(model, list(truths.values()), names, progress=progress)
    return [
        Validated(
            index,
            _motion_error(result.position, truth, result.given),
            _motion_error(truth.position[result.given - 1], truth, result.given),
            None,
        )
        if result.failure is None
        else Validated(index, None, None, result.failure)
        for (index, truth), result in zip(truths.items(), results, strict=True)
    ]


def _motion_error(position: np.ndarray, truth: Trajectory, given: int) -> SquaredError:
    """Error of the frames after the given ones on NORMAL nodes; `position` [S, N, 3], or [N, 3] for one that stays."""
    predicted = position[given:] if position.ndim == 3 else position
    return SquaredError.between(predicted, truth.position[given:], ~truth.scene.prescribed)

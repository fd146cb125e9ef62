"""Errors of the model and of trivial predictors, at several horizons.

Predictors of the displacement: the model; `hold_still` (the next position equals the present one); `repeat_last` (the
next increment equals the last one). Predictors of the stress: the model; `stress_zero`; `stress_constant` (the mean of
the training split); `stress_frame_mean` (the mean of the true frame); of a named field likewise, with its name. All
predictors have the prescribed nodes at their true positions. Stress and fields are compared on the nodes or elements
that deform (`Scene.deforming`), reactions at the prescribed nodes.

Horizons: `one_step` (each frame is predicted from the true frame before it; not of a model that jumps), `rollout_50`
(the first 50 frames of the rollout, or all frames if it is shorter), `rollout_all` (all frames).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ast_sim.figures import MeanError, SceneError, main_nodes
from ast_sim.inference.answer import Answer
from ast_sim.inference.evaluation.measures import SquaredError, rmse_pooled, rmse_sequence
from ast_sim.named_field import REACTION, STRESS
from ast_sim.scene import NodeType, Scene, Trajectory

# The errors of one scene, by predictor, horizon and set of nodes.
Errors = dict[str, dict[str, dict[str, SquaredError]]]


def displacement_errors(truth: Trajectory, one_step: np.ndarray | None, answer: Answer) -> Errors:
    """Errors of the positions on NORMAL nodes and on all nodes. Displacements have the same errors.

    Args:
        one_step: [S - given, N, 3], the model's predictions from the true frames; None if it jumps.
        answer: the model's rollout.
    """
    position = truth.position.astype(np.float64)
    given = answer.given
    scene = truth.scene
    target, present = position[given:], position[given - 1 : -1]
    # The increment before frame 0 is zero, since the scene was at rest.
    before = np.concatenate([position[:1], position])[given - 1 : -2]
    last = present[0] - before[0]
    frames = np.arange(1, len(target) + 1)[:, None, None]
    predictors = {
        "model": (one_step, answer.position[given:] if answer.failure is None else None),
        "hold_still": (present, np.broadcast_to(present[0], target.shape)),
        "repeat_last": (2 * present - before, present[0] + frames * last),
    }
    rows = {"normal": scene.node_type == NodeType.NORMAL, "all": np.ones(scene.num_nodes, bool)}
    prescribed = scene.prescribed[:, None]
    placed = {
        key: tuple(None if value is None else np.where(prescribed, target, value) for value in values)
        for key, values in predictors.items()
    }
    return _errors_by_horizon(placed, target, rows)


def field_errors(
    name: str, location: str, truth: Trajectory, one_step: np.ndarray | None, answer: Answer, constant: float
) -> Errors:
    """Errors of the stress, or of another field by name, where it counts; `constant` is the value of
    `NAME_constant`."""
    target = values_of(truth, name)[answer.given :].astype(np.float64)
    rows = where_it_counts(truth.scene, name, location)
    mean = target[:, rows].mean(axis=1, keepdims=True)
    predictors = {
        "model": (one_step, values_of(answer, name)[answer.given :] if answer.failure is None else None),
        f"{name}_zero": (np.zeros(1), np.zeros(1)),
        f"{name}_constant": (np.full(1, constant), np.full(1, constant)),
        f"{name}_frame_mean": (mean, mean),
    }
    return _errors_by_horizon(predictors, target, {main_nodes(name): rows})


def values_of(shown: Trajectory | Answer, name: str) -> np.ndarray:
    """[S, N or E, *]: the stress or a named field."""
    if name != STRESS:
        return shown.fields[name].values
    assert shown.stress is not None
    return shown.stress


def where_it_counts(scene: Scene, name: str, location: str) -> np.ndarray:
    """[N or E] bool: where a field is compared."""
    return scene.prescribed if name == REACTION else scene.deforming(location)


def _errors_by_horizon(
    predictors: dict[str, tuple[np.ndarray | None, ...]], target: np.ndarray, rows: dict[str, np.ndarray]
) -> Errors:
    """Compare the predictions of each predictor, a pair (one step, rollout) of what broadcasts to the target, with the
    target [S - given, rows, F]. Without a step there is no error of it; a rollout that is None has failed."""
    horizons = {"one_step": (0, None), "rollout_50": (1, 50), "rollout_all": (1, None)}
    failed = SquaredError(math.inf, 1)
    return {
        predictor: {
            horizon: {
                nodes: failed
                if predictions[which] is None
                else SquaredError.between(predictions[which][:stop], target[:stop], mask)
                for nodes, mask in rows.items()
            }
            for horizon, (which, stop) in horizons.items()
            if which or predictions[0] is not None
        }
        for predictor, predictions in predictors.items()
    }


def scene_errors(quantity: str, errors: Errors) -> list[SceneError]:
    """The root mean square errors of one scene."""
    return [SceneError(quantity, *key, _or_none(error.rmse)) for key, error in _leaves(errors)]


def errors_over_scenes(quantity: str, of_scenes: Sequence[Errors]) -> list[MeanError]:
    """The errors over all scenes, in both conventions."""
    rows = []
    for same in zip(*(_leaves(errors) for errors in of_scenes), strict=True):
        (predictor, horizon, nodes), _ = same[0]
        squared = [error for _, error in same]
        rows.append(
            MeanError(
                quantity, predictor, horizon, nodes, _or_none(rmse_sequence(squared)), _or_none(rmse_pooled(squared))
            )
        )
    return rows


def _leaves(errors: Errors) -> list[tuple[tuple[str, str, str], SquaredError]]:
    """Each error with its predictor, horizon and nodes."""
    return [
        ((predictor, horizon, nodes), error)
        for predictor, by_horizon in errors.items()
        for horizon, by_nodes in by_horizon.items()
        for nodes, error in by_nodes.items()
    ]


def _or_none(value: float) -> float | None:
    """None for infinity and NaN, which JSON does not have."""
    return value if math.isfinite(value) else None

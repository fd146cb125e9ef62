"""Evaluation on a split: every error convention, next to trivial predictors, and the time against the solver's.

Predictors of the displacement: the model; `hold_still` (the next position is the present one); `repeat_last` (the
next increment is the last one). Of the stress: the model; `stress_zero`; `stress_constant` (the mean over the
training split); `stress_frame_mean` (the mean over the truth's frame). Prescribed nodes are at their true places in
all of them. Stress is compared on what is not part of an obstacle.

Horizons: `one_step` (every frame predicted from the true frame before), `rollout_50` (the first 50 frames of the
rollout, or all if it is shorter), `rollout_all`. A time-conditioned model does not know the frame before: its one step
is that of its rollout, and `time_conditioned` says so.
"""

from __future__ import annotations

import math
import os
import platform
import subprocess
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ast_sim.data.file import Dataset
from ast_sim.data.graph import Graph
from ast_sim.data.scene import NodeType, Scene, Trajectory
from ast_sim.data.seconds import processor, read_seconds
from ast_sim.errors import DatasetError
from ast_sim.measures import SquaredError, rmse_pooled, rmse_sequence
from ast_sim.model.simulator import Simulator
from ast_sim.rollout import Rollout, make_batch, predict_next, rollouts

ONE_STEP_NODES = 8192  # frames are predicted together up to about this many nodes
MEAN_TRAJECTORIES = 100  # training trajectories that `stress_constant` is the mean of, at most

# Errors of one scene by predictor, horizon and set of nodes.
Errors = dict[str, dict[str, dict[str, SquaredError]]]


def evaluate(
    model: Simulator, dataset: Dataset, split: str = "test", progress: Callable[[str], None] | None = None
) -> dict[str, Any]:
    """Compare the model's predictions with all trajectories of a split.

    Scenes are rolled out one at a time, so that the time of a step is that of the scene alone. A rollout that fails
    has no error (None); then neither has the summary, whose `failures` counts them.

    Returns:
        `samples`: for each scene its name, nodes, frames, errors (root mean square, in `displacement` and `stress`
        by predictor, horizon and nodes) and seconds per step of model and solver; `summary`: for each predictor
        `rmse_sequence` and `rmse_pooled` of the same; `time_conditioned`: whether the model's one step is its rollout;
        `speedup`: the solver's time over the model's, None where the solver's is not known; units; threads.

    Raises:
        DatasetError: the split is empty.
    """
    count = dataset.count(split)
    if count == 0:
        raise DatasetError(f"{dataset.path}: the split {split} is empty, so there is nothing to evaluate on")
    model.eval()
    constant = _training_stress(dataset) if model.config.stress != "none" else None
    samples, displacement, stress = [], [], []
    seconds = read_seconds(dataset).samples
    for index in range(count):
        name = f"{split}/{index:06d}"
        truth = dataset.load(split, index)
        result = rollouts(model, [truth], [name])[0]
        one_step = _rolled(result) if model.config.time_conditioned else one_step_predictions(model, truth, name)
        displacement.append(displacement_errors(truth, one_step[0], result))
        if constant is not None:
            stress.append(stress_errors(truth, one_step[1], result, constant, model.config.stress))
        solver = seconds.get(name, truth.attributes.get("solve_seconds"))
        samples.append(_sample(name, truth, result, displacement[-1], stress[-1] if stress else None, solver))
        if progress is not None:
            progress(name)
    summary = summarize(displacement, "displacement")
    for predictor, values in summarize(stress, "stress").items():
        summary.setdefault(predictor, {}).update(values)
    return {
        "samples": samples,
        "summary": summary,
        "failures": sum(sample["failure"] is not None for sample in samples),
        "time_conditioned": model.config.time_conditioned,
        "speedup": _speedup(samples),
        "length_unit": dataset.info.length_unit,
        "stress_unit": "Pa",
        "threads": torch.get_num_threads(),
    }


def _rolled(result: Rollout) -> tuple[np.ndarray | None, np.ndarray | None]:
    """The predicted positions and stresses of a rollout; None if it failed."""
    if result.failure is not None:
        return None, None
    return result.position[result.given :], None if result.stress is None else result.stress[result.given :]


def one_step_predictions(model: Simulator, truth: Trajectory, name: str) -> tuple[np.ndarray, np.ndarray | None]:
    """Every frame after the given ones, predicted from the true frame before: positions [S - given, N, 3], stress."""
    given = 2 if model.config.dynamic else 1
    graph = model.graph(truth.scene)
    script = torch.tensor(truth.position)
    known = None if truth.stress is None else torch.tensor(truth.stress)
    chunk = max(1, ONE_STEP_NODES // truth.scene.num_nodes)
    positions, stresses = [], []
    for start in range(given, truth.num_frames, chunk):
        frames = torch.arange(start, min(start + chunk, truth.num_frames))
        batch = make_batch(
            model,
            Graph.concatenate([graph] * len(frames)),
            position=script[frames - 1].flatten(0, 1),
            previous=script[frames - 2].flatten(0, 1) if given == 2 else None,
            target=script[frames].flatten(0, 1),
            stress=None if known is None else known[frames - 1].flatten(0, 1),
            names=[f"{name} frame {int(frame) - 1}" for frame in frames],
            frame=frames.float(),
        )
        with torch.inference_mode():
            position, stress = predict_next(model, batch, script[frames].flatten(0, 1))
        positions.append(position.reshape(len(frames), -1, 3).numpy())
        if stress is not None:
            stresses.append(stress.reshape(len(frames), -1, 1).numpy())
    return np.concatenate(positions), np.concatenate(stresses) if stresses else None


def displacement_errors(truth: Trajectory, one_step: np.ndarray | None, result: Rollout) -> Errors:
    """Errors of the positions (the same as of the displacements) on NORMAL nodes and on all nodes.

    Args:
        one_step: [S - given, N, 3], the model's predictions from the true frames; None if there are none.
        result: the model's rollout.
    """
    position, given, scene = truth.position.astype(np.float64), result.given, truth.scene
    target, present = position[given:], position[given - 1 : -1]
    # The increment before frame 0 counts as zero: the scene was at rest.
    before = np.concatenate([position[:1], position])[given - 1 : -2]
    last = present[0] - before[0]
    frames = np.arange(1, len(target) + 1)[:, None, None]
    predictors = {
        "model": (one_step, result.position[given:] if result.failure is None else None),
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


def stress_errors(
    truth: Trajectory, one_step: np.ndarray | None, result: Rollout, constant: float, location: str
) -> Errors:
    """Errors of the stress on nodes, or elements, that are not part of an obstacle; `constant` is a predictor."""
    target = truth.stress[result.given :].astype(np.float64)
    rows = deforming(truth.scene, location)
    mean = target[:, rows].mean(axis=1, keepdims=True)
    predictors = {
        "model": (one_step, result.stress[result.given :] if result.failure is None else None),
        "stress_zero": (np.zeros(1), np.zeros(1)),
        "stress_constant": (np.full(1, constant), np.full(1, constant)),
        "stress_frame_mean": (mean, mean),
    }
    full = {
        key: tuple(None if value is None else np.broadcast_to(value, target.shape) for value in values)
        for key, values in predictors.items()
    }
    return _errors_by_horizon(full, target, {"deforming": rows})


def deforming(scene: Scene, location: str) -> np.ndarray:
    """[N] or [E] bool: the nodes, or elements, that are not part of an obstacle."""
    obstacle = scene.node_type == NodeType.OBSTACLE
    return ~obstacle if location == "node" else ~obstacle[scene.elements].any(axis=1)


def _errors_by_horizon(
    predictors: dict[str, tuple[np.ndarray | None, ...]], target: np.ndarray, rows: dict[str, np.ndarray]
) -> Errors:
    """Compare each (one-step, rollout) pair of predictions with the target [S - given, rows, F]."""
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
        }
        for predictor, predictions in predictors.items()
    }


def summarize(errors: list[Errors], quantity: str) -> dict[str, Any]:
    """predictor -> quantity -> horizon -> nodes -> {rmse_sequence, rmse_pooled}, over the scenes in `errors`."""
    if not errors:
        return {}
    return {
        predictor: {
            quantity: {
                horizon: {
                    nodes: {
                        name: _number(measure([scene[predictor][horizon][nodes] for scene in errors]))
                        for name, measure in (("rmse_sequence", rmse_sequence), ("rmse_pooled", rmse_pooled))
                    }
                    for nodes in by_nodes
                }
                for horizon, by_nodes in horizons.items()
            }
        }
        for predictor, horizons in errors[0].items()
    }


def _number(value: float) -> float | None:
    """JSON has no infinity and no NaN."""
    return value if math.isfinite(value) else None


def _sample(
    name: str,
    truth: Trajectory,
    result: Rollout,
    displacement: Errors,
    stress: Errors | None,
    solver: list[float] | None,
) -> dict[str, Any]:
    """What is told of one scene; `solver`: the solver's seconds a frame, None where they are not known."""

    def values(errors: Errors) -> dict[str, Any]:
        return {
            predictor: {
                h: {n: _number(error.rmse) for n, error in by_nodes.items()} for h, by_nodes in horizons.items()
            }
            for predictor, horizons in errors.items()
        }

    steps = truth.num_frames - result.given
    return {
        "name": name,
        "nodes": truth.scene.num_nodes,
        "frames": truth.num_frames,
        "displacement": values(displacement),
        "stress": values(stress) if stress is not None else None,
        "model_seconds_per_step": sum(result.seconds) / steps if result.failure is None else None,
        "solver_seconds_per_step": float(np.sum(solver)) / (truth.num_frames - 1) if solver is not None else None,
        "failure": result.failure,
    }


def _speedup(samples: list[dict[str, Any]]) -> float | None:
    """The solver's time over the model's, on the scenes where both are known."""
    keys = ("solver_seconds_per_step", "model_seconds_per_step")
    both = [sample for sample in samples if sample[keys[0]] is not None and sample[keys[1]] is not None]
    solver, model = (math.fsum(sample[key] * (sample["frames"] - 1) for sample in both) for key in keys)
    return solver / model if both and model > 0 else None


def _training_stress(dataset: Dataset) -> float:
    """Mean stress of the training split on what is not part of an obstacle; 0 without training data."""
    count = dataset.count("train")
    total, number = 0.0, 0
    for index in np.unique(np.linspace(0, count - 1, min(count, MEAN_TRAJECTORIES)).astype(int)) if count else ():
        trajectory = dataset.load("train", int(index))
        stress = trajectory.stress[:, deforming(trajectory.scene, dataset.info.stress_location)]
        total, number = total + float(stress.sum(dtype=np.float64)), number + stress.size
    return total / number if number else 0.0


def table(found: dict[str, Any]) -> str:
    """The summary as text: for each quantity and set of nodes a row a predictor, its errors at every horizon."""
    lines = []
    units = {"displacement": found["length_unit"], "stress": found["stress_unit"]}
    for quantity, nodes in (("displacement", "normal"), ("displacement", "all"), ("stress", "deforming")):
        rows = {key: values[quantity] for key, values in found["summary"].items() if quantity in values}
        if not rows:
            continue
        lines.append(f"{quantity} [{units[quantity]}], {nodes} nodes: rmse_sequence / rmse_pooled")
        horizons = next(iter(rows.values()))
        lines.append(" " * 20 + "".join(f"{horizon:>24}" for horizon in horizons))
        for predictor, values in rows.items():
            cells = [values[horizon][nodes] for horizon in horizons]
            shown = [" / ".join(_shown(cell[key]) for key in ("rmse_sequence", "rmse_pooled")) for cell in cells]
            lines.append(f"  {predictor:18}" + "".join(f"{cell:>24}" for cell in shown))
        lines.append("")
    lines.append(f"{len(found['samples'])} scenes, {found['failures']} failed, on {found['threads']} threads")
    if found["time_conditioned"]:
        lines.append(
            "time-conditioned: every frame is predicted from the first, so the model's one_step is its rollout"
        )
    if all(sample["solver_seconds_per_step"] is None for sample in found["samples"]):
        lines.append("speed against the solver: unknown, there are no seconds of it on these scenes")
    elif found["speedup"] is not None:
        lines.append(f"{found['speedup']:.3g} times as fast as the solver on the same scenes")
    return "\n".join(lines)


def _shown(value: float | None) -> str:
    return "failed" if value is None else f"{value:.4g}"


def provenance(command: str) -> dict[str, Any]:
    """What a reader needs to judge figures: the command, the commit, the processor and the versions."""
    versions = {"python": platform.python_version()}
    for package in ("ast_sim", "torch", "numpy"):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = None
    return {
        "command": command,
        "commit": _commit(),
        "processor": processor(),
        "cores": os.cpu_count(),
        "versions": versions,
    }


def _commit() -> str | None:
    """The commit of the source tree that this package is imported from; None for an installed one."""
    root = Path(__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return None
    try:
        found = subprocess.run(
            ["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return found.stdout.strip()

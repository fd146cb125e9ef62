"""Evaluation on a split: errors of the model and of trivial predictors, and its speed relative to the solver."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from ast_sim.batches.batch_builder import State
from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.solver_seconds import read_seconds
from ast_sim.inference.answer import Answer
from ast_sim.inference.effort import FIRST_CALL, Effort
from ast_sim.inference.evaluation import asked_frame
from ast_sim.inference.evaluation.trivial_predictors import (
    Errors,
    displacement_errors,
    rmse_of,
    stress_errors,
    summarize,
)
from ast_sim.inference.predict import answers as predictions
from ast_sim.inference.predict_batch import Start, predict_batch
from ast_sim.inference.question import Question
from ast_sim.models.simulator import Simulator
from ast_sim.scene import Trajectory
from ast_sim.support.errors import DatasetError

ONE_STEP_NODES = 8192  # frames are predicted together as long as they have at most about so many nodes
MEAN_TRAJECTORIES = 100  # `stress_constant` is the mean of at most so many training trajectories


def evaluate(
    model: Simulator,
    dataset: Dataset,
    split: str = "test",
    progress: Callable[[str], None] | None = None,
    effort: Effort = FIRST_CALL,
    rival_scenes: int = 0,
    made_from: str | os.PathLike[str] | None = None,
) -> dict[str, Any]:
    """Predict all trajectories of a split and compare.

    A scene without a frame to predict is left out. Where a prediction fails, its errors and the summary are None.

    Returns:
        Figures that hold:
        samples: for each scene its name, nodes, frames, root mean square errors (`displacement` and `stress`, by
        predictor, horizon and nodes), and the seconds per step of the model and of the solver;
        summary: by predictor, quantity, horizon and nodes the errors `rmse_sequence` and `rmse_pooled` of all scenes;
        failures: the number of failed predictions;
        jumps: whether the model predicts each frame from the first one, so that its `one_step` errors are those of its
        rollout; corrections, newton_steps: what follows the first call of such a model;
        asked: the deepest frame of each scene, see `asked_frames`; the solver is run in `rival_scenes` scenes;
        speedup: the solver's recorded time for all frames over the model's, both on one thread; else None;
        length_unit, stress_unit, threads.

    Raises:
        DatasetError: the split has no frame to predict.
    """
    indices = dataset.with_frames(split, model.config.given_frames + 1)
    if not indices:
        raise DatasetError(f"{dataset.path}: the split {split} has no frame to predict")
    constant = _training_stress(dataset) if model.config.stress != "none" else None
    samples, displacement, stress = [], [], []
    seconds = read_seconds(dataset).samples
    for index in indices:
        name, truth = f"{split}/{index:06d}", dataset.load(split, index)
        answer = predictions(model, [Question.of(truth, name)], effort)[0]
        one_step = _predicted(answer) if model.config.jumps else one_step_predictions(model, truth, name)
        displacement.append(displacement_errors(truth, one_step[0], answer))
        if constant is not None:
            stress.append(stress_errors(truth, one_step[1], answer, constant, model.config.stress))
        recorded = truth.attributes.get("solve_seconds")
        solver = seconds.get(name, recorded if isinstance(recorded, list) else None)
        samples.append(_sample(truth, answer, displacement[-1], stress[-1] if stress else None, solver))
        if progress is not None:
            progress(name)
    return {
        "samples": samples,
        "summary": summarize({"displacement": displacement, "stress": stress}),
        "failures": sum(sample["failure"] is not None for sample in samples),
        "jumps": model.config.jumps,
        **dataclasses.asdict(effort),
        "asked": asked_frame.asked_frames(model, dataset, split, effort, rival_scenes, progress, made_from),
        "speedup": _speedup(samples),
        "length_unit": dataset.info.length_unit,
        "stress_unit": "Pa",
        "threads": torch.get_num_threads(),
    }


def _predicted(answer: Answer) -> tuple[np.ndarray | None, np.ndarray | None]:
    """The predicted positions and stresses of a rollout, without the given frames; None if the rollout failed."""
    if answer.failure is not None:
        return None, None
    return answer.position[answer.given :], None if answer.stress is None else answer.stress[answer.given :]


def one_step_predictions(model: Simulator, truth: Trajectory, name: str) -> tuple[np.ndarray, np.ndarray | None]:
    """Each frame after the given ones, predicted from the true frame before it.

    Returns:
        Positions [S - given, N, 3] and stresses [S - given, N or E, 1] or None.
    """
    given = model.config.given_frames
    graph = model.graph(truth.scene)
    script = torch.tensor(truth.position)
    known = [None] * len(script) if truth.stress is None else torch.tensor(truth.stress)
    starts = []
    for frame in range(given, truth.num_frames):
        state = State(script[frame - 1], script[frame - 2] if given == 2 else None, known[frame - 1])
        starts.append(Start(f"{name} frame {frame - 1}", graph, state, script[frame]))
    chunk, found = max(1, ONE_STEP_NODES // truth.scene.num_nodes), []
    with model.predicting():
        for first in range(0, len(starts), chunk):
            found += predict_batch(model, starts[first : first + chunk])
    stresses = [stress.numpy() for _, stress, _ in found if stress is not None]
    return np.array([positions[0].numpy() for positions, *_ in found]), np.array(stresses) if stresses else None


def _sample(
    truth: Trajectory,
    answer: Answer,
    displacement: Errors,
    stress: Errors | None,
    solver: list[float] | None,
) -> dict[str, Any]:
    """The figures of one scene; `solver`: the solver's seconds of each frame, None if they are not known."""
    steps = truth.num_frames - answer.given
    return {
        "name": answer.name,
        "nodes": truth.scene.num_nodes,
        "frames": truth.num_frames,
        "displacement": rmse_of(displacement),
        "stress": rmse_of(stress) if stress is not None else None,
        "model_seconds_per_step": answer.seconds / steps if answer.failure is None else None,
        "solver_seconds_per_step": float(np.sum(solver)) / (truth.num_frames - 1) if solver is not None else None,
        "failure": answer.failure,
    }


def _speedup(samples: list[dict[str, Any]]) -> float | None:
    """The solver's time divided by the model's time, on the scenes where both are known, both on one thread."""
    if torch.get_num_threads() != 1:
        return None
    keys = ("solver_seconds_per_step", "model_seconds_per_step")
    both = [sample for sample in samples if sample[keys[0]] is not None and sample[keys[1]] is not None]
    solver, model = (math.fsum(sample[key] * (sample["frames"] - 1) for sample in both) for key in keys)
    return solver / model if both and model > 0 else None


def _training_stress(dataset: Dataset) -> float:
    """Mean stress of the training split on the nodes or elements that deform; 0 without training data."""
    total, number = 0.0, 0
    for _, trajectory in dataset.spread("train", MEAN_TRAJECTORIES):
        assert trajectory.stress is not None
        stress = trajectory.stress[:, trajectory.scene.deforming(dataset.info.stress_location)]
        total, number = total + float(stress.sum(dtype=np.float64)), number + stress.size
    return total / number if number else 0.0


def table(found: dict[str, Any]) -> str:
    """The summary as text: for each quantity and set of nodes a table with a row for each predictor."""
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
    lines.append(f"scenes: {len(found['samples'])}, failed: {found['failures']}, threads: {found['threads']}")
    if found["jumps"]:
        after = Effort(found["corrections"], found["newton_steps"])
        lines.append(f"every frame is one jump from the first and {after.text}, so the model's one_step is its rollout")
    if all(sample["solver_seconds_per_step"] is None for sample in found["samples"]):
        lines.append("speed relative to the solver: unknown. Neither the scenes nor a file beside the dataset")
        lines.append("(its name and .seconds.json) hold the seconds of a solver; a dataset is moved together with it")
    else:
        lines.append(_all_frames(found))
    lines += asked_frame.lines(found["asked"])
    return "\n".join(lines)


def _all_frames(found: dict[str, Any]) -> str:
    """A line on the time of all frames, the model's beside the solver's; a ratio only if both had one thread."""
    if found["speedup"] is not None:
        return f"all frames: {found['speedup']:.3g} times as fast as the solver was when it made them (one thread each)"
    known = [sample for sample in found["samples"] if sample["solver_seconds_per_step"] is not None]
    times = {}
    for who in ("model", "solver"):
        seconds = [sample[f"{who}_seconds_per_step"] for sample in known]
        times[who] = "unknown" if None in seconds else f"{1000 * math.fsum(seconds) / len(seconds):.3g} ms"
    return (
        f"a frame of all: the model {times['model']} on {found['threads']} threads, the solver {times['solver']} on one"
        " thread when it made them"
    )


def _shown(value: float | None) -> str:
    return "failed" if value is None else f"{value:.4g}"

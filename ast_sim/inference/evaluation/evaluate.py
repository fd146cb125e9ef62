"""Evaluation on a split: errors of the model and of trivial predictors, and its speed relative to the solver."""

from __future__ import annotations

import dataclasses
import os
import statistics
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch

from ast_sim.batches.batch_builder import State
from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.solver_seconds import read_seconds
from ast_sim.dataset.whole_motions import require_whole_motions
from ast_sim.figures import Figures, SceneError, SceneFigures
from ast_sim.inference.answer import Answer
from ast_sim.inference.answering import answers as predictions
from ast_sim.inference.effort import FIRST_CALL, Effort
from ast_sim.inference.evaluation import deepest_frames
from ast_sim.inference.evaluation.trivial_predictors import (
    Errors,
    displacement_errors,
    errors_over_scenes,
    field_errors,
    scene_errors,
    values_of,
    where_it_counts,
)
from ast_sim.inference.predicting.predicted_frames import Start, predict_frames
from ast_sim.inference.predicting.question import Question
from ast_sim.models.data_facts import DataFacts
from ast_sim.models.simulator import Simulator
from ast_sim.named_field import STRESS, Output, require_fields
from ast_sim.number_arrays import measured_time, percent
from ast_sim.scene import Trajectory
from ast_sim.simulate.jobs.recipe import recipe_of
from ast_sim.support.errors import ConfigError, DatasetError, counted, warn

ONE_STEP_NODES = 8192  # at most, of frames that are predicted together, unless a single one has more
MEAN_TRAJECTORIES = 100  # training trajectories, at most, of whose stress `stress_constant` is the mean


def evaluate(
    model: Simulator,
    dataset: Dataset,
    split: str = "test",
    advance: Callable[[str], None] = lambda name: None,
    effort: Effort = FIRST_CALL,
    solver_scenes: int = 0,
    made_from: str | os.PathLike[str] | None = None,
) -> Figures:
    """Predict all trajectories of a split and compare.

    A scene without a frame to predict is left out. A warning tells of predictions that failed. `advance` is called with
    the name of each scene, once for all of its frames and once for its deepest frame, and of each scene that the solver
    has solved.

    Args:
        solver_scenes: in how many scenes the solver goes to the deepest frame, to compare.
        made_from: as in `deepest_frames`.

    Raises:
        DatasetError: the split has no frame to predict.
        ConfigError: `made_from` is given, but the solver is not run, or the dataset was made of other things; or a
            scene has some frames of its motion only.
    """
    if made_from is not None:
        _require_origin(dataset, solver_scenes, made_from)
    indices = _predictable(dataset, split, model.config.data.given_frames + 1)
    outputs = model.config.data.outputs
    scheme = model.config.scheme
    constants = _training_means(dataset, outputs)
    scenes: list[SceneFigures] = []
    errors: dict[str, list[Errors]] = {"displacement": [], **{output.name: [] for output in outputs}}
    seconds = read_seconds(dataset).samples
    for index in indices:
        name = f"{split}/{index:06d}"
        truth = _truth(dataset, split, index, model.config.data)
        (answer,) = predictions(model, [Question.of(truth, name)], effort)
        of_scene = _errors_of_scene(model, truth, name, answer, constants)
        for quantity, values in of_scene.items():
            errors[quantity].append(values)
        own = [row for quantity, values in of_scene.items() for row in scene_errors(quantity, values)]
        recorded = truth.attributes.get("solve_seconds")
        solver = seconds.get(name, recorded if isinstance(recorded, list) else None)
        scenes.append(_scene_figures(truth, answer, own, solver))
        advance(name)
    return Figures(
        scenes=tuple(scenes),
        errors=tuple(
            row for quantity, of_all in errors.items() if of_all for row in errors_over_scenes(quantity, of_all)
        ),
        failures=_told_failures(scenes),
        jumps=scheme.jumps,
        effort=dataclasses.asdict(effort),
        deepest=deepest_frames.deepest_frames(model, dataset, split, effort, solver_scenes, advance, made_from),
        speedup=_speedup(scenes),
        length_unit=dataset.info.length_unit,
        stress_unit="Pa",
        threads=torch.get_num_threads(),
        field_units={key: unit for key, _, _, unit in model.config.data.fields},
    )


def _errors_of_scene(
    model: Simulator, truth: Trajectory, name: str, answer: Answer, constants: Mapping[str, float]
) -> dict[str, Errors]:
    """The errors of the displacement and of each output that the answer has: Newton steps leave the reaction out."""
    steps = model.config.scheme.errors_add_up
    position, fields = one_step_predictions(model, truth, name) if steps else (None, {})
    errors = {"displacement": displacement_errors(truth, position, answer)}
    for key, location, *_ in model.config.data.outputs:
        if key == STRESS or key in answer.fields:
            errors[key] = field_errors(key, location, truth, fields.get(key), answer, constants[key])
    return errors


def _predictable(dataset: Dataset, split: str, least: int) -> list[int]:
    """The trajectories of a split with at least `least` frames, after a check that there are some, with all frames of
    their motions."""
    require_whole_motions(dataset, split)
    indices = dataset.with_frames(split, least)
    if not indices:
        raise DatasetError(f"{dataset.path}: the split {split} has no frame to predict")
    return indices


def _told_failures(scenes: Sequence[SceneFigures]) -> int:
    """How many predictions failed; a warning tells of them."""
    failures = [scene.failure for scene in scenes if scene.failure is not None]
    if failures:
        warn(f"{len(failures)} of {counted(len(scenes), 'prediction')} failed; the first: {failures[0]}")
    return len(failures)


def _require_origin(dataset: Dataset, solver_scenes: int, made_from: str | os.PathLike[str]) -> None:
    """Raise ConfigError if the solver is not run, or the dataset was made of other things, with which it would be
    left out in the end."""
    if not solver_scenes:
        raise ConfigError("made_from is for the solver: give solver_scenes, or leave it out")
    recipe_of(str(dataset.path), dataset.info, made_from)


def _truth(dataset: Dataset, split: str, index: int, data: DataFacts) -> Trajectory:
    """A trajectory with the named fields that a model predicts."""
    names = [key for key, *_ in data.fields]
    truth = dataset.load(split, index, names)
    require_fields(f"{dataset.path}: {split}/{index:06d}", truth.fields, data.fields)
    return truth


def one_step_predictions(model: Simulator, truth: Trajectory, name: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Each frame after the given ones, predicted from the true frame before it.

    Returns:
        Positions [S - given, N, 3] and fields [S - given, N or E, *] by name.
    """
    given = model.config.data.given_frames
    chunk = max(1, ONE_STEP_NODES // truth.scene.num_nodes)
    starts, predicted = [], []
    with model.predicting():
        graph = model.graph(truth.scene)
        position = torch.tensor(truth.position)
        known = [None] * len(position) if truth.stress is None else torch.tensor(truth.stress)
        for frame in range(given, truth.num_frames):
            state = State(position[frame - 1], position[frame - 2] if given == 2 else None, known[frame - 1])
            starts.append(Start(f"{name} frame {frame - 1}", graph, state, position[frame]))
        for first in range(0, len(starts), chunk):
            predicted += predict_frames(model, starts[first : first + chunk])
    fields = {
        output.name: np.array([frame.fields[output.name].numpy() for frame in predicted])
        for output in model.config.data.outputs
    }
    return np.array([frame.positions[0].numpy() for frame in predicted]), fields


def _scene_figures(
    truth: Trajectory, answer: Answer, errors: list[SceneError], solver: list[float] | None
) -> SceneFigures:
    """The figures of one scene; `solver`: the solver's seconds of each frame, None if they are not known."""
    steps = truth.num_frames - answer.given
    return SceneFigures(
        name=answer.name,
        nodes=truth.scene.num_nodes,
        frames=truth.num_frames,
        errors=tuple(errors),
        model_seconds_per_step=answer.seconds / steps if answer.failure is None else None,
        solver_seconds_per_step=float(np.sum(solver)) / (truth.num_frames - 1) if solver is not None else None,
        failure=answer.failure,
    )


def _speedup(scenes: list[SceneFigures]) -> float | None:
    """The solver's time divided by the model's time, in the median of the scenes where both are known, both on one
    thread."""
    if torch.get_num_threads() != 1:
        return None
    ratios = [
        scene.solver_seconds_per_step / scene.model_seconds_per_step
        for scene in scenes
        if scene.solver_seconds_per_step is not None and scene.model_seconds_per_step
    ]
    return statistics.median(ratios) if ratios else None


def _training_means(dataset: Dataset, outputs: Sequence[Output]) -> dict[str, float]:
    """The mean of the stress and of each named field in the training split, where they count; 0 where there is none."""
    totals = dict.fromkeys((output.name for output in outputs), 0.0)
    numbers = dict.fromkeys(totals, 0)
    for _, trajectory in dataset.spread("train", MEAN_TRAJECTORIES, list(totals)) if totals else ():
        for name, location, *_ in outputs:
            if name == STRESS or name in trajectory.fields:
                values = values_of(trajectory, name)[:, where_it_counts(trajectory.scene, name, location)]
                totals[name] += float(values.sum(dtype=np.float64))
                numbers[name] += values.size
    return {name: total / max(numbers[name], 1) for name, total in totals.items()}


def table(figures: Figures) -> str:
    """The errors as text: for each quantity and set of nodes a table with a row for each predictor."""
    lines = []
    for quantity, nodes in dict.fromkeys((row.quantity, row.nodes) for row in figures.errors):
        rows = [row for row in figures.errors if (row.quantity, row.nodes) == (quantity, nodes)]
        horizons = [row.horizon for row in rows if row.predictor == "model"]
        unit = figures.unit(quantity)
        in_unit = f" [{unit}]" if unit else ""
        lines.append(f"{quantity}{in_unit}, {nodes} nodes: rmse_sequence / rmse_pooled")
        lines.append(" " * 20 + "".join(f"{horizon:>24}" for horizon in horizons))
        for predictor in dict.fromkeys(row.predictor for row in rows):
            cells = [figures.error(quantity, predictor, horizon, nodes) for horizon in horizons]
            shown = [f"{_shown(cell.rmse_sequence)} / {_shown(cell.rmse_pooled)}" for cell in cells if cell is not None]
            lines.append(f"  {predictor:18}" + "".join(f"{cell:>24}" for cell in shown))
        share = figures.relative(quantity) if quantity in figures.field_units else None
        if share is not None:
            lines.append(f"  relative: {percent(share, 3)} of the root mean square of {quantity} in all frames")
        lines.append("")
    lines.append(f"scenes: {len(figures.scenes)}, failed: {figures.failures}, threads: {figures.threads}")
    if figures.jumps:
        after = Effort(**figures.effort)
        lines.append(f"every frame is one jump and {after.text}: there is no error of one step")
    if all(scene.solver_seconds_per_step is None for scene in figures.scenes):
        lines.append("speed relative to the solver: unknown. Neither the scenes nor a file beside the dataset")
        lines.append("(its name and .seconds.json) hold the seconds of a solver; a dataset is moved together with it")
    else:
        lines.append(_all_frames(figures))
    lines += deepest_frames.lines(figures.deepest)
    return "\n".join(lines)


def _all_frames(figures: Figures) -> str:
    """A line on the time of all frames, the model's beside the solver's; a ratio only if both had one thread."""
    if figures.speedup is not None:
        times = (
            f"{figures.speedup:.3g} times faster" if figures.speedup >= 1 else f"{1 / figures.speedup:.3g} times slower"
        )
        return f"all frames: {times} than the solver was when it made them (median, one thread each)"
    known = [scene for scene in figures.scenes if scene.solver_seconds_per_step is not None]
    model, solver = (
        _median([getattr(scene, f"{who}_seconds_per_step") for scene in known]) for who in ("model", "solver")
    )
    return (
        f"a frame of all, in the median: the model {model} on {counted(figures.threads, 'thread')}, the solver {solver}"
        " on one thread when it made them"
    )


def _median(seconds: list[float | None]) -> str:
    known = [value for value in seconds if value is not None]
    return measured_time(statistics.median(known)) if len(known) == len(seconds) else "unknown"


def _shown(value: float | None) -> str:
    return "failed" if value is None else f"{value:.4g}"

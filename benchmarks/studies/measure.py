"""What a study measures of a trained run beside `Run.evaluate`: errors by phase of contact, and long rollouts.

`python -m benchmarks.studies.measure RUN HORIZONS FILE` evaluates the best checkpoint of a run on the test scenes of
its dataset. A scene is rolled out for HORIZONS times its length; its script is played forward and backward in turn.
Only the frames of the first time are compared with the truth.

The phases follow from the area in contact that the solver recorded:

- `before`: before any contact;
- `first`: the frame where contact begins and the two frames after it;
- `release`: all frames after the deepest frame;
- `full`: all other frames.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ast_sim import keep_memory
from ast_sim.dataset.reader import Dataset
from ast_sim.inference.answer import Answer
from ast_sim.inference.answering import answers
from ast_sim.inference.evaluation.measures import SquaredError, rmse_pooled, rmse_sequence
from ast_sim.inference.predicting.question import Question
from ast_sim.inference.trained_run import Run
from ast_sim.scene import NodeType, Trajectory
from ast_sim.support.disk import write_json
from benchmarks.studies.measured_run import MeasuredRun, PhaseError

FIRST = 3  # frames that count as the beginning of contact
PHASES = ("before", "first", "full", "release")


def phases(truth: Trajectory) -> dict[str, np.ndarray] | None:
    """The frames [S] bool of each phase; None where contact was not recorded."""
    area = truth.attributes.get("contact_area")
    if area is None:
        return None
    frames, touching = np.arange(truth.num_frames), np.asarray(area)[: truth.num_frames] > 0
    start = int(np.argmax(touching)) if touching.any() else truth.num_frames
    prescribed = truth.scene.prescribed
    travel = np.linalg.norm(truth.position[:, prescribed] - truth.position[0, prescribed], axis=2)
    deepest = int(np.argmax(travel.max(axis=1))) if prescribed.any() else truth.num_frames
    masks = {"before": frames < start, "first": (frames >= start) & (frames < start + FIRST)}
    masks["release"] = (frames > deepest) & (frames >= start + FIRST)
    masks["full"] = (frames >= start + FIRST) & ~masks["release"]
    return masks


def repeated(truth: Trajectory, horizons: int) -> Trajectory:
    """The trajectory with its frames forward, backward, forward ... for `horizons` times its length."""
    there, last = np.arange(1, truth.num_frames), truth.num_frames - 1
    order = np.concatenate([[0], *(there if i % 2 == 0 else last - there for i in range(horizons))])
    stress = None if truth.stress is None else truth.stress[order]
    return replace(truth, position=truth.position[order], stress=stress, cauchy_stress=None, frames=None, times=None)


def phase_errors(truth: Trajectory, result: Answer) -> dict[str, SquaredError]:
    """Errors of the positions of NORMAL nodes in each phase; nothing where the rollout failed on the way."""
    masks, normal = phases(truth), truth.scene.node_type == NodeType.NORMAL
    if masks is None or len(result.position) < truth.num_frames:
        return {}
    predicted = np.arange(truth.num_frames) >= result.given
    return {
        name: SquaredError.between(result.position[: truth.num_frames][rows], truth.position[rows], normal)
        for name, rows in ((name, frames & predicted) for name, frames in masks.items())
    }


def long_rollouts(run: Run, dataset: Dataset, horizons: int) -> Iterator[tuple[Trajectory, Answer]]:
    """Every test scene and its rollout over all horizons."""
    for index, truth in enumerate(dataset["test"]):
        question = Question.of(repeated(truth, horizons), f"test/{index:06d}")
        yield truth, answers(run.model, [question], run.effort)[0]


def measure(run: Run, horizons: int, command: str) -> MeasuredRun:
    """The evaluation of a run, its errors by phase, and its long rollouts."""
    figures = run.evaluate(command=command).figures
    here = {key: value for key, value in figures.origin.items() if key != "data"}  # that is a path of this machine
    errors: dict[str, list[SquaredError]] = {name: [] for name in PHASES}
    diverged, farthest, center = {}, 0.0, np.array(run.info.domain_center)
    with run.open() as dataset:
        for truth, result in long_rollouts(run, dataset, horizons):
            for phase, error in phase_errors(truth, result).items():
                errors[phase].append(error)
            if result.failure is not None:
                diverged[result.name] = result.failure
            reach = [float(np.abs(p - center).max()) for p in (result.position, truth.position)]
            farthest = max(farthest, reach[0] / reach[1])
    return MeasuredRun(
        figures=replace(figures, origin=here),
        parameters=run.model.num_parameters,
        phases={
            name: PhaseError(rmse_sequence(list_), rmse_pooled(list_))
            for name, list_ in errors.items()
            if any(error.count for error in list_)
        },
        horizons=horizons,
        diverged=diverged,
        farthest=farthest,
    )


def main() -> None:
    run_folder, horizons, file = sys.argv[1:]
    keep_memory()
    command = f"python -m benchmarks.studies.measure {run_folder} {horizons} {file}"
    write_json(Path(file), measure(Run(run_folder), int(horizons), command).to_json())


if __name__ == "__main__":
    main()

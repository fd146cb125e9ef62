"""What a study measures of a trained run, beside `ast_sim.evaluate`: errors by phase of contact, and long rollouts.

`python -m benchmarks.study_measure RUN HORIZONS FILE` evaluates the best checkpoint of a run on the test scenes of its
dataset. A scene is rolled out for HORIZONS times its length, its script played forward and backward in turn; the frames
of the first time are those that are compared with the truth.

Phases, by the area in contact that the solver recorded: `before` any contact; `first` is where contact begins and the
two frames after; `release` is all after the deepest frame; `full` the rest.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim import keep_memory
from ast_sim.data.scene import NodeType, Trajectory
from ast_sim.measures import SquaredError, rmse_pooled, rmse_sequence
from ast_sim.results import TrainedRun, evaluate_run, open_run, write_json
from ast_sim.rollout import Rollout, rollouts

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
    found = {"before": frames < start, "first": (frames >= start) & (frames < start + FIRST)}
    found["release"] = (frames > deepest) & (frames >= start + FIRST)
    found["full"] = (frames >= start + FIRST) & ~found["release"]
    return found


def repeated(truth: Trajectory, horizons: int) -> Trajectory:
    """The trajectory with its frames forward, backward, forward ... for so many times its length."""
    there, last = np.arange(1, truth.num_frames), truth.num_frames - 1
    order = np.concatenate([[0], *(there if i % 2 == 0 else last - there for i in range(horizons))])
    stress = None if truth.stress is None else truth.stress[order]
    return replace(truth, position=truth.position[order], stress=stress, cauchy_stress=None)


def phase_errors(truth: Trajectory, result: Rollout) -> dict[str, SquaredError]:
    """Errors of the positions of NORMAL nodes in each phase; nothing where the rollout failed on the way."""
    found, normal = phases(truth), truth.scene.node_type == NodeType.NORMAL
    if found is None or len(result.position) < truth.num_frames:
        return {}
    predicted = np.arange(truth.num_frames) >= result.given
    return {
        name: SquaredError.between(result.position[: truth.num_frames][rows], truth.position[rows], normal)
        for name, rows in ((name, frames & predicted) for name, frames in found.items())
    }


def long_rollouts(run: TrainedRun, horizons: int) -> Iterator[tuple[str, Trajectory, Rollout]]:
    """Every test scene and its rollout over all horizons."""
    for index in range(run.dataset.count("test")):
        name, truth = f"test/{index:06d}", run.dataset.load("test", index)
        yield name, truth, rollouts(run.model, [repeated(truth, horizons)], [name])[0]


def measure(run: TrainedRun, horizons: int, command: str) -> dict[str, Any]:
    """The evaluation of a run with `phases` (for each, `rmse_sequence` and `rmse_pooled`), `diverged` (what stopped a
    long rollout, by scene) and `farthest` (the largest distance in all of them from the centre of the domain over the
    largest in the truth)."""
    found = evaluate_run(run, "test", command)
    del found["data"]  # a path of this machine
    errors: dict[str, list[SquaredError]] = {name: [] for name in PHASES}
    diverged, farthest, center = {}, 0.0, np.array(run.dataset.info.domain_center)
    for name, truth, result in long_rollouts(run, horizons):
        for phase, error in phase_errors(truth, result).items():
            errors[phase].append(error)
        if result.failure is not None:
            diverged[name] = result.failure
        reach = [float(np.abs(p - center).max()) for p in (result.position, truth.position)]
        farthest = max(farthest, reach[0] / reach[1])
    return {
        **found,
        "parameters": sum(p.numel() for p in run.model.parameters()),
        "phases": {
            name: {"rmse_sequence": rmse_sequence(list_), "rmse_pooled": rmse_pooled(list_)}
            for name, list_ in errors.items()
            if any(error.count for error in list_)
        },
        "horizons": horizons,
        "diverged": diverged,
        "farthest": farthest,
    }


def main() -> None:
    run_folder, horizons, file = sys.argv[1:]
    keep_memory()
    with open_run(Path(run_folder)) as run:
        command = f"python -m benchmarks.study_measure {run_folder} {horizons} {file}"
        write_json(Path(file), measure(run, int(horizons), command))


if __name__ == "__main__":
    main()

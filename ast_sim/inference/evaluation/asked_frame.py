"""One frame of every scene, as a user asks for it: its errors, its time, and what the solver takes for the same answer.

The asked frame is the deepest: the free nodes are displaced most in it. The relative error is the root mean square of
the error over that of the displacement, over the free nodes in this frame. Times are of one thread, and count what is
prepared for a mesh, for the model and for the solver.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from ast_sim.dataset.reader import Dataset
from ast_sim.inference.effort import Effort, EffortErrors
from ast_sim.inference.jump import calls
from ast_sim.inference.predict import answers
from ast_sim.inference.question import Question
from ast_sim.mechanics.linearised_contact import STILL
from ast_sim.models.simulator import Simulator
from ast_sim.scene import Trajectory
from ast_sim.simulate.jobs.rival import Rivals, cheapest, deepest_frame, rivals
from ast_sim.support.errors import SimulationError


def asked_frames(
    model: Simulator,
    dataset: Dataset,
    split: str,
    effort: Effort,
    rival_scenes: int = 0,
    progress: Callable[[str], None] | None = None,
    made_from: str | os.PathLike[str] | None = None,
) -> dict[str, Any]:
    """Predict the deepest frame of each scene of a split, alone and on one thread.

    Args:
        effort: what follows the first call of a model that jumps.
        rival_scenes: in so many scenes the solver goes to the same frame, in several ways; see `simulate.jobs.rival`.
        made_from: the specification or the parts of which the dataset was made, if any; the solver needs them.

    Returns:
        scenes: for each its name, frame, nodes, displacement, relative_error, by_calls (the relative error after each
        call of a model that jumps, and after each Newton step, of the first start), seconds, last_step (the size of the
        last Newton step, None without one), stress_share (the stress error over that of the frame's true mean),
        largest_stress (relative error of the largest stress), and `solver` where it was run; their means
        (`relative_error`, `by_calls`, `stress_share`, `largest_stress`), the median of seconds; unsettled: the scenes
        whose Newton steps did not end;
        solver: sums over the scenes where it was run, None if there are none, and `no_solver` says why.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        indices = dataset.with_frames(split, model.config.given_frames + 1)
        scenes = []
        for index in indices:
            scenes.append(_scene(model, dataset, split, index, effort))
            if progress is not None:
                progress(scenes[-1]["name"])
    finally:
        torch.set_num_threads(threads)
    why = None
    try:
        indices, frames = indices[:rival_scenes], [scene["frame"] for scene in scenes[:rival_scenes]]
        found = rivals(dataset.path, split, indices, frames, made_from=made_from, progress=False) if indices else ()
        for scene, rival in zip(scenes, found, strict=False):
            scene["solver"] = _solver(rival, scene["relative_error"])
            if progress is not None:
                progress(scene["name"])
    except SimulationError as error:
        why = str(error)
    known = [scene for scene in scenes if scene["relative_error"] is not None]
    return {
        "scenes": scenes,
        **{key: _mean([scene[key] for scene in known]) for key in ("relative_error", "stress_share", "largest_stress")},
        "by_calls": np.mean([scene["by_calls"] for scene in known], axis=0).tolist() if known else [],
        "seconds": float(np.median([scene["seconds"] for scene in known])) if known else None,
        "unsettled": sum((scene["last_step"] or 0) > STILL for scene in known),
        "solver": _sums([scene for scene in known if "solver" in scene]),
        "no_solver": why,
    }


def errors_by_effort(model: Simulator, truth: Trajectory, most: Effort) -> list[EffortErrors]:
    """The errors at the deepest frame after each number of corrections and of Newton steps, up to `most`; empty where
    nothing is displaced."""
    frame = max(deepest_frame(truth), model.config.given_frames)
    if not _rms(truth.position[frame] - truth.position[0], ~truth.scene.prescribed):
        return []
    efforts = range(most.corrections + 1)
    return [errors for corrections in efforts for errors in _after(model, truth, frame, corrections, most.newton_steps)]


def _after(model: Simulator, truth: Trajectory, frame: int, corrections: int, most: int) -> list[EffortErrors]:
    """The errors after so many corrections and 0 to `most` Newton steps."""
    question = Question.of(truth, "validation", [frame])
    (way,) = calls(model, [question], Effort(corrections, most))
    if isinstance(way, str) and most:  # a Newton step failed; the calls before it still count
        (way,) = calls(model, [question], Effort(corrections))
    if isinstance(way, str):
        return [EffortErrors(Effort(corrections, steps), None, None, 0, 0) for steps in range(most + 1)]
    positions = way.position[corrections:]
    needed = int(way.steps[0]) + bool(way.last_step[0] > STILL)
    measured = []
    for steps in range(most + 1):
        effort = Effort(corrections, steps)
        if steps >= len(positions):
            measured.append(EffortErrors(effort, None, None, 0, 0))
            continue
        error = relative_error(positions[steps][0], truth, frame)
        stress = None if way.stress is None else way.stress[steps][0]
        stress_error = _stress_errors(truth, stress, frame, model.config.stress)["stress_share"]
        measured.append(EffortErrors(effort, error, stress_error, min(steps, needed), float(0 < steps < needed)))
    return measured


def lines(found: dict[str, Any]) -> list[str]:
    """The most important figures as sentences."""
    if found["relative_error"] is None:
        return ["the deepest frame: every prediction failed"]
    after = [f"{100 * error:.3g}" for error in found["by_calls"]]
    told = [
        f"the deepest frame at once: error {100 * found['relative_error']:.3g} % of the displacement,"
        f" {1000 * found['seconds']:.3g} ms on one thread"
    ]
    if len(after) > 1:
        told.append(f"  after each call, and each Newton step: {', '.join(after)} %")
    if found["unsettled"]:
        told.append(f"  in {found['unsettled']} of {len(found['scenes'])} scenes the Newton steps did not end")
    if found["stress_share"] is not None:
        told.append(
            f"  stress: {found['stress_share']:.2f} of the error of the frame's true mean; the largest is"
            f" {100 * found['largest_stress']:.3g} % off"
        )
    if found["solver"] is not None:
        told += _solver_lines(found["solver"])
    elif found["no_solver"] is not None:
        told.append(f"  the solver was not run: {found['no_solver']}")
    return told


def _solver_lines(solver: dict[str, Any]) -> list[str]:
    told = [
        f"  the solver for this frame: {1000 * solver['seconds']:.3g} ms, {solver['ratio']:.3g} times as long"
        f" (mean of {solver['scenes']} scenes, one thread)"
    ]
    if solver["cheapest_scenes"]:
        told.append(
            f"  its cheapest way with at most the model's error: {1000 * solver['cheapest_seconds']:.3g} ms,"
            f" {solver['cheapest_ratio']:.3g} times as long ({solver['cheapest_scenes']} scenes)"
        )
    return told


def _scene(model: Simulator, dataset: Dataset, split: str, index: int, effort: Effort) -> dict[str, Any]:
    name, truth = f"{split}/{index:06d}", dataset.load(split, index)
    frame = max(deepest_frame(truth), model.config.given_frames)
    question = Question.of(truth, name, [frame])
    began = time.perf_counter()
    (answer,) = answers(model, [question], effort)
    seconds = time.perf_counter() - began
    size = _rms(truth.position[frame] - truth.position[0], ~truth.scene.prescribed)
    failed = answer.failure is not None or not size  # where nothing moves, there is no relative error
    stress = None if answer.stress is None or answer.failure is not None else answer.stress[0]
    by_calls = []
    if model.config.jumps and not failed:
        (after,) = calls(model, [question], effort)
        positions = () if isinstance(after, str) else after.position
        by_calls = [relative_error(position[0], truth, frame) for position in positions]
    return {
        "name": name,
        "frame": frame,
        "nodes": truth.scene.num_nodes,
        "displacement": size,
        "relative_error": None if failed else relative_error(answer.position[0], truth, frame),
        "by_calls": by_calls,
        "seconds": seconds,
        "last_step": answer.last_steps[-1] if answer.last_steps else None,
        **_stress_errors(truth, stress, frame, model.config.stress),
    }


def relative_error(position: np.ndarray, truth: Trajectory, frame: int) -> float:
    """The error of the free nodes at positions [N, 3] in a frame, over their displacement, which must not be 0."""
    free, true = ~truth.scene.prescribed, truth.position[frame]
    return _rms(position - true, free) / _rms(true - truth.position[0], free)


def _rms(difference: np.ndarray, rows: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(difference[rows], dtype=np.float64))))


def _stress_errors(truth: Trajectory, stress: np.ndarray | None, frame: int, location: str) -> dict[str, float | None]:
    """The error of the stress on what deforms, relative to that of the frame's true mean; and by how much the largest
    is off. None where they say nothing."""
    if stress is None or truth.stress is None:
        return {"stress_share": None, "largest_stress": None}
    rows = truth.scene.deforming(location)
    there, found = truth.stress[frame].astype(np.float64), stress.astype(np.float64)
    spread, largest = float(there[rows].std()), float(there[rows].max())
    return {
        "stress_share": _rms(found - there, rows) / spread if spread else None,
        "largest_stress": abs(float(found[rows].max()) - largest) / largest if largest else None,
    }


def _solver(rival: Rivals, error: float | None) -> dict[str, Any]:
    """What the solver took: at its own stop test, and in each way; the cheapest has at most the model's error."""
    ways = {
        outcome.way.name: {
            "seconds": outcome.whole_seconds,
            "setup_seconds": outcome.setup_seconds,
            "relative_error": outcome.relative_error,
            "load_steps": outcome.load_steps,
            "newton_iterations": outcome.newton_iterations,
        }
        if outcome.converged
        else {"failure": outcome.failure}
        for outcome in rival.outcomes
    }
    best = None if error is None else cheapest(rival.outcomes, error)
    own = rival.outcomes[0]
    return {
        "seconds": own.whole_seconds if own.converged else None,
        "cheapest": None if best is None else best.way.name,
        "cheapest_seconds": None if best is None else best.whole_seconds,
        "ways": ways,
    }


def _sums(scenes: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Means over the scenes in which the solver converged, and its time over the model's in these scenes."""
    own = [scene for scene in scenes if scene["solver"]["seconds"] is not None]
    best = [scene for scene in scenes if scene["solver"]["cheapest_seconds"] is not None]
    if not own:
        return None
    found: dict[str, Any] = {"scenes": len(own), "cheapest_scenes": len(best)}
    for which, chosen in (("", own), ("cheapest_", best)):
        took = [scene["solver"][f"{which}seconds"] for scene in chosen]
        found[f"{which}seconds"] = _mean(took)
        found[f"{which}ratio"] = sum(took) / sum(scene["seconds"] for scene in chosen) if chosen else None
    return found


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None

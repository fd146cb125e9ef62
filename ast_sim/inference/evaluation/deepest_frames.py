"""The deepest frame of every scene, predicted alone: errors, times, and what the solver takes for the same answer.

In the deepest frame the free nodes are displaced most. The relative error is the root mean square of the error, divided
by the root mean square of the displacement, over the free nodes in this frame. Times are processor time of one thread,
and count what is prepared for a mesh, for the model and for the solver.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
import statistics
import time
from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch

from ast_sim.dataset.reader import Dataset
from ast_sim.figures import Beside, DeepestFrame, DeepestFrames, SolverFigures, VariantFigures
from ast_sim.inference.answering import answers
from ast_sim.inference.effort import Effort, EffortErrors
from ast_sim.inference.predicting.jump import AnswerSteps, answer_steps
from ast_sim.inference.predicting.question import Question
from ast_sim.inference.quantities.relative_errors import displacement, relative_error, stress_errors
from ast_sim.mechanics.linearised.linearised_contact import STILL
from ast_sim.models.simulator import Simulator
from ast_sim.number_arrays import measured_time, percent
from ast_sim.scene import Trajectory
from ast_sim.simulate.jobs.fastest_solver import UNMESHED, SolverOutcomes, cheapest, deepest_frame, solver_outcomes
from ast_sim.support.errors import ConfigError, SimulationError, counted


def deepest_frames(
    model: Simulator,
    dataset: Dataset,
    split: str,
    effort: Effort,
    solver_scenes: int = 0,
    advance: Callable[[str], None] = lambda name: None,
    made_from: str | os.PathLike[str] | None = None,
    most_scenes: int | None = None,
) -> DeepestFrames:
    """Predict the deepest frame of each scene of a split, alone and on one thread.

    Args:
        effort: what follows the first call of a model that jumps.
        solver_scenes: the number of scenes in which the solver goes to the same frame, in several variants; see
            `simulate.jobs.fastest_solver`.
        made_from: the specification or the parts of which the dataset was made, if any; the solver needs them.
        most_scenes: the number of scenes that are predicted, at most: the first ones of the split; None: all.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        indices = dataset.with_frames(split, model.config.data.given_frames + 1)[:most_scenes]
        scenes = []
        for index in indices:
            scenes.append(_scene(model, dataset, split, index, effort))
            advance(scenes[-1].name)
    finally:
        torch.set_num_threads(threads)
    first = scenes[:solver_scenes]
    outcomes = _solved(dataset, split, indices[:solver_scenes], [scene.frame for scene in first], made_from)
    solved, why = _with_solver(first, outcomes, advance)
    scenes = [*solved, *scenes[len(solved) :]]
    known = [scene for scene in scenes if scene.relative_error is not None]
    return DeepestFrames(
        scenes=tuple(scenes),
        relative_error=_mean([scene.relative_error for scene in known]),
        stress_share=_mean([scene.stress_share for scene in known]),
        largest_stress=_mean([scene.largest_stress for scene in known]),
        after_calls=_means([scene.after_calls for scene in known]),
        after_newton_steps=_means([scene.after_newton_steps for scene in known]),
        seconds=statistics.median(scene.seconds for scene in known) if known else None,
        not_converged=sum((scene.last_step or 0) > STILL for scene in known),
        solver=_beside([(scene, scene.solver.seconds) for scene in known if scene.solver]),
        cheapest=_beside([(scene, scene.solver.cheapest_seconds) for scene in known if scene.solver]),
        no_solver=why,
    )


def _solved(
    dataset: Dataset, split: str, indices: list[int], frames: list[int], made_from: str | os.PathLike[str] | None
) -> Iterable[SolverOutcomes]:
    """What the solver took to these frames; nothing, where none is wanted."""
    if indices:
        yield from solver_outcomes(dataset.path, split, indices, frames, made_from=made_from, progress=False)


def _with_solver(
    scenes: list[DeepestFrame], outcomes: Iterable[SolverOutcomes], advance: Callable[[str], None]
) -> tuple[list[DeepestFrame], str | None]:
    """The scenes with what the solver took; and why it ended before the last one, if it did. `advance` is called for
    each scene all the same, so that what counts them comes to its end."""
    solved: list[DeepestFrame] = []
    why = None
    try:
        for scene, one in zip(scenes, outcomes, strict=True):
            solved.append(dataclasses.replace(scene, solver=_solver(one, scene.relative_error)))
            advance(scene.name)
    except (ConfigError, SimulationError) as error:
        why = str(error)
    for scene in scenes[len(solved) :]:
        advance(scene.name)
    return solved, why


def deepest_predicted(model: Simulator, truth: Trajectory) -> int:
    """The number of the deepest frame, or of the first frame after the given ones if that comes later."""
    return max(deepest_frame(truth), model.config.data.given_frames)


def errors_by_effort(model: Simulator, truth: Trajectory, efforts: Sequence[Effort]) -> list[EffortErrors]:
    """The errors at the deepest frame after each number of Newton steps up to the one of each effort; empty where
    nothing is displaced."""
    frame = deepest_predicted(model, truth)
    if not displacement(truth, frame):
        return []
    return [errors for effort in efforts for errors in _after(model, truth, frame, effort)]


def _after(model: Simulator, truth: Trajectory, frame: int, most: Effort) -> list[EffortErrors]:
    """The errors after 0 Newton steps up to the number of an effort."""
    efforts = [dataclasses.replace(most, newton_steps=steps) for steps in range(most.newton_steps + 1)]
    outcome = _steps_to_answer(model, Question.of(truth, "validation", [frame]), most)
    if outcome is None:
        return [EffortErrors(effort, None, None, 0, 0) for effort in efforts]
    needed = int(outcome.steps[0]) + bool(outcome.last_step[0] > STILL)
    positions = [outcome.after_calls[-1], *outcome.after_newton_steps]
    stresses = [outcome.stress, *outcome.stress_after_newton_steps]
    measured = []
    for effort, position, stress in itertools.zip_longest(efforts, positions, stresses):
        if position is None:  # a Newton step failed
            measured.append(EffortErrors(effort, None, None, 0, 0))
            continue
        error = relative_error(position[0], truth, frame)
        in_frame = None if stress is None else stress[0]
        stress_error, _ = stress_errors(truth, in_frame, frame, model.config.data.stress)
        made = min(effort.newton_steps, needed)
        measured.append(EffortErrors(effort, error, stress_error, made, float(0 < effort.newton_steps < needed)))
    return measured


def _steps_to_answer(model: Simulator, question: Question, effort: Effort) -> AnswerSteps | None:
    """The steps to an answer, or its calls alone if a Newton step failed; None: these failed, too."""
    calls_alone = dataclasses.replace(effort, newton_steps=0, solved=False, solved_beyond=0.0)
    for tried in dict.fromkeys([effort, calls_alone]):
        (outcome,) = answer_steps(model, [question], tried)
        if not isinstance(outcome, str):
            return outcome
    return None


def lines(frames: DeepestFrames) -> list[str]:
    """The most important figures as sentences."""
    of_all = counted(len(frames.scenes), "scene")
    still = sum(not scene.displacement for scene in frames.scenes)
    failed = sum(scene.relative_error is None for scene in frames.scenes) - still
    if frames.relative_error is None or frames.seconds is None:
        nothing = f"nothing moves in {still} of {of_all}, so there is no relative error" if still else ""
        return [f"the deepest frame: {'; '.join(filter(None, ['every prediction failed' if failed else '', nothing]))}"]
    after = [f"{100 * error:.3g}" for error in (*frames.after_calls, *frames.after_newton_steps)]
    told = [
        f"the deepest frame at once: error {percent(frames.relative_error, 3)} of the displacement,"
        f" {measured_time(frames.seconds)} in the median, on one thread"
    ]
    if len(after) > 1:
        told.append(f"  after each call, and each Newton step: {', '.join(after)} %")
    for count, why in ((still, "in which nothing moves"), (failed, "whose prediction failed")):
        if count:
            told.append(f"  without {count} of {of_all}, {why}")
    if frames.not_converged:
        told.append(f"  in {frames.not_converged} of {of_all} the Newton steps have not converged")
    if frames.stress_share is not None and frames.largest_stress is not None:
        told.append(
            f"  stress: {frames.stress_share:.2f} of the error of the frame's true mean; the largest is"
            f" {percent(frames.largest_stress, 3)} off"
        )
    if frames.no_solver is not None:
        told.append(f"  the solver was not run: {frames.no_solver}")
    for what, beside in (
        ("the solver for this frame", frames.solver),
        ("its fastest setting that is as accurate", frames.cheapest),
    ):
        if beside is not None:
            told.append(
                f"  {what}: {measured_time(beside.seconds)}, {beside.ratio:.3g} times as long (medians of"
                f" {counted(beside.scenes, 'scene')}, one thread)"
            )
    return told + _unmeshed(frames.scenes)


def _unmeshed(scenes: Iterable[DeepestFrame]) -> list[str]:
    """In how many scenes the solver has no coarser mesh, so that variants which begin on one are missing, and why."""
    solvers = [scene.solver for scene in scenes if scene.solver is not None]
    failures = [[one.failure for one in solver.variants.values() if one.failure is not None] for solver in solvers]
    reasons = [next((why for why in each if why.startswith(UNMESHED)), None) for each in failures]
    without = [why for why in reasons if why is not None]
    if not without:
        return []
    return [
        f"  in {len(without)} of {counted(len(solvers), 'scene')} the solver has no coarser mesh to begin on, also not"
        f" for nested iteration: {without[0]}"
    ]


def _scene(model: Simulator, dataset: Dataset, split: str, index: int, effort: Effort) -> DeepestFrame:
    name = f"{split}/{index:06d}"
    truth = dataset.load(split, index)
    frame = deepest_predicted(model, truth)
    question = Question.of(truth, name, [frame])
    began = time.process_time()  # as of the solver: other work on the machine does not count
    (answer,) = answers(model, [question], effort)
    seconds = time.process_time() - began
    size = displacement(truth, frame)
    failed = answer.failure is not None or not size  # where nothing moves, there is no relative error
    stress = None if answer.stress is None or answer.failure is not None else answer.stress[0]
    outcome = _steps_to_answer(model, question, effort) if model.config.scheme.corrects and not failed else None
    after_calls = [] if outcome is None else outcome.after_calls
    after_newton_steps = [] if outcome is None else outcome.after_newton_steps
    share, largest = stress_errors(truth, stress, frame, model.config.data.stress)
    return DeepestFrame(
        name=name,
        nodes=truth.scene.num_nodes,
        frame=frame,
        displacement=size,
        relative_error=None if failed else relative_error(answer.position[0], truth, frame),
        after_calls=tuple(relative_error(position[0], truth, frame) for position in after_calls),
        after_newton_steps=tuple(relative_error(position[0], truth, frame) for position in after_newton_steps),
        seconds=seconds,
        last_step=answer.last_steps[-1] if answer.last_steps else None,
        stress_share=share,
        largest_stress=largest,
    )


def _solver(scene: SolverOutcomes, error: float | None) -> SolverFigures:
    """What the solver took: at its own stop test, and in each variant; the cheapest has at most the model's error."""
    variants = {
        outcome.variant.name: VariantFigures(
            seconds=outcome.whole_seconds,
            setup_seconds=outcome.setup_seconds,
            relative_error=outcome.relative_error,
            load_steps=outcome.load_steps,
            newton_iterations=outcome.newton_iterations,
        )
        if outcome.converged
        else VariantFigures(failure=outcome.failure)
        for outcome in scene.outcomes
    }
    best = None if error is None else cheapest(scene.outcomes, error)
    own = scene.outcomes[0]
    return SolverFigures(
        seconds=own.whole_seconds if own.converged else None,
        cheapest=None if best is None else best.variant.name,
        cheapest_seconds=None if best is None else best.whole_seconds,
        variants=variants,
    )


def _beside(scenes: list[tuple[DeepestFrame, float | None]]) -> Beside | None:
    """The scenes with the solver's seconds, as medians."""
    both = [(seconds, scene.seconds) for scene, seconds in scenes if seconds is not None]
    if not both:
        return None
    solver, model = zip(*both, strict=True)
    ratio = statistics.median(theirs / ours for theirs, ours in both)
    return Beside(len(both), statistics.median(solver), statistics.median(model), ratio)


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _means(of_scenes: list[tuple[float, ...]]) -> tuple[float, ...]:
    """The mean after each step over the scenes that have any."""
    known = [errors for errors in of_scenes if errors]
    return tuple(np.mean(known, axis=0).tolist()) if known else ()

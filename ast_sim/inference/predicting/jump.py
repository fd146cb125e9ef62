"""Jumps: each wanted frame is predicted at once from the first frame, then corrected; no other frame is computed.

The start is the first frame, carried along by the prescribed nodes. Where the material yields, it is the last frame in
which the motion turned back, if it did; such frames are predicted before the others. Each call of the model gets the
answer of the call before and predicts what is missing. Newton steps of the solver may follow. The model predicts the
frames of all scenes side by side, in ragged batches. With friction, Newton steps know the load path as far as the
frames before are wanted, too; in all else a frame does not depend on others than its start. The bundled solver may end
an answer (`Effort.solved`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
from torch import Tensor

from ast_sim.batches.carry import Carrier
from ast_sim.inference.answer import Answer
from ast_sim.inference.effort import AGAIN, MOST_NEWTON_STEPS, Effort
from ast_sim.inference.predicting.jumping_scene import JumpingFrame, JumpingScene
from ast_sim.inference.predicting.predicted_frames import predict_frames
from ast_sim.inference.predicting.question import Question, law_of, not_finite, too_far
from ast_sim.models.simulator import Simulator
from ast_sim.named_field import STRESS
from ast_sim.support.errors import RolloutError
from ast_sim.support.progress import Progress, ShowProgress

BATCH_NODES = 4096  # at most, of frames that are predicted together, unless a single one has more


def jumps(
    model: Simulator,
    questions: Sequence[Question],
    effort: Effort,
    progress: ShowProgress = False,
) -> list[Answer]:
    """Predict the wanted frames of several scenes; the other scenes of a batch do not change a frame.

    If a frame fails, the answer of its scene says why in `failure` and keeps the frames before. `progress`
    (`support.progress`) counts frames; a function may raise to stop.

    Args:
        effort: what follows the first call.

    Raises:
        RolloutError: a scene has no frame to predict.
        DatasetError: in a scene nothing can deform.
        ConfigError: the model cannot make this effort.
    """
    return [scene.answer() for scene in _predicted(model, questions, effort, progress)]


@dataclass(frozen=True, eq=False)
class AnswerSteps:
    """The S wanted frames of a scene on the way to the answer, as far as the Newton steps lead.

    Where a frame needed fewer Newton steps than another, its last positions and stresses are repeated.

    Attributes:
        after_calls: for the first call and each correction [S, N, 3] float32.
        after_newton_steps: for each Newton step [S, N, 3] float32.
        stress: [S, N or E, 1] float32, after the last call; None without stress.
        stress_after_newton_steps: for each Newton step [S, N or E, 1] float32; empty without stress.
        steps: [S], the Newton steps that were made.
        last_step: [S], the size of the last one, NaN where none was made.
    """

    after_calls: list[np.ndarray]
    after_newton_steps: list[np.ndarray]
    stress: np.ndarray | None
    stress_after_newton_steps: list[np.ndarray]
    steps: np.ndarray
    last_step: np.ndarray


def answer_steps(model: Simulator, questions: Sequence[Question], effort: Effort) -> list[AnswerSteps | str]:
    """For each scene the steps to its answer, or a text that says why a frame failed. Arguments and errors as for
    `jumps`; the solver is left out."""
    outcomes: list[AnswerSteps | str] = []
    for scene in _predicted(model, questions, replace(effort, solved=False, solved_beyond=0.0), each_step=True):
        if scene.failure is not None:
            outcomes.append(scene.failure)
            continue
        wanted = scene.wanted
        known = [frame.fields for frame in wanted if model.config.data.stress != "none"]
        stresses = _by_step([[one[STRESS] for one in fields] for fields in known], 1 + effort.newton_steps)
        outcomes.append(
            AnswerSteps(
                _by_step([frame.after_calls for frame in wanted], 1 + effort.corrections),
                _by_step([frame.after_newton_steps for frame in wanted], effort.newton_steps),
                stresses[0] if stresses else None,
                stresses[1:],
                np.array([len(frame.after_newton_steps) for frame in wanted]),
                np.array([np.nan if frame.last_step is None else frame.last_step for frame in wanted]),
            )
        )
    return outcomes


def _by_step(rows: list[list[Tensor]], count: int) -> list[np.ndarray]:
    """`count` times [S, ...]: what each frame has after each step, its last one again where it has fewer."""
    padded = [of_frame + of_frame[-1:] * (count - len(of_frame)) for of_frame in rows]
    return [torch.stack(same).numpy() for same in zip(*padded, strict=True)]


def _predicted(
    model: Simulator,
    questions: Sequence[Question],
    effort: Effort,
    progress: ShowProgress = False,
    each_step: bool = False,
) -> list[JumpingScene]:
    """The scenes with their predicted frames. `each_step`: the stress after each Newton step, and no second start."""
    effort.check(model.config)
    for question in questions:
        question.check(model.config.data.given_frames)
    # Several questions may share a scene.
    graph = cache(model.graph)
    carrier = cache(Carrier)
    solver = cache(law_of(model.config).newton_steps)
    with model.predicting():
        scenes = [JumpingScene(model, q, graph(q.scene), carrier(q.scene), solver) for q in questions]
        frames = [frame for scene in scenes for frame in scene.frames]
        with Progress(len(frames), "frames", progress) as bar:
            for wave in _waves(scenes):
                for group in _groups(model, wave):
                    _predict(model, group, effort)
                    if not effort.newton_steps and not effort.solved:
                        bar.advance(group[-1].name, len(group))
            # In ascending order, whatever the domains: with friction a frame needs to know the one before.
            for frame in frames if effort.newton_steps else ():
                frame.refine(effort.newton_steps, each_step, bar)
                if not each_step and effort.newton_steps >= MOST_NEWTON_STEPS and frame.not_converged:
                    _start_again(model, frame, effort, bar)
                if not effort.solved:
                    bar.advance(frame.name)
            for frame in frames if effort.solved else ():
                if frame.moved(effort.corrections) >= effort.solved_beyond:
                    frame.solve()
                bar.advance(frame.name)
    return scenes


def _start_again(model: Simulator, frame: JumpingFrame, effort: Effort, progress: Progress) -> None:
    """Newton steps need a nearly right start: more corrections give a better one."""
    first = (frame.after_calls, frame.after_newton_steps, frame.fields, frame.last_step)
    spent = frame.seconds
    _predict(model, [frame], replace(effort, corrections=effort.corrections + AGAIN))
    frame.refine(effort.newton_steps, False, progress)
    frame.seconds += spent
    if frame.failure is not None:  # the first answer at least says that it has not converged
        frame.failure = None
        (frame.after_calls, frame.after_newton_steps, frame.fields, frame.last_step) = first


def _waves(scenes: Sequence[JumpingScene]) -> Iterator[list[JumpingFrame]]:
    """The frames of all scenes with their starts: first the frames that start from a given frame, then, when these are
    predicted, the frames that start from one of these, and so on."""
    frames = [frame for scene in scenes for frame in scene.frames]
    for depth in range(1 + max((frame.depth for frame in frames), default=-1)):
        wave = [frame for frame in frames if frame.depth == depth]
        for frame in wave:
            frame.begin()
        yield [frame for frame in wave if frame.failure is None]


def _groups(model: Simulator, frames: Sequence[JumpingFrame]) -> Iterator[list[JumpingFrame]]:
    """The frames in batches. Only frames in the same domain are predicted together."""
    of_domain: dict[int, list[JumpingFrame]] = {}
    for frame in frames:
        position = frame.start.state.position
        domain = model.domain(position)
        if domain is None:
            frame.failure = too_far(model.config, frame.scene.question.name, frame.number, position)
        else:
            of_domain.setdefault(domain, []).append(frame)
    for together in of_domain.values():
        group: list[JumpingFrame] = []
        for frame in together:
            if group and sum(len(other.start.prescribed_position) for other in [*group, frame]) > BATCH_NODES:
                yield group
                group = []
            group.append(frame)
        yield group


def _predict(model: Simulator, group: list[JumpingFrame], effort: Effort) -> None:
    """Predict the frames of a batch."""
    try:
        predicted = predict_frames(model, [frame.start for frame in group], effort)
    except RolloutError as error:
        if len(group) > 1:  # one frame must not spoil the others
            for frame in group:
                _predict(model, [frame], effort)
        else:
            group[0].failure = f"{group[0].name}: {error}"
        return
    for frame, (after_calls, fields, latent, seconds) in zip(group, predicted, strict=True):
        frame.failure = not_finite(model.config, frame.scene.question.name, frame.number, after_calls[-1], fields)
        frame.after_calls = after_calls
        frame.after_newton_steps = []
        frame.fields = [fields]
        frame.latent = latent
        frame.seconds = seconds

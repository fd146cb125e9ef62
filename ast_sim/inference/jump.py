"""Jumps: each wanted frame is predicted at once from the first frame, then corrected; no other frame is computed.

The start is the first frame, carried along by the prescribed nodes. Where the material yields, it is the last frame in
which the motion turned back, if it did; such frames are predicted before the others. Each call of the model gets the
answer of the call before and predicts what is missing. Newton steps of the solver may follow. The model predicts the
frames of all scenes side by side, in ragged batches. With friction, Newton steps know the way of the load as far as the
frames before are wanted, too; in all else a frame does not depend on others than its start. The bundled solver may end
an answer (`Effort.solved`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from itertools import takewhile
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ast_sim.batches.batch_builder import State
from ast_sim.batches.carry import Carrier
from ast_sim.batches.graph import Graph
from ast_sim.batches.turning_points import jump_sources
from ast_sim.inference.answer import Answer
from ast_sim.inference.effort import AGAIN, MOST_NEWTON_STEPS, Effort, law_of, newton_steps
from ast_sim.inference.predict_batch import Start, predict_batch
from ast_sim.inference.question import Question, not_finite, too_far
from ast_sim.mechanics.equilibria import Equilibria
from ast_sim.mechanics.linearised_contact import STILL, NewtonSteps
from ast_sim.models.simulator import Simulator
from ast_sim.named_field import STRESS
from ast_sim.scene import Scene
from ast_sim.support.errors import RolloutError, SimulationError

BATCH_NODES = 4096  # frames are predicted together as long as they have at most about so many nodes


def jumps(
    model: Simulator,
    questions: Sequence[Question],
    effort: Effort,
    progress: Callable[[int], None] | None = None,
) -> list[Answer]:
    """Predict the wanted frames of several scenes; the other scenes of a batch do not change a frame.

    If a frame fails, the answer of its scene says why in `failure` and keeps the frames before. `progress` is called
    with the number of each batch and may raise to stop.

    Args:
        effort: what follows the first call.

    Raises:
        RolloutError: a scene has no frame to predict.
        DatasetError: in a scene nothing can deform.
        ConfigError: the model cannot make this effort.
    """
    return [scene.answer() for scene in _predicted(model, questions, effort, progress)]


class Way(NamedTuple):
    """The wanted frames of a scene on the way to the answer.

    Attributes:
        position: [1 + corrections + Newton steps, S, N, 3] float32, after the first call, each correction, and each
            Newton step. Where a frame needed fewer Newton steps, its last positions are repeated; stress likewise.
        stress: [1 + Newton steps, S, N or E, 1] float32, after the last call and each Newton step; None without stress.
        steps: [S], the Newton steps that were made.
        last_step: [S], the size of the last one, NaN where none was made.
    """

    position: np.ndarray
    stress: np.ndarray | None
    steps: np.ndarray
    last_step: np.ndarray


def calls(model: Simulator, questions: Sequence[Question], effort: Effort) -> list[Way | str]:
    """For each scene the way to its answer, or a text that says why a frame failed. Arguments and errors as for
    `jumps`."""
    ways: list[Way | str] = []
    for scene in _predicted(model, questions, effort, None, whole_way=True):
        if scene.failure is not None:
            ways.append(scene.failure)
            continue
        count = 1 + effort.corrections + effort.newton_steps
        wanted = scene.wanted
        position = [_stacked(frame.positions, count) for frame in wanted]
        known = [frame for frame in wanted if model.config.data.stress != "none"]
        stress = [_stacked([one[STRESS] for one in frame.fields], 1 + effort.newton_steps) for frame in known]
        steps = np.array([len(frame.positions) - 1 - effort.corrections for frame in wanted])
        last = np.array([np.nan if frame.last_step is None else frame.last_step for frame in wanted])
        ways.append(Way(np.stack(position, axis=1), np.stack(stress, axis=1) if stress else None, steps, last))
    return ways


def _stacked(rows: list, count: int) -> np.ndarray:
    """The rows, and the last one again until they are so many."""
    return torch.stack([*rows, *[rows[-1]] * (count - len(rows))]).numpy()


def _predicted(
    model: Simulator,
    questions: Sequence[Question],
    effort: Effort,
    progress: Callable[[int], None] | None,
    whole_way: bool = False,
) -> list[_JumpingScene]:
    """The scenes with their predicted frames. `whole_way`: the stress after each Newton step, and no second start."""
    effort.check(model.config)
    for question in questions:
        question.check(model.config.data.given_frames)
    # Several questions may share a scene.
    graph, carrier, solver = cache(model.graph), cache(Carrier), cache(partial(newton_steps, model.config))
    scenes = [_JumpingScene(model, q, graph(q.scene), carrier(q.scene), solver) for q in questions]
    with model.predicting():
        for number, group in enumerate(group for wave in _waves(scenes) for group in _groups(model, wave)):
            _predict(model, group, effort.corrections)
            if progress is not None:
                progress(number)
        # In ascending order, whatever the domains: with friction a frame needs to know the one before.
        for frame in (frame for scene in scenes for frame in scene.frames if effort.newton_steps):
            frame.refine(effort.newton_steps, whole_way)
            if not whole_way and effort.newton_steps >= MOST_NEWTON_STEPS and frame.unsettled:
                _start_again(model, frame, effort)
        for frame in (frame for scene in scenes for frame in scene.frames if effort.solved):
            frame.solve()
    return scenes


def _start_again(model: Simulator, frame: _Frame, effort: Effort) -> None:
    """Newton steps need a nearly right start: more corrections give a better one."""
    first, spent = (frame.positions, frame.fields, frame.last_step), frame.seconds
    _predict(model, [frame], effort.corrections + AGAIN)
    frame.refine(effort.newton_steps, every_stress=False)
    frame.seconds += spent
    if frame.failure is not None:  # the first answer at least says that it has not converged
        frame.failure, (frame.positions, frame.fields, frame.last_step) = None, first


@dataclass(eq=False)
class _Frame:
    """A frame to predict.

    Attributes:
        source: the frame that it starts from; None: the first one, which is given.
        start: made when the source is predicted.
        positions: after each call and each Newton step.
        fields: after the last call and after Newton steps, which change the stress alone.
        last_step: the size of the last Newton step.
        latent: what the network made of it in the first call.
        walked: whether the solver went the way of the load; None: it was not asked.
    """

    scene: _JumpingScene
    number: int
    source: _Frame | None
    start: Start = field(init=False)
    positions: list[Tensor] = field(default_factory=list)
    fields: list[dict[str, Tensor]] = field(default_factory=list)
    last_step: float | None = None
    latent: np.ndarray | None = None
    walked: bool | None = None
    seconds: float = 0.0
    failure: str | None = None

    @property
    def depth(self) -> int:
        """How many frames are predicted one after another before this one."""
        return 0 if self.source is None else 1 + self.source.depth

    @property
    def name(self) -> str:
        return f"{self.scene.question.name} frame {self.number}"

    def begin(self) -> None:
        """Make the start, when the source is predicted."""
        scene, source = self.scene, self.source
        if source is None:
            state = scene.state(scene.question.prescribed_position[0], scene.fields[0], self.number)
        elif source.failure is None:
            state = scene.state(source.positions[-1].numpy(), source.fields[-1], self.number)
        else:
            self.failure = source.failure
            return
        self.start = Start(self.name, scene.graph, state, scene.prescribed_position[self.number])

    @property
    def unsettled(self) -> bool:
        """Whether the Newton steps did not end."""
        return self.failure is None and self.last_step is not None and self.last_step > STILL

    def refine(self, most: int, every_stress: bool) -> None:
        """Make Newton steps from the answer of the model until one is `STILL`; the stress then is that of the material.

        Friction resists slip from the frame before, where that is wanted, too. The stress is that of the last step, or
        of every one.
        """
        if self.failure is not None:
            return
        began = time.perf_counter()
        location = self.scene.model.config.data.stress
        try:
            solver = self.scene.solver(self.scene.question.scene)
            position = _array(self.positions[-1])
            stuck = self.scene.settled(self.number - 1)
            for step in range(1, most + 1):
                before = position
                position = solver.step(position, from_afar=step == 1, stuck=stuck)
                self.positions.append(torch.from_numpy(position.astype(np.float32)))
                self.last_step = solver.size(before, position)
                ends = step == most or self.last_step <= STILL
                if location != "none" and (every_stress or ends):
                    stress = torch.from_numpy(solver.von_mises(position, location))
                    self.fields.append({**self.fields[-1], STRESS: stress})
                if ends:
                    break
        except SimulationError as error:
            self.failure = f"{self.name}: a Newton step failed: {error}"
        self.seconds += time.perf_counter() - began

    def solve(self) -> None:
        """Have the solver go on to its stop test, from where the Newton steps have ended, if they have not failed."""
        if not self.positions:  # the model has failed
            return
        began = time.perf_counter()
        location = self.scene.model.config.data.stress
        start = _array(self.positions[-1]) if self.failure is None else None
        try:
            position, self.walked = self.scene.equilibria.solve(self.number, start)
            self.failure, self.last_step = None, 0.0
            self.positions.append(torch.from_numpy(position.astype(np.float32)))
            if location != "none":
                stress = self.scene.solver(self.scene.question.scene).von_mises(position, location)
                self.fields.append({**self.fields[-1], STRESS: torch.from_numpy(stress)})
        except SimulationError as error:
            self.failure = f"{self.name}: the solver found no equilibrium: {error}"
        self.seconds += time.perf_counter() - began


@dataclass(eq=False)
class _JumpingScene:
    """A scene and the frames of it that are predicted, in ascending order: those that are wanted, and those that they
    start from."""

    model: Simulator
    question: Question
    graph: Graph
    carry: Carrier
    solver: Callable[[Scene], NewtonSteps]
    frames: list[_Frame] = field(default_factory=list)

    def __post_init__(self) -> None:
        question, self.given = self.question, self.model.config.data.given_frames
        self.prescribed_position = torch.tensor(question.prescribed_position)
        self.fields = question.given_fields(self.model.config.data, self.given)
        self.history = self.model.config.history
        sources = np.zeros(len(question.prescribed_position), np.int64)
        if self.history is not None:
            sources = jump_sources(question.prescribed_position, question.scene.prescribed)
        needed: set[int] = set()
        for number in question.wanted():
            while number >= self.given and number not in needed:
                needed.add(number)
                number = int(sources[number])
        by_number: dict[int, _Frame] = {}
        for number in sorted(needed):
            by_number[number] = _Frame(self, number, by_number.get(int(sources[number])))
        self.frames += by_number.values()

    @property
    def wanted(self) -> list[_Frame]:
        """The frames that are wanted, in ascending order."""
        return [frame for frame in self.frames if frame.number in self.question.wanted()]

    def state(self, position: np.ndarray, fields: dict[str, Tensor], number: int) -> State:
        """The positions [N, 3] and fields of a frame, carried along to a later one."""
        carried = torch.from_numpy(self.carry(position, self.question.prescribed_position[number]))
        state = State(carried, stress=fields.get(STRESS))
        if self.history is None:
            return state
        return replace(state, source=torch.tensor(position), history=self.graph.at_nodes(self.history, fields))

    @cached_property
    def equilibria(self) -> Equilibria:
        """What the solver finds in this scene."""
        return Equilibria(self.question.scene, law_of(self.model.config), self.question.prescribed_position)

    def settled(self, number: int) -> np.ndarray | None:
        """The positions [N, 3] of a wanted frame that is given or has had its Newton steps, else None."""
        if number < self.given:
            return _array(self.prescribed_position[number]) if number in self.question.wanted() else None
        done = (frame for frame in self.frames if frame.last_step is not None and frame.failure is None)
        return next((_array(frame.positions[-1]) for frame in done if frame.number == number), None)

    @property
    def failure(self) -> str | None:
        """Why the first frame that failed did so."""
        return next((frame.failure for frame in self.frames if frame.failure), None)

    def answer(self) -> Answer:
        """The frames before the first that failed."""
        predicted = list(takewhile(lambda frame: frame.failure is None, self.wanted))
        frames = dict(enumerate(zip(self.prescribed_position[: self.given], self.fields, strict=True)))
        return self.question.answer(
            self.model.config,
            frames | {frame.number: (frame.positions[-1], frame.fields[-1]) for frame in predicted},
            [frame.seconds for frame in predicted],
            self.failure and f"{self.failure}; the frames before it are kept",
            {frame.number: frame.latent for frame in predicted},
            tuple(frame.last_step for frame in predicted if frame.last_step is not None),
            _solved(predicted),
        )


def _solved(frames: Sequence[_Frame]) -> dict[str, str]:
    """How the solver reached the frames, as a fact of an answer; empty if it was not asked."""
    ways = {frame.walked for frame in frames} - {None}
    if not ways:
        return {}
    way = "along the way of the load, frame by frame" if True in ways else "from the answer of the model"
    return {"solved": f"solved to the stop test of the solver, {way}"}


def _array(positions: Tensor) -> np.ndarray:
    return positions.numpy().astype(np.float64)


def _waves(scenes: Sequence[_JumpingScene]) -> Iterator[list[_Frame]]:
    """The frames of all scenes with their starts: those that start from a given frame, then, when these are predicted,
    those that start from one of these, and so on."""
    frames = [frame for scene in scenes for frame in scene.frames]
    for depth in range(1 + max((frame.depth for frame in frames), default=-1)):
        wave = [frame for frame in frames if frame.depth == depth]
        for frame in wave:
            frame.begin()
        yield [frame for frame in wave if frame.failure is None]


def _groups(model: Simulator, frames: Sequence[_Frame]) -> Iterator[list[_Frame]]:
    """The frames in batches. Only frames in the same domain are predicted together."""
    of_domain: dict[int, list[_Frame]] = {}
    for frame in frames:
        position = frame.start.state.position
        domain = model.domain(position)
        if domain is None:
            frame.failure = too_far(model.config, frame.scene.question.name, frame.number, position)
        else:
            of_domain.setdefault(domain, []).append(frame)
    for together in of_domain.values():
        group: list[_Frame] = []
        for frame in together:
            if group and sum(len(other.start.prescribed) for other in [*group, frame]) > BATCH_NODES:
                yield group
                group = []
            group.append(frame)
        yield group


def _predict(model: Simulator, group: list[_Frame], corrections: int) -> None:
    """Predict the frames of a batch."""
    try:
        predicted = predict_batch(model, [frame.start for frame in group], corrections + 1)
    except RolloutError as error:
        if len(group) > 1:  # one frame must not spoil the others
            for frame in group:
                _predict(model, [frame], corrections)
        else:
            group[0].failure = f"{group[0].name}: {error}"
        return
    for frame, (positions, fields, latent, seconds) in zip(group, predicted, strict=True):
        frame.failure = not_finite(model.config, frame.scene.question.name, frame.number, positions[-1], fields)
        frame.positions, frame.fields, frame.latent, frame.seconds = positions, [fields], latent, seconds

"""A scene that is predicted by jumps, and its frames on the way to the answer."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import takewhile

import numpy as np
import torch
from torch import Tensor

from ast_sim.batches.batch_builder import State
from ast_sim.batches.carry import Carrier
from ast_sim.batches.graph import Graph
from ast_sim.inference.answer import Answer
from ast_sim.inference.predicting.predicted_frames import Start
from ast_sim.inference.predicting.question import Question, law_of
from ast_sim.mechanics.equilibria import Equilibria
from ast_sim.mechanics.linearised.linearised_contact import STILL, NewtonSteps
from ast_sim.models.simulator import Simulator
from ast_sim.named_field import STRESS
from ast_sim.scene import Scene
from ast_sim.support.errors import SimulationError
from ast_sim.support.progress import Patience, Progress


@dataclass(eq=False)
class JumpingFrame:
    """A frame to predict.

    Attributes:
        source: the frame that it starts from; None: the first one, which is given.
        start: made when the source is predicted.
        after_calls, after_newton_steps: positions after each call and after each Newton step.
        solution: positions where the solver ended; None: it did not solve the frame.
        fields: after the last call, after Newton steps and of the solution; these change the stress alone.
        last_step: the size of the last Newton step.
        latent: what the network made of it in the first call.
        along_load_path: whether the solver followed the load path; None: it did not solve the frame.
    """

    scene: JumpingScene
    number: int
    source: JumpingFrame | None
    start: Start = field(init=False)
    after_calls: list[Tensor] = field(default_factory=list)
    after_newton_steps: list[Tensor] = field(default_factory=list)
    solution: Tensor | None = None
    fields: list[dict[str, Tensor]] = field(default_factory=list)
    last_step: float | None = None
    latent: np.ndarray | None = None
    along_load_path: bool | None = None
    seconds: float = 0.0
    failure: str | None = None

    @property
    def depth(self) -> int:
        """How many frames are predicted one after another before this one."""
        return 0 if self.source is None else 1 + self.source.depth

    @property
    def name(self) -> str:
        return f"{self.scene.question.name} frame {self.number}"

    @property
    def position(self) -> Tensor:
        """The positions after all that was computed so far."""
        return (self.after_newton_steps or self.after_calls)[-1] if self.solution is None else self.solution

    def begin(self) -> None:
        """Make the start, when the source is predicted."""
        scene = self.scene
        source = self.source
        if source is None:
            state = scene.state(scene.question.prescribed_position[0], scene.fields[0], self.number)
        elif source.failure is None:
            state = scene.state(source.position.numpy(), source.fields[-1], self.number)
        else:
            self.failure = source.failure
            return
        self.start = Start(self.name, scene.graph, state, scene.prescribed_position[self.number])

    @property
    def not_converged(self) -> bool:
        """Whether Newton steps were made and have not converged."""
        return self.failure is None and self.last_step is not None and self.last_step > STILL

    def refine(self, most: int, every_stress: bool, progress: Progress) -> None:
        """Make Newton steps from the answer of the model until one is `STILL`. The law of the material then gives the
        stress.

        Friction resists slip from the frame before, where that is wanted, too. There is a stress for the last step, or
        for every one. `progress` tells of steps that take long.
        """
        if self.failure is not None:
            return
        began = time.perf_counter()
        location = self.scene.model.config.data.stress
        try:
            solver = self.scene.solver(self.scene.question.scene)
            position = _array(self.position)
            stuck = self.scene.refined_position(self.number - 1)
            patience = Patience(progress)
            for step in range(1, most + 1):
                told = f"{self.name}: Newton step {step} of at most {most}"
                patience.tell(told)
                solver.watch = lambda forces, told=told: patience.tell(f"{told}, {forces:,} forces of contact so far")
                before = position
                position = solver.step(position, from_afar=step == 1, stuck=stuck)
                self.after_newton_steps.append(torch.from_numpy(position.astype(np.float32)))
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

    def moved(self, corrections: int) -> float:
        """How far the Newton steps have moved the model's answer after these corrections, as a share of the
        displacement of the free nodes; infinite where a step has failed."""
        if self.failure is not None:
            return math.inf
        scene = self.scene.question.scene
        free = scene.deforming_nodes & ~scene.prescribed
        end = _array(self.position)[free]
        move = np.linalg.norm(end - _array(self.after_calls[corrections])[free])
        return float(move / max(np.linalg.norm(end - scene.rest_position[free]), np.finfo(float).tiny))

    def solve(self) -> None:
        """Have the solver go on to its stop test, from where the Newton steps have ended, if they have not failed."""
        if not self.after_calls:  # the model has failed
            return
        began = time.perf_counter()
        location = self.scene.model.config.data.stress
        start = _array(self.position) if self.failure is None else None
        try:
            position, self.along_load_path = self.scene.equilibria.solve(self.number, start)
            self.failure = None
            self.last_step = 0.0
            self.solution = torch.from_numpy(position.astype(np.float32))
            if location != "none":
                stress = self.scene.solver(self.scene.question.scene).von_mises(position, location)
                self.fields.append({**self.fields[-1], STRESS: torch.from_numpy(stress)})
        except SimulationError as error:
            self.failure = f"{self.name}: the solver found no equilibrium: {error}"
        self.seconds += time.perf_counter() - began


@dataclass(eq=False)
class JumpingScene:
    """A scene and the frames of it that are predicted, in ascending order: the wanted frames, and the frames that they
    start from."""

    model: Simulator
    question: Question
    graph: Graph
    carry: Carrier
    solver: Callable[[Scene], NewtonSteps]
    frames: list[JumpingFrame] = field(default_factory=list)

    def __post_init__(self) -> None:
        question = self.question
        self.given = self.model.config.data.given_frames
        self.prescribed_position = torch.tensor(question.prescribed_position)
        self.fields = question.given_fields(self.model.config.data, self.given)
        scheme = self.model.config.scheme
        self.history = scheme.history
        sources = scheme.sources(question.prescribed_position, question.scene.prescribed)
        by_number: dict[int, JumpingFrame] = {}
        for number in scheme.computed(question.wanted(), sources):
            by_number[number] = JumpingFrame(self, number, by_number.get(int(sources[number])))
        self.frames += by_number.values()

    @property
    def wanted(self) -> list[JumpingFrame]:
        """The frames that are wanted, in ascending order."""
        return [frame for frame in self.frames if frame.number in self.question.wanted()]

    def state(self, position: np.ndarray, fields: dict[str, Tensor], number: int) -> State:
        """The positions [N, 3] and fields of a frame, carried along to a later one."""
        position_then = torch.from_numpy(self.carry(position, self.question.prescribed_position[number]))
        state = State(position_then, stress=fields.get(STRESS))
        if self.history is None:
            return state
        return replace(state, source=torch.tensor(position), history=self.graph.at_nodes(self.history, fields))

    @cached_property
    def equilibria(self) -> Equilibria:
        """What the solver finds in this scene."""
        scene = self.question.scene
        return Equilibria.of(scene, law_of(self.model.config), self.question.prescribed_position, self.solver(scene))

    def refined_position(self, number: int) -> np.ndarray | None:
        """The positions [N, 3] of a wanted frame that is given or has had its Newton steps, else None."""
        if number < self.given:
            return _array(self.prescribed_position[number]) if number in self.question.wanted() else None
        done = (frame for frame in self.frames if frame.last_step is not None and frame.failure is None)
        return next((_array(frame.position) for frame in done if frame.number == number), None)

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
            frames | {frame.number: (frame.position, frame.fields[-1]) for frame in predicted},
            [frame.seconds for frame in predicted],
            self.failure and f"{self.failure}; the frames before it are kept",
            {frame.number: frame.latent for frame in predicted},
            tuple(frame.last_step for frame in predicted if frame.last_step is not None),
            _solved(predicted),
        )


def _solved(frames: Sequence[JumpingFrame]) -> dict[str, str]:
    """How the solver reached the frames, as a fact of an answer; empty if it solved none."""
    solved = [frame.along_load_path for frame in frames if frame.along_load_path is not None]
    if not solved:
        return {}
    path = "along the load path, frame by frame" if any(solved) else "from the answer of the model"
    some = "" if len(solved) == len(frames) else f"{len(solved)} of {len(frames)} frames "
    return {"solved": f"{some}solved to the stop test of the solver, {path}"}


def _array(positions: Tensor) -> np.ndarray:
    return positions.numpy().astype(np.float64)

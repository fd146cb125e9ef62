"""Rollouts: a model predicts scenes step by step, each frame from the frame before.

The model predicts the free nodes; prescribed nodes (obstacles and handles) are set exactly to their prescribed
positions. Several scenes are predicted together as one ragged batch; a scene that ends or fails leaves the batch.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from ast_sim.batches.batch_builder import Batch, State
from ast_sim.batches.graph import Graph
from ast_sim.inference.answer import Answer
from ast_sim.inference.question import Question, not_finite, too_far
from ast_sim.models.simulator import Simulator


def rollouts(
    model: Simulator, questions: Sequence[Question], progress: Callable[[int], None] | None = None
) -> list[Answer]:
    """Predict several scenes as one ragged batch; the batch does not change the prediction of a scene.

    If a scene fails, its answer says why in `failure` and keeps the frames before; the other scenes go on. `progress`
    is called after each step with the number of its frame and may raise to stop.

    Raises:
        RolloutError: a scene has no frame to predict.
        DatasetError: in a scene nothing can deform.
    """
    given = model.config.given_frames
    for question in questions:
        question.check(given)
    scenes = [_RollingScene(model, question, given) for question in questions]
    concatenate = lru_cache(maxsize=4)(lambda *graphs: Graph.concatenate(list(graphs)))
    with model.predicting():
        for frame in range(given, max(scene.end for scene in scenes)):
            running = [scene for scene in scenes if scene.runs_at(frame)]
            # Only scenes of the same domain are predicted together: none may change another's domain.
            for domain in dict.fromkeys(scene.domain for scene in running):
                _step(model, [scene for scene in running if scene.domain == domain], frame, concatenate)
            if progress is not None and running:
                progress(frame)
    return [scene.answer() for scene in scenes]


class _RollingScene:
    """A scene during its rollout: its graph, its script and the frames so far."""

    def __init__(self, model: Simulator, question: Question, given: int) -> None:
        self.model, self.config, self.question, self.given = model, model.config, question, given
        self.graph = model.graph(question.scene)
        self.script = torch.tensor(question.script)
        self.end = max(question.wanted()) + 1
        self.positions = list(self.script[:given])
        self.stresses = question.given_stress(model.config, given)
        self.seconds: list[float] = []
        self.failure: str | None = None
        self.place(given - 1, self.positions[-1])

    def runs_at(self, frame: int) -> bool:
        return frame < self.end and self.failure is None

    def state(self, frame: int) -> State:
        """The state from which a frame is predicted."""
        previous = self.positions[frame - 2] if self.config.dynamic else None
        return State(self.positions[frame - 1], previous, self.stresses[frame - 1] if self.stresses else None)

    def advance(self, frame: int, position: Tensor, stress: Tensor | None, seconds: float) -> None:
        """Keep the predicted frame, or set `failure` if it is not finite or too far away."""
        failure = not_finite(self.config, self.question.name, frame, position, stress)
        if failure is not None:
            self.failure = f"{failure}; the {frame} frames before it are kept"
            return
        self.place(frame, position)
        if self.failure is None:
            self.positions.append(position)
            self.stresses += [] if stress is None else [stress]
            self.seconds.append(seconds)

    def place(self, frame: int, position: Tensor) -> None:
        """Find the domain that holds the state from which the frame after `frame` is predicted."""
        self.domain = self.model.domain(position)
        if self.domain is None:
            failure = too_far(self.config, self.question.name, frame, position)
            self.failure = f"{failure}; the {frame} frames before it are kept"

    def answer(self) -> Answer:
        """The wanted frames so far as an answer."""
        numbers = tuple(frame for frame in self.question.wanted() if frame < len(self.positions))
        positions, stresses = ([values[i] for i in numbers if values] for values in (self.positions, self.stresses))
        asked, nodes = self.question, self.question.scene.num_nodes
        return Answer(
            asked.name,
            asked.scene,
            torch.stack(positions).numpy() if positions else np.zeros((0, nodes, 3), np.float32),
            torch.stack(stresses).numpy() if stresses else None,
            sum(number < self.given for number in numbers),
            self.seconds,
            failure=self.failure,
            stress_location=self.config.stress,
            frames=numbers,
        )


def _step(model: Simulator, scenes: list[_RollingScene], frame: int, concatenate: Callable[..., Graph]) -> None:
    """Predict a frame of all scenes at once; `concatenate` joins their graphs."""
    start = time.perf_counter()
    prescribed = torch.cat([scene.script[frame] for scene in scenes])
    batch = Batch.build(
        concatenate(*(scene.graph for scene in scenes)),
        State.concatenate([scene.state(frame) for scene in scenes]),
        prescribed,
        [f"{scene.question.name} frame {frame - 1}" for scene in scenes],
    )
    position, stress = model.advance(batch, prescribed)
    positions = position.split(batch.graph.node_offsets.diff().tolist())
    stresses: Sequence[Tensor | None] = [None] * len(scenes)
    if stress is not None:
        stresses = stress.split([len(scene.stresses[-1]) for scene in scenes])
    seconds = (time.perf_counter() - start) / len(scenes)
    for scene, next_position, next_stress in zip(scenes, positions, stresses, strict=True):
        scene.advance(frame, next_position, next_stress, seconds)

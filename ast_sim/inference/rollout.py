"""Rollouts: a model predicts scenes frame by frame. The model's horizon decides which frame it starts from.

The model predicts the free nodes; prescribed nodes (obstacles and handles) are set exactly to their prescribed
positions. Several scenes are predicted together as one ragged batch; a scene that ends or fails leaves the batch.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from ast_sim.batches.batch_builder import Batch, State
from ast_sim.batches.graph import Graph
from ast_sim.inference.answer import Answer
from ast_sim.models.simulator import Simulator
from ast_sim.scene import Scene, Trajectory
from ast_sim.support.errors import RolloutError


@dataclass(frozen=True, eq=False)
class Question:
    """A scene to be predicted.

    Attributes:
        name: name of the scene, for messages.
        scene: the scene.
        script: [S, N, 3] float32, the positions of the prescribed nodes in each frame; in the given frames, of all
            nodes. Other entries are not read.
        stress: [frames, N or E, 1] float32, the stress of at least the given frames; None: zero.
    """

    name: str
    scene: Scene
    script: np.ndarray
    stress: np.ndarray | None = None

    @classmethod
    def of(cls, truth: Trajectory, name: str) -> Question:
        """The question whose true answer is a known trajectory."""
        return cls(name, truth.scene, truth.position, truth.stress)


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
        question.scene.require_predictable(question.name)
        if len(question.script) <= given:
            raise RolloutError(
                f"{question.name} has {len(question.script)} frames; a rollout needs at least {given + 1}"
            )
    scenes = [_RollingScene(model, question, given) for question in questions]
    concatenate = lru_cache(maxsize=4)(lambda *graphs: Graph.concatenate(list(graphs)))
    training = model.training
    model.eval()
    try:
        with torch.inference_mode():
            for frame in range(given, max(len(scene.script) for scene in scenes)):
                running = [scene for scene in scenes if scene.runs_at(frame)]
                # Only scenes of the same domain are predicted together: none may change another's domain.
                for domain in dict.fromkeys(scene.domain for scene in running):
                    _step(model, [scene for scene in running if scene.domain == domain], frame, concatenate)
                if progress is not None and running:
                    progress(frame)
    finally:
        model.train(training)
    return [scene.answer() for scene in scenes]


class _RollingScene:
    """A scene during its rollout: its graph, its script and the frames so far."""

    def __init__(self, model: Simulator, question: Question, given: int) -> None:
        self.model, self.config, self.question, self.given = model, model.config, question, given
        self.graph = model.graph(question.scene)
        self.script = torch.tensor(question.script)
        self.positions = list(self.script[:given])
        self.stresses = self._given_stress()
        self.seconds: list[float] = []
        self.failure: str | None = None
        self.place(given - 1, self.positions[-1])

    def _given_stress(self) -> list[Tensor]:
        """The stress of each given frame, [N or E, 1]; an empty list if the model predicts no stress."""
        if self.config.stress == "none":
            return []
        scene, stress = self.question.scene, self.question.stress
        rows = scene.num_nodes if self.config.stress == "node" else scene.num_elements
        if stress is None or stress.shape[1] != rows:
            return list(torch.zeros(self.given, rows, 1))
        return list(torch.tensor(stress[: self.given]))

    def runs_at(self, frame: int) -> bool:
        return frame < len(self.script) and self.failure is None

    def state(self, frame: int) -> State:
        """The state from which a frame is predicted."""
        source = self.config.horizon.source(frame)
        previous = self.positions[source - 1] if self.config.dynamic else None
        return State(self.positions[source], previous, self.stresses[source] if self.stresses else None)

    def advance(self, frame: int, position: Tensor, stress: Tensor | None, seconds: float) -> None:
        """Keep the predicted frame, or set `failure` if it is not finite or too far away."""
        for what, value in (("position", position), ("stress", stress)):
            if value is not None and not value.isfinite().all():
                row = int(torch.nonzero(~value.isfinite().all(dim=1))[0])
                kind = "element" if what == "stress" and self.config.stress == "element" else "node"
                self.failure = (
                    f"{self.question.name}: the predicted {what} of {kind} {row} in frame {frame} is not finite:"
                    f" {value[row].tolist()}; the {frame} frames before it are kept"
                )
                return
        self.place(frame, position)
        if self.failure is None:
            self.positions.append(position)
            self.stresses += [] if stress is None else [stress]
            self.seconds.append(seconds)

    def place(self, frame: int, position: Tensor) -> None:
        """Find the domain that holds the state from which the frame after `frame` is predicted."""
        if not self.config.horizon.drifts and frame + 1 < len(self.script):
            position = torch.where(self.graph.prescribed[:, None], self.script[frame + 1], self.script[0])
        self.domain = self.model.domain(position)
        if self.domain is None:
            center = torch.tensor(self.config.domain_center, dtype=torch.float64)
            distance = (position.double() - center).abs().amax(dim=1)
            self.failure = (
                f"{self.question.name}: in frame {frame} node {int(distance.argmax())} is {float(distance.max()):.3g}"
                f" from the centre of the domain, too far for the model; the {frame} frames before it are kept"
            )

    def answer(self) -> Answer:
        """The frames so far as an answer."""
        stress = torch.stack(self.stresses).numpy() if self.stresses else None
        frames = torch.stack(self.positions).numpy(), stress, self.given, self.seconds
        asked, location = self.question, self.config.stress
        return Answer(asked.name, asked.scene, *frames, failure=self.failure, stress_location=location)


def _step(model: Simulator, scenes: list[_RollingScene], frame: int, concatenate: Callable[..., Graph]) -> None:
    """Predict a frame of all scenes at once; `concatenate` joins their graphs."""
    start = time.perf_counter()
    prescribed = torch.cat([scene.script[frame] for scene in scenes])
    batch = Batch.build(
        concatenate(*(scene.graph for scene in scenes)),
        State.concatenate([scene.state(frame) for scene in scenes]),
        prescribed,
        [f"{scene.question.name} frame {frame - 1}" for scene in scenes],
        torch.full((len(scenes),), float(frame)),
    )
    position, stress = model.advance(batch, prescribed)
    positions = position.split(batch.graph.node_offsets.diff().tolist())
    stresses: Sequence[Tensor | None] = [None] * len(scenes)
    if stress is not None:
        stresses = stress.split([len(scene.stresses[-1]) for scene in scenes])
    seconds = (time.perf_counter() - start) / len(scenes)
    for scene, next_position, next_stress in zip(scenes, positions, stresses, strict=True):
        scene.advance(frame, next_position, next_stress, seconds)

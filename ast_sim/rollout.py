"""Rollouts: a model predicts a trajectory from its first frame, one increment after the other.

A time-conditioned model predicts each frame from the first one: no prediction depends on another.

Prescribed nodes (obstacles and handles) are put exactly where the script says; everything else is the model's.
Scenes roll out together as one ragged batch; a scene that ends or fails leaves the batch.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from ast_sim.data.batch import Batch
from ast_sim.data.graph import Graph
from ast_sim.data.scene import Trajectory
from ast_sim.errors import RolloutError
from ast_sim.model.simulator import Simulator


@dataclass(eq=False)
class Rollout:
    """A predicted trajectory of S frames (fewer if it failed), of which the first `given` are the truth's.

    Attributes:
        position: [S, N, 3] float32.
        stress: [S, N or E, 1] float32, or None; a given frame holds the truth's stress, or zero where there is none.
        given: how many frames were taken from the truth: 1, or 2 if the integration is dynamic.
        seconds: wall seconds of each predicted step; scenes of one batch share their step's time equally.
        failure: why the rollout ended early, naming the frame and the node; None if it did not.
    """

    position: np.ndarray
    stress: np.ndarray | None
    given: int
    seconds: list[float] = field(default_factory=list)
    failure: str | None = None


def rollout(
    model: Simulator,
    trajectory: Trajectory,
    name: str = "scene",
    steps: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Rollout:
    """Predict a trajectory from its first frame (and second, if dynamic); its prescribed nodes are the script.

    `progress` is called with the number of the frame after each step.

    Raises:
        RolloutError: a position that is not finite or left the largest domain; `error.rollout` holds the frames
            before it.
    """
    result = rollouts(model, [trajectory], [name], steps=steps, progress=progress)[0]
    if result.failure is not None:
        error = RolloutError(result.failure)
        error.rollout = result
        raise error
    return result


def rollouts(
    model: Simulator,
    trajectories: Sequence[Trajectory],
    names: Sequence[str],
    steps: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[Rollout]:
    """Predict several trajectories as one ragged batch, each as `rollout` would predict it alone.

    A scene that fails says so in its `failure` and keeps the frames before; the others go on. `progress` is called
    after each step and may raise to stop.
    """
    given = 2 if model.config.dynamic else 1
    for name, trajectory in zip(names, trajectories, strict=True):
        if trajectory.num_frames <= given:
            raise RolloutError(f"{name} has {trajectory.num_frames} frames; a rollout needs at least {given + 1}")
    scenes = [_RollingScene(model, t, name, given, steps) for t, name in zip(trajectories, names, strict=True)]
    concatenate = lru_cache(maxsize=4)(lambda *graphs: Graph.concatenate(list(graphs)))
    training = model.training
    model.eval()
    try:
        with torch.inference_mode():
            for frame in range(given, max(scene.end for scene in scenes)):
                running = [scene for scene in scenes if scene.runs_at(frame)]
                for together in _same_domain(running):
                    _step(model, together, frame, concatenate)
                if progress is not None and running:
                    progress(frame)
    finally:
        model.train(training)
    return [scene.result() for scene in scenes]


class _RollingScene:
    """One scene on its way: its graph, its script and the frames so far."""

    def __init__(self, model: Simulator, trajectory: Trajectory, name: str, given: int, steps: int | None) -> None:
        self.model, self.config = model, model.config
        self.name = name
        self.graph = model.graph(trajectory.scene)
        self.script = torch.tensor(trajectory.position)
        self.end = len(self.script) if steps is None else min(len(self.script), given + steps)
        self.positions = list(self.script[:given])
        self.stresses = self._given_stress(self.config.stress, trajectory, given)
        self.given = given
        self.source = 0 if self.config.time_conditioned else -1  # of the frames so far, where the next starts from
        self.seconds: list[float] = []
        self.failure: str | None = None
        self.place(given - 1, self.positions[-1])

    @staticmethod
    def _given_stress(location: str, trajectory: Trajectory, given: int) -> list[Tensor]:
        """The stress of the given frames, one tensor [N or E, 1] a frame; nothing if the model predicts none."""
        if location == "none":
            return []
        rows = trajectory.scene.num_nodes if location == "node" else trajectory.scene.num_elements
        if trajectory.stress is None or trajectory.stress.shape[1] != rows:
            return list(torch.zeros(given, rows, 1))
        return list(torch.tensor(trajectory.stress[:given]))

    def runs_at(self, frame: int) -> bool:
        return frame < self.end and self.failure is None

    def advance(self, frame: int, position: Tensor, stress: Tensor | None, seconds: float) -> None:
        """Take over the predicted frame, unless it is not finite or too far away."""
        for what, value in (("position", position), ("stress", stress)):
            if value is not None and not value.isfinite().all():
                row = int(torch.nonzero(~value.isfinite().all(dim=1))[0])
                kind = "element" if what == "stress" and self.config.stress == "element" else "node"
                self.failure = (
                    f"{self.name}: the predicted {what} of {kind} {row} in frame {frame} is not finite:"
                    f" {value[row].tolist()}; the {frame} frames before it are kept"
                )
                return
        self.place(frame, position)
        if self.failure is None:
            self.positions.append(position)
            self.stresses += [] if stress is None else [stress]
            self.seconds.append(seconds)

    def place(self, frame: int, position: Tensor) -> None:
        """Find the domain that holds the positions of a frame; time-conditioned, what the frame after starts from."""
        if self.config.time_conditioned and frame + 1 < len(self.script):
            position = torch.where(self.graph.prescribed[:, None], self.script[frame + 1], self.script[0])
        self.domain = self.model.domain(position)
        if self.domain is None:
            center = torch.tensor(self.config.domain_center, dtype=torch.float64)
            distance = (position.double() - center).abs().amax(dim=1)
            self.failure = (
                f"{self.name}: node {int(distance.argmax())} is {float(distance.max()):.3g} from the centre of the"
                f" domain in frame {frame}, further than the model reaches; the {frame} frames before it are kept"
            )

    def result(self) -> Rollout:
        stress = torch.stack(self.stresses).numpy() if self.stresses else None
        return Rollout(torch.stack(self.positions).numpy(), stress, self.given, self.seconds, self.failure)


def _same_domain(scenes: list[_RollingScene]) -> Iterator[list[_RollingScene]]:
    """Group the scenes by their domain, so that none changes another's."""
    groups: dict[int, list[_RollingScene]] = {}
    for scene in scenes:
        groups.setdefault(scene.domain, []).append(scene)
    return iter(groups.values())


def _step(model: Simulator, scenes: list[_RollingScene], frame: int, concatenate: Callable[..., Graph]) -> None:
    """Predict the frame of all scenes at once; `concatenate` makes one graph of theirs."""
    start = time.perf_counter()
    batch = make_batch(
        model,
        concatenate(*(scene.graph for scene in scenes)),
        position=torch.cat([scene.positions[scene.source] for scene in scenes]),
        previous=torch.cat([scene.positions[-2] for scene in scenes]) if scenes[0].given == 2 else None,
        target=torch.cat([scene.script[frame] for scene in scenes]),
        stress=torch.cat([scene.stresses[scene.source] for scene in scenes]) if scenes[0].stresses else None,
        names=[f"{scene.name} frame {frame - 1}" for scene in scenes],
        frame=torch.full((len(scenes),), float(frame)),
    )
    position, stress = predict_next(model, batch, torch.cat([scene.script[frame] for scene in scenes]))
    sizes = batch.graph.node_offsets.diff().tolist()
    positions = position.split(sizes)
    if stress is None:
        stresses: Sequence[Tensor | None] = [None] * len(scenes)
    else:
        stresses = stress.split([len(scene.stresses[-1]) for scene in scenes])
    seconds = (time.perf_counter() - start) / len(scenes)
    for scene, next_position, next_stress in zip(scenes, positions, stresses, strict=True):
        scene.advance(frame, next_position, next_stress, seconds)


def make_batch(
    model: Simulator,
    graph: Graph,
    position: Tensor,
    previous: Tensor | None,
    target: Tensor,
    stress: Tensor | None,
    names: list[str],
    frame: Tensor | None = None,
) -> Batch:
    """The model's input at one instant: states [N, 3], for the boundary motion the positions `target` of the frame to
    predict, and for a time-conditioned model its number in each scene."""
    motion = torch.where(graph.prescribed[:, None], target - position, 0.0)
    return Batch(graph, position, previous, motion, stress, names, frame)


def predict_next(model: Simulator, batch: Batch, target: Tensor) -> tuple[Tensor, Tensor | None]:
    """The next positions [N, 3], prescribed nodes exactly at `target`, and the next stress."""
    prediction = model.predict(batch)
    position = model.integrate(batch, prediction.motion)
    return torch.where(batch.graph.prescribed[:, None], target, position), prediction.stress

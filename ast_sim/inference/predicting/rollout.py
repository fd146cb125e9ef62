"""Rollouts: a model predicts scenes step by step, each frame from the frame before.

The model predicts the free nodes; prescribed nodes (obstacles and handles) are set exactly to their prescribed
positions. Several scenes are predicted together as one ragged batch; a scene that ends or fails leaves the batch.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ast_sim.batches.batch_builder import State
from ast_sim.inference.answer import Answer
from ast_sim.inference.predicting.predicted_frames import PredictedFrame, Start, predict_frames
from ast_sim.inference.predicting.question import Question, not_finite, too_far
from ast_sim.models.simulator import Simulator
from ast_sim.named_field import STRESS
from ast_sim.support.errors import counted
from ast_sim.support.progress import Progress, ShowProgress


def rollouts(model: Simulator, questions: Sequence[Question], progress: ShowProgress = False) -> list[Answer]:
    """Predict several scenes as one ragged batch; the batch does not change the prediction of a scene.

    If a scene fails, its answer says why in `failure` and keeps the frames before; the other scenes go on. `progress`
    (`support.progress`) counts frames; a function may raise to stop.

    Raises:
        RolloutError: a scene has no frame to predict.
        DatasetError: in a scene nothing can deform.
    """
    given = model.config.data.given_frames
    for question in questions:
        question.check(given)
    with model.predicting():
        scenes = [_RollingScene(model, question, given) for question in questions]
        with Progress(sum(scene.end - given for scene in scenes), "frames", progress) as bar:
            for frame in range(given, max(scene.end for scene in scenes)):
                running = [scene for scene in scenes if scene.runs_at(frame)]
                # Only scenes of the same domain are predicted together: none may change another's domain.
                for domain in dict.fromkeys(scene.domain for scene in running):
                    group = [scene for scene in running if scene.domain == domain]
                    predicted = predict_frames(model, [scene.start(frame) for scene in group])
                    for scene, of_scene in zip(group, predicted, strict=True):
                        scene.advance(frame, of_scene)
                if running:
                    bar.advance(f"frame {frame}", len(running))
    return [scene.answer() for scene in scenes]


class _RollingScene:
    """A scene during its rollout: its graph, its motion and the frames so far."""

    def __init__(self, model: Simulator, question: Question, given: int) -> None:
        self.model = model
        self.config = model.config
        self.question = question
        self.graph = model.graph(question.scene)
        self.prescribed_position = torch.tensor(question.prescribed_position)
        self.end = max(question.wanted()) + 1
        self.frames = list(
            zip(self.prescribed_position[:given], question.given_fields(model.config.data, given), strict=True)
        )
        self.seconds: list[float] = []
        self.latents: dict[int, np.ndarray | None] = {}
        self.failure: str | None = None
        self.place(given - 1, *self.frames[-1])

    def runs_at(self, frame: int) -> bool:
        return frame < self.end and self.failure is None

    def start(self, frame: int) -> Start:
        """What a frame is predicted from."""
        position, fields = self.frames[frame - 1]
        previous = self.frames[frame - 2][0] if self.config.data.dynamic else None
        state = State(position, previous, fields.get(STRESS))
        return Start(f"{self.question.name} frame {frame - 1}", self.graph, state, self.prescribed_position[frame])

    def advance(self, frame: int, predicted: PredictedFrame) -> None:
        """Keep the predicted frame, or set `failure` if it is not finite or too far away."""
        position = predicted.positions[-1]
        self.place(frame, position, predicted.fields)
        if self.failure is None:
            self.frames.append((position, predicted.fields))
            self.seconds.append(predicted.seconds)
            self.latents[frame] = predicted.latent

    def place(self, frame: int, position: Tensor, fields: dict[str, Tensor]) -> None:
        """Find the domain that holds the state from which the frame after `frame` is predicted, or set `failure`."""
        failure = not_finite(self.config, self.question.name, frame, position, fields)
        if failure is None:
            self.domain = self.model.domain(position)
            failure = too_far(self.config, self.question.name, frame, position) if self.domain is None else None
        self.failure = failure and f"{failure}; the {counted(frame, 'frame before it is', 'frames before it are')} kept"

    def answer(self) -> Answer:
        """The wanted frames so far as an answer."""
        frames = dict(enumerate(self.frames))
        return self.question.answer(self.config, frames, self.seconds, self.failure, self.latents)

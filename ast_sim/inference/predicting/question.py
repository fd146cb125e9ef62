"""What a model is to predict: a scene, the motion of its prescribed nodes, and the frames that are wanted."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ast_sim.inference.answer import Answer
from ast_sim.mechanics.driven import Driven
from ast_sim.mechanics.physics_check import Law
from ast_sim.models.data_facts import DataFacts
from ast_sim.models.model_config import ModelConfig
from ast_sim.named_field import REACTION, STRESS, NamedField
from ast_sim.scene import Scene, Trajectory
from ast_sim.support.argument_checks import in_short
from ast_sim.support.errors import ConfigError, RolloutError, counted
from ast_sim.support.toml_settings import NOTHING

WantedFrames = Iterable[int] | int | slice  # numbers of frames; negative ones count from the end


@dataclass(frozen=True, eq=False)
class Question:
    """A scene to be predicted.

    Attributes:
        name: name of the scene, for messages.
        scene: the scene.
        prescribed_position: [S, N, 3] float32, the positions of the prescribed nodes in each frame; in the given
            frames, of all nodes. Other entries are not read.
        fields: [frames, N or E, *] float32, the stress and named fields of at least the given frames, by name; missing
            ones are zero.
        frames: the numbers of the frames that are wanted, in the order in which the answer has them; None: all of them,
            the given ones too.
        notes: what is unusual about the scene for the model, as sentences.
        times: of all frames of the motion in seconds; None: they are not known.
    """

    name: str
    scene: Scene
    prescribed_position: np.ndarray
    fields: Mapping[str, np.ndarray] = field(default_factory=dict)
    frames: tuple[int, ...] | None = None
    notes: tuple[str, ...] = ()
    times: tuple[float, ...] | None = None

    @classmethod
    def of(cls, truth: Trajectory, name: str, frames: WantedFrames | None = None) -> Question:
        """The question whose true answer is a known trajectory, which has all frames of its motion."""
        return cls(name, truth.scene, truth.position, fields_of(truth), times=truth.times).asking(frames)

    def asking(self, frames: WantedFrames | None) -> Question:
        """The same question for these frames only; negative numbers count from the end.

        Raises:
            ConfigError: the frames are no whole numbers, or one is named twice.
            RolloutError: there is no such frame, or none is named.
        """
        if frames is None:
            return self
        count = len(self.prescribed_position)
        numbers = _whole_numbers(frames, count)
        for number in numbers:
            if not -count <= number < count:
                raise RolloutError(f"{self.name} has the frames 0 to {count - 1}; there is no frame {number}")
        wanted = tuple(number % count for number in numbers)
        if not wanted:
            raise RolloutError(f"{self.name} has the frames 0 to {count - 1}: name at least one frame")
        twice = next((number for number in wanted if wanted.count(number) > 1), None)
        if twice is not None:
            raise ConfigError(f"{self.name}: frame {twice} is named twice: name each frame once")
        return replace(self, frames=wanted)

    def check(self, given: int) -> None:
        """Raise RolloutError or DatasetError unless there is a frame to predict and something that can deform."""
        self.scene.require_predictable(self.name)
        if len(self.prescribed_position) <= given:
            count = len(self.prescribed_position)
            raise RolloutError(f"{self.name} has {counted(count, 'frame')}; a rollout needs at least {given + 1}")

    def wanted(self) -> tuple[int, ...]:
        """The numbers of the frames that are wanted."""
        return tuple(range(len(self.prescribed_position))) if self.frames is None else self.frames

    def given_fields(self, data: DataFacts, given: int) -> list[dict[str, Tensor]]:
        """What the model predicts, in each given frame: [N or E, *] by name."""
        rows = {"node": self.scene.num_nodes, "element": self.scene.num_elements}
        values = {
            output.name: torch.tensor(self.fields[output.name][:given])
            if output.name in self.fields
            else torch.zeros(given, rows[output.location], output.columns, dtype=torch.float32)
            for output in data.outputs
        }
        return [{name: one[frame] for name, one in values.items()} for frame in range(given)]

    def answer(
        self,
        config: ModelConfig,
        frames: Mapping[int, tuple[Tensor, dict[str, Tensor]]],
        seconds: list[float],
        failure: str | None,
        latents: Mapping[int, np.ndarray | None],
        last_steps: tuple[float, ...] = (),
        source: Mapping[str, str] = NOTHING,
    ) -> Answer:
        """The answer with the wanted ones of these frames: positions and fields, by number of the frame; and the
        `latents` of the predicted ones. The other arguments are as in `Answer`."""
        numbers = tuple(number for number in self.wanted() if number in frames)
        position = np.array([frames[number][0].numpy() for number in numbers], np.float32)
        fields = {
            output.name: NamedField(
                np.array([frames[number][1][output.name].numpy() for number in numbers]), output.location, output.unit
            )
            for output in config.data.outputs
            if numbers
        }
        stress = fields.pop(STRESS, None)
        if last_steps:  # the positions have changed since the network predicted reactions
            fields.pop(REACTION, None)
        return Answer(
            self.name,
            self.scene,
            position.reshape(len(numbers), self.scene.num_nodes, 3),
            None if stress is None else stress.values,
            config.data.given_frames,
            seconds,
            failure,
            stress_location=config.data.stress,
            frames=numbers,
            fields=fields,
            last_steps=last_steps,
            driven=Driven.of(self.scene, self.prescribed_position),
            law=law_of(config),
            source=dict(source),
            times={} if self.times is None else {number: self.times[number] for number in numbers},
            latents={number: row for number in numbers if (row := latents.get(number)) is not None},
        )


def law_of(config: ModelConfig) -> Law:
    """The law of the training scenes, which is the one of all answers."""
    return Law(config.data.material, config.data.contact_range)


def fields_of(trajectory: Trajectory) -> dict[str, np.ndarray]:
    """The stress, if there is one, and the named fields of a trajectory: [S, N or E, *] by name."""
    stress = {} if trajectory.stress is None else {STRESS: trajectory.stress}
    return {**{name: one.values for name, one in trajectory.fields.items()}, **stress}


def _whole_numbers(frames: WantedFrames, count: int) -> list[int]:
    """The frames, of `count`, as a list; one number is a frame, too."""
    must = "frames must be whole numbers, one such number, or a slice"
    wrong = f"{must}, not {in_short(frames)}"
    if isinstance(frames, slice):
        try:
            return list(range(count)[frames])
        except (TypeError, ValueError) as error:  # bounds that are no whole numbers, or a step of 0
            raise ConfigError(wrong) from error
    if isinstance(frames, Mapping | str | bytes) or np.ma.is_masked(frames):
        raise ConfigError(wrong)
    listed: list[Any]
    try:
        listed = list(frames) if isinstance(frames, Iterable) else [frames]
    except TypeError:  # an array of no axis counts as Iterable
        listed = [frames]
    numbers = []
    for one in listed:
        try:
            numbers.append(operator.index(one))
            if np.asarray(one).dtype == bool:  # it counts as a whole number
                raise TypeError(one)
        except TypeError as error:
            raise ConfigError(wrong if one is frames else f"{must}; one is {in_short(one)}") from error
    return numbers


def not_finite(
    config: ModelConfig, name: str, frame: int, position: Tensor, fields: Mapping[str, Tensor]
) -> str | None:
    """Where a predicted frame is not finite; None if it is finite everywhere."""
    places = {output.name: output.location for output in config.data.outputs}
    for what, value in {"position": position, **fields}.items():
        if not value.isfinite().all():
            row = int(torch.nonzero(~value.isfinite().all(dim=1))[0])
            kind = places.get(what, "node")
            return f"{name}: the predicted {what} of {kind} {row} in frame {frame} is not finite: {value[row].tolist()}"
    return None


def too_far(config: ModelConfig, name: str, frame: int, position: Tensor) -> str:
    """The message that a state lies too far from the domain."""
    center = torch.tensor(config.data.domain_center, dtype=torch.float64)
    distance = (position.double() - center).abs().amax(dim=1)
    return (
        f"{name}: in frame {frame} node {int(distance.argmax())} is {float(distance.max()):.3g}"
        " from the centre of the domain, too far for the model"
    )

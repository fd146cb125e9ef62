"""What the samples of a dataset are like: one pass over the file gathers the figures of each."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ast_sim.data.file import Dataset
from ast_sim.data.scene import AttributeValue, NodeType, Trajectory
from ast_sim.data.seconds import SolverSeconds
from ast_sim.view.fields import deforming_rows


@dataclass(frozen=True)
class Sample:
    """The figures of one sample.

    Attributes:
        name: such as "train/000012"; its split is the part before the stroke.
        nodes, elements, frames: how many it has.
        bodies: numbers of its bodies.
        displacement: the largest, from rest, of a node outside the obstacles, in the dataset's length unit.
        stress: the largest von Mises stress outside the obstacles in pascal; None without stress.
        peak: the frame of the largest displacement.
        outside: whether a node leaves the domain of the dataset.
        attributes: the records of the solver, as they are in the file; any may be missing.
        seconds: the solver's, one number a frame; None where they were not recorded.
    """

    name: str
    nodes: int
    elements: int
    frames: int
    bodies: int
    displacement: float
    stress: float | None
    peak: int
    outside: bool
    attributes: dict[str, AttributeValue]
    seconds: list[float] | None

    @property
    def split(self) -> str:
        return self.name.split("/")[0]

    @property
    def index(self) -> int:
        return int(self.name.split("/")[1])

    @property
    def complete(self) -> bool:
        """Whether all frames are there; a file that does not say counts as complete."""
        return self.attributes.get("status", "complete") == "complete"

    @property
    def total_seconds(self) -> float | None:
        return sum(self.seconds) if self.seconds else None

    @property
    def contact_area(self) -> float | None:
        """The largest of its frames."""
        return max(self.numbers("contact_area"), default=None)

    def numbers(self, key: str) -> list[float]:
        """The numbers that are recorded under a name, one or a list of them; [] where there are none."""
        value = self.attributes.get(key)
        values = value if isinstance(value, list) else [value]
        return [float(number) for number in values if isinstance(number, int | float)]

    def worst(self, key: str, by_frame: str, select: Callable[[Sequence[float]], float]) -> float | None:
        """The number `key` of the sample, else the `select`ed one of its frames'; NaN if one is; None without any."""
        values = self.numbers(key) or self.numbers(by_frame)
        if not values:
            return None
        return math.nan if any(map(math.isnan, values)) else select(values)

    def per_frame(self, key: str) -> list[float]:
        """The numbers of the frames after the first, which is at rest and takes no solving."""
        return self.numbers(key)[1:]


def names(dataset: Dataset) -> list[str]:
    """All samples in the order of the file."""
    return [f"{split}/{index:06d}" for split, count in dataset.splits.items() for index in range(count)]


def survey(dataset: Dataset, seconds: SolverSeconds) -> Iterator[Sample]:
    """The figures of every sample, in the order of the file; one trajectory is looked at at a time."""
    for name in names(dataset):
        split, _, index = name.partition("/")
        yield figures(name, dataset.load(split, int(index)), dataset.info, seconds.samples.get(name))


def figures(name: str, trajectory: Trajectory, info: Any, seconds: list[float] | None) -> Sample:
    """The figures of a trajectory; `info` is the dataset's."""
    scene, attributes = trajectory.scene, trajectory.attributes
    free = scene.node_type != NodeType.OBSTACLE
    largest = _largest_displacements(trajectory, free)
    stress = None
    if trajectory.stress is not None:
        stress = float(trajectory.stress[:, deforming_rows(trajectory)].max(initial=0.0))
    low, high = trajectory.position.min(axis=(0, 1)), trajectory.position.max(axis=(0, 1))
    center, half = np.array(info.domain_center), info.domain_half_width
    old = attributes.get("solve_seconds")  # where files of earlier versions kept them
    return Sample(
        name=name,
        nodes=scene.num_nodes,
        elements=scene.num_elements,
        frames=trajectory.num_frames,
        bodies=len(np.unique(scene.body)),
        displacement=float(largest.max()),
        stress=stress,
        peak=int(largest.argmax()),
        outside=bool((low < center - half).any() or (high > center + half).any()),
        attributes=attributes,
        seconds=seconds if seconds is not None else old if isinstance(old, list) else None,
    )


def _largest_displacements(trajectory: Trajectory, free: np.ndarray) -> np.ndarray:
    """[S]: the largest displacement from rest of a frame over the nodes `free`; 0 without any."""
    rest = trajectory.scene.rest_position[free]
    return np.array([np.linalg.norm(frame[free] - rest, axis=1).max(initial=0.0) for frame in trajectory.position])

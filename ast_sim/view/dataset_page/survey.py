"""The figures of each sample of a dataset, gathered in one pass over the file."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.solver_seconds import SolverSeconds
from ast_sim.scene import AttributeValue, Trajectory


@dataclass(frozen=True)
class SampleFigures:
    """The figures of one sample.

    Attributes:
        name: such as "train/000012"; the part before the slash is its split.
        nodes, elements, frames: how many it has.
        bodies: numbers of its bodies.
        displacement: largest displacement from rest of a node outside the obstacles, in the dataset's length unit.
        stress: largest von Mises stress outside the obstacles in pascal; None without stress.
        peak: the frame of the largest displacement.
        outside: whether a node leaves the domain of the dataset.
        attributes: the solver's records, as they are in the file. Any of them may be missing.
        seconds: the solver's seconds, one number a frame; None if they were not recorded.
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
        """The largest contact area of its frames; None if it is not recorded."""
        return max(self.numbers("contact_area"), default=None)

    def numbers(self, key: str) -> list[float]:
        """The numbers recorded under a name, as a list. It is empty if there are none."""
        value = self.attributes.get(key)
        values = value if isinstance(value, list) else [value]
        return [float(number) for number in values if isinstance(number, int | float)]

    def worst(self, key: str, by_frame: str, select: Callable[[Sequence[float]], float]) -> float | None:
        """The number `key` of the sample. Without it, the one that `select` picks from the numbers `by_frame`.

        NaN if one of them is NaN; None if there are none.
        """
        values = self.numbers(key) or self.numbers(by_frame)
        if not values:
            return None
        return math.nan if any(map(math.isnan, values)) else select(values)

    @property
    def work_imbalance(self) -> float | None:
        """The median over the loaded frames of |work - change of stored energy - loss to friction|, relative.

        It is relative to the largest energy of the sample. A median, because a frame in which a body snaps through
        loses energy with good reason, and the rule by which work is summed up fails where an obstacle turns back within
        a frame. A solver that is wrong is wrong in most frames. A frame is loaded if a thousandth of the largest energy
        moves in it. NaN if a record is NaN; None if the records are missing, or bodies also have kinetic energy.
        """
        keys = ("work", "elastic_energy", "contact_energy", "dissipation")
        records = [self.numbers(key) for key in keys]
        if self.numbers("kinetic_energy") or {len(values) for values in records} != {self.frames}:
            return None
        work, elastic, contact, dissipated = map(np.array, records)
        stored = elastic + contact
        largest = max(np.abs(energy).max() for energy in (work, stored, dissipated))
        if not np.isfinite(largest):
            return math.nan
        loaded = np.abs(np.diff(work)) + np.abs(np.diff(stored)) > 1e-3 * largest
        imbalance = np.abs(np.diff(work - stored - dissipated))[loaded]
        return float(np.median(imbalance)) / largest if loaded.any() else 0.0

    @property
    def iterations(self) -> list[float]:
        """The Newton iterations of all frames but the first, which is at rest and needs no solving."""
        return self.numbers("newton_iterations")[1:]


def names(dataset: Dataset) -> list[str]:
    """All samples in the order of the file."""
    return [f"{split}/{index:06d}" for split, count in dataset.splits.items() for index in range(count)]


def survey(dataset: Dataset, seconds: SolverSeconds) -> Iterator[SampleFigures]:
    """The figures of every sample, in the order of the file. One trajectory is in memory at a time."""
    for name in names(dataset):
        split, _, index = name.partition("/")
        yield figures(name, dataset.load(split, int(index)), dataset.info, seconds.samples.get(name))


def figures(name: str, trajectory: Trajectory, info: Any, seconds: list[float] | None) -> SampleFigures:
    """The figures of a trajectory; `info` describes its dataset."""
    scene = trajectory.scene
    attributes = trajectory.attributes
    largest = _largest_displacements(trajectory)
    stress = None
    if trajectory.stress is not None:
        stress = float(trajectory.stress[:, scene.deforming(trajectory.stress_at)].max(initial=0.0))
    low, high = trajectory.position.min(axis=(0, 1)), trajectory.position.max(axis=(0, 1))
    center = np.array(info.domain_center)
    half = info.domain_half_width
    old = attributes.get("solve_seconds")  # files of earlier versions kept the seconds here
    return SampleFigures(
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


def _largest_displacements(trajectory: Trajectory) -> np.ndarray:
    """[S]: the largest displacement from rest in each frame over the nodes that deform; 0 if none deform."""
    inside = trajectory.scene.deforming_nodes
    rest = trajectory.scene.rest_position[inside]
    return np.array([np.linalg.norm(frame[inside] - rest, axis=1).max(initial=0.0) for frame in trajectory.position])

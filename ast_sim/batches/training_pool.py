"""What a model is trained on when its own answers lead there: scenes that go on side by side while it trains."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Generic, Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor

from ast_sim.batches.batch_builder import Batch, Target
from ast_sim.batches.mirror_and_shift import Placement
from ast_sim.batches.pairs import Jump, Pair, PairSampler


class PooledScene(Protocol):
    """A scene of a pool: a trajectory by its number, mirrored and moved."""

    index: int
    placement: Placement


S = TypeVar("S", bound=PooledScene)


class TrainingPool(ABC, Generic[S]):
    """Training scenes that go on from the model's own answers. The pool has `size` places, and batches take them in
    turn.

    When a scene ends, another follows at its place; all are drawn about equally often. The seed determines all random
    choices. `batch` may be called ahead of `advance` if the two calls concern different places.

    A derived class says how a scene starts, what of it a batch holds, and how it goes on. Its scenes also have the
    attributes in `kept`.

    Args:
        sampler: reads and assembles frames. Its batch size, seed and part hold for the pool too.
        size: how many scenes; a multiple of the batch size.
        largest: a root mean square error above this, in the unit of length, is too large to learn from.
    """

    streams: tuple[int, int]  # the order and the scenes draw from separate sequences of random numbers
    kept: tuple[str, ...]  # of each scene, in `state`: arrays, numbers and None; the first one is never None
    weighs = False  # whether some scenes count more than others

    def __init__(self, sampler: PairSampler, size: int, largest: float) -> None:
        self._sampler = sampler
        self._size = size
        self._batches = size // sampler.batch_size
        self._largest = largest
        self._begun: dict[int, int] = {}
        self._going: dict[int, S] = {}

    @abstractmethod
    def _start(self, index: int, first: bool, generator: np.random.Generator) -> S:
        """A scene at its start; `first`: the first one at its place."""

    @abstractmethod
    def _frames(self, place: int, scene: S) -> Pair | Jump:
        """What a batch holds of a scene."""

    @abstractmethod
    def _goes_on(self, scene: S, error: np.ndarray) -> bool:
        """Take over the answer, which is off its target by `error` [N, 3]; False: the scene ends."""

    def batch(self, number: int) -> tuple[Batch, Target]:
        """The present states of the scenes of a batch, and what the model should make of them."""
        for place in self._places(number):
            if place not in self._going:
                self._begun[place] = self._begun.get(place, 0) + 1
                self._going[place] = self._drawn(place)
        return self._sampler.assemble([self._frames(place, self._going[place]) for place in self._places(number)])

    def errors(self, number: int, target: Target) -> list[tuple[int, float]]:
        """What `weights` needs to know of a batch; computed only if the pool `weighs`."""
        raise NotImplementedError

    def weights(self, number: int, errors: list[tuple[int, float]]) -> Tensor:
        """[B]: how much the squared error of each scene of a batch counts; computed only if the pool `weighs`.

        Args:
            errors: of all parts of the batch, in their order.
        """
        raise NotImplementedError

    def advance(self, number: int, residual: Tensor) -> None:
        """Move the scenes of a batch on; `residual` [N, 3] is `Simulator.residual` of the batch."""
        for place, rows in zip(self._places(number), self._of_scenes(number, residual), strict=True):
            scene = self._going[place]
            if not self._goes_on(scene, scene.placement.vectors(rows).numpy()):
                del self._going[place]

    def state(self) -> dict[str, Tensor]:
        """The state of all scenes, for `restore`."""
        arrays = {f"{place}.begun": torch.tensor(count) for place, count in self._begun.items()}
        for place, scene in self._going.items():
            kept = {key: getattr(scene, key) for key in self.kept}
            arrays |= {f"{place}.{key}": torch.as_tensor(value) for key, value in kept.items() if value is not None}
        return arrays

    def restore(self, state: dict[str, Tensor]) -> None:
        """Take over what `state` returned, of this part of the batches or of all parts together."""
        own = [place for i in range(self._batches) for place in self._places(i) if f"{place}.begun" in state]
        self._begun = {place: int(state[f"{place}.begun"]) for place in own}
        self._going = {place: self._drawn(place) for place in own if f"{place}.{self.kept[0]}" in state}
        for place, scene in self._going.items():
            for key in self.kept:
                value = state.get(f"{place}.{key}")
                if value is not None:
                    value = value.numpy() if value.dim() else value.item()
                setattr(scene, key, value)

    def _places(self, number: int) -> range:
        """The places in the pool of this part of a batch."""
        return self._sampler.places(number % self._batches)

    def _of_scenes(self, number: int, values: Tensor) -> tuple[Tensor, ...]:
        """The rows of `values` [N, *] of each scene of a batch."""
        scenes = (self._going[place] for place in self._places(number))
        return values.split([self._sampler.num_nodes(scene.index) for scene in scenes])

    def _drawn(self, place: int) -> S:
        """The last scene that started at a place, as it was at the start."""
        sampler = self._sampler
        begun = self._begun[place]
        order, draws = self.streams
        epoch, number = divmod((begun - 1) * self._size + place, len(sampler.trajectories))
        index = int(sampler.random(order, epoch).permutation(sampler.trajectories)[number])
        return self._start(index, begun == 1, sampler.random(draws, place, begun))

    def _is_too_large(self, error: np.ndarray) -> bool:
        """Whether an error is too large to learn from."""
        return bool(np.sqrt(np.mean(np.square(error, dtype=np.float64))) > self._largest)

"""Training along rollouts: a model is trained on states that its own predictions have led to.

White noise teaches a model to undo errors that differ from node to node. The errors that add up in a rollout are
smooth, and each model makes its own. So scenes are rolled out while the model trains: the error that a step leaves in
the position is in the state of the next step, and each step is trained to lead back to the truth. This costs no
additional prediction.

With inertia a state is two positions, so it has two errors. To undo an error of the velocity in one step would take
accelerations far above those of the data. So targets undo errors like a critically damped spring:

    e_{t+1} = 2 r e_t - r^2 e_{t-1},    r = 1 - gamma.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ast_sim.batches.batch_builder import Batch, Target
from ast_sim.batches.mirror_and_shift import Placement
from ast_sim.batches.pairs import Pair, PairSampler

SHARE = np.float32(1 / 3)  # share of the white noise that is added in each step of a rollout
# The order, the scenes and their steps draw from separate sequences of random numbers, apart from the sampler's.
_ORDER, _SCENE, _NOISE = 10, 11, 12


@dataclass(eq=False)
class _Rolling:
    """A scene that is rolled out. Errors are [N, 3] float32, before the scene is mirrored.

    error: the error that the last step left in p_t; None: white noise takes its place.
    error_before: the error of p_{t-1}; None: p_{t-1} is true.
    pair: the last pair of the scene in a batch.
    """

    index: int
    t: int
    placement: Placement
    error: np.ndarray | None
    error_before: np.ndarray | None = None
    pair: Pair | None = None


class RolloutPool:
    """Training scenes that are rolled out side by side. The pool has `size` places, and batches take them in turn.

    A scene starts at its first frame, and another scene follows it after its last frame, each about equally often. Only
    the first scene at each place starts at a random frame, so that all frames occur equally often from the beginning.
    A scene whose error is too large to learn from goes on from the true state with white noise, as without a pool. The
    seed determines all random choices.

    `batch` may be called ahead of `advance` if the two calls concern different places.

    Args:
        sampler: reads and assembles frames. Its batch size, seed, noise, gamma and part hold for the pool too.
        size: how many scenes; a multiple of the batch size.
        largest: a state with a root mean square error above this, in the unit of length, is too wrong to learn from.
    """

    def __init__(self, sampler: PairSampler, size: int, largest: float) -> None:
        self._sampler, self._size, self._batches = sampler, size, size // sampler.batch_size
        self._largest = largest
        self._begun: dict[int, int] = {}
        self._rolling: dict[int, _Rolling] = {}

    def batch(self, number: int) -> tuple[Batch, Target]:
        """The current states of the scenes of a batch, and the next frames in the data."""
        return self._sampler.assemble([self._pair(place) for place in self._places(number)])

    def errors(self, number: int, target: Target) -> list[tuple[int, float]]:
        """None are needed: every scene counts as much; see `JumpPool`."""
        return []

    def weights(self, number: int, errors: list[tuple[int, float]]) -> None:
        """None: every scene counts as much."""

    def advance(self, number: int, residual: Tensor) -> None:
        """Move the scenes of a batch one frame on.

        Args:
            number: of the batch.
            residual: [N, 3], `Simulator.residual` of the batch.
        """
        first = 0
        for place in self._places(number):
            scene = self._rolling[place]
            rows = residual[first : first + self._sampler.num_nodes(scene.index)]
            first += len(rows)
            scene.t += 1
            if scene.t == self._sampler.last_frame(scene.index):
                del self._rolling[place]
            else:
                # The residual counts from the target, which has an error of its own.
                error = scene.placement.vectors(rows).numpy() + scene.pair.error_after
                lost = np.sqrt(np.mean(np.square(error, dtype=np.float64))) > self._largest
                before = scene.pair.error if self._sampler.dynamic else None
                scene.error, scene.error_before = (None, None) if lost else (error, before)

    def state(self) -> dict[str, Tensor]:
        """The state of all scenes, for `restore`."""
        found = {f"{place}.begun": torch.tensor(count) for place, count in self._begun.items()}
        for place, scene in self._rolling.items():
            kept = {"t": scene.t, "error": scene.error, "error_before": scene.error_before}
            found |= {f"{place}.{key}": torch.as_tensor(value) for key, value in kept.items() if value is not None}
        return found

    def restore(self, state: dict[str, Tensor]) -> None:
        """Take over what `state` returned, of this part of the batches or of all parts together."""
        own = [place for i in range(self._batches) for place in self._places(i) if f"{place}.begun" in state]
        self._begun = {place: int(state[f"{place}.begun"]) for place in own}
        self._rolling = {place: self._drawn(place) for place in own if f"{place}.t" in state}
        for place, scene in self._rolling.items():
            scene.t = int(state[f"{place}.t"])
            errors = (state.get(f"{place}.{key}") for key in ("error", "error_before"))
            scene.error, scene.error_before = (None if error is None else error.numpy() for error in errors)

    def _places(self, number: int) -> range:
        """The places in the pool of this part of a batch."""
        return self._sampler.places(number % self._batches)

    def _pair(self, place: int) -> Pair:
        if place not in self._rolling:
            self._begun[place] = self._begun.get(place, 0) + 1
            self._rolling[place] = self._drawn(place)
        scene = self._rolling[place]
        generator = np.random.default_rng([self._sampler.seed, _NOISE, place, self._begun[place], scene.t])
        white = self._sampler.white_noise(scene.index, generator)
        error, after = white, self._sampler.left * white
        if scene.error is not None:
            error, after = scene.error + white * SHARE, after * SHARE + self._led_back(scene)
        scene.pair = Pair(scene.index, scene.t, scene.placement, error, scene.error_before, after)
        return scene.pair

    def _led_back(self, scene: _Rolling) -> np.ndarray:
        """How much of the error that the last step left in p_t the target leaves in p_{t+1}."""
        left = self._sampler.left
        if not self._sampler.dynamic:
            return left * scene.error
        before = np.float32(0) if scene.error_before is None else scene.error_before
        return 2 * left * scene.error - left**2 * before

    def _drawn(self, place: int) -> _Rolling:
        """The last scene that started at a place, as it was at the start."""
        seed, begun = self._sampler.seed, self._begun[place]
        scenes = self._sampler.trajectories
        epoch, number = divmod((begun - 1) * self._size + place, len(scenes))
        index = int(np.random.default_rng([seed, _ORDER, epoch]).permutation(scenes)[number])
        generator = np.random.default_rng([seed, _SCENE, place, begun])
        first = self._sampler.first_frame
        t = int(generator.integers(first, self._sampler.last_frame(index)))
        placement = self._sampler.random_placement(index, generator)
        if begun == 1:
            return _Rolling(index, t, placement, None)
        return _Rolling(index, first, placement, np.zeros((self._sampler.num_nodes(index), 3), np.float32))

"""Training along rollouts: the states that a model is trained on are those to which it led itself.

White noise teaches a model to undo errors that differ from node to node. What adds up in a rollout is smooth, and other
for each model. So scenes are rolled out while the model trains: the error that a step leaves in the position is the
error of the state of the next, and each step is trained to lead back to the truth. It takes no prediction more.

With inertia a state is two positions, and so two errors. Led back in one step, an error of the velocity would ask for
accelerations far above those of the data. So errors are led back as by a critically damped spring:

    e_{t+1} = 2 r e_t - r^2 e_{t-1},    r = 1 - gamma.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ast_sim.data.batch import Batch, Target
from ast_sim.data.placement import Placement
from ast_sim.data.sampling import Pair, PairSampler

SHARE = np.float32(1 / 3)  # of the white noise that is added in each step
# Separate the random numbers of the order, of the scenes and of their steps; those of the sampler are others.
_ORDER, _SCENE, _NOISE = 10, 11, 12


@dataclass(eq=False)
class _Rolling:
    """A scene under way; errors are [N, 3] float32, as in the data.

    error: what the last step left in p_t; None where white noise takes its place.
    error_before: that of p_{t-1}; None where it is the true one.
    pair: the one that the scene gave last.
    """

    index: int
    t: int
    placement: Placement
    error: np.ndarray | None
    error_before: np.ndarray | None = None
    pair: Pair | None = None


class RolloutPool:
    """So many training scenes, rolled out side by side; each batch takes the next of them, in turn.

    A scene begins at its first frame, the first one at each place at any frame, so that all frames are as frequent.
    After its last frame another one takes its place, each about as often. Where its error is too large to learn from,
    it goes on from the true state with white noise, as without a pool. All of it follows from the seed.

    `batch` may run ahead of `advance`, as long as the places of the two are not the same.

    Args:
        sampler: reads, places and puts together the frames of scenes; the batch size, the seed, the noise, the share
            of errors that targets undo and the part of each batch are its own.
        size: how many scenes; a multiple of the batch size.
        largest: root mean square error of a state, in units of length, above which there is nothing to learn from it.
    """

    def __init__(self, sampler: PairSampler, size: int, largest: float) -> None:
        self._sampler, self._size, self._batches = sampler, size, size // sampler.batch_size
        self._largest = largest
        self._begun: dict[int, int] = {}
        self._rolling: dict[int, _Rolling] = {}

    def batch(self, number: int) -> tuple[Batch, Target]:
        """The states to which the scenes of a batch have come, and what follows in the data."""
        return self._sampler.assemble([self._pair(place) for place in self._places(number)])

    def advance(self, number: int, residual: Tensor) -> None:
        """Go on with the scenes of a batch, given what was predicted of it minus the truth [N, 3], after the step."""
        first = 0
        for place in self._places(number):
            scene = self._rolling[place]
            rows = residual[first : first + self._sampler.num_nodes(scene.index)].numpy()
            first += len(rows)
            scene.t += 1
            if scene.t == self._sampler.last_frame(scene.index):
                del self._rolling[place]
            else:
                error = scene.placement.vectors(rows) + scene.pair.error_after  # the target was off the truth, too
                lost = np.sqrt(np.mean(np.square(error, dtype=np.float64))) > self._largest
                before = scene.pair.error if self._sampler.dynamic else None
                scene.error, scene.error_before = (None, None) if lost else (error, before)

    def state(self) -> dict[str, Tensor]:
        """Where all scenes stand, for `restore`."""
        found = {f"{place}.begun": torch.tensor(count) for place, count in self._begun.items()}
        for place, scene in self._rolling.items():
            found[f"{place}.t"] = torch.tensor(scene.t)
            errors = {"error": scene.error, "error_before": scene.error_before}
            found |= {f"{place}.{key}": torch.from_numpy(value) for key, value in errors.items() if value is not None}
        return found

    def restore(self, state: dict[str, Tensor]) -> None:
        """Go on where `state` was taken, or those of all parts together."""
        own = [place for i in range(self._batches) for place in self._places(i) if f"{place}.begun" in state]
        self._begun = {place: int(state[f"{place}.begun"]) for place in own}
        self._rolling = {place: self._drawn(place) for place in own if f"{place}.t" in state}
        for place, scene in self._rolling.items():
            scene.t = int(state[f"{place}.t"])
            errors = (state.get(f"{place}.{key}") for key in ("error", "error_before"))
            scene.error, scene.error_before = (None if error is None else error.numpy() for error in errors)

    def _places(self, number: int) -> range:
        """Where in the pool the scenes of this part of a batch are."""
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
        """What the target leaves in p_{t+1} of the error that the last step left in p_t."""
        left = self._sampler.left
        if not self._sampler.dynamic:
            return left * scene.error
        before = np.float32(0) if scene.error_before is None else scene.error_before
        return 2 * left * scene.error - left**2 * before

    def _drawn(self, place: int) -> _Rolling:
        """The scene that began last at a place, as it began."""
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

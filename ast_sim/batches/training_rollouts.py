"""Training along rollouts: a model is trained on states that its own predictions have led to.

White noise teaches a model to undo errors that differ from node to node. The errors that add up in a rollout are
smooth, and each model makes its own. So scenes are rolled out while the model trains: the error that a step leaves in
the position is in the state of the next step, and each step is trained to lead back to the truth. This costs no
additional prediction.

With inertia a state is two positions, so it has two errors. To undo an error of the velocity in one step would take
accelerations far above the accelerations in the data. So targets undo errors like a critically damped spring:

    e_{t+1} = 2 r e_t - r^2 e_{t-1},    r = 1 - gamma.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ast_sim.batches.mirror_and_shift import Placement
from ast_sim.batches.pairs import Pair
from ast_sim.batches.training_pool import TrainingPool

SHARE = np.float32(1 / 3)  # share of the white noise that is added in each step of a rollout
_NOISE = 12  # the noise draws from a sequence of random numbers of its own


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


class RolloutPool(TrainingPool[_Rolling]):
    """Training scenes that are rolled out side by side; see `TrainingPool` for the arguments.

    A scene starts at its first frame, and another scene follows it after its last frame. Only the first scene at each
    place starts at a random frame, so that all frames occur equally often from the beginning. A scene whose error is
    too large to learn from goes on from the true state with white noise, as without a pool. The sampler's noise and
    gamma hold for the pool too.
    """

    streams = (10, 11)
    kept = ("t", "error", "error_before")

    def _start(self, index: int, first: bool, generator: np.random.Generator) -> _Rolling:
        earliest = self._sampler.first_frame
        t = int(generator.integers(earliest, self._sampler.last_frame(index)))
        placement = self._sampler.random_placement(index, generator)
        if first:
            return _Rolling(index, t, placement, None)
        return _Rolling(index, earliest, placement, np.zeros((self._sampler.num_nodes(index), 3), np.float32))

    def _frames(self, place: int, scene: _Rolling) -> Pair:
        generator = self._sampler.random(_NOISE, place, self._begun[place], scene.t)
        white = self._sampler.white_noise(scene.index, generator)
        error = white
        after = self._sampler.left * white
        if scene.error is not None:
            led_back = self._led_back(scene.error, scene.error_before)
            error, after = scene.error + white * SHARE, after * SHARE + led_back
        scene.pair = Pair(scene.index, scene.t, scene.placement, error, scene.error_before, after)
        return scene.pair

    def _led_back(self, error: np.ndarray, error_before: np.ndarray | None) -> np.ndarray:
        """How much of the error that the last step left in p_t the target leaves in p_{t+1}."""
        left = self._sampler.left
        if not self._sampler.scheme.has_inertia:
            return left * error
        before = np.float32(0) if error_before is None else error_before
        return 2 * left * error - left**2 * before

    def _goes_on(self, scene: _Rolling, error: np.ndarray) -> bool:
        assert scene.pair is not None  # `batch` has made it
        scene.t += 1
        error = error + scene.pair.error_after  # the residual counts from the target, which has an error of its own
        before = scene.pair.error if self._sampler.scheme.has_inertia else None
        scene.error, scene.error_before = (None, None) if self._is_too_large(error) else (error, before)
        return scene.t < self._sampler.last_frame(scene.index)

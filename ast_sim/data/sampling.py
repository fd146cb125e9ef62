"""The pairs of frames that a model is trained on, as a pure function of a seed and a step number."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from ast_sim.data.batch import Batch, Target
from ast_sim.data.file import Dataset
from ast_sim.data.graph import Graph
from ast_sim.data.placement import Placement
from ast_sim.data.scene import Scene
from ast_sim.errors import DatasetError

# Separate the random numbers of the order from those of the noise and of the places.
_ORDER, _NOISE, _PLACE = 0, 1, 2


@dataclass(frozen=True, eq=False)
class _Member:
    """A trajectory: what its pairs share.

    noisy: [N, 3] float32, 1 where noise acts (NORMAL nodes; not z in a plane scene), else 0.
    center: [3] float32, the middle of the box that holds the scene at rest.
    """

    graph: Graph
    noisy: np.ndarray
    prescribed: np.ndarray
    center: np.ndarray


@dataclass(frozen=True, eq=False)
class Pair:
    """Frames t and t + 1 of a trajectory, and where they are put; errors are [N, 3] float32, as in the data.

    Attributes:
        error: that of p_t in the state.
        error_before: if there is inertia, that of p_{t-1}; None: there is none.
        error_after: that of p_{t+1} to which the target leads.
    """

    index: int
    t: int
    placement: Placement
    error: np.ndarray
    error_before: np.ndarray | None
    error_after: np.ndarray


class PairSampler:
    """Draws batches of frame pairs (t, t + 1) of a split; each epoch is a new random order of all pairs.

    With `from_first` the pairs are (0, t + 1): the state is always that of frame 0, for a time-conditioned model.

    White Gaussian noise n of standard deviation `noise` (in units of length) is added to p_t of the NORMAL nodes. It
    depends on seed, epoch and pair alone, not on the batch that the pair is in. The target's next position is
    p_{t+1} + (1 - gamma) n (MeshGraphNets, add_noise), so that

        increment     p_{t+1} - p_t - gamma n
        acceleration  p_{t+1} - 2 p_t + p_{t-1} - (1 + gamma) n

    and gamma = 1 leads back to the true next position; an error of p_{t-1} adds to the acceleration. Scenes whose z is
    0 throughout get no noise in z.

    Each pair is mirrored along each axis of `mirror` with probability 1/2, at planes through the middle of the scene at
    rest, and moved along each by at most `shift` (units of length), not out of its plane if it has one: functions of
    seed, epoch and pair, too.

    With `part` = (i, n) a batch is the i-th of n equal parts of the one that it would be.

    Raises:
        DatasetError: the split has no pair, or a sample cannot be read.
    """

    def __init__(
        self,
        dataset: Dataset,
        split: str,
        *,
        batch_size: int,
        seed: int,
        noise: float,
        make_graph: Callable[[Scene], Graph],
        dynamic: bool,
        gamma: float,
        part: tuple[int, int] = (0, 1),
        from_first: bool = False,
        mirror: tuple[str, ...] = (),
        shift: float = 0.0,
    ) -> None:
        self.batch_size, self.seed, self.noise = batch_size, seed, noise
        self.left = np.float32(1 - gamma)  # the share of the noise that stays in the target
        self._dataset, self._split, self._part = dataset, split, part
        self._make_graph, self.dynamic = make_graph, dynamic
        self.first_frame = 1 if dynamic else 0  # of a pair: the acceleration needs a frame before
        self._from_first = from_first
        self._mirrored, self._shift = np.array([axis in mirror for axis in "xyz"]), np.float32(shift)
        frames = np.array([dataset.num_frames(split, i) for i in range(dataset.count(split))], np.int64)
        self._starts = np.concatenate([[0], np.cumsum(np.maximum(frames - 1 - self.first_frame, 0))])
        if self.num_pairs == 0:
            least = 2 + self.first_frame
            raise DatasetError(
                f"{dataset.path}: {split} has no trajectory of at least {least} frames to draw pairs from"
            )
        self._members: dict[int, _Member] = {}
        self._order = lru_cache(maxsize=2)(self._draw_order)

    @property
    def num_pairs(self) -> int:
        """The number of pairs in an epoch."""
        return int(self._starts[-1])

    def batch(self, step: int) -> tuple[Batch, Target]:
        """The batch of a step: places step * batch_size onward in the endless sequence of epochs."""
        draws = [divmod(place, self.num_pairs) for place in self.places(step)]
        return self.assemble([self._pair(epoch, int(self._order(epoch)[place])) for epoch, place in draws])

    def places(self, step: int) -> range:
        """Which places, counted from the first batch on, are in this part of a step's batch."""
        index, count = self._part
        size = self.batch_size // count
        first = step * self.batch_size + index * size
        return range(first, first + size)

    def _pair(self, epoch: int, number: int) -> Pair:
        """A pair of all, with the noise and the place that it has in an epoch."""
        index, t = self._locate(number)
        noise = self.white_noise(index, np.random.default_rng([self.seed, _NOISE, epoch, number]))
        placement = self.random_placement(index, np.random.default_rng([self.seed, _PLACE, epoch, number]))
        return Pair(index, t, placement, noise, None, self.left * noise)

    def _locate(self, number: int) -> tuple[int, int]:
        """The trajectory and the first frame of pair 0, 1, ... `num_pairs` - 1."""
        index = int(np.searchsorted(self._starts, number, side="right")) - 1
        return index, number - int(self._starts[index]) + self.first_frame

    def last_frame(self, index: int) -> int:
        """The number of the last frame of a trajectory."""
        return self._dataset.num_frames(self._split, index) - 1

    @property
    def trajectories(self) -> np.ndarray:
        """Those that have a pair."""
        return np.flatnonzero(np.diff(self._starts))

    def num_nodes(self, index: int) -> int:
        """The number of nodes of a trajectory."""
        return len(self._member(index).noisy)

    def _draw_order(self, epoch: int) -> np.ndarray:
        return np.random.default_rng([self.seed, _ORDER, epoch]).permutation(self.num_pairs)

    def assemble(self, pairs: list[Pair]) -> tuple[Batch, Target]:
        """The batch of these pairs; errors count where noise acts."""
        graphs, names, positions, previous, boundary, motions = [], [], [], [], [], []
        stresses, next_stresses, numbers = [], [], []
        for pair in pairs:
            t, placement, member = pair.t, pair.placement, self._member(pair.index)
            position, stress = self._read(pair.index, t)
            before, now, after = position[0], position[-2], position[-1]
            increment = after - now
            error, error_after = pair.error * member.noisy, pair.error_after * member.noisy
            graphs.append(member.graph.placed(placement))
            names.append(f"{self._split}/{pair.index:06d} frame {t}")
            numbers.append(t + 1.0)
            positions.append(placement.points(now + error))
            boundary.append(placement.vectors(np.where(member.prescribed, increment, np.float32(0))))
            motion = increment + (error_after - error)
            if self.dynamic:
                if pair.error_before is not None:
                    before = before + pair.error_before * member.noisy
                previous.append(placement.points(before))
                motion -= now - before + error
            motions.append(placement.vectors(motion))
            if stress is not None:
                stresses.append(stress[-2])
                next_stresses.append(stress[-1])
        graph = Graph.concatenate(graphs)
        state = (_join(positions), _join(previous), _join(boundary), _join(stresses))
        return Batch(graph, *state, names, torch.tensor(numbers)), Target(_join(motions), _join(next_stresses))

    def _read(self, index: int, t: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Positions and stresses of the frames that a pair needs; the last two are the state's and the target's."""
        if not self._from_first:
            return self._dataset.frames(self._split, index, t - self.first_frame, t + 2)
        frames = (self._dataset.frames(self._split, index, frame, frame + 1) for frame in (0, t + 1))
        positions, stresses = zip(*frames, strict=True)
        return np.concatenate(positions), None if stresses[0] is None else np.concatenate(stresses)

    def white_noise(self, index: int, generator: np.random.Generator) -> np.ndarray:
        """[N, 3] float32 of the standard deviation `noise`."""
        return generator.standard_normal(self._member(index).noisy.shape, np.float32) * np.float32(self.noise)

    def random_placement(self, index: int, generator: np.random.Generator) -> Placement:
        """Mirrored at the middle of a scene along each axis of `mirror` with probability 1/2, and moved."""
        member = self._member(index)
        drawn = generator.integers(2, size=3, dtype=bool)
        sign = np.where(drawn & self._mirrored, np.float32(-1), np.float32(1))
        shift = generator.uniform(-1, 1, 3).astype(np.float32) * self._shift * member.noisy.max(axis=0)
        return Placement(sign, member.center, shift)

    def _member(self, index: int) -> _Member:
        if index not in self._members:
            scene = self._dataset.scene(self._split, index)
            position, _ = self._dataset.frames(self._split, index, 0, self._dataset.num_frames(self._split, index))
            noisy = np.repeat(~scene.prescribed[:, None], 3, axis=1).astype(np.float32)
            if not scene.rest_position[:, 2].any() and not position[:, :, 2].any():
                noisy[:, 2] = 0
            graph = self._make_graph(scene)
            center = (scene.rest_position.min(0) + scene.rest_position.max(0)) / 2
            self._members[index] = _Member(graph, noisy, scene.prescribed[:, None], center)
        return self._members[index]


def _join(arrays: list[np.ndarray]) -> Tensor | None:
    return torch.from_numpy(np.concatenate(arrays)) if arrays else None

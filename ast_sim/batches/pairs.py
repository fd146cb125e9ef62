"""The pairs of frames on which a model is trained. They depend only on a seed and the number of the step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ast_sim.batches.batch_builder import Batch, State, Target
from ast_sim.batches.carry import Carrier
from ast_sim.batches.frame_pairs import place_of, to_collate
from ast_sim.batches.graph import Graph
from ast_sim.batches.mirror_and_shift import Placement
from ast_sim.batches.scheme import Scheme
from ast_sim.batches.torch_settings import tensors_on_cpu
from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.whole_motions import require_whole_motions
from ast_sim.named_field import STRESS, require_fields
from ast_sim.scene import Scene
from ast_sim.support.argument_checks import in_short
from ast_sim.support.byte_cache import ByteCache, cache_bytes
from ast_sim.support.errors import ConfigError, DatasetError
from ast_sim.support.notebook_table import one_line

# The order, the noise and the placements draw from separate sequences of random numbers.
_ORDER, _NOISE, _PLACE = 0, 1, 2
_LARGEST_SEED = 1 << 62

_Motion = tuple[np.ndarray, Tensor | None, np.ndarray]  # the position in the state, the one before it, the target


@dataclass(frozen=True, eq=False)
class _Member:
    """What the pairs of a trajectory share.

    noisy: [N, 3] float32, 1 where noise is added, else 0: at NORMAL nodes, in a plane scene only in x and y.
    center: [3] float32, the middle of the box around the scene at rest.
    carry: moves a state along with the prescribed nodes; None if frames are predicted step by step.
    fields: [S, N or E, *] float32 of each named field to predict.
    sources: [S] int64, the frame that each frame is predicted from.
    """

    graph: Graph
    noisy: np.ndarray
    center: np.ndarray
    carry: Carrier | None
    fields: list[np.ndarray]
    sources: np.ndarray


@dataclass(frozen=True, eq=False)
class Pair:
    """Frames t and t + 1 of a trajectory, how they are mirrored and moved, and errors of their positions.

    Errors are [N, 3] float32, before the scene is mirrored.

    Attributes:
        error: the error of p_t in the state.
        error_before: with inertia, the error of p_{t-1} in the state; None for no error.
        error_after: the error of the p_{t+1} to which the target leads.
    """

    index: int
    t: int
    placement: Placement
    error: np.ndarray
    error_before: np.ndarray | None
    error_after: np.ndarray


@dataclass(eq=False)
class Jump:
    """Two frames of a trajectory, the later of which is predicted at once, and how they are mirrored and moved.

    Attributes:
        source, frame: the frame that is carried along to be the start, and the frame to predict.
        error: [N, 3] float32, the error of a guess of the frame to predict, which is to be corrected, before the scene
            is mirrored; None: there is no guess yet, and the jump starts from the source.
        share: without a guess, the jump starts with this share of the error of the carried-along start.
        source_error: [N, 3] float32, the error of the source, as a prediction of it has; None: the source is true.
    """

    index: int
    source: int
    frame: int
    placement: Placement
    error: np.ndarray | None = None
    share: float = 1.0
    source_error: np.ndarray | None = None


class PairSampler:
    """Draws batches of frame pairs (t, t + 1) of a split. Each epoch is a new random order of all pairs.

    A DataLoader of torch takes it, too, as a map-style dataset: `DataLoader(pairs, batch_size=4, shuffle=True,
    collate_fn=pairs.collate)`. The loader then chooses the pairs.

    The `scheme` says what t + 1 is predicted from: frame t, or, by a jump, an earlier frame, carried along. In jumps
    there is no noise; instead, half of the pairs start from a guess that has a random share of the error of this start,
    as a correction does.

    White Gaussian noise n of standard deviation `noise` (in the unit of length) is added to p_t of the NORMAL nodes.
    The next position in the target is p_{t+1} + (1 - gamma) n (MeshGraphNets, add_noise), so the target is

        increment     p_{t+1} - p_t - gamma n
        acceleration  p_{t+1} - 2 p_t + p_{t-1} - (1 + gamma) n

    With gamma = 1 it leads back to the true next position. An error of p_{t-1} adds to the acceleration. A plane scene,
    where z is 0 in all frames, gets no noise in z.

    Each pair is mirrored along each axis of `mirror` with probability 1/2, at planes through the middle of the scene at
    rest. It is moved along each axis by at most `shift` (in the unit of length), but a plane scene stays in its plane.

    Noise, mirroring and shift depend on seed, epoch and pair only, not on the batch of the pair.

    Targets have the stress, if there is one, and the named fields that `fields` tells of as in `Output`.

    With `part` = (i, n), `batch` returns the i-th of n equal parts of the whole batch. With `scenes` = k, all pairs
    come from the first k scenes of the split.

    Raises:
        ConfigError: a trajectory has some frames of its motion only.
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
        scheme: Scheme,
        gamma: float,
        part: tuple[int, int] = (0, 1),
        mirror: tuple[str, ...] = (),
        shift: float = 0.0,
        fields: tuple[tuple[str, str, int, str], ...] = (),
        scenes: int | None = None,
    ) -> None:
        self.batch_size = batch_size
        self.seed = seed
        self.noise = noise
        self.left = np.float32(1 - gamma)  # share of the noise that stays in the target
        self._dataset = dataset
        self._split = split
        self.part = part
        self._make_graph = make_graph
        self._fields = fields
        self.scheme = scheme
        self.first_frame = scheme.given_frames - 1  # the least t of a pair
        self._mirrored = np.array([axis in mirror for axis in "xyz"])
        self._shift = np.float32(shift)
        require_whole_motions(dataset, split)
        frames = np.array([dataset.num_frames(split, i) for i in range(dataset.count(split))[:scenes]], np.int64)
        self._starts = np.concatenate([[0], np.cumsum(np.maximum(frames - 1 - self.first_frame, 0))])
        if self.num_pairs == 0:
            least = f"at least {2 + self.first_frame} frames"
            raise DatasetError(f"{dataset.path}: {split} has no trajectory of {least} to draw pairs from")
        self._make_caches()

    def _make_caches(self) -> None:
        self._members: ByteCache[_Member] = ByteCache(cache_bytes())
        self._order = lru_cache(maxsize=2)(lambda epoch: self.random(_ORDER, epoch).permutation(self.num_pairs))

    def __getstate__(self) -> dict[str, Any]:
        """What the processes of a DataLoader need; each makes caches of its own."""
        return {key: value for key, value in vars(self).items() if key not in ("_members", "_order")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._make_caches()

    def __len__(self) -> int:
        return self.num_pairs

    def __repr__(self) -> str:
        facts = {"pairs": f"{len(self):,}", "split": self._split, "file": self._dataset.path.name}
        return one_line("PairSampler", facts)

    def __getitem__(self, number: int) -> tuple[Batch, Target]:
        """One pair of all, as a batch of its own. Its noise and its placement are new at each call; the seed of torch
        determines them."""
        number = place_of(number, len(self))
        return self._built(self._pair(int(torch.randint(_LARGEST_SEED, (), device="cpu")), number))

    @staticmethod
    @tensors_on_cpu()
    def collate(pairs: Sequence[tuple[Batch, Target]]) -> tuple[Batch, Target]:
        """Several pairs as one batch.

        Raises:
            ConfigError: there are none, or one is no pair of a batch and a target.
        """
        listed = to_collate(pairs, tuple, "pair of a batch and a target")
        for number, pair in enumerate(listed):
            if [type(one) for one in pair] != [Batch, Target]:
                raise ConfigError(f"item {number} is {in_short(pair)}; it must be one pair of a batch and a target")
        batches, targets = zip(*listed, strict=True)
        return Batch.concatenate(batches), Target.concatenate(targets)

    @property
    def num_pairs(self) -> int:
        """The number of pairs in an epoch."""
        return int(self._starts[-1])

    def batch(self, step: int) -> tuple[Batch, Target]:
        """The batch of a step: `batch_size` pairs from place step * batch_size on in the endless sequence of epochs."""
        draws = [divmod(place, self.num_pairs) for place in self.places(step)]
        return self.assemble([self._pair(epoch, int(self._order(epoch)[place])) for epoch, place in draws])

    def places(self, step: int) -> range:
        """The places of this part of a step's batch in the endless sequence of epochs."""
        index, count = self.part
        first = step * self.batch_size + index * (self.batch_size // count)
        return range(first, first + self.batch_size // count)

    def _pair(self, epoch: int, number: int) -> Pair | Jump:
        """Pair `number` of all, with its noise and its placement in an epoch."""
        index = int(np.searchsorted(self._starts, number, side="right")) - 1
        t = number - int(self._starts[index]) + self.first_frame
        placement = self.random_placement(index, self.random(_PLACE, epoch, number))
        if self.scheme.jumps:
            draw = self.random(_NOISE, epoch, number).random()
            return Jump(index, self.source(index, t + 1), t + 1, placement, share=min(2 * draw, 1.0))
        noise = self.white_noise(index, self.random(_NOISE, epoch, number))
        return Pair(index, t, placement, noise, None, self.left * noise)

    def last_frame(self, index: int) -> int:
        """The number of the last frame of a trajectory."""
        return self._dataset.num_frames(self._split, index) - 1

    def source(self, index: int, frame: int) -> int:
        """The frame of a trajectory that a jump to a frame starts from."""
        return int(self._member(index).sources[frame])

    @property
    def trajectories(self) -> np.ndarray:
        """The numbers of the trajectories that have a pair."""
        return np.flatnonzero(np.diff(self._starts))

    def num_nodes(self, index: int) -> int:
        """The number of nodes of a trajectory."""
        return len(self._member(index).noisy)

    def free(self, index: int) -> np.ndarray:
        """[N] bool: the nodes of a trajectory that a model moves."""
        return self._member(index).noisy[:, 0] > 0

    def random(self, *stream: int) -> np.random.Generator:
        """A sequence of random numbers, which the seed and these numbers determine."""
        return np.random.default_rng([self.seed, *stream])

    def assemble(self, pairs: Sequence[Pair | Jump]) -> tuple[Batch, Target]:
        """The batch of these pairs. Their errors are added only where noise would be."""
        return self.collate([self._built(pair) for pair in pairs])

    @tensors_on_cpu()
    def _built(self, pair: Pair | Jump) -> tuple[Batch, Target]:
        """The batch of one pair, mirrored and moved."""
        member = self._member(pair.index)
        jumps = isinstance(pair, Jump)
        source, frame = (pair.source, pair.frame) if jumps else (pair.t, pair.t + 1)
        before, stress = self._dataset.frames(self._split, pair.index, source - self.first_frame, source + 1)
        if jumps and pair.source_error is not None:
            before = before + pair.source_error * member.noisy
        (after,), next_stress = self._dataset.frames(self._split, pair.index, frame, frame + 1)
        position, previous, motion = (
            self._jump(pair, member, before, after) if jumps else self._step(pair, member, before, after)
        )
        known = self._values(member, stress, -1, source)
        state = State(torch.from_numpy(position), previous, known.get(STRESS))
        if self.scheme.history is not None:
            history = member.graph.at_nodes(self.scheme.history, known)
            state = replace(state, source=torch.tensor(before[-1]), history=history)
        target = Target(torch.from_numpy(motion), self._values(member, next_stress, 0, frame))
        names = [f"{self._split}/{pair.index:06d} frame {frame if jumps else source}"]
        batch = Batch.build(member.graph, state, torch.tensor(after), names)
        return batch.placed(pair.placement), target.placed(pair.placement)

    def _values(self, member: _Member, stress: np.ndarray | None, row: int, frame: int) -> dict[str, Tensor]:
        """What is predicted beside the motion, [N or E, *] by name, in a frame, whose stress is in this row."""
        rows = zip(self._fields, member.fields, strict=True)
        values = {key: torch.tensor(field[frame]) for (key, *_), field in rows}
        return values if stress is None else {STRESS: torch.tensor(stress[row]), **values}

    def _jump(self, jump: Jump, member: _Member, before: np.ndarray, after: np.ndarray) -> _Motion:
        if jump.error is not None:
            guess = after + jump.error * member.noisy
        else:
            assert member.carry is not None  # it is made for models that jump
            start = member.carry(before[-1], after)
            guess = start if jump.share == 1 else after + np.float32(jump.share) * (start - after)
        return guess, None, after - guess

    def _step(self, pair: Pair, member: _Member, position: np.ndarray, after: np.ndarray) -> _Motion:
        before, now = position[0], position[-1]
        error, error_after = pair.error * member.noisy, pair.error_after * member.noisy
        motion = after - now + (error_after - error)
        previous = None
        if self.scheme.has_inertia:
            if pair.error_before is not None:
                before = before + pair.error_before * member.noisy
            motion -= now - before + error
            previous = torch.tensor(before)
        return now + error, previous, motion

    def white_noise(self, index: int, generator: np.random.Generator) -> np.ndarray:
        """[N, 3] float32: noise of the standard deviation `noise`."""
        return generator.standard_normal(self._member(index).noisy.shape, np.float32) * np.float32(self.noise)

    def random_placement(self, index: int, generator: np.random.Generator) -> Placement:
        """Mirrored along each axis of `mirror` with probability 1/2, and moved by at most `shift`."""
        member = self._member(index)
        sign = np.where(generator.integers(2, size=3, dtype=bool) & self._mirrored, np.float32(-1), np.float32(1))
        shift = generator.uniform(-1, 1, 3).astype(np.float32) * self._shift * member.noisy.max(axis=0)
        return Placement(sign, member.center, shift)

    def _member(self, index: int) -> _Member:
        return self._members.get(index, lambda: self._make_member(index))

    @tensors_on_cpu()
    def _make_member(self, index: int) -> _Member:
        scene = self._dataset.scene(self._split, index)
        noisy = np.repeat(~scene.prescribed[:, None], 3, axis=1).astype(np.float32)
        count = self._dataset.num_frames(self._split, index)
        position = np.broadcast_to(scene.rest_position, (count, *scene.rest_position.shape))
        plane = not scene.rest_position[:, 2].any()
        if plane or self.scheme.turns:  # else the motion does not matter here, and the trajectory need not be read
            position, _ = self._dataset.frames(self._split, index, 0, count)
        if plane:
            noisy[:, 2] *= position[:, :, 2].any()
        sources = self.scheme.sources(position, scene.prescribed)
        center = (scene.rest_position.min(0) + scene.rest_position.max(0)) / 2
        carry = Carrier(scene) if self.scheme.jumps else None
        return _Member(self._make_graph(scene), noisy, center, carry, self._read_fields(index), sources)

    def _read_fields(self, index: int) -> list[np.ndarray]:
        """The values of the named fields to predict, [S, N or E, *] each."""
        names = [key for key, *_ in self._fields]
        read = self._dataset.fields(self._split, index, names) if names else {}
        require_fields(f"{self._dataset.path}: {self._split}/{index:06d}", read, self._fields)
        return [read[key].values for key in names]

"""Training jumps and corrections: a model learns to correct its own answers.

The first call of a model predicts a frame from the first frame, carried along. Each further call gets the answer of the
call before as its guess, sees the gaps, overlaps and strains that the guess has, and predicts what is missing. Scenes
go through all these calls side by side while the model trains: the answer that a step leaves is the guess of the
scene's next step. This costs no additional prediction.

The errors of later calls are smaller. So that they count as much, the squared error of call k is divided by the mean
square of the errors that call k has found so far, relative to that of the first call.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ast_sim.batches.batch_builder import Batch, Target
from ast_sim.batches.pairs import Jump, PairSampler

# The order and the jumps draw from separate sequences of random numbers, apart from the sampler's.
_ORDER, _JUMP = 20, 21
MEMORY = 0.99  # share of the running mean square that stays when a scene is added
UNSEEN = 0.3  # the first guess of the errors of later calls, relative to that of the first
LEAST = 0.02  # the errors of later calls, relative to that of the first, count as at least this
ELSEWHERE = 0.1  # share of the jumps that start from a later frame than the first


@dataclass(eq=False)
class _Guess:
    """A jump that is being corrected. `call` counts the calls that led to its guess; after `last` it is given up.
    `free` [N] bool: the nodes that a model moves."""

    jump: Jump
    call: int
    last: int
    free: np.ndarray


class JumpPool:
    """Jumps that are corrected side by side. The pool has `size` places, and batches take them in turn.

    A jump leads from the first frame of a scene, or in some cases from a later one, to a frame that is drawn; after
    `calls` calls another jump follows at its place. All scenes are drawn about equally often. Only the first jump at
    each place gets a random number of calls, so that all calls occur equally often from the beginning. A guess whose
    error is too large to learn from is given up. The seed determines all random choices.

    `batch` may be called ahead of `advance` if the two calls concern different places.

    Args:
        sampler: reads and assembles frames. Its batch size, seed and part hold for the pool too.
        size: how many jumps; a multiple of the batch size.
        calls: how many calls correct one another.
        largest: a guess with a root mean square error above this, in the unit of length, is too wrong to learn from.
    """

    def __init__(self, sampler: PairSampler, size: int, calls: int, largest: float) -> None:
        self._sampler, self._size, self._batches = sampler, size, size // sampler.batch_size
        self._calls, self._largest = calls, largest
        self._begun: dict[int, int] = {}
        self._guesses: dict[int, _Guess] = {}
        self._squares = np.full(calls, np.nan)

    def batch(self, number: int) -> tuple[Batch, Target]:
        """The current guesses of the jumps of a batch, and what is missing."""
        return self._sampler.assemble([self._jump(place) for place in self._places(number)])

    def errors(self, number: int, target: Target) -> list[tuple[int, float]]:
        """For each jump of a batch the number of its call, and the mean square of the error that the call finds."""
        return [
            (guess.call, float(np.square(motion.numpy()[guess.free]).mean(dtype=np.float64)))
            for guess, motion in self._rows(number, target.motion)
        ]

    def weights(self, number: int, errors: list[tuple[int, float]]) -> Tensor:
        """[B]: how much the squared error of each jump of a batch counts.

        Args:
            errors: those of all parts of the batch, in their order. They are added to the running means, so that all
                parts have the same means.
        """
        for call, square in errors:
            before = self._squares[call]
            self._squares[call] = square if np.isnan(before) else MEMORY * before + (1 - MEMORY) * square
        found = [self._guesses[place].call for place in self._places(number)]
        known = np.where(np.isnan(self._squares), UNSEEN**2 * self._squares[0], self._squares)
        shares = known / known[0] if known[0] > 0 else np.ones(self._calls)
        shares = np.where(np.isfinite(shares), np.maximum(shares, LEAST**2), 1)
        return torch.tensor(1 / shares[found], dtype=torch.float32)

    def advance(self, number: int, residual: Tensor) -> None:
        """Take over the answers of a batch as guesses.

        Args:
            number: of the batch.
            residual: [N, 3], `Simulator.residual` of the batch.
        """
        for place, (guess, rows) in zip(self._places(number), self._rows(number, residual), strict=True):
            guess.call += 1
            error = guess.jump.placement.vectors(rows).numpy()
            lost = np.sqrt(np.mean(np.square(error, dtype=np.float64))) > self._largest
            if guess.call >= guess.last or lost:
                del self._guesses[place]
            else:
                guess.jump = _with_error(guess.jump, error)

    def state(self) -> dict[str, Tensor]:
        """The state of all jumps, for `restore`."""
        found = {f"{place}.begun": torch.tensor(count) for place, count in self._begun.items()}
        for place, guess in self._guesses.items():
            found[f"{place}.call"] = torch.tensor(guess.call)
            if guess.jump.error is not None:
                found[f"{place}.error"] = torch.from_numpy(guess.jump.error)
        return {**found, "squares": torch.from_numpy(self._squares.copy())}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Take over what `state` returned, of this part of the batches or of all parts together."""
        own = [place for i in range(self._batches) for place in self._places(i) if f"{place}.begun" in state]
        self._begun = {place: int(state[f"{place}.begun"]) for place in own}
        self._guesses = {place: self._drawn(place) for place in own if f"{place}.call" in state}
        for place, guess in self._guesses.items():
            guess.call = int(state[f"{place}.call"])
            error = state.get(f"{place}.error")
            guess.jump = guess.jump if error is None else _with_error(guess.jump, error.numpy())
        self._squares = state["squares"].numpy().copy()

    def _places(self, number: int) -> range:
        """The places in the pool of this part of a batch."""
        return self._sampler.places(number % self._batches)

    def _jump(self, place: int) -> Jump:
        if place not in self._guesses:
            self._begun[place] = self._begun.get(place, 0) + 1
            self._guesses[place] = self._drawn(place)
        return self._guesses[place].jump

    def _drawn(self, place: int) -> _Guess:
        """The last jump that started at a place, as it was at the start."""
        seed, begun = self._sampler.seed, self._begun[place]
        scenes = self._sampler.trajectories
        epoch, number = divmod((begun - 1) * self._size + place, len(scenes))
        index = int(np.random.default_rng([seed, _ORDER, epoch]).permutation(scenes)[number])
        generator = np.random.default_rng([seed, _JUMP, place, begun])
        first = self._sampler.first_frame
        frame = int(generator.integers(first + 1, self._sampler.last_frame(index) + 1))
        source = int(generator.integers(first, frame)) if generator.random() < ELSEWHERE else first
        last = int(generator.integers(1, self._calls + 1)) if begun == 1 else self._calls
        jump = Jump(index, source, frame, self._sampler.random_placement(index, generator))
        return _Guess(jump, 0, last, self._sampler.free(index))

    def _rows(self, number: int, values: Tensor) -> list[tuple[_Guess, Tensor]]:
        """The guesses of a batch, and the rows of `values` [N, *] of each."""
        guesses = [self._guesses[place] for place in self._places(number)]
        return list(zip(guesses, values.split([len(guess.free) for guess in guesses]), strict=True))


def _with_error(jump: Jump, error: np.ndarray) -> Jump:
    return Jump(jump.index, jump.source, jump.frame, jump.placement, error)

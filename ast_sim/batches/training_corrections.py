"""Training jumps and corrections: a model learns to correct its own answers.

The first call of a model predicts a frame from the first frame, carried along. Each further call gets the answer of the
call before as its guess, sees the gaps, overlaps and strains that the guess has, and predicts what is missing. Scenes
go through all these calls side by side while the model trains: the answer that a step leaves is the guess of the
scene's next step. This costs no additional prediction.

The errors of later calls are smaller. So that they count as much, the squared error of call k is divided by the mean
square of the errors that call k leaves, relative to what the first call leaves. What it leaves is what call k + 1 has
found so far; what the last call leaves counts as what it finds. A division by what a call finds would give the first
call, which finds the whole displacement, hardly any weight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ast_sim.batches.batch_builder import Target
from ast_sim.batches.pairs import Jump, PairSampler
from ast_sim.batches.training_pool import TrainingPool

MEMORY = 0.99  # share of the running mean square that stays when a scene is added
UNSEEN = 0.3  # the first guess of the errors of later calls, relative to the error of the first call
LEAST = 0.02  # what later calls leave, relative to what the first leaves, counts as at least this
OWN = 0.5  # share of the jumps from a later frame than the first that start from the model's own answer for it
ELSEWHERE = 0.1  # share of the jumps that start from a later frame than `PairSampler.source` says


@dataclass(eq=False)
class _Guess(Jump):
    """A jump that is being corrected. `call` counts the calls that led to its guess; after `last` it ends. Then the
    model's answer is the start of a jump to the frame `then`, if there is one."""

    call: int = 0
    last: int = 1
    then: int | None = None

    def go_to(self, frame: int) -> None:
        """Jump to a frame from the one that was predicted."""
        self.source = self.frame
        self.frame = frame
        self.then = None


class JumpPool(TrainingPool[_Guess]):
    """Jumps that are corrected side by side; see `TrainingPool` for the other arguments.

    A jump leads from `PairSampler.source`, or in some cases from a later frame, to a frame that is drawn; after
    `calls` calls another jump follows at its place. Where the source is not the first frame, half of the jumps start
    from the model's own answer for the source, to which a jump led just before. Only the first jump at each place gets
    a random number of calls, so that all calls occur equally often from the beginning. A guess whose error is too large
    to learn from is given up.

    Args:
        calls: how many calls correct one another.
    """

    streams = (20, 21)
    kept = ("call", "error", "source_error")

    def __init__(self, sampler: PairSampler, size: int, calls: int, largest: float) -> None:
        super().__init__(sampler, size, largest)
        self._calls = calls
        self.weighs = calls > 1
        self._squares = np.full(calls, np.nan)

    def errors(self, number: int, target: Target) -> list[tuple[int, float]]:
        """For each jump of a batch the number of its call, and the mean square of the error that the call finds."""
        guesses = [self._going[place] for place in self._places(number)]
        motions = zip(guesses, self._of_scenes(number, target.motion), strict=True)
        free = self._sampler.free
        return [(g.call, float(np.square(m.numpy()[free(g.index)]).mean(dtype=np.float64))) for g, m in motions]

    def weights(self, number: int, errors: list[tuple[int, float]]) -> Tensor:
        """See `TrainingPool`. The errors are added to the running means, so that all parts have the same means."""
        for call, square in errors:
            before = self._squares[call]
            self._squares[call] = square if np.isnan(before) else MEMORY * before + (1 - MEMORY) * square
        known = np.where(np.isnan(self._squares), UNSEEN**2 * self._squares[0], self._squares)
        left = np.append(known[1:], known[-1])
        shares = left / left[0] if left[0] > 0 else np.ones(self._calls)
        shares = np.where(np.isfinite(shares), np.maximum(shares, LEAST**2), 1)
        calls = [self._going[place].call for place in self._places(number)]
        return torch.tensor(1 / shares[calls], dtype=torch.float32)

    def state(self) -> dict[str, Tensor]:
        return {**super().state(), "squares": torch.from_numpy(self._squares.copy())}

    def restore(self, state: dict[str, Tensor]) -> None:
        super().restore(state)
        for guess in self._going.values():
            if guess.source_error is not None and guess.then is not None:
                guess.go_to(guess.then)
        self._squares = state["squares"].numpy().copy()

    def _start(self, index: int, first: bool, generator: np.random.Generator) -> _Guess:
        earliest = self._sampler.first_frame
        frame = int(generator.integers(earliest + 1, self._sampler.last_frame(index) + 1))
        path = [self._sampler.source(index, frame), frame]
        if generator.random() < ELSEWHERE:
            path[0] = int(generator.integers(path[0], frame))
        elif path[0] > earliest and generator.random() < OWN:
            path.insert(0, self._sampler.source(index, path[0]))
        last = int(generator.integers(1, self._calls + 1)) if first else self._calls
        placement = self._sampler.random_placement(index, generator)
        return _Guess(index, path[0], path[1], placement, last=last, then=path[2] if len(path) > 2 else None)

    def _frames(self, place: int, scene: _Guess) -> _Guess:
        return scene

    def _goes_on(self, scene: _Guess, error: np.ndarray) -> bool:
        scene.call = scene.call + 1
        scene.error = error
        if self._is_too_large(error):
            return False
        if scene.call == scene.last and scene.then is not None:
            scene.go_to(scene.then)
            scene.call = 0
            scene.error = None
            scene.source_error = error
        return scene.call < scene.last

"""The number of steps, and the learning rate and the random seed of each."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from typing import TypeVar

from ast_sim.runs.train_config import TrainConfig

T = TypeVar("T")


@dataclass(frozen=True)
class Schedule:
    """The steps of a training whose settings are resolved. The attributes are as in `TrainConfig`, but none is None."""

    steps: int
    peak_rate: float
    warmup: int
    decay: int
    validate_every: int
    checkpoint_every: int

    @staticmethod
    def of(config: TrainConfig) -> Schedule:
        """Of resolved settings."""
        return Schedule(
            steps=_known(config.steps),
            peak_rate=_known(config.peak_rate),
            warmup=_known(config.warmup),
            decay=_known(config.decay),
            validate_every=_known(config.validate_every),
            checkpoint_every=_known(config.checkpoint_every),
        )

    def rate(self, step: int) -> float:
        """The learning rate of step 0, 1, ...

        It grows linearly from 1e-4 of the peak to the peak in `warmup` steps, then falls as a cosine to 0 at step
        `decay`.
        """
        if step < self.warmup:
            return self.peak_rate * (1e-4 + (1 - 1e-4) * step / self.warmup)
        phase = (step - self.warmup) / max(1, self.decay - self.warmup)
        return 0.5 * self.peak_rate * (1 + math.cos(math.pi * min(1.0, phase)))


def _known(value: T | None) -> T:
    assert value is not None, "the settings of the training are not resolved"
    return value


def step_seed(seed: int, step: int) -> int:
    """The seed for the dropout of a step: 63 bits of a hash of both numbers."""
    return int.from_bytes(hashlib.sha256(f"{seed}:{step}".encode()).digest()[:8], "little") >> 1

"""The number of steps, and the learning rate and the random seed of each."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass

from ast_sim.runs.train_config import TrainConfig
from ast_sim.support.toml_settings import known


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
            steps=known(config.steps),
            peak_rate=known(config.peak_rate),
            warmup=known(config.warmup),
            decay=known(config.decay),
            validate_every=known(config.validate_every),
            checkpoint_every=known(config.checkpoint_every),
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


def step_seed(seed: int, step: int) -> int:
    """The seed for the dropout of a step: 63 bits of a hash of both numbers."""
    return int.from_bytes(hashlib.sha256(f"{seed}:{step}".encode()).digest()[:8], "little") >> 1

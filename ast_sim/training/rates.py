"""The learning rate and the random seed of each step."""

from __future__ import annotations

import hashlib
import math

from ast_sim.runs.train_config import TrainConfig


def learning_rate(config: TrainConfig, step: int) -> float:
    """The learning rate of step 0, 1, ...

    It grows linearly from 1e-4 of the peak to the peak in `warmup` steps, then falls as a cosine to 0 at step `decay`.
    """
    if step < config.warmup:
        return config.peak_rate * (1e-4 + (1 - 1e-4) * step / config.warmup)
    phase = (step - config.warmup) / max(1, config.decay - config.warmup)
    return 0.5 * config.peak_rate * (1 + math.cos(math.pi * min(1.0, phase)))


def step_seed(seed: int, step: int) -> int:
    """The seed for the dropout of a step: 63 bits of a hash of both numbers."""
    return int.from_bytes(hashlib.sha256(f"{seed}:{step}".encode()).digest()[:8], "little") >> 1

"""Error measures: the root of a mean squared error, by the two conventions in use; numpy only.

For sequences s with squared errors e of all their frames, nodes and coordinates:

    rmse_sequence = mean over s of sqrt(mean of e within s)      (the AST paper's)
    rmse_pooled   = sqrt(mean of e over all sequences together)  (MeshGraphNets')
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SquaredError:
    """The squared errors of one sequence: their sum and how many numbers were compared."""

    total: float
    count: int

    @classmethod
    def between(cls, prediction: np.ndarray, truth: np.ndarray, rows: np.ndarray) -> SquaredError:
        """Compare [S, N, F] with [S, N, F] (or what broadcasts to it) on the rows [N] bool, in float64."""
        difference = np.asarray(prediction, np.float64) - truth
        difference = difference[:, rows]
        return cls(float(np.square(difference).sum()), difference.size)

    @property
    def rmse(self) -> float:
        return math.sqrt(self.total / self.count) if self.count else math.nan


def rmse_sequence(errors: Sequence[SquaredError]) -> float:
    """Mean over the sequences of the root of each sequence's mean squared error; sequences without numbers are left
    out, and without any the result is NaN."""
    values = [error.rmse for error in errors if error.count]
    return math.fsum(values) / len(values) if values else math.nan


def rmse_pooled(errors: Sequence[SquaredError]) -> float:
    """Root of the mean squared error over everything; NaN without numbers."""
    count = sum(error.count for error in errors)
    return math.sqrt(math.fsum(error.total for error in errors) / count) if count else math.nan

"""Root mean square errors over several sequences, in the two conventions that are in use; numpy only.

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
    """Mean over the sequences of the root mean square error of each. Sequences without numbers are left out; if none
    is left, the result is NaN."""
    values = [error.rmse for error in errors if error.count]
    return math.fsum(values) / len(values) if values else math.nan


def rmse_pooled(errors: Sequence[SquaredError]) -> float:
    """Root mean square error over the numbers of all sequences; NaN if there are no numbers."""
    count = sum(error.count for error in errors)
    return math.sqrt(math.fsum(error.total for error in errors) / count) if count else math.nan

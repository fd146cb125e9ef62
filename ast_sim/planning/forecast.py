"""The error of a long training from the errors of shorter ones, by a power law.

The error of whole trainings, each with a learning rate that falls to zero at its end, falls about as a power of the
number of their steps (Hestness et al. 2017, arXiv:1712.00409). The power gets smaller as trainings get longer, so the
slope between the two longest trials is damped. `DAMPING` and `SPREAD` come from measured curves
(`python -m benchmarks.studies.forecasts`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

DAMPING = 0.9  # of the slope, beyond the longest trial
SPREAD = 0.3  # the interval reaches from 0.7 to 1.3 times the expected error


class Forecast(NamedTuple):
    """An expected error and an interval around it; four of five trainings that were checked ended in theirs."""

    error: float
    low: float
    high: float


def slope(points: Sequence[tuple[int, float]]) -> float:
    """The power by which the error falls with the steps, between the last two points (steps, error)."""
    (before, worse), (after, better) = points[-2:]
    return math.log(worse / better) / math.log(after / before)


def forecast(points: Sequence[tuple[int, float]], steps: int) -> Forecast | None:
    """The error after `steps` steps; None if the longest training was no better than the one before.

    Args:
        points: steps and error of two trainings or more, the longest one last.
    """
    power = slope(points)
    if power <= 0:
        return None
    longest, error = points[-1]
    expected = error * (steps / longest) ** (-DAMPING * power)
    return Forecast(expected, expected * (1 - SPREAD), expected * (1 + SPREAD))

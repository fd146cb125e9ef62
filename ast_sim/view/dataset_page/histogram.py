"""Histograms with round edges, as JSON for the page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

BINS = 20  # at most
TAIL = 0.99  # if values have a long tail, this share of them has its own bins; the last bin takes the rest


def histogram(values: Mapping[str, Sequence[float]], whole: bool = False) -> dict[str, Any]:
    """How many values fall between round edges, counted separately for each key (the splits).

    A bin is [edge, next edge); the last one includes its upper end. If `open` is true, the last bin also holds all
    values above it. Values that are not finite are counted only in `not_finite`.

    Args:
        values: numbers by split.
        whole: the values are whole numbers, so no edge stands between two of them.
    """
    arrays = {key: np.asarray(numbers, dtype=float) for key, numbers in values.items()}
    every = np.concatenate([*arrays.values(), np.zeros(0)])
    finite = every[np.isfinite(every)]
    result: dict[str, Any] = {"not_finite": len(every) - len(finite), "count": len(finite)}
    if not len(finite):
        return result
    edges, is_open = _edges(finite, whole)
    counts = {
        key: np.histogram(np.clip(numbers[np.isfinite(numbers)], edges[0], edges[-1]), edges)[0].tolist()
        for key, numbers in arrays.items()
    }
    low, median, high = np.quantile(finite, (0.05, 0.5, 0.95))
    return {
        **result,
        "edges": edges.tolist(),
        "counts": counts,
        "open": is_open,
        "whole": whole,
        "summary": {
            "smallest": float(finite.min()),
            "low": float(low),
            "median": float(median),
            "high": float(high),
            "largest": float(finite.max()),
        },
    }


def _edges(values: np.ndarray, whole: bool) -> tuple[np.ndarray, bool]:
    """Round edges for at most `BINS` bins, and whether values lie above the last."""
    low, high = float(values.min()), float(values.max())
    tail = float(np.quantile(values, TAIL))
    is_open = high - low > 2 * (tail - low) > 0
    upper = tail if is_open else high
    if 0 < low < 0.25 * upper:
        low = 0.0  # a scale that starts at 0 where that costs little
    wanted = min(BINS, max(6, 2 * math.ceil(math.sqrt(len(values)))))
    step = _round_up((upper - low) / wanted or 0.1 * abs(upper) or 1.0)
    if whole:
        step = max(1.0, step)
    first = math.floor(low / step)
    last = math.floor(upper / step) + 1
    if not whole and upper == (last - 1) * step and last - 1 > first:
        last -= 1
    return step * np.arange(first, last + 1), is_open


def _round_up(step: float) -> float:
    """The next of 1, 2, 5, 10, ..."""
    size = 10.0 ** math.floor(math.log10(step))
    return next(size * factor for factor in (1, 2, 5, 10) if step <= size * factor * (1 + 1e-9))

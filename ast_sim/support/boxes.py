"""Which points and triangles may lie near others, by the boxes around them: a search need not look at the rest."""

from __future__ import annotations

import numpy as np


def beside(things: np.ndarray, others: np.ndarray, distance: float) -> np.ndarray:
    """[n] bool: which points [n, 3] or triangles [n, 3, 3] come as near as `distance` to the box around the others."""
    if not len(others):
        return np.zeros(len(things), bool)
    box = others.reshape(-1, 3).min(axis=0) - distance, others.reshape(-1, 3).max(axis=0) + distance
    low, high = (things, things) if things.ndim == 2 else (things.min(axis=1), things.max(axis=1))
    return ((high >= box[0]) & (low <= box[1])).all(axis=1)

"""The root cell of the octree, from the positions of a dataset."""

from __future__ import annotations

import numpy as np

# The cube of the octree reaches beyond the positions of the data by this share of their largest extent.
MARGIN = 0.1


class Domain:
    """The smallest box that holds all positions so far; with a margin it gives the cube of `DatasetInfo`."""

    def __init__(self) -> None:
        self._lowest, self._highest = np.full(3, np.inf), np.full(3, -np.inf)

    def add(self, position: np.ndarray) -> None:
        """Take in positions [S, N, 3]."""
        # Over the frames first: rows of 3 N numbers are long enough for vector instructions.
        frames = position.reshape(len(position), -1)
        self._lowest = np.minimum(self._lowest, frames.min(axis=0).reshape(-1, 3).min(axis=0))
        self._highest = np.maximum(self._highest, frames.max(axis=0).reshape(-1, 3).max(axis=0))

    @property
    def center(self) -> tuple[float, float, float]:
        return tuple(float(x) for x in (self._lowest + self._highest) / 2)

    @property
    def half_width(self) -> float:
        return float((0.5 + MARGIN) * (self._highest - self._lowest).max())

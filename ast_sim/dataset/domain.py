"""Writing a dataset whose domain, the root cell of the octree, follows from its positions."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import numpy as np

from ast_sim.dataset.layout import DatasetInfo
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.scene import Trajectory

# On each side the domain is larger than the positions by this share of their largest extent.
MARGIN = 0.1


class FittedWriter(DatasetWriter):
    """A `DatasetWriter` that fits the domain of its `info` to the positions of all trajectories.

    Args:
        facts: the fields of `DatasetInfo` without the domain.
    """

    def __init__(self, path: str | os.PathLike[str], **facts: Any) -> None:
        super().__init__(path, DatasetInfo(domain_center=(0.0, 0.0, 0.0), domain_half_width=1.0, **facts))
        self._lowest, self._highest = np.full(3, np.inf), np.full(3, -np.inf)

    def add(self, split: str, trajectory: Trajectory) -> None:
        super().add(split, trajectory)
        # The minimum over the frames comes first: its rows of 3 N numbers suit vector instructions.
        frames = trajectory.position.reshape(trajectory.num_frames, -1)
        self._lowest = np.minimum(self._lowest, frames.min(axis=0).reshape(-1, 3).min(axis=0))
        self._highest = np.maximum(self._highest, frames.max(axis=0).reshape(-1, 3).max(axis=0))

    def _finish(self) -> None:
        x, y, z = ((self._lowest + self._highest) / 2).tolist()
        half_width = float((0.5 + MARGIN) * (self._highest - self._lowest).max())
        self.info = replace(self.info, domain_center=(x, y, z), domain_half_width=half_width)
        super()._finish()

"""Horizons: the frame from which a frame is predicted, and where the model then takes the prescribed nodes to be.

Step by step, each frame is predicted from the frame before. The errors of a prediction are in the state from which the
next one starts. From the first frame, each frame is predicted at once. The model then takes the prescribed nodes to be
where they will be in the frame to predict.
"""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from ast_sim.batches.batch_builder import Batch


class Horizon(Protocol):
    """How far ahead a model predicts.

    Attributes:
        drifts: whether later predictions start from states with the errors of earlier ones.
        numbered: whether the number of the frame is an input of every node.
    """

    drifts: bool
    numbered: bool

    def source(self, frame: int) -> int:
        """The frame from which `frame` is predicted."""

    def present(self, batch: Batch) -> Tensor:
        """[N, 3]: the positions from which a model makes edges and cells."""


class StepByStep:
    """Each frame from the frame before."""

    drifts, numbered = True, False

    def source(self, frame: int) -> int:
        return frame - 1

    def present(self, batch: Batch) -> Tensor:
        return batch.position


class FromFirst:
    """Each frame at once from the first frame."""

    drifts, numbered = False, True

    def source(self, frame: int) -> int:
        return 0

    def present(self, batch: Batch) -> Tensor:
        return batch.position + batch.boundary_motion


STEP_BY_STEP, FROM_FIRST = StepByStep(), FromFirst()

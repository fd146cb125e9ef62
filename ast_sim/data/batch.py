"""What a model is given and what it is to find, for a batch of scenes (N nodes, E elements in all)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from ast_sim.data.graph import Graph


@dataclass(frozen=True, eq=False)
class Batch:
    """The state of each scene at its time t; of a time-conditioned model at t = 0, whichever frame it is to predict.

    Attributes:
        graph: the static part.
        position: [N, 3] float32, p_t (with noise in training).
        previous_position: [N, 3], p_{t-1}; None unless the dynamics has inertia.
        boundary_motion: [N, 3], p_{t+1} - p_t of the prescribed nodes, zero elsewhere; time-conditioned, their whole
            way to the frame.
        stress: [N, 1] or [E, 1] at t, or None.
        names: for messages, one per scene: "train/000012 frame 7".
        frame: [B] float32, the number of the frame to predict, which a time-conditioned model needs.
    """

    graph: Graph
    position: Tensor
    previous_position: Tensor | None
    boundary_motion: Tensor
    stress: Tensor | None
    names: list[str]
    frame: Tensor | None = None


@dataclass(frozen=True, eq=False)
class Target:
    """What follows the state of a batch.

    Attributes:
        motion: [N, 3], the increment p_{t+1} - p_t, or the acceleration p_{t+1} - 2 p_t + p_{t-1} where there is
            inertia; corrected for the noise on p_t. Time-conditioned, the whole way from the first frame.
        stress: [N, 1] or [E, 1] at t + 1, or None.
    """

    motion: Tensor
    stress: Tensor | None

"""How a model comes to a frame: at once, by a jump, or step by step."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ast_sim.batches.turning_points import jump_sources
from ast_sim.named_field import Output


@dataclass(frozen=True)
class Scheme:
    """How a model predicts, and what follows from it (`ModelConfig.scheme`).

    Attributes:
        jumps: a frame is predicted at once from an earlier one, which is carried along with the prescribed nodes; else
            from the frame before.
        given_frames: the first frames of a scene, which are not predicted.
        history: a jump starts from the last frame in which the motion turned back, if it did, and knows these outputs
            there; None: it starts from the first one.
    """

    jumps: bool
    given_frames: int = 1
    history: tuple[Output, ...] | None = None

    @property
    def turns(self) -> bool:
        """Whether a jump may start from a later frame than the first one."""
        return self.history is not None

    @property
    def has_inertia(self) -> bool:
        """Whether a frame follows from two frames before it."""
        return self.given_frames > 1

    @property
    def corrects(self) -> bool:
        """Whether further calls of the model correct its answer, and Newton steps and the solver may follow."""
        return self.jumps

    @property
    def errors_add_up(self) -> bool:
        """Whether the error of a frame goes on into the next one: then noise on the states of the training makes sense,
        and one step from the true frame before has another error than a prediction of the whole scene."""
        return not self.jumps

    @property
    def needs_each_frame(self) -> bool:
        """Whether the frames before a wanted one are computed, so that it matters how far a frame goes."""
        return not self.jumps

    @property
    def follows_motion(self) -> bool:
        """Whether a frame depends on where the prescribed nodes were before, not on where they are alone."""
        return not self.jumps or self.turns

    def sources(self, position: np.ndarray, prescribed: np.ndarray) -> np.ndarray:
        """[S] int64: the frame that each frame is predicted from; of the given frames it means nothing.

        Args:
            position: [S, N, 3], the positions in each frame; only prescribed nodes are read.
            prescribed: [N] bool.
        """
        if not self.jumps:
            return np.arange(len(position)) - 1
        return jump_sources(position, prescribed) if self.turns else np.zeros(len(position), np.int64)

    def computed(self, wanted: Iterable[int], sources: np.ndarray) -> list[int]:
        """The frames that are predicted for these wanted ones, in ascending order."""
        needed: set[int] = set()
        for number in wanted:
            while number >= self.given_frames and number not in needed:
                needed.add(number)
                number = int(sources[number])
        return sorted(needed)

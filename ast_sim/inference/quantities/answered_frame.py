"""One frame of an answer."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ast_sim.support.notebook_table import one_line


class AnsweredFrame(NamedTuple):
    """One frame of an answer.

    Attributes:
        number: its number in the motion of the question.
        time: in seconds; None: it is not known.
        position: [N, 3].
        displacement: [N, 3], from the positions at rest.
        stress: [N or E], von Mises stress in pascal, or None.
        fields: [N or E, *], the named fields that the model predicts, by name.
    """

    number: int
    time: float | None
    position: np.ndarray
    displacement: np.ndarray
    stress: np.ndarray | None
    fields: dict[str, np.ndarray]

    def __repr__(self) -> str:
        facts = {
            "number": self.number,
            "time": "not known" if self.time is None else f"{self.time:.4g} s",
            "nodes": f"{len(self.position):,}",
            "largest displacement": f"{np.linalg.norm(self.displacement, axis=1).max(initial=0.0):.4g}",
            "largest stress": "none" if self.stress is None else f"{self.stress.max(initial=0.0):.4g} Pa",
            "fields": ", ".join(self.fields) or "none",
        }
        return one_line("AnsweredFrame", facts)

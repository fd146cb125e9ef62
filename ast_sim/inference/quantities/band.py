"""How far a quantity of an answer may be from the truth, frame by frame, and what is known of the answer in words.

A quantity has values [n, c] in each frame: the displacement of the n free nodes, the force on the moved body (n = 1),
the largest stress (n = c = 1). Its size is the root mean square of the n vectors, its error the length of the largest
of their differences from the truth. The scale of an error is the sum of the size and of a typical size: frames in which
hardly anything moves have errors that are large beside their size, and would make every band wide (docs/log.md,
2026-11-27).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ast_sim.inference.quantities.forces_and_figures import STIFFER, is_stiffer
from ast_sim.inference.quantities.relative_errors import require_quantity, truth_in_place
from ast_sim.number_arrays import percent
from ast_sim.scene import Trajectory
from ast_sim.support.errors import ConfigError

if TYPE_CHECKING:
    from ast_sim.inference.answer import Answer

LEVEL = 0.95  # the probability with which a band holds


@dataclass(frozen=True)
class Band:
    """The band of a quantity: width * (size + typical).

    Attributes:
        width: q of the calibration.
        typical: the root mean square of the true sizes in the calibration scenes.
    """

    width: float
    typical: float

    def around(self, answer: Answer, quantity: str) -> np.ndarray:
        """[S]: how far from the truth the quantity may be; 0 in given frames."""
        return np.where(answer.computed, self.width * (_sizes(VALUES[quantity](answer)) + self.typical), 0)


def band_of(answer: Answer, quantity: str) -> np.ndarray | None:
    """See `Answer.band`."""
    require_quantity(quantity, answer.bands)
    if quantity == "reaction" and is_stiffer(answer):
        raise ConfigError(f"{answer.name}: no force is promised: {STIFFER}")
    return answer.bands[quantity].around(answer, quantity) if quantity in answer.bands else None


def bands_of(answer: Answer) -> dict[str, np.ndarray]:
    """The bands that an answer has, [S] each, by their names in `Answer.figures` and in files."""
    known = [name for name in answer.bands if name != "reaction" or not is_stiffer(answer)]
    figures = {name: "largest_stress" if name == "stress" else name for name in known}
    return {f"{figures[name]}_band": answer.bands[name].around(answer, name) for name in known}


@dataclass(frozen=True)
class Comparison:
    """The sizes of a quantity in the S computed frames of an answer and in truth, and its errors, each [S]."""

    sizes: np.ndarray
    true_sizes: np.ndarray
    errors: np.ndarray

    def score(self, typical: float) -> float:
        """The largest error over its scale; 0 without errors."""
        scales = np.maximum(self.sizes + typical, np.finfo(float).tiny)
        return float((self.errors / scales).max(initial=0.0))


def compared(answer: Answer, truth: Trajectory) -> dict[str, Comparison]:
    """Each quantity that the scene has, in the answer of a run and in all frames of the same motion."""
    true = truth_in_place(answer, truth, list(answer.frames))
    result = {}
    for quantity, values in VALUES.items():
        if quantity == "reaction" and is_stiffer(answer):
            continue
        try:
            ours, theirs = (values(one)[answer.computed] for one in (answer, true))
        except ConfigError:  # a quantity that this scene has not
            continue
        errors = np.linalg.norm(ours - theirs, axis=2).max(axis=1)
        result[quantity] = Comparison(_sizes(ours), _sizes(theirs), errors)
    return result


def how_far(answer: Answer) -> list[str]:
    """See `Answer.how_far`."""
    told = []
    if "promise" in answer.source:
        told.append(f"effort: {answer.source['effort']}, {answer.source['promise']}")
    told += [answer.source["solved"]] if "solved" in answer.source else []
    if answer.expected_error is not None:
        share = f"{percent(answer.expected_error)} of the displacement"
        told.append(f"expected error: {share}, as in the validation scenes at their deepest frame")
    if (band := answer.band()) is not None:
        unit = "" if answer.info is None else f" {answer.info.length_unit}"
        widest = f"{band.max():.3g}{unit}, in frame {answer.frames[int(band.argmax())]}"
        told.append(f"band: with {100 * LEVEL:g} % all free nodes lie within {widest} at most")
    return told


def _displacement(answer: Answer) -> np.ndarray:
    return answer.displacement[:, ~answer.scene.prescribed].astype(np.float64)


def _reaction(answer: Answer) -> np.ndarray:
    return answer.reaction()[:, None]


def _largest_stress(answer: Answer) -> np.ndarray:
    if answer.stress is None:
        raise ConfigError(f"{answer.name} has no stress")
    rows = answer.scene.deforming(answer.stress_location or "node")
    return answer.stress[:, rows].max(axis=1, keepdims=True).astype(np.float64)


VALUES = {"displacement": _displacement, "reaction": _reaction, "stress": _largest_stress}  # [S, n, c]


def _sizes(values: np.ndarray) -> np.ndarray:
    """[S] float64: the root mean square of the vectors [n, c] of each frame."""
    return np.sqrt(np.square(values).sum(axis=2).mean(axis=1))

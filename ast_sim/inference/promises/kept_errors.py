"""The errors of calibration scenes after each effort, and the cheapest effort that keeps an error.

A scene misses an effort if its error is above the wanted one after this effort or after a dearer one: so the scenes
that miss an effort hold all that miss a dearer one. Of n scenes let m miss an effort. The cheapest effort with
m + 1 <= (1 - KEPT) (n + 1) is taken; where there is none, nothing is promised. Then a fresh scene of the same kind is
given a promise that is broken with a probability of at most 1 - KEPT, over calibrations and fresh scenes (conformal
risk control: Angelopoulos, Bates, Fisch, Lei, Schuster 2024, theorem 1). That efforts are compared costs nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from numbers import Real
from typing import Any, Self

import numpy as np

from ast_sim.inference.effort import Effort
from ast_sim.number_arrays import percent
from ast_sim.support.argument_checks import in_short
from ast_sim.support.errors import ConfigError

KEPT = 0.9  # of the scenes keep the error that is promised
DISPLACEMENT = "displacement"  # the quantity that every scene has; what an error is of, if nothing is said


@dataclass(frozen=True)
class KeptErrors:
    """Relative errors of calibration scenes at their deepest frame.

    Attributes:
        efforts: K efforts, from the cheapest to the dearest; none for a model that predicts step by step.
        errors: by quantity ("displacement", "reaction", "stress"), K rows of n scenes; infinite where a prediction
            failed, or where the true quantity is 0. A quantity that no scene has is left out.
    """

    efforts: tuple[Effort, ...] = ()
    errors: Mapping[str, tuple[tuple[float, ...], ...]] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """As `from_json` reads it: an infinite error is null."""
        errors = {
            quantity: [[error if math.isfinite(error) else None for error in row] for row in rows]
            for quantity, rows in self.errors.items()
        }
        return {"efforts": [asdict(effort) for effort in self.efforts], "errors": errors}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        errors = {
            quantity: tuple(tuple(math.inf if error is None else error for error in row) for row in rows)
            for quantity, rows in values["errors"].items()
        }
        return cls(tuple(Effort(**one) for one in values["efforts"]), errors)

    def bounds(self, quantity: str) -> list[float]:
        """For each effort the smallest error of a quantity that it keeps; infinite if it keeps none."""
        errors = np.array(self.errors[quantity])
        worst = np.sort(np.maximum.accumulate(errors[::-1])[::-1], axis=1)
        return worst[:, -1 - _allowed(worst.shape[1])].tolist()

    def effort_for(self, wanted: Mapping[str, float]) -> Effort:
        """The cheapest effort that keeps all wanted errors, by quantity, in 90 % of fresh scenes.

        Raises:
            ConfigError: no effort keeps them, which names the smallest that can be had; a quantity is not known; or
                none is given.
        """
        if not wanted:
            raise ConfigError("no error is given: give one, such as 0.02 or {'reaction': 0.05}")
        for quantity, error in wanted.items():
            self._require(quantity, error)
        wanted = {quantity: float(error) for quantity, error in wanted.items()}
        limits = np.array(list(wanted.values()))[:, None, None]
        errors = np.array([self.errors[quantity] for quantity in wanted])
        above: np.ndarray = np.any(errors > limits, axis=0)
        missed = np.logical_or.accumulate(above[::-1])[::-1].sum(axis=1)
        kept = np.flatnonzero(missed <= _allowed(above.shape[1]))
        if len(kept):
            return self.efforts[kept[0]]
        smallest = [f"{quantity} {percent(self.bounds(quantity)[-1], 3)}" for quantity in wanted]
        raise ConfigError(
            f"no effort of this run keeps an error of {in_words(wanted)} in {percent(KEPT)} of the scenes; the"
            f" smallest{' are, each alone,' if len(wanted) > 1 else ' is'} {', '.join(smallest)}, with"
            f" {self.efforts[-1].text}"
        )

    def _require(self, quantity: str, error: float) -> None:
        """Raise ConfigError unless an error of this quantity can be kept."""
        if not self.errors:
            raise ConfigError(
                "the run can promise no error: its calibration holds none; calibrate it again (a model that goes step"
                " by step has none)"
            )
        if quantity not in self.errors:
            raise ConfigError(f"an error of {quantity} is not known; known are {', '.join(self.errors)}")
        if not isinstance(error, Real):
            raise ConfigError(f"the error of the {quantity} is {in_short(error)}; it must be a number, as 0.02 for 2 %")
        if not 0 < error < 1:
            raise ConfigError(
                f"the error of the {quantity} is {in_short(error)}; it must lie between 0 and 1, as 0.02 for 2 %"
            )


def in_words(errors: Mapping[str, float]) -> str:
    """Errors by quantity, such as "2 % of the displacement and 5 % of the reaction"."""
    return " and ".join(f"{percent(error, 3)} of the {quantity}" for quantity, error in errors.items())


def _allowed(scenes: int) -> int:
    """How many of `scenes` calibration scenes may miss an effort; there are at least 9."""
    return math.floor((1 - KEPT) * (scenes + 1) + 1e-9) - 1

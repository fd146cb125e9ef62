"""The parts of a verification problem: rows with an expected value, a figure and a tolerance, and a picture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Row:
    """One quantity of a problem.

    Attributes:
        quantity: what is measured.
        expected: by the closed form; None where only a bound holds.
        computed: by the solver.
        error: what is compared with the tolerance.
        tolerance: up to which error the row holds.
        source: where the tolerance comes from.
        unit: of expected and computed; "" for a pure number.
    """

    quantity: str
    expected: float | None
    computed: float
    error: float
    tolerance: float
    source: str
    unit: str = ""

    @property
    def holds(self) -> bool:
        """Whether the error is within the tolerance; a NaN is not."""
        return bool(self.error <= self.tolerance)


def relative(quantity: str, expected: float, computed: float, tolerance: float, source: str, unit: str = "") -> Row:
    """A row whose error is |computed - expected| / |expected|."""
    error = abs(computed - expected) / abs(expected)
    return Row(quantity, float(expected), float(computed), float(error), float(tolerance), source, unit)


def absolute(quantity: str, expected: float, computed: float, tolerance: float, source: str, unit: str = "") -> Row:
    """A row whose error is |computed - expected|."""
    error = abs(computed - expected)
    return Row(quantity, float(expected), float(computed), float(error), float(tolerance), source, unit)


def at_most(quantity: str, computed: float, tolerance: float, source: str, unit: str = "") -> Row:
    """A row whose figure is itself an error: it is to be zero."""
    return Row(quantity, 0.0, float(computed), abs(float(computed)), float(tolerance), source, unit)


def more_than(quantity: str, computed: float, least: float, source: str, unit: str = "") -> Row:
    """A row whose figure must be above `least`; its error is by how much it falls short, infinite at `least` itself."""
    short = np.inf if computed == least else least - float(computed)
    error = 0.0 if computed > least else short
    return Row(f"{quantity} (> {least:g})", None, float(computed), float(error), 0.0, source, unit)


@dataclass(frozen=True)
class Curve:
    """Points of a picture: `style` is matplotlib's, such as "o-" (computed) or "k--" (closed form)."""

    label: str
    x: np.ndarray
    y: np.ndarray
    style: str = "o-"


@dataclass(frozen=True)
class Picture:
    """A plot: its curves, its axes, and whether these are logarithmic or of equal scale."""

    title: str
    x: str
    y: str
    curves: list[Curve]
    logarithmic: bool = False
    equal: bool = False


@dataclass(frozen=True)
class Outcome:
    """What solving a problem gave: rows, pictures by a short name, and remarks on what the figures mean."""

    rows: list[Row]
    pictures: dict[str, Picture] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Problem:
    """A problem with a known answer.

    Attributes:
        name: in the command and in the names of its pictures.
        title: its heading.
        text: set-up, closed form and where it comes from.
        solve: gives the outcome.
        quick: gives, within a few seconds, the same outcome or the outcome of coarser meshes: it runs with the tests.
            None if there is nothing quick to be said.
    """

    name: str
    title: str
    text: str
    solve: Callable[[], Outcome]
    quick: Callable[[], Outcome] | None


def observed_order(size: list[float], value: list[float]) -> tuple[float, float]:
    """Order p and limit of value = limit + C size^p through three meshes, each half as fine as the next.

    Args:
        size: element sizes h, h/2, h/4.
        value: what was computed on them.
    """
    coarse, middle, fine = value[-3:]
    order = float(np.log2((coarse - middle) / (middle - fine)))
    assert np.allclose(np.divide(size[-3:-1], size[-2:]), 2), size
    return order, richardson(middle, fine, order)


def richardson(coarse: float, fine: float, order: float) -> float:
    """Limit of value = limit + C h^order from the values at 2 h and h."""
    return float(fine + (fine - coarse) / (2**order - 1))

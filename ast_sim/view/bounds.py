"""The bounds that every sample of a dataset must keep, each with its verdict."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from ast_sim.view.survey import Sample

# Work of the prescribed nodes against the change of the stored energy, relative, of converged quasi-static frames.
WORK_TOLERANCE = 0.02


@dataclass(frozen=True)
class Bound:
    """A figure of each sample and what it must be.

    Attributes:
        title, what: the name of the figure and what it means.
        key, by_frame: attributes that hold it for the sample, or for each frame.
        worst: picks the worst of several (min or max).
        holds: whether a value keeps the bound; NaN keeps none.
        text: the bound in words.
        unit: of the figure; None for a plain number.
    """

    title: str
    what: str
    key: str
    by_frame: str
    worst: Callable[[Sequence[float]], float]
    holds: Callable[[float], bool]
    text: str
    unit: str | None = None


def bounds(length_unit: str) -> list[Bound]:
    """The bounds, in the order to be shown."""

    def positive(value: float) -> bool:
        return value > 0

    return [
        Bound("Gap", "smallest distance of surfaces", "min_gap", "gap", min, positive, "> 0", length_unit),
        Bound("det F", "smallest volume ratio of an element", "min_jacobian", "jacobian", min, positive, "> 0"),
        Bound(
            "Residual",
            "largest free force / stop test",
            "max_residual",
            "residual",
            max,
            lambda value: value <= 1,
            "≤ 1",
        ),
        Bound(
            "Work balance",
            "work against stored energy, relative; a snap loses some",
            "work_balance",
            "work_balance",
            lambda values: max(values, key=abs),
            lambda value: abs(value) <= WORK_TOLERANCE,
            f"± {WORK_TOLERANCE:g}",
        ),
    ]


def verdicts(samples: Sequence[Sample], length_unit: str) -> list[dict[str, Any]]:
    """One row a bound: the range over the samples, the worst sample, for how many it is recorded, and the verdict.

    `passed` is None where no sample records the figure. A last row asks whether all nodes stay inside the domain.
    """
    rows = [_verdict(samples, bound) for bound in bounds(length_unit)]
    outside = [sample.name for sample in samples if sample.outside]
    rows.append(
        {
            "title": "Domain",
            "what": "samples with a node outside the dataset’s cube",
            "bound": "0",
            "range": [float(len(outside))] * 2,
            "unit": None,
            "worst": outside[0] if outside else None,
            "recorded": len(samples),
            "failed": len(outside),
            "passed": not outside,
        }
    )
    return rows


def _verdict(samples: Sequence[Sample], bound: Bound) -> dict[str, Any]:
    found = {s.name: value for s in samples if (value := s.worst(bound.key, bound.by_frame, bound.worst)) is not None}
    failed = [name for name, value in found.items() if not bound.holds(value)]
    # A figure that is not a number is worse than any other; an infinite gap (nothing to touch) is none to show.
    wrong = [name for name, value in found.items() if math.isnan(value)]
    numbers = {name: value for name, value in found.items() if math.isfinite(value)}
    worst = bound.worst(list(numbers.values())) if numbers else None
    named = wrong or [name for name, value in numbers.items() if value == worst]
    return {
        "title": bound.title,
        "what": bound.what,
        "bound": bound.text,
        "range": [min(numbers.values()), max(numbers.values())] if numbers else None,
        "unit": bound.unit,
        "worst": named[0] if named else None,
        "recorded": len(found),
        "failed": len(failed),
        "passed": not failed if found else None,
    }

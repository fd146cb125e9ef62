"""The bounds that every sample of a dataset must keep, with a verdict on each bound."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from ast_sim.view.dataset_page.survey import SampleFigures

# Largest relative imbalance of work in a typical frame. Of 2,160 scenes of plates and parts, the worst has 0.0014; half
# of them are below 1e-5.
WORK_TOLERANCE = 0.005


@dataclass(frozen=True)
class Bound:
    """A figure of each sample, and the bound that it must keep.

    Attributes:
        title, what: the name of the figure and what it means.
        figure: the figure of a sample; None if the sample does not record it.
        worst: picks the worst of several values (min or max).
        holds: whether a value keeps the bound; NaN never does.
        text: the bound in words.
        unit: unit of the figure; None for a plain number.
    """

    title: str
    what: str
    figure: Callable[[SampleFigures], float | None]
    worst: Callable[[Sequence[float]], float]
    holds: Callable[[float], bool]
    text: str
    unit: str | None = None


def bounds(length_unit: str) -> list[Bound]:
    """The bounds, in the order to be shown."""

    def positive(value: float) -> bool:
        return value > 0

    def recorded(key: str, by_frame: str, worst: Callable[[Sequence[float]], float]) -> dict[str, Any]:
        return {"figure": lambda sample: sample.worst(key, by_frame, worst), "worst": worst}

    return [
        Bound(
            "Gap",
            "smallest distance between surfaces",
            **recorded("min_gap", "gap", min),
            holds=positive,
            text="> 0",
            unit=length_unit,
        ),
        Bound(
            "det F",
            "smallest volume of an element over its volume at rest",
            **recorded("min_jacobian", "jacobian", min),
            holds=positive,
            text="> 0",
        ),
        Bound(
            "Residual",
            "largest residual over what the stop test allows",
            **recorded("max_residual", "residual", max),
            holds=lambda value: value <= 1,
            text="≤ 1",
        ),
        Bound(
            "Work balance",
            "work minus stored energy and friction in a typical frame, relative; a frame with a snap does not count",
            figure=lambda sample: sample.work_imbalance,
            worst=max,
            holds=lambda value: value <= WORK_TOLERANCE,
            text=f"≤ {WORK_TOLERANCE:g}",
        ),
    ]


def verdicts(samples: Sequence[SampleFigures], length_unit: str) -> list[dict[str, Any]]:
    """One row for each bound: range over the samples, worst sample, number of samples that record it, and verdict.

    `passed` is None if no sample records the figure. The last row says whether all nodes stay inside the domain.
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


def _verdict(samples: Sequence[SampleFigures], bound: Bound) -> dict[str, Any]:
    figures = {s.name: value for s in samples if (value := bound.figure(s)) is not None}
    failed = [name for name, value in figures.items() if not bound.holds(value)]
    # NaN is worse than any other figure. An infinite gap means that there is nothing to touch: it is not shown.
    wrong = [name for name, value in figures.items() if math.isnan(value)]
    numbers = {name: value for name, value in figures.items() if math.isfinite(value)}
    worst = bound.worst(list(numbers.values())) if numbers else None
    named = wrong or [name for name, value in numbers.items() if value == worst]
    return {
        "title": bound.title,
        "what": bound.what,
        "bound": bound.text,
        "range": [min(numbers.values()), max(numbers.values())] if numbers else None,
        "unit": bound.unit,
        "worst": named[0] if named else None,
        "recorded": len(figures),
        "failed": len(failed),
        "passed": not failed if figures else None,
    }

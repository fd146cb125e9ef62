"""How the errors of a run fell while it was trained, by its validations, at the deepest frame."""

from __future__ import annotations

from dataclasses import dataclass

from ast_sim import Run
from ast_sim.inference.effort import EffortErrors
from ast_sim.runs.metrics import Metrics


@dataclass(frozen=True)
class CurvePoint:
    """A validation.

    Attributes:
        step, minutes: of the training until then.
        model, newton: the smallest relative errors over all numbers of corrections, of the model alone and with Newton
            steps after it.
    """

    step: int
    minutes: float
    model: float
    newton: float


def minutes_per_step(run: Run) -> float:
    """The median time of a training step, in minutes."""
    seconds = run.folder.metrics.seconds_per_step()
    assert seconds is not None
    return seconds / 60


def validation_curve(run: Run) -> list[CurvePoint]:
    """The validations of a run."""
    minutes = minutes_per_step(run)
    points: dict[int, CurvePoint] = {}
    for record in Metrics(run.path):
        measured = [EffortErrors.from_json(one) for one in record.get("valid_by_effort", [])]
        known = [one for one in measured if one.error is not None]
        if known:
            model = min(one.error for one in known if not one.effort.newton_steps)
            newton = min(one.error for one in known)
            step = record["step"]  # a later validation of a step replaces an earlier one
            points[step] = CurvePoint(step, minutes * step, model, newton)
    return list(points.values())


def curve_line(curve: list[CurvePoint]) -> str:
    """The curve as a sentence."""
    told = [
        f"{point.step:,} steps ({point.minutes:.0f} min) {100 * point.model:.1f} and {100 * point.newton:.1f} %"
        for point in curve
    ]
    return f"Validation scenes, the model alone and with Newton steps, each at its best: {', '.join(told)}."

"""An evaluation and a training as the other commands write them, with figures chosen by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ast_sim.figures import DeepestFrames, Figures, MeanError, SceneError, SceneFigures


def _errors(quantity: str, predictor: str, one_step: float, rollout: float) -> list[MeanError]:
    """By horizon and nodes; pooled errors are a tenth above the others."""
    values = {"one_step": one_step, "rollout_50": rollout, "rollout_all": rollout}
    nodes = ("normal", "all") if quantity == "displacement" else ("deforming",)
    return [
        MeanError(quantity, predictor, horizon, where, value, 1.1 * value)
        for horizon, value in values.items()
        for where in nodes
    ]


def _scene(name: str, error: float | None) -> SceneFigures:
    errors = [
        SceneError("displacement", "model", "rollout_all", "normal", error),
        SceneError("displacement", "hold_still", "rollout_all", "normal", 6e-3),
        SceneError("stress", "model", "rollout_all", "deforming", 6e3),
        SceneError("stress", "stress_frame_mean", "rollout_all", "deforming", 12e3),
    ]
    failure = None if error is not None else f"{name}: not finite"
    return SceneFigures(name, 400, 9, tuple(errors), None if error is None else 0.002, 0.034, failure)


NO_DEEPEST = DeepestFrames((), None, None, None, (), (), None, 0, None, None, None)


def evaluation(errors: dict[str, float | None], scale: float = 1.0, **changes: Any) -> Figures:
    """An evaluation whose scenes have the given displacement errors; `scale` multiplies the errors over all scenes."""
    figures = Figures(
        scenes=tuple(_scene(name, error) for name, error in errors.items()),
        errors=(
            *_errors("displacement", "model", 0.33e-3, 1.43e-3 * scale),
            *_errors("stress", "model", 4300.0, 6780.0 * scale),
            *_errors("displacement", "hold_still", 0.77e-3, 6.5e-3),
            *_errors("displacement", "repeat_last", 0.29e-3, 6.5e-3),
            *_errors("stress", "stress_zero", 20700.0, 20700.0),
            *_errors("stress", "stress_constant", 15800.0, 15800.0),
            *_errors("stress", "stress_frame_mean", 11300.0, 11300.0),
        ),
        failures=sum(error is None for error in errors.values()),
        jumps=False,
        effort={"corrections": 0, "newton_steps": 0},
        deepest=NO_DEEPEST,
        speedup=17.0,
        length_unit="m",
        stress_unit="Pa",
        threads=2,
        origin={
            "command": "ast-sim evaluate run data.h5 --out <file>",
            "commit": "0123456789abcdef",
            "processor": "A processor",
            "versions": {"python": "3.11.2", "torch": "2.13.0", "ast_sim": None},
            "run": "run",
            "data": "data.h5",
            "split": "test",
        },
    )
    return replace(figures, **changes)


def metrics(steps: int = 1000) -> list[dict[str, Any]]:
    """Lines of metrics.jsonl: losses at each step, a validation at each hundredth, of which one failed."""
    lines: list[dict[str, Any]] = []
    for step in range(1, steps + 1):
        lines.append({"step": step, "loss": 2.0 / step, "motion": 1.5 / step, "stress": 5.0 / step, "rate": 1e-4})
        if step % 100 == 0:
            error = None if step == 300 else 0.4 / step
            lines.append({"step": step, "valid_rmse": error, "valid_hold_still": 9e-3, "seconds": 1.0})
    return lines

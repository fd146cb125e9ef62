"""An evaluation and a training as the other commands write them, with figures chosen by hand."""

from __future__ import annotations

from typing import Any


def _errors(one_step: float, rollout: float, nodes: tuple[str, ...]) -> dict[str, Any]:
    """By horizon, nodes and convention; pooled errors are a tenth above the others."""
    values = {"one_step": one_step, "rollout_50": rollout, "rollout_all": rollout}
    return {
        horizon: {n: {"rmse_sequence": value, "rmse_pooled": 1.1 * value} for n in nodes}
        for horizon, value in values.items()
    }


def evaluation(errors: dict[str, float | None], scale: float = 1.0) -> dict[str, Any]:
    """An evaluation whose scenes have the given displacement errors; `scale` multiplies the summary's."""
    displacement, stress = ("normal", "all"), ("deforming",)
    hold, frame_mean = {"rollout_all": {"normal": 6e-3}}, {"rollout_all": {"deforming": 12e3}}
    samples = [
        {
            "name": name,
            "nodes": 400,
            "frames": 9,
            "displacement": {"model": {"rollout_all": {"normal": error}}, "hold_still": hold},
            "stress": {"model": {"rollout_all": {"deforming": 6e3}}, "stress_frame_mean": frame_mean},
            "model_seconds_per_step": None if error is None else 0.002,
            "solver_seconds_per_step": 0.034,
            "failure": None if error is not None else f"{name}: not finite",
        }
        for name, error in errors.items()
    ]
    return {
        "command": "ast-sim evaluate run data.h5 --out <file>",
        "commit": "0123456789abcdef",
        "processor": "A processor",
        "versions": {"python": "3.11.2", "torch": "2.13.0", "ast_sim": None},
        "run": "run",
        "data": "data.h5",
        "split": "test",
        "samples": samples,
        "summary": {
            "model": {
                "displacement": _errors(0.33e-3, 1.43e-3 * scale, displacement),
                "stress": _errors(4300.0, 6780.0 * scale, stress),
            },
            "hold_still": {"displacement": _errors(0.77e-3, 6.5e-3, displacement)},
            "repeat_last": {"displacement": _errors(0.29e-3, 6.5e-3, displacement)},
            "stress_zero": {"stress": _errors(20700.0, 20700.0, stress)},
            "stress_constant": {"stress": _errors(15800.0, 15800.0, stress)},
            "stress_frame_mean": {"stress": _errors(11300.0, 11300.0, stress)},
        },
        "failures": sum(error is None for error in errors.values()),
        "speedup": 17.0,
        "length_unit": "m",
        "stress_unit": "Pa",
        "threads": 2,
    }


def metrics(steps: int = 1000) -> list[dict[str, Any]]:
    """Lines of metrics.jsonl: losses at each step, a validation at each hundredth, of which one failed."""
    lines: list[dict[str, Any]] = []
    for step in range(1, steps + 1):
        lines.append({"step": step, "loss": 2.0 / step, "motion": 1.5 / step, "stress": 5.0 / step, "rate": 1e-4})
        if step % 100 == 0:
            error = None if step == 300 else 0.4 / step
            lines.append({"step": step, "valid_rmse": error, "valid_hold_still": 9e-3, "seconds": 1.0})
    return lines

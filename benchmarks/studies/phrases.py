"""What the pages of asked frames and of own assemblies say in the same words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

SHOWN_WORST = 5


def beside_solver(scenes: Sequence[dict[str, Any]], errors: Sequence[float | None], seconds: Sequence[float]) -> str:
    """The solver's time and its ratio to the answers', where the solver was run and the answer did not fail. In each
    scene the fastest way counts that is as accurate as the answer; the own stop test always is."""
    taken, ratios = [], []
    for scene, error, answer in zip(scenes, errors, seconds, strict=True):
        if "solver" not in scene or scene["solver"]["seconds"] is None or error is None:
            continue
        ways = [way for way in scene["solver"]["ways"].values() if "seconds" in way]
        fit = [way["seconds"] for way in ways if way["relative_error"] <= error]
        taken.append(min([*fit, scene["solver"]["seconds"]]))
        ratios.append(taken[-1] / answer)
    if not taken:
        return "-"
    return times_as_long(taken, ratios)


def over_the_scenes(scenes: Sequence[dict[str, Any]]) -> str:
    """How the errors of the answers are spread, and which scenes are the worst."""
    errors = {scene["name"]: 100 * scene["relative_error"] for scene in scenes if scene["relative_error"] is not None}
    low, middle, high = np.quantile(list(errors.values()), (0.1, 0.5, 0.9))
    worst = ", ".join(f"{name} {errors[name]:.2g} %" for name in sorted(errors, key=lambda n: -errors[n])[:SHOWN_WORST])
    return (
        f"Over the scenes: a tenth below {low:.2g} %, the median {middle:.2g} %, a tenth above {high:.2g} %."
        f" Worst: {worst}."
    )


def times_as_long(taken: Sequence[float], ratios: Sequence[float]) -> str:
    """The mean of the solver's seconds, and of its times over those of the answers, with its standard error."""
    spread = f" ± {np.std(ratios) / len(ratios) ** 0.5:.1g}" if len(ratios) > 1 else ""
    return f"{1000 * np.mean(taken):.0f} ms, {np.mean(ratios):.2g}{spread} times as long"

"""The time of the solver beside the time of the answers, as the pages of the studies state it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


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


def times_as_long(taken: Sequence[float], ratios: Sequence[float]) -> str:
    """The mean of the solver's seconds, and of its times over those of the answers, with its standard error."""
    spread = f" ± {np.std(ratios) / len(ratios) ** 0.5:.1g}" if len(ratios) > 1 else ""
    return f"{1000 * np.mean(taken):.0f} ms, {np.mean(ratios):.2g}{spread} times as long"

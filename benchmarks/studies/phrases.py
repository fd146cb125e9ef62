"""What the pages of studies say in the same words, and their tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ast_sim.figures import DeepestFrame, DeepestFrames
from ast_sim.simulate.jobs.fastest_solver import VARIANTS

SHOWN_WORST = 5
RESAMPLES = 2000


def beside_solver(scenes: Sequence[DeepestFrame], errors: Sequence[float | None], seconds: Sequence[float]) -> str:
    """The solver's time and its ratio to the answers', where the solver was run and the answer did not fail. In each
    scene the fastest setting counts that is as accurate as the answer; the own stop test always is."""
    taken, ratios = [], []
    for scene, error, answer in zip(scenes, errors, seconds, strict=True):
        solver = scene.solver
        if solver is None or solver.seconds is None or error is None:
            continue
        solved = [one for one in solver.variants.values() if one.seconds is not None and one.relative_error is not None]
        fit = [one.seconds for one in solved if one.relative_error <= error]
        taken.append(min([*fit, solver.seconds]))
        ratios.append(taken[-1] / answer)
    if not taken:
        return "-"
    return times_as_long(taken, ratios)


def over_the_scenes(scenes: Sequence[DeepestFrame]) -> str:
    """How the errors of the answers are spread, and which scenes are the worst."""
    errors = {scene.name: 100 * scene.relative_error for scene in scenes if scene.relative_error is not None}
    low, middle, high = np.quantile(list(errors.values()), (0.1, 0.5, 0.9))
    worst = ", ".join(f"{name} {errors[name]:.2g} %" for name in sorted(errors, key=lambda n: -errors[n])[:SHOWN_WORST])
    return (
        f"Over the scenes: a tenth below {low:.2g} %, the median {middle:.2g} %, a tenth above {high:.2g} %."
        f" Worst: {worst}."
    )


def settings_tried(rows: Mapping[str, DeepestFrames]) -> str:
    """In how many settings the solver was run, such as "13 settings": rows may be older than some of them."""
    titles: dict[str, list[str]] = {}
    for title, frames in rows.items():
        names = {name for scene in frames.scenes if scene.solver for name in scene.solver.variants}
        if names:
            titles.setdefault(_settings(names), []).append(title)
    first, *others = sorted(titles, key=lambda text: int(text.split()[0])) or [
        _settings({variant.name for variant in VARIANTS})
    ]
    if not others:
        return first
    later = "; ".join(f"{text.replace(' settings', '')} for {', '.join(titles[text])}" for text in others)
    return f"{first} ({later})"


def _settings(names: set[str]) -> str:
    nested = any(variant.name in names for variant in VARIANTS if variant.newton)
    return f"{len(names)} settings" + (", nested iteration among them," if nested else "")


def times_as_long(taken: Sequence[float], ratios: Sequence[float]) -> str:
    """The median of the solver's seconds, and the median of its times over the answers' times, with its standard
    error."""
    ratio = f"{np.median(ratios):.2g}"
    if len(ratios) > 1:
        error = median_error(ratios)
        ratio += f" ± {error:.0f}" if error >= 9.5 else f" ± {error:.1g}"
    return f"{1000 * np.median(taken):.0f} ms, {ratio} times as long"


def median_error(values: Sequence[float]) -> float:
    """The standard error of the median, by drawing the values again with replacement (bootstrap)."""
    drawn = np.random.default_rng(0).choice(np.asarray(values), (RESAMPLES, len(values)))
    return float(np.median(drawn, axis=1).std())


def table_head(columns: Sequence[str], texts: int) -> list[str]:
    """The first two lines of a table; its first `texts` columns are aligned to the left."""
    return [table_line(columns), "|" + " --- |" * texts + " ---: |" * (len(columns) - texts)]


def table_line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"

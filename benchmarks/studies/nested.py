"""The solver at its best, with nested iteration and without it, beside the run of plates that comes with the package.

`python -m benchmarks.studies.nested [NODES ...]` generates a few plates of each size, goes to the deepest frame of each
in every variant of `ast_sim.simulate.jobs.fastest_solver`, and asks the run for the same frame. It writes
benchmarks/results/nested.json and docs/results/nested.md. The scenes lie in `--folder`. Everything runs on one thread.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

import ast_sim
from ast_sim.inference.effort import MOST_NEWTON_STEPS, Effort
from ast_sim.inference.trade import timed_answer
from ast_sim.simulate.jobs.fastest_solver import VARIANTS, solver_outcomes
from ast_sim.support.provenance import provenance
from ast_sim.trade_figures import TOLERANCES
from benchmarks.studies.phrases import median_error
from benchmarks.studies.rows import study_rows

RESULTS = Path(__file__).parents[1] / "results" / "nested.json"
PAGE = Path(__file__).parents[2] / "docs" / "results" / "nested.md"
EFFORTS = (Effort(0), Effort(0, 1), Effort(0, MOST_NEWTON_STEPS))
NESTED = frozenset(variant.name for variant in VARIANTS if variant.newton)


@dataclass(frozen=True)
class Plates:
    """Plates that no training has seen; plates of the same seed and split are scenes of the study of jumps.

    Attributes:
        title: what the page calls them.
        nodes, split, scenes, frames, keep: of the dataset.
        rounds: how often the scenes are measured; the smallest time of each setting and of each answer counts.
        run: whether the run that comes with the package is for plates of this size.
    """

    title: str
    nodes: int
    split: str
    scenes: int
    frames: int = 41
    keep: tuple[int, ...] | None = (14, 24, 34)
    rounds: int = 3
    run: bool = False


SETS = (
    Plates("Plates, 400 nodes", 400, "test", 10, run=True),
    Plates("Plates, 1,300 nodes", 1300, "valid", 5, rounds=1),
)


def measured(plates: Plates, folder: Path) -> dict[str, Any]:
    """Each scene with the figures of all settings and answers."""
    counts = {"train": 0, "valid": 0, "test": 0, plates.split: plates.scenes}
    data = ast_sim.generate(
        "deforming_plate", folder / f"plates{plates.nodes}.h5", seed=11, nodes=plates.nodes, frames=plates.frames,
        keep=plates.keep, **counts,
    ).path  # fmt: skip
    model = ast_sim.example_run("plates").model if plates.run else None
    scenes: list[dict[str, Any]] = [{"variants": {}, "answers": {}} for _ in range(plates.scenes)]
    for turn in range(plates.rounds):
        for index, scene in enumerate(scenes):
            (solved,) = solver_outcomes(data, plates.split, [index], progress=False)
            scene |= {"frame": solved.frame, "displacement": solved.displacement}
            for outcome in solved.outcomes:
                figures = {
                    "seconds": outcome.whole_seconds if outcome.converged else None,
                    "relative_error": outcome.relative_error if outcome.converged else None,
                    "mesh_seconds": outcome.mesh_seconds,
                    "failure": outcome.failure or None,
                }
                _keep_faster(scene["variants"], outcome.variant.name, figures)
            if model is not None:
                with ast_sim.Dataset(data) as dataset:
                    _ask(model, dataset, plates.split, index, scene["answers"])
            print(
                f"{plates.title}, round {turn + 1} of {plates.rounds}: {index + 1} of {len(scenes)} scenes", flush=True
            )
    return {
        **provenance(f"python -m benchmarks.studies.nested {plates.nodes}"), **asdict(plates), "measured": scenes
    }  # fmt: skip


def _ask(model: Any, dataset: ast_sim.Dataset, split: str, index: int, known: dict[str, dict[str, Any]]) -> None:
    """Ask for the deepest frame with every effort."""
    for effort in EFFORTS:
        errors, seconds, failure = timed_answer(model, dataset, split, index, effort)
        answered = failure is None
        figures = {
            "seconds": seconds if answered else None,
            "relative_error": errors["displacement"] if answered else None,
            "failure": failure,
        }
        _keep_faster(known, effort.text, figures)


def _keep_faster(known: dict[str, dict[str, Any]], name: str, figures: dict[str, Any]) -> None:
    before = known.get(name)
    if before is None or (before["seconds"] or np.inf) > (figures["seconds"] or np.inf):
        known[name] = figures


def cheapest(scene: dict[str, Any], error: float, nested: bool) -> tuple[str, float] | None:
    """The name and the seconds of the fastest setting with at most this error; with nested iteration or without it."""
    fit = [
        (figures["seconds"], name)
        for name, figures in scene["variants"].items()
        if figures["seconds"] is not None and figures["relative_error"] <= error and (nested or name not in NESTED)
    ]
    return min(fit)[::-1] if fit else None


def page(results: dict[str, Any]) -> str:
    shown = [results[str(plates.nodes)] for plates in SETS if str(plates.nodes) in results]
    names = set(shown[0]["measured"][0]["variants"])
    introduction = _INTRODUCTION.format(both=len(names), plain=len(names - NESTED), processor=shown[0]["processor"])
    return "\n".join([introduction.rstrip(), *(line for plates in shown for line in _section(plates))])


_INTRODUCTION = """# The solver at its best: nested iteration

Made by `python -m benchmarks.studies.nested` from `benchmarks/results/nested.json`; do not edit.

Nested iteration needs no model. A mesh of a half or a quarter of the nodes is solved, to the solver's own stop test or
in 6 or 12 load steps of one Newton step each. Its displacements are carried over to the mesh of the dataset, and one,
two or three Newton steps with linearised contact correct them there. It needs a geometry that can be meshed coarser: a
family or a specification has one. A mesh from a file has none, so there the solver has only its other settings.

Each scene is solved to its deepest frame in {both} settings. In each scene the fastest counts whose error is at most
the wanted error; who does not know the truth cannot choose so well. Without nested iteration there are {plain}
settings: stop tests, ranges of contact, coarser meshes, 6, 12 and 24 linearised steps. The error compares the
positions of the free nodes with the frame of the dataset, as a share of their displacement. Times are medians over the
scenes of processor time on one thread, on a shared machine ({processor}); where scenes were measured several times, the
smallest time counts. Times count what is prepared for both meshes, the coarse solution and the transfer, but no
meshing. A ratio is the median over the scenes, with its standard error.
"""


def _section(plates: dict[str, Any]) -> list[str]:
    scenes = plates["measured"]
    head = ["error at most", "without", "with nested iteration", "without / with"]
    head += ["the run", "solver faster"] if plates["run"] else []
    lines = [
        "",
        f"## {plates['title']}",
        "",
        _measured_text(plates),
        "",
        *_head([*head, "most often fastest, in how many scenes"]),
    ]
    won = []
    for level in TOLERANCES:
        *times, names = _compared(scenes, [level] * len(scenes))
        run = []
        if plates["run"]:
            reached, wins = _run_at(scenes, level)
            run = [reached, f"in {wins} of {len(scenes)}"]
            if 2 * wins > len(scenes):
                won.append(f"{100 * level:g} %")
        lines.append(f"| {100 * level:g} % | " + " | ".join([*times, *run, names]) + " |")
    lines += _meshing(scenes)
    if not plates["run"]:
        return lines
    lines += ["", f"The solver is faster in most scenes at {' and '.join(won) or 'none of these errors'}."]
    lines += [_RUN, *_head(["answer of the run", "error", "time", "without", "with nested", "with / answer", "faster"])]
    return lines + [_beside(scenes, effort.text) for effort in EFFORTS]


_RUN = """
"The run" is the fastest of its three answers with at most this error, and in how many scenes there is one. The solver
is faster where its fastest setting takes less, and where the run has no such answer. The run's training, and the 6,000
scenes that it took, are not counted. Below, the solver is at most as far off as the answer, scene by scene; "faster" is
who is so by two standard errors.
"""


def _run_at(scenes: Sequence[dict[str, Any]], level: float) -> tuple[str, int]:
    """The cell of the run at a level: its median seconds, and in how many scenes the solver is faster."""
    own = [
        [a["seconds"] for a in scene["answers"].values() if a["seconds"] is not None and a["relative_error"] <= level]
        for scene in scenes
    ]
    answered = [min(seconds) for seconds in own if seconds]
    best = [cheapest(scene, level, nested=True) for scene in scenes]
    wins = sum(
        fastest is not None and (not seconds or fastest[1] < min(seconds))
        for fastest, seconds in zip(best, own, strict=True)
    )
    reached = f"{_milliseconds(answered)} in {len(answered)}" if answered else "none"
    return reached, wins


def _measured_text(plates: dict[str, Any]) -> str:
    times = "once" if plates["rounds"] == 1 else f"{plates['rounds']} times"
    return f"Scenes: {len(plates['measured'])}, of the split {plates['split']}, measured {times}."


def _head(names: Sequence[str]) -> list[str]:
    return ["| " + " | ".join(names) + " |", "| --- |" + " ---: |" * (len(names) - 2) + " --- |"]


def _compared(scenes: Sequence[dict[str, Any]], errors: Sequence[float]) -> list[str]:
    """The cells of a level: median seconds without and with, their ratio, and the fastest settings."""
    pairs = [(cheapest(*each, nested=False), cheapest(*each, nested=True)) for each in zip(scenes, errors, strict=True)]
    both = [(plain, best) for plain, best in pairs if plain is not None and best is not None]
    if not both:
        return ["none", "none", "-", "-"]
    ratios = [plain[1] / best[1] for plain, best in both]
    names = Counter(best[0] for _, best in both).most_common(2)
    missing = f"; none in {len(pairs) - len(both)}" if len(both) < len(pairs) else ""
    return [
        _milliseconds([plain[1] for plain, _ in both]),
        _milliseconds([best[1] for _, best in both]),
        _ratio(ratios),
        "; ".join(f"{name}: {count}" for name, count in names) + missing,
    ]


def _meshing(scenes: Sequence[dict[str, Any]]) -> list[str]:
    """What meshing takes, and in how many scenes a coarser mesh is missing."""
    lines = []
    for share in ("1/2", "1/4"):
        solved = [scene["variants"][f"{share} nodes"] for scene in scenes]
        meshing = [figures["mesh_seconds"] for figures in solved]
        failures = [figures["failure"] for figures in solved if figures["failure"] is not None]
        lines.append(
            f"Meshing {share} of the nodes takes {_milliseconds(meshing)}, not counted."
            + (f" In {len(failures)} of {len(scenes)} scenes it is not solved: {failures[0]}." if failures else "")
        )
    return ["", *lines]


def _beside(scenes: Sequence[dict[str, Any]], effort: str) -> str:
    """The line of an effort: the run's answers, the solver at the same error, and who is faster."""
    known = [scene for scene in scenes if scene["answers"][effort]["seconds"] is not None]
    errors = [scene["answers"][effort]["relative_error"] for scene in known]
    seconds = [scene["answers"][effort]["seconds"] for scene in known]
    best = [cheapest(scene, error, nested=True) for scene, error in zip(known, errors, strict=True)]
    ratios = [fastest[1] / answer for fastest, answer in zip(best, seconds, strict=True) if fastest is not None]
    without, with_nested, *_ = _compared(known, errors)
    middle, spread = np.median(ratios), median_error(ratios)
    faster = "neither, within two standard errors"
    if abs(middle - 1) > 2 * spread:
        faster = "the run" if middle > 1 else "the solver"
    failed = f", {len(scenes) - len(known)} failed" if len(known) < len(scenes) else ""
    error = f"{100 * np.mean(errors):.2g} %{failed}"
    cells = [effort, error, _milliseconds(seconds), without, with_nested, _ratio(ratios), faster]
    return "| " + " | ".join(cells) + " |"


def _milliseconds(seconds: Sequence[float]) -> str:
    return f"{1000 * np.median(seconds):.0f} ms"


def _ratio(ratios: Sequence[float]) -> str:
    return f"{np.median(ratios):.2f} ± {median_error(ratios):.2f}"


def main(arguments: Sequence[str] | None = None) -> None:
    rows = {str(plates.nodes): plates for plates in SETS}

    def of_row(name: str, folder: Path) -> dict[str, Any]:
        return measured(rows[name], folder)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Newton steps that do not end: their errors count
        study_rows(__doc__, rows, arguments, of_row, _measured_text, (RESULTS, PAGE), page)


if __name__ == "__main__":
    main()

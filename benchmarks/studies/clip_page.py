"""The page of `benchmarks.studies.clip`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ast_sim.support.progress import duration
from ast_sim.trade_figures import Setting
from benchmarks.studies import clip_variants
from benchmarks.studies.clip_outcome import Outcome, errors
from benchmarks.studies.clip_variants import FINER, OWN
from benchmarks.studies.phrases import RESAMPLES, median_error

ANSWERS = (
    ("the run, all frames", "run"),
    ("the run, the frames 3 and 6 alone", "run_two_frames"),
    ("Gaussian process", "gaussian_process"),
)

TABLES = {
    "scenes": "test scenes",
    "unseen": "more scenes, by which nothing was chosen",
    "other_cutout": "clips with two holes, a cutout that no training scene has",
}

_INTRODUCTION = """# A metal clip: permanent set and peak force

Made by `python -m benchmarks.studies.clip` from `benchmarks/results/clip.json`; do not edit.

`examples/clip`: a ram bends the arm of a metal clip open, turns in frame 3 of 6 and goes back. Length, thickness, place
and kind of the cutout, travel and yield stress are drawn. The set is the length of the mean displacement of the arm's
free end in the last frame, the peak force the largest force on the ram in all frames. Errors are relative to what
CalculiX found on the same mesh, in scenes that no training has seen. The run predicts all frames of a scene,
the frames after the turn from its own answer for the turn
([the load path](../reference/model.md#jumps-and-corrections)). The Gaussian process (scikit-learn, a squared
exponential with a length for each parameter) maps the drawn parameters to both numbers; it knows nothing else of a
scene, and can predict nothing else. No parameter tells it of two holes side by side; the run sees their mesh. Times are
processor times of one thread ({processor}), beside other work.
"""

_VARIANTS = """
## CalculiX on coarser meshes and with larger increments

The same scenes solved with other settings, {count} of the test scenes ({first} to {last}). Errors are relative to
the scene's own mesh, as the run's are. A frame of the dataset is solved in at least 4 increments; two steps are the
ram's way out and back, which is all that both numbers need. Where CalculiX finds no solution on a mesh, or does
not end, meshes of nearly that size are tried, and the failed tries cost nothing here. Meshing is counted on neither
side.
"""

_FINER = """
## What the mesh itself gets wrong

The mesh of the dataset against one of about {nodes:,} nodes, and the run, which asks for the dataset's mesh, against
both. The run learns the error of its mesh with the rest.
"""


def page(results: dict[str, Any]) -> str:
    """The page of the results."""
    lines = [_INTRODUCTION.format(processor=results["processor"])]
    for key, title in TABLES.items():
        if results[key]:
            lines += [*_answers(results[key], f"{len(results[key])} {title}"), ""]
    lines += _figures(results)
    lines += _variants(results)
    return "\n".join([*lines, *_finer(results)])


def _answers(scenes: Sequence[dict[str, Any]], title: str) -> list[str]:
    """The table of the errors."""
    kinds = ("median", "mean", "90 % below")
    heads = [f"{what}: {kind}" for what in ("set", "peak force") for kind in kinds]
    lines = [f"| {title} | {' | '.join(heads)} |", "| --- |" + " ---: |" * 6]
    seeds = [(f"the same with {key}, all frames", key) for key in scenes[0] if key.startswith("seed ")]
    for name, key in (*ANSWERS[:2], *seeds, *ANSWERS[2:]):
        lines.append(f"| {name} | {' | '.join(_cells(errors(scenes, key, number)) for number in Outcome._fields)} |")
    return [*lines, "| springs back wholly | 100 % | 100 % | 100 % | - | - | - |"]


def _cells(values: np.ndarray) -> str:
    middle = f"{100 * np.median(values):.2g} ± {100 * median_error(values):.1g} %"
    return f"{middle} | {100 * values.mean():.2g} % | {100 * np.quantile(values, 0.9):.2g} %"


def _figures(results: dict[str, Any]) -> list[str]:
    """What else was measured in the test scenes."""
    scenes, plan, simulated = results["scenes"], results["plan"], results["simulation_seconds"]
    lines = [f"- {_beside_process(results[key], title)}" for key, title in TABLES.items() if results[key]]
    solver = float(np.median([scene["solver_seconds"] for scene in scenes]))
    for key, what in (("seconds", "all frames"), ("seconds_of_two", "the frames 3 and 6")):
        ratios = [scene["solver_seconds"] / scene[key] for scene in scenes]
        spent = 1000 * np.median([scene[key] for scene in scenes])
        lines.append(
            f"- An answer with {what} takes {spent:.0f} ms, CalculiX {solver:.3g} s a scene:"
            f" {np.median(ratios):.0f} ± {median_error(ratios):.0f} times as long."
        )
    return [
        *lines,
        f"- The run: {plan['train']} scenes, meshed for {plan['nodes']:,} nodes, {plan['steps']:,} steps in"
        f" {duration(results['training_seconds'])}, {results['parameters']:,} weights. CalculiX took"
        f" {duration(simulated['train'] + simulated['valid'])} for the scenes of training and validation.",
        f"- Errors of the run in the field, medians: displacement {_median(scenes, 'turn_error')} when the ram turns,"
        f" {_median(scenes, 'last_error')} when it is back; plastic strain there {_median(scenes, 'strain_error')};"
        f" forces on single nodes when the ram turns {_median(scenes, 'force_error')}.",
        f"- Sets from {_range(scenes, 'set')} mm, peak forces from {_range(scenes, 'peak')} N. {_worst(scenes)}",
    ]


def _beside_process(scenes: Sequence[dict[str, Any]], title: str) -> str:
    """How large the median errors of the run are beside the errors of the Gaussian process, with intervals of 95 % by
    bootstrap over the scenes, and who is ahead by them."""
    drawn = np.random.default_rng(0).integers(len(scenes), size=(RESAMPLES, len(scenes)))
    told = []
    for number, what in (("set", "the set"), ("peak", "the peak force")):
        ours, theirs = (errors(scenes, key, number) for key in ("run", "gaussian_process"))
        low, high = np.quantile(np.median(ours[drawn], axis=1) / np.median(theirs[drawn], axis=1), (0.025, 0.975))
        ahead = "the Gaussian process is ahead" if low > 1 else "the run is ahead" if high < 1 else "both are level"
        ratio = np.median(ours) / np.median(theirs)
        told.append(f"in {what} {ratio:.2g} ({low:.2g} to {high:.2g}) times as large, {ahead}")
    return f"{len(scenes)} {title}: beside the Gaussian process, the median error of the run is {'; '.join(told)}."


def _median(scenes: Sequence[dict[str, Any]], key: str) -> str:
    return f"{100 * np.median([scene[key] for scene in scenes]):.2g} %"


def _range(scenes: Sequence[dict[str, Any]], number: str) -> str:
    values = [scene["true"][number] for scene in scenes]
    return f"{min(values):.3g} to {max(values):.3g}"


def _worst(scenes: Sequence[dict[str, Any]]) -> str:
    off = errors(scenes, "run", "set")
    worst = (scenes[i] for i in np.argsort(-off)[:3])
    told = (f"{one['name']} {one['run']['set']:.2g} for {one['true']['set']:.2g} mm" for one in worst)
    return f"The worst sets of the run: {', '.join(told)}."


def settings(results: dict[str, Any], number: str) -> dict[str, Setting]:
    """The errors and the seconds of the run, of the Gaussian process and of every setting of CalculiX in the scenes
    that were solved with other settings, by their names; infinite where there is no solution."""
    scenes = [scene for scene in results["scenes"] if scene["name"] in clip_variants.SCENES]
    seconds = {"run": "seconds", "run_two_frames": "seconds_of_two"}
    made = {}
    for name, key in ANSWERS:
        spent = [scene[seconds[key]] if key in seconds else 0.0 for scene in scenes]
        made[name] = Setting(name, tuple(errors(scenes, key, number).tolist()), tuple(spent))
    for name, solved in results["variants"].items():
        if name != FINER.name:
            pairs = [
                (abs(one[number] / scene["true"][number] - 1), one["seconds"])
                if number in one
                else (math.inf, math.inf)
                for scene, one in zip(scenes, solved, strict=True)
            ]
            made[name] = Setting(name, *zip(*pairs, strict=True))
    return made


def _variants(results: dict[str, Any]) -> list[str]:
    """The table of the settings, who is as accurate as the run, and after how many questions each answer pays."""
    off = {number: settings(results, number) for number in Outcome._fields}
    count = len(off["set"][OWN].errors)
    within = f"{math.ceil(0.9 * count)} of {count} below"
    lines = [
        _VARIANTS.format(count=count, first=clip_variants.SCENES[0], last=clip_variants.SCENES[-1]),
        f"| answer | nodes | failed tries | set: median | set: {within} | force: median | force: {within} | time |",
        "| --- |" + " ---: |" * 7,
    ]
    for name, of_set in off["set"].items():
        solved = results["variants"].get(name, [])
        nodes = f"{np.median([one['nodes'] for one in solved if 'nodes' in one]):,.0f}" if solved else "-"
        failed = str(sum(len(one["failures"]) for one in solved)) if solved else "-"
        cells = [
            text for one in (of_set, off["peak"][name]) for text in (_share(np.median(one.errors)), _share(one.kept))
        ]
        lines.append(f"| {name} | {nodes} | {failed} | {' | '.join(cells)} | {_time(of_set.middle)} |")
    return [*lines, "", *_verdicts(results, off)]


def _share(value: float) -> str:
    return f"{100 * value:.2g} %" if math.isfinite(value) else "-"


def _time(seconds: float) -> str:
    return f"{1000 * seconds:.0f} ms" if 0 < seconds < 1 else f"{seconds:.3g} s" if 0 < seconds < math.inf else "-"


def _verdicts(results: dict[str, Any], off: dict[str, dict[str, Setting]]) -> list[str]:
    """The fastest setting that is as accurate as the run, and the questions after which the run pays."""
    run = off["set"][ANSWERS[1][0]]
    simulated = results["simulation_seconds"]
    invested = simulated["train"] + simulated["valid"] + results["training_seconds"]
    own = off["set"][OWN]
    lines = [
        f"- Simulation and training took {duration(invested)} of one core. Beside CalculiX on the scene's own mesh, as"
        f" in the dataset, the run pays after {_questions(invested, own, run)}, the Gaussian process, which needs the"
        f" training scenes alone, after {_questions(simulated['train'], own)}."
    ]
    for numbers, what in ((("set",), "in the set"), (("peak",), "in the force"), (("set", "peak"), "in both numbers")):
        fit = [
            off["set"][name]
            for name in results["variants"]
            if name != FINER.name and all(off[n][name].kept <= off[n][run.name].kept for n in numbers)
        ]
        best = min(fit, key=lambda one: one.middle)
        ratios = np.array(best.seconds) / np.array(run.seconds)
        spread = median_error(ratios[np.isfinite(ratios)])  # without scenes in which it finds no solution
        lines.append(
            f"- The fastest setting of CalculiX that is as accurate as the run {what}, in 90 % of the scenes:"
            f" {best.name}, {_time(best.middle)}, {np.median(ratios):.0f} ± {spread:.0f} times as long as the frames 3"
            f" and 6 of the run. Beside it the run pays after {_questions(invested, best, run)}."
        )
    return lines


def _questions(invested: float, solver: Setting, run: Setting | None = None) -> str:
    saved = solver.middle - (0.0 if run is None else run.middle)
    return f"{math.ceil(invested / saved):,} questions"


def _finer(results: dict[str, Any]) -> list[str]:
    """The error of the mesh beside the error of the run."""
    solved = results["variants"][FINER.name]
    lines = [
        _FINER.format(nodes=round(FINER.share * results["plan"]["nodes"])),
        "| scene | nodes | set: own mesh off | run off own mesh | run off finer mesh | force: own mesh off"
        " | run off own mesh | run off finer mesh | time |",
        "| --- |" + " ---: |" * 8,
    ]
    scenes = [scene for scene in results["scenes"] if scene["name"] in clip_variants.SCENES]
    for scene, one in zip(scenes, solved, strict=False):
        if "set" not in one:
            continue
        cells = []
        for number in Outcome._fields:
            ours, true, finer = scene["run"][number], scene["true"][number], one[number]
            cells += [
                f"{100 * (value / base - 1):+.1f} %" for value, base in ((true, finer), (ours, true), (ours, finer))
            ]
        lines.append(f"| {scene['name']} | {one['nodes']:,} | {' | '.join(cells)} | {_time(one['seconds'])} |")
    return lines

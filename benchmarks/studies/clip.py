"""A metal clip that a ram bends open and lets go: the permanent set, and the peak force on the ram.

`python -m benchmarks.studies.clip` solves scenes of `examples/clip` by CalculiX, trains a run on them and asks it for
test scenes, beside a Gaussian process that maps the drawn parameters to both numbers. It writes
benchmarks/results/clip.json and docs/results/clip.md. Data and run lie in `--folder`; a second call goes on with what
is there. Everything runs on one thread, and all times are processor times.
"""

from __future__ import annotations

import argparse
import os
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import ast_sim
from ast_sim.dataset.solver_seconds import read_seconds
from ast_sim.inference.relative_errors import relative_error
from ast_sim.named_field import REACTION
from ast_sim.support.disk import write_json, write_text
from ast_sim.support.provenance import provenance
from benchmarks.studies.phrases import median_error
from benchmarks.studies.validation_curve import minutes_per_step

ROOT = Path(__file__).parents[2]
SPEC = ROOT / "examples" / "clip" / "SPEC.toml"
RESULTS = ROOT / "benchmarks" / "results" / "clip.json"
PAGE = ROOT / "docs" / "results" / "clip.md"
CLIP, RAM = 0, 1  # bodies
TURN, LAST = 3, 6  # the frames in which the ram turns and is back
FOLDS = 5  # of the cross-validation that chooses the scale of a Gaussian process
STATE = ("PEEQ", REACTION)


@dataclass(frozen=True)
class Plan:
    """The scenes and the training.

    Attributes:
        nodes, train, valid, test, calibration: of the dataset.
        steps, settings: of the training.
    """

    nodes: int = 1400
    train: int = 80
    valid: int = 6
    test: int = 30
    calibration: int = 0
    steps: int = 3600
    settings: tuple[tuple[str, Any], ...] = (("mirror", ("y",)), ("stress_weight", 0.3))


class Outcome(NamedTuple):
    """What an engineer asks of a clip: the permanent set in the unit of length, the peak force on the ram in newton."""

    set: float
    peak: float


def outcome(scene: ast_sim.Scene, first: np.ndarray, last: np.ndarray, reaction: np.ndarray) -> Outcome:
    """The set is the length of the mean displacement of the free end of the arm, its upper face, when the ram is back.

    Args:
        first, last: [N, 3], the positions in the first and in the last frame.
        reaction: [S, N, 3], the forces on the prescribed nodes in all frames.
    """
    height = np.where(scene.body == CLIP, scene.rest_position[:, 2], -np.inf)
    end = height > height.max() - 1e-3 * np.ptp(scene.rest_position[:, 2])
    way = (last[end].astype(np.float64) - first[end]).mean(axis=0)
    force = reaction[:, scene.body == RAM].astype(np.float64).sum(axis=1)
    return Outcome(float(np.linalg.norm(way)), float(np.linalg.norm(force, axis=1).max()))


def true_outcome(truth: ast_sim.Trajectory) -> Outcome:
    """The one that CalculiX found."""
    return outcome(truth.scene, truth.position[0], truth.position[-1], truth.fields[REACTION].values)


def parameters(truth: ast_sim.Trajectory) -> dict[str, Any]:
    """The drawn parameters of a scene, by name."""
    marked = {name: value for name, value in truth.attributes.items() if name.startswith("parameter ")}
    return {name.removeprefix("parameter "): value for name, value in marked.items()}


def features(drawn: Sequence[dict[str, Any]], known: Sequence[dict[str, Any]]) -> np.ndarray:
    """[n, f]: the parameters as a Gaussian process takes them. Numbers are scaled by those that are `known`; of a text,
    such as the name of a variant, each value has a column; what never varies has none."""
    columns = []
    for name in known[0]:
        values = [one[name] for one in known]
        if isinstance(values[0], str):
            columns += [[float(one[name] == value) for one in drawn] for value in sorted(set(values))]
        elif np.ptp(values) > 0:
            columns.append([(one[name] - np.mean(values)) / np.std(values) for one in drawn])
    return np.array(columns).T


def gaussian_process(x: np.ndarray, y: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """[m]: what a Gaussian process says of the points `asked` [m, f] after the points x [n, f] with values y [n] > 0.

    The kernel is a squared exponential with a length for each feature, and white noise; maximum likelihood chooses. It
    models y or log y, whichever has the lower median relative error in a cross-validation.
    """
    scales: tuple[tuple[Callable, Callable], ...] = ((np.asarray, np.asarray), (np.log, np.exp))
    fold = np.arange(len(x)) % FOLDS
    errors = []
    for scale, back in scales:
        guess = np.empty_like(y)
        for part in range(FOLDS):
            guess[fold == part] = back(_fitted(x[fold != part], scale(y[fold != part])).predict(x[fold == part]))
        errors.append(np.median(np.abs(guess / y - 1)))
    scale, back = scales[int(np.argmin(errors))]
    return back(_fitted(x, scale(y)).predict(asked))


def _fitted(x: np.ndarray, y: np.ndarray) -> Any:
    from sklearn.gaussian_process import GaussianProcessRegressor  # takes a second
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    lengths = RBF(np.full(x.shape[1], 2.0), (0.1, 1e3))
    kernel = ConstantKernel(1.0, (1e-2, 1e3)) * lengths + WhiteKernel(1e-3, (1e-8, 1.0))
    process = GaussianProcessRegressor(kernel, normalize_y=True, n_restarts_optimizer=2, random_state=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a length at its bound, or a search that ends early: the best of three counts
        return process.fit(x, y)


def trained(plan: Plan, folder: Path) -> tuple[ast_sim.Run, Path]:
    """The run and its dataset; what is there already is not made again."""
    data = ast_sim.generate(
        "assembly", folder / "clip.h5", spec=SPEC, nodes=plan.nodes, workers=1, train=plan.train, valid=plan.valid,
        test=plan.test, calibration=plan.calibration,
    ).path  # fmt: skip
    settings = dict(plan.settings)
    run = ast_sim.train(data, folder / f"run_{plan.steps}", steps=plan.steps, state=STATE, resume=True, **settings)
    return run, data


def measured(plan: Plan, folder: Path) -> dict[str, Any]:
    """Solve, train and measure."""
    run, data = trained(plan, folder)
    with run.open(data) as dataset:
        seconds = read_seconds(dataset).samples
        known = _solved(dataset, "train")
        scenes = [
            {"name": name, "solver_seconds": sum(seconds[name]), **_asked(run, truth)}
            for name, truth in _solved(dataset, "test")
        ]
    drawn, outcomes = [parameters(truth) for _, truth in known], [true_outcome(truth) for _, truth in known]
    asked = features([scene["parameters"] for scene in scenes], drawn)
    for key in Outcome._fields:
        values = np.array([getattr(one, key) for one in outcomes])
        for scene, value in zip(scenes, gaussian_process(features(drawn, drawn), values, asked), strict=True):
            scene["gaussian_process"] = {**scene.get("gaussian_process", {}), key: float(value)}
    return {
        **provenance("python -m benchmarks.studies.clip"),
        "plan": {**plan.__dict__, "settings": dict(plan.settings)},
        "solved": {"train": len(known), "test": len(scenes)},
        "generation_minutes": sum(map(sum, seconds.values())) / 60,
        "training_minutes": minutes_per_step(run) * plan.steps,
        "parameters": sum(weights.numel() for weights in run.model.parameters()),
        "scenes": scenes,
    }


def _solved(dataset: ast_sim.Dataset, split: str) -> list[tuple[str, ast_sim.Trajectory]]:
    """The scenes of a split that CalculiX finished, with their names."""
    scenes = [(f"{split}/{i:06d}", dataset.load(split, i, STATE)) for i in range(dataset.count(split))]
    return [(name, truth) for name, truth in scenes if truth.num_frames == LAST + 1]


def _asked(run: ast_sim.Run, truth: ast_sim.Trajectory) -> dict[str, Any]:
    """A test scene: its parameters, both outcomes, relative errors, and the seconds of an answer with all frames and of
    one with the two frames that the outcomes need."""
    answer, seconds = _timed(run, truth, None)
    turned, seconds_of_two = _timed(run, truth, [TURN, LAST])
    two = Outcome(*outcome(truth.scene, truth.position[0], turned.position[-1], turned.fields[REACTION].values))
    metal = truth.scene.deforming_nodes
    strain, true_strain = (one.fields["PEEQ"].values[-1, metal].astype(np.float64) for one in (answer, truth))
    return {
        "parameters": parameters(truth),
        "true": true_outcome(truth)._asdict(),
        "run": outcome(truth.scene, truth.position[0], answer.position[-1], answer.fields[REACTION].values)._asdict(),
        "run_two_frames": two._asdict(),
        "turn_error": relative_error(answer.position[TURN], truth, TURN),
        "last_error": relative_error(answer.position[LAST], truth, LAST),
        "strain_error": float(np.linalg.norm(strain - true_strain) / np.linalg.norm(true_strain)),
        "seconds": seconds,
        "seconds_of_two": seconds_of_two,
    }


def _timed(run: ast_sim.Run, truth: ast_sim.Trajectory, frames: list[int] | None) -> tuple[ast_sim.Answer, float]:
    """The answer, and the least processor time of three."""
    spent = []
    for _ in range(3):
        began = time.process_time()
        answer = run.predict(truth, frames=frames)
        spent.append(time.process_time() - began)
    return answer, min(spent)


_INTRODUCTION = """# A metal clip: permanent set and peak force

Made by `python -m benchmarks.studies.clip` from `benchmarks/results/clip.json`; do not edit.

`examples/clip`: a ram bends the arm of a metal clip open, turns in frame 3 of 6 and goes back. Length, thickness, place
and kind of the cutout, travel and yield stress are drawn. The set is the length of the mean displacement of the arm's
free end in the last frame, the peak force the largest force on the ram in all frames. Errors are relative to what
CalculiX found on the same mesh, in test scenes that no training has seen. The run predicts all frames of a scene,
those after the turn from its own answer for the turn
([the load path](../reference/model.md#jumps-and-corrections)). The Gaussian process (scikit-learn, a squared
exponential with a length for each parameter) maps the drawn parameters to both numbers; it knows nothing else of a
scene, and can be asked for nothing else. Times are processor times of one thread ({processor}).
"""


def page(found: dict[str, Any]) -> str:
    """The page of the results."""
    scenes, plan = found["scenes"], found["plan"]
    solver = float(np.median([scene["solver_seconds"] for scene in scenes]))
    lines = [_INTRODUCTION.format(processor=found["processor"])]
    kinds = ("median", "mean", "90 % below")
    heads = [f"{what}: {kind}" for what in ("set", "peak force") for kind in kinds]
    lines += [f"| answer | {' | '.join(heads)} |", "| --- |" + " ---: |" * 6]
    for title, key in (
        ("the run, all frames", "run"),
        ("the run, the frames 3 and 6 alone", "run_two_frames"),
        ("Gaussian process", "gaussian_process"),
    ):
        cells = [_cells(errors(scenes, key, number)) for number in Outcome._fields]
        lines.append(f"| {title} | {' | '.join(cells)} |")
    lines += ["| springs back wholly | 100 % | 100 % | 100 % | - | - | - |", ""]
    ours, theirs = ([np.median(errors(scenes, key, n)) for n in Outcome._fields] for key in ("run", "gaussian_process"))
    lines.append(
        f"- The median error of the run is {ours[0] / theirs[0]:.2g} times that of the Gaussian process in the set,"
        f" {ours[1] / theirs[1]:.2g} times in the peak force."
    )
    for key, what in (("seconds", "all frames"), ("seconds_of_two", "the frames 3 and 6")):
        ratios = [scene["solver_seconds"] / scene[key] for scene in scenes]
        spent = 1000 * np.median([scene[key] for scene in scenes])
        lines.append(
            f"- An answer with {what} takes {spent:.0f} ms, CalculiX {solver:.3g} s a scene:"
            f" {np.median(ratios):.0f} ± {median_error(ratios):.0f} times as long."
        )
    lines += [
        f"- The run: {found['solved']['train']} scenes of about {plan['nodes']:,} nodes, {plan['steps']:,} steps in"
        f" {found['training_minutes']:.0f} min, {found['parameters']:,} weights. CalculiX took"
        f" {found['generation_minutes']:.0f} min for the scenes of all splits. {found['solved']['test']} test scenes.",
        f"- Errors of the run in the field, medians: displacement {_median(scenes, 'turn_error')} when the ram turns,"
        f" {_median(scenes, 'last_error')} when it is back; plastic strain there {_median(scenes, 'strain_error')}.",
        f"- Sets from {_range(scenes, 'set')} mm, peak forces from {_range(scenes, 'peak')} N. {_worst(scenes)}",
    ]
    return "\n".join(lines)


def errors(scenes: Sequence[dict[str, Any]], key: str, number: str) -> np.ndarray:
    """[n]: the relative errors of the set or the peak force in an answer."""
    return np.array([abs(scene[key][number] / scene["true"][number] - 1) for scene in scenes])


def _cells(values: np.ndarray) -> str:
    middle = f"{100 * np.median(values):.2g} ± {100 * median_error(values):.1g} %"
    return f"{middle} | {100 * values.mean():.2g} % | {100 * np.quantile(values, 0.9):.2g} %"


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


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = Path("build/clip")
    parser.add_argument("--folder", type=Path, default=default, help=f"data and run (default: {default})")
    asked = parser.parse_args(arguments)
    import torch  # after ast_sim, which says how its threads wait

    torch.set_num_threads(1)
    os.environ["OMP_NUM_THREADS"] = "1"  # of the generator's processes
    ast_sim.keep_memory()
    found = measured(Plan(), asked.folder)
    write_json(RESULTS, found)
    write_text(PAGE, page(found) + "\n")
    print(page(found))


if __name__ == "__main__":
    main()

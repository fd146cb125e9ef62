"""A metal clip that a ram bends open and lets go: the permanent set, and the peak force on the ram.

`python -m benchmarks.studies.clip` solves scenes of `examples/clip` by CalculiX, trains a run on them and asks it for
test scenes and for clips with a cutout that no training scene has, beside a Gaussian process that maps the drawn
parameters to both numbers, and beside CalculiX on other meshes and with larger increments. It writes
benchmarks/results/clip.json, docs/results/clip.md and examples/clip/test_scenes.h5. Data and run lie in `--folder`; a
second call goes on with what is there. Everything runs on one thread, and all times are processor times.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import ast_sim
from ast_sim.dataset.solver_seconds import SolverSeconds, read_seconds, write_seconds
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.inference.evaluation.gaussian_process import features, gaussian_process
from ast_sim.inference.quantities.relative_errors import relative_error
from ast_sim.named_field import REACTION
from ast_sim.simulate.own_assembly.parameters import values_of
from ast_sim.support.disk import write_json, write_text
from ast_sim.support.provenance import provenance
from benchmarks.studies import clip_variants
from benchmarks.studies.clip_outcome import LAST, SPEC, TURN, Outcome, outcome, true_outcome
from benchmarks.studies.clip_page import page
from benchmarks.studies.validation_curve import minutes_per_step

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results" / "clip.json"
PAGE = ROOT / "docs" / "results" / "clip.md"
SHARED = SPEC.with_name("test_scenes.h5")
OTHER_CUTOUT = SPEC.with_name("two_holes.toml")
OTHER_SEED = 1  # other values of the parameters than in the test scenes
NO_CUTOUT = {"clip.file": ""}  # of which kind a cutout is, where no parameter says it
STATE = ("PEEQ", REACTION)


@dataclass(frozen=True)
class Plan:
    """The scenes and the training.

    Attributes:
        nodes, train, valid, test, calibration: of the dataset.
        other_cutout: the number of clips with a cutout that no training scene has.
        steps, settings: of the training.
        seeds: of the trainings; the run of the first one ships.
    """

    nodes: int = 3500
    train: int = 80
    valid: int = 6
    test: int = 30
    calibration: int = 40
    other_cutout: int = 6
    steps: int = 3600
    settings: tuple[tuple[str, Any], ...] = (("mirror", ("y",)), ("stress_weight", 0.3))
    seeds: tuple[int, ...] = (0,)


def trained(plan: Plan, folder: Path, seed: int = 0) -> tuple[ast_sim.Run, Path]:
    """The run and its dataset; what is there already is not made again."""
    data = ast_sim.generate(
        "assembly", folder / "clip.h5", spec=SPEC, nodes=plan.nodes, workers=1, train=plan.train, valid=plan.valid,
        test=plan.test, calibration=plan.calibration,
    ).path  # fmt: skip
    settings = {**dict(plan.settings), "steps": plan.steps, "seed": seed}
    run = ast_sim.train(data, folder / f"run_{plan.steps}_seed{seed}", state=STATE, resume=True, **settings)
    return run, data


def other_cutout(plan: Plan, folder: Path) -> list[tuple[str, ast_sim.Trajectory, float]]:
    """The clips with a cutout that no training scene has: names, motions, and the seconds of CalculiX."""
    data = ast_sim.generate(
        "assembly", folder / "two_holes.h5", spec=OTHER_CUTOUT, nodes=plan.nodes, workers=1, train=0, valid=0,
        test=plan.other_cutout, seed=OTHER_SEED,
    ).path  # fmt: skip
    with ast_sim.Dataset(data) as dataset:
        seconds = read_seconds(dataset).samples
        return [(name, truth, sum(seconds[name])) for name, truth in _solved(dataset, "test")]


def measured(plan: Plan, folder: Path) -> dict[str, Any]:
    """Solve, train and measure."""
    run, data = trained(plan, folder)
    others = {f"seed {seed}": trained(plan, folder, seed)[0] for seed in plan.seeds[1:]}
    with run.open(data) as dataset:
        taken = read_seconds(dataset)
        seconds = {name: sum(frames) for name, frames in taken.samples.items()}
        known, tests, calibration = (_solved(dataset, split) for split in ("train", "test", "calibration"))
        beside = [(name, truth) for name, truth in tests if name in clip_variants.SCENES]
        share_scenes(dataset, beside, taken)
    groups = [[(name, truth, seconds[name]) for name, truth in group] for group in (tests, calibration)]
    scenes, unseen, strangers = (
        [{"name": name, "solver_seconds": spent, **_scene_figures(run, truth, others)} for name, truth, spent in group]
        for group in (*groups, other_cutout(plan, folder))
    )
    drawn, outcomes = [values_of(truth.attributes) for _, truth in known], [true_outcome(truth) for _, truth in known]
    for key in Outcome._fields:
        law = gaussian_process(features(drawn, drawn), np.array([getattr(one, key) for one in outcomes]))
        for group in (scenes, unseen, strangers):
            points = features([{**NO_CUTOUT, **scene["parameters"]} for scene in group], drawn)
            for scene, value in zip(group, law(points), strict=True):
                scene["gaussian_process"] = {**scene.get("gaussian_process", {}), key: float(value)}
    own = [
        {"nodes": truth.scene.num_nodes, **true_outcome(truth)._asdict(), "seconds": seconds[name], "failures": []}
        for name, truth in beside
    ]
    solved = clip_variants.solved(
        [values_of(truth.attributes) for _, truth in beside], plan.nodes, folder / "variants.json"
    )
    return {
        **provenance("python -m benchmarks.studies.clip"),
        "plan": {**plan.__dict__, "settings": dict(plan.settings)},
        "simulation_seconds": {
            split: sum(value for name, value in seconds.items() if name.startswith(split))
            for split in ("train", "valid", "test", "calibration")
        },
        "training_seconds": 60 * minutes_per_step(run) * plan.steps,
        "parameters": run.model.num_parameters,
        "scenes": scenes,
        "unseen": unseen,
        "other_cutout": strangers,
        "variants": {clip_variants.OWN: own, **solved},
    }


def share_scenes(
    dataset: ast_sim.Dataset, scenes: Sequence[tuple[str, ast_sim.Trajectory]], taken: SolverSeconds
) -> None:
    """Write named scenes to `SHARED` as a motion of two steps, the ram's way out and back: rest, turn and last frame;
    the seconds of CalculiX beside it."""
    kept = [0, TURN, LAST]
    origin = dataset.info.generator
    counts = {**dict.fromkeys(origin.get("counts", {}), 0), "test": len(scenes)}
    origin = {**origin, "counts": counts, "note": f"frames {kept} of {', '.join(name for name, _ in scenes)}"}
    seconds = {}
    with DatasetWriter(SHARED, replace(dataset.info, generator=origin)) as writer:
        for index, (name, truth) in enumerate(scenes):
            lists = {key: value for key, value in truth.attributes.items() if isinstance(value, list)}
            cut = {key: [value[frame] for frame in kept] for key, value in lists.items() if len(value) > LAST}
            writer.add("test", replace(truth.select(kept), frames=None, attributes={**truth.attributes, **cut}))
            until = np.cumsum(taken.samples[name])[kept]
            spent = {"solve_seconds": np.diff(until, prepend=0).tolist(), "processor": ", ".join(taken.processors)}
            seconds[f"test/{index:06d}"] = spent
    write_seconds(SHARED, origin, seconds)


def _solved(dataset: ast_sim.Dataset, split: str) -> list[tuple[str, ast_sim.Trajectory]]:
    """The scenes of a split that CalculiX finished, with their names."""
    scenes = [(f"{split}/{i:06d}", dataset.load(split, i, STATE)) for i in range(dataset.count(split))]
    return [(name, truth) for name, truth in scenes if truth.num_frames == LAST + 1]


def _scene_figures(run: ast_sim.Run, truth: ast_sim.Trajectory, others: dict[str, ast_sim.Run]) -> dict[str, Any]:
    """A test scene: its parameters, the outcomes, relative errors, and the seconds of an answer with all frames and of
    one with the two frames that the outcomes need."""
    answer, seconds = _timed(run, truth, None)
    turned, seconds_of_two = _timed(run, truth, [TURN, LAST])
    metal = truth.scene.deforming_nodes
    strain, true_strain = (one.fields["PEEQ"].values[-1, metal] for one in (answer, truth))
    force, true_force = (one.fields[REACTION].values[TURN] for one in (answer, truth))
    return {
        "parameters": values_of(truth.attributes),
        "true": true_outcome(truth)._asdict(),
        "run": _said(answer, truth),
        "run_two_frames": _said(turned, truth),
        **{name: _said(other.predict(truth), truth) for name, other in others.items()},
        "turn_error": relative_error(answer.position[TURN], truth, TURN),
        "last_error": relative_error(answer.position[LAST], truth, LAST),
        "strain_error": _relative(strain, true_strain),
        "force_error": _relative(force, true_force),
        "seconds": seconds,
        "seconds_of_two": seconds_of_two,
    }


def _said(answer: ast_sim.Answer, truth: ast_sim.Trajectory) -> dict[str, float]:
    forces = answer.fields[REACTION].values
    return outcome(truth.scene, truth.position[0], answer.position[-1], forces)._asdict()


def _relative(values: np.ndarray, true: np.ndarray) -> float:
    return float(np.linalg.norm(values.astype(np.float64) - true) / np.linalg.norm(true.astype(np.float64)))


def _timed(run: ast_sim.Run, truth: ast_sim.Trajectory, frames: list[int] | None) -> tuple[ast_sim.Answer, float]:
    """The answer, and the least processor time of three."""
    spent = []
    for _ in range(3):
        began = time.process_time()
        answer = run.predict(truth, frames=frames)
        spent.append(time.process_time() - began)
    return answer, min(spent)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = Path("build/clip")
    parser.add_argument("--folder", type=Path, default=default, help=f"data and run (default: {default})")
    options = parser.parse_args(arguments)
    import torch  # after ast_sim, which says how its threads wait

    torch.set_num_threads(1)
    os.environ["OMP_NUM_THREADS"] = "1"  # of the generator's processes
    ast_sim.keep_memory()
    results = measured(Plan(), options.folder)
    write_json(RESULTS, results)
    write_text(PAGE, page(results) + "\n")
    print(page(results))


if __name__ == "__main__":
    main()

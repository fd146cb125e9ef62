"""Do bands and asked errors hold? In how many fresh plates all errors lie within the band, how many
keep an error that an effort was chosen for, and how many strange plates are told.

`python -m benchmarks.studies.coverage` calibrates the run of plates that comes with the package on a hundred plates,
and predicts 300 others, and changed ones, with each effort. It writes benchmarks/results/coverage.json. The
scenes lie in `--folder`; a second call goes on with what is there.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import betabinom

import ast_sim
from ast_sim.inference.promises.familiarity import UNUSUAL
from ast_sim.inference.quantities.band import LEVEL, compared
from ast_sim.simulate.jobs.fastest_solver import deepest_frame
from ast_sim.support.disk import write_json
from ast_sim.support.errors import ConfigError
from ast_sim.support.provenance import provenance

RESULTS = Path(__file__).parents[1] / "results" / "coverage.json"
PLATES = {"train": 0, "valid": 0, "nodes": 400, "frames": 41, "keep": (14, 24, 34)}
SETS = {"calibration": {"seed": 911, "test": 100}, "fresh": {"seed": 912, "test": 300}}
ASKED = {
    "displacement": (0.1, 0.08, 0.05, 0.025, 0.02, 0.015, 0.01),
    "reaction": (0.5, 0.2, 0.1, 0.05, 0.02),
    "stress": (0.2, 0.1, 0.05, 0.02, 0.01),
}


def plates(folder: Path, name: str) -> Path:
    """The dataset with the plates `name`, made if it is not there yet."""
    return ast_sim.generate("deforming_plate", folder / f"{name}.h5", **SETS[name], **PLATES).path


def bands(run: ast_sim.Run, truths: Sequence[ast_sim.Trajectory], effort: ast_sim.Effort) -> list[dict[str, Any]]:
    """How the bands of an effort hold in fresh scenes, a row for each quantity."""
    assert run.calibration is not None
    result = run.calibration
    answers = [(run.predict(truth, effort=effort, throw=False), truth) for truth in truths]
    known = [(answer, compared(answer, truth)) for answer, truth in answers if answer.bands]
    rank = int(np.ceil((result.scenes + 1) * LEVEL - 1e-9))
    low, high = betabinom(len(known), rank, result.scenes + 1 - rank).interval(0.99)
    rows = []
    for quantity, width in known[0][0].bands.items():
        scores = [comparisons[quantity].score(width.typical) for _, comparisons in known]
        widest = [width.around(answer, quantity).max() for answer, _ in known]
        errors = [comparisons[quantity].errors.max() for _, comparisons in known]
        rows.append({
            "effort": effort.text,
            "quantity": quantity,
            "quantile": width.width,
            "typical": width.typical,
            "fresh_scenes": len(known),
            "without_band": len(truths) - len(known),
            "held": sum(score <= width.width for score in scores),
            "held_interval_99": [int(low), int(high)],
            "median_band": float(np.median(widest)),
            "median_largest_error": float(np.median(errors)),
        })  # fmt: skip
    return rows


def strange(truths: Sequence[ast_sim.Trajectory]) -> dict[str, list[tuple[ast_sim.Scene, np.ndarray]]]:
    """Questions by what is strange about them: each of these plates, changed."""
    quarter = np.float32([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    upside_down = np.float32([[1, 0, 0], [0, -1, 0], [0, 0, -1]])
    kinds: dict[str, list[tuple[ast_sim.Scene, np.ndarray]]] = {}
    for truth in truths:
        scene, motion = truth.scene, truth.position
        way = motion - motion[:1]
        held = scene.node_type == ast_sim.NodeType.HANDLE
        one_end = held & (scene.rest_position[:, 0] > scene.rest_position[held, 0].mean())
        for kind, question in {
            "turned by 180 degrees: nothing strange": _turned(scene, motion, quarter @ quarter),
            "turned by 90 degrees in its plane": _turned(scene, motion, quarter),
            "pressed from below": _turned(scene, motion, upside_down),
            "pressed sideways": (scene, motion[:1] + way[..., [2, 1, 0]]),
            "twice the travel": (scene, motion[:1] + 2 * way),
            "held at one end": (_free(scene, one_end), motion),
            "held by nothing": (_free(scene, held), motion),
        }.items():
            kinds.setdefault(kind, []).append(question)
    kinds["a beam in place of a plate"] = [_beam(height) for height in np.linspace(0.06, 0.14, len(truths))]
    return kinds


def _turned(scene: ast_sim.Scene, motion: np.ndarray, turn: np.ndarray) -> tuple[ast_sim.Scene, np.ndarray]:
    return replace(scene, rest_position=scene.rest_position @ turn.T), motion @ turn.T


def _free(scene: ast_sim.Scene, nodes: np.ndarray) -> ast_sim.Scene:
    return replace(scene, node_type=np.where(nodes, ast_sim.NodeType.NORMAL, scene.node_type).astype(np.uint8))


def _beam(height: float) -> tuple[ast_sim.Scene, np.ndarray]:
    """A beam that is held at one end and pressed at the other, within the ranges of the plates."""
    body = ast_sim.box((0, 0, 0), (0.5, 0.1, height), cells=(13, 3, 3))
    kinds = np.where(body.rest_position[:, 0] == 0, ast_sim.NodeType.HANDLE, body.node_type).astype(np.uint8)
    punch = ast_sim.box((0.4, 0.0, height + 0.01), (0.48, 0.1, height + 0.11), cells=(2, 2, 2))
    rigid = replace(punch, node_type=np.full_like(punch.node_type, ast_sim.NodeType.OBSTACLE))
    scene = ast_sim.Scene.join(replace(body, node_type=kinds), rigid)
    motion = np.repeat(scene.rest_position[None], 2, axis=0)
    motion[1, scene.body == 1] -= np.float32([0, 0, 0.06])
    return scene, motion


def unusual(run: ast_sim.Run, questions: Sequence[tuple[ast_sim.Scene, np.ndarray]]) -> dict[str, int]:
    """How many questions there are, at the last frame by one call, and how many of them lie outside the ranges of the
    training, are unlike the calibration scenes by the network, or are told by either."""
    answers = [run.predict(*one, frames=[-1], effort=ast_sim.Effort(), throw=False) for one in questions]
    unlike = [one.p_value is not None and one.p_value <= UNUSUAL for one in answers]
    outside = [len(one.notes) > alike for one, alike in zip(answers, unlike, strict=True)]
    return {
        "questions": len(answers),
        "outside": sum(outside),
        "unlike": sum(unlike),
        "told": sum(bool(one.notes) for one in answers),
    }


def promises(run: ast_sim.Run, truths: Sequence[ast_sim.Trajectory]) -> dict[str, Any]:
    """The errors that each effort of a calibrated run keeps; for asked ones the effort that is chosen, and in how many
    of the fresh scenes within its ranges it keeps them."""
    assert run.calibration is not None
    kept = run.calibration.kept
    errors = []
    for truth in truths:
        frame = deepest_frame(truth)
        answers = [run.predict(truth, frames=frame, effort=effort, throw=False) for effort in kept.efforts]
        if not answers[0].notes:
            errors.append([dict.fromkeys(ASKED, np.inf) if one.failure else one.errors(truth) for one in answers])
    told = []
    for quantity, levels in ASKED.items():
        for level in levels:
            one: dict[str, Any] = {"quantity": quantity, "error": level}
            try:
                chosen = kept.effort_for({quantity: level})
            except ConfigError as error:
                told.append({**one, "refused": str(error)})
                continue
            number = kept.efforts.index(chosen)
            told.append({**one, "effort": chosen.text, "held": sum(row[number][quantity] <= level for row in errors)})
    middle = {
        quantity: [float(np.median([row[number][quantity] for row in errors])) for number in range(len(kept.efforts))]
        for quantity in ASKED
    }
    return {
        "efforts": [effort.text for effort in kept.efforts],
        "kept": {quantity: kept.bounds(quantity) for quantity in ASKED},
        "median_error": middle,
        "promises": told,
        "promised_scenes": len(errors),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, default=Path("build/coverage"), help="scenes (default: build/coverage)")
    folder = parser.parse_args(arguments).folder
    run = ast_sim.example_run("plates")
    with ast_sim.Dataset(plates(folder, "fresh")) as data:
        truths = [data["test"][index] for index in range(data.count("test"))]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what they tell is counted
        calibration = ast_sim.calibrate(run, plates(folder, "calibration"), "test")
        rows = [row for effort in calibration.efforts for row in bands(run, truths, effort)]
        asked = promises(run, truths)
        ordinary = [(truth.scene, truth.position) for truth in truths]
        kinds = {"fresh plates": ordinary, **strange(truths[:40])}
        told = {kind: unusual(run, questions) for kind, questions in kinds.items()}
    for row in rows:
        print(f"{row['quantity']}, {row['effort']}: held in {row['held']} of {row['fresh_scenes']}")
    for one in asked["promises"]:
        print(f"{one['quantity']} {one['error']:g}: {one.get('effort', one.get('refused'))}: {one.get('held')}")
    for kind, counts in told.items():
        print(f"{kind}: {counts['told']} of {counts['questions']} told, {counts['unlike']} by the network")
    known = {"calibration_scenes": calibration.scenes, "spacing": list(calibration.spacing)}
    write_json(
        RESULTS, {**provenance("python -m benchmarks.studies.coverage"), **known, "rows": rows, **asked, "told": told}
    )


if __name__ == "__main__":
    main()

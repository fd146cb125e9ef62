"""Do bands and promised errors hold? In how many fresh scenes all errors lie within the band, how many keep an error
that an effort was chosen for, and how many strange scenes are told.

`python -m benchmarks.studies.coverage [ROW ...]` calibrates the run of each row (the plates' comes with the package,
the products' are of `benchmarks.studies.assembly`) on a hundred scenes, and predicts fresh ones, and changed ones, with
each effort. It writes benchmarks/results/coverage.json and docs/results/coverage.md. Scenes and runs lie in `--folder`;
a second call goes on with what is there. Everything runs on one thread.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import betabinom

import ast_sim
from ast_sim.inference.effort import Effort
from ast_sim.inference.promises.familiarity import UNUSUAL
from ast_sim.inference.quantities.band import LEVEL, compared
from ast_sim.simulate.jobs.fastest_solver import deepest_frame
from ast_sim.support.errors import ConfigError
from ast_sim.support.provenance import provenance
from benchmarks.studies import assembly
from benchmarks.studies.coverage_page import LEVELS, page
from benchmarks.studies.rows import study_rows
from benchmarks.studies.trade import DEEP_PLATES

RESULTS = Path(__file__).parents[1] / "results" / "coverage.json"
PAGE = Path(__file__).parents[2] / "docs" / "results" / "coverage.md"
SEEDS = {"calibration": 911, "fresh": 912}
STRANGE = 40  # fresh scenes that are changed
WANTED = {
    "displacement": (0.1, 0.08, 0.05, 0.025, 0.02, 0.015, 0.01),
    "reaction": (0.5, 0.2, 0.1, 0.05, 0.02),
    "stress": (0.2, 0.1, 0.05, 0.02, 0.01),
}
Question = tuple[ast_sim.Scene, np.ndarray]


@dataclass(frozen=True)
class Row:
    """A run and its scenes.

    Attributes:
        title: what the page calls them.
        run: gives the run; data of its own lie in the folder.
        generate: the settings of `generate`.
        fresh: the number of fresh scenes.
        calibration: the number of calibration scenes.
    """

    title: str
    run: Callable[[Path], ast_sim.Run]
    generate: dict[str, Any]
    fresh: int
    calibration: int = 100


def _product(name: str) -> Row:
    """The row of a product of `benchmarks.studies.assembly`."""
    product = assembly.ROWS[name]
    scenes = {"family": "assembly", "spec": product.spec, "nodes": product.nodes}
    return Row(product.title, lambda folder: assembly.trained(name, folder)[0], scenes, fresh=100)


_PLATES = {**DEEP_PLATES, "nodes": 400}
ROWS = {
    "plates": Row("Plates, 400 nodes", lambda _: ast_sim.example_run("plates"), _PLATES, fresh=300),
    "snap_hook": _product("snap_hook"),
    "bumper": _product("bumper"),
}


def scenes(name: str, folder: Path, which: str) -> Path:
    """The dataset with the scenes of a row, `which` of "calibration" and "fresh", in its split "test"; it is made if it
    is not there yet."""
    row = ROWS[name]
    return ast_sim.generate(
        out=folder / f"{name}_{which}.h5", train=0, valid=0, test=getattr(row, which), seed=SEEDS[which], **row.generate
    ).path


def measured(name: str, folder: Path) -> dict[str, Any]:
    """The figures of a row."""
    run = ROWS[name].run(folder)
    truths, path = _loaded(scenes(name, folder, "fresh")), scenes(name, folder, "calibration")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what they tell is counted
        calibration = ast_sim.calibrate(run, path, "test")
        calibrating = _loaded(path)
        rows = [row for effort in calibration.efforts for row in bands(run, calibrating, truths, effort)]
        promised = promises(run, truths)
        ordinary = [(truth.scene, truth.position) for truth in truths]
        kinds = {"fresh scenes": ordinary, **strange(name, run, truths[:STRANGE], folder)}
        told = {kind: unusual(run, questions) for kind, questions in kinds.items()}
    known = {"title": ROWS[name].title, "calibration_scenes": calibration.scenes, "spacing": list(calibration.spacing)}
    origin = provenance(f"python -m benchmarks.studies.coverage {name}")
    return {**origin, **known, "rows": rows, **promised, "told": told}


def _loaded(path: Path) -> list[ast_sim.Trajectory]:
    with ast_sim.Dataset(path) as data:
        return [data["test"][index] for index in range(data.count("test"))]


def bands(
    run: ast_sim.Run, calibrating: Sequence[ast_sim.Trajectory], truths: Sequence[ast_sim.Trajectory], effort: Effort
) -> list[dict[str, Any]]:
    """How the bands of an effort hold in fresh scenes, a row for each quantity."""
    assert run.calibration is not None
    measured = [(answer, compared(answer, truth)) for answer, truth in _answers(run, truths, effort) if answer.bands]
    known = [
        None if answer.failure else compared(answer, truth)
        for answer, truth in _answers(run, calibrating, effort)
        if not _is_outside(answer)
    ]
    assert len(known) == run.calibration.scenes
    rows = []
    for quantity, band in measured[0][0].bands.items():
        scores = sorted(np.inf if one is None else one[quantity].score(band.typical) for one in known)
        fresh = [comparisons[quantity].score(band.typical) for _, comparisons in measured]
        widest = float(np.median([band.around(answer, quantity).max() for answer, _ in measured]))
        levels = {}
        for level in LEVELS:
            rank = int(np.ceil((len(scores) + 1) * level - 1e-9))
            low, high = betabinom(len(fresh), rank, len(scores) + 1 - rank).interval(0.99)
            width = scores[rank - 1]
            levels[f"{level:g}"] = {
                "width": width,
                "held": sum(score <= width for score in fresh),
                "held_interval_99": [int(low), int(high)],
                "median_band": widest * width / band.width,
            }
        assert levels[f"{LEVEL:g}"]["width"] == band.width
        rows.append({
            "effort": effort.text,
            "quantity": quantity,
            "typical": band.typical,
            "fresh_scenes": len(fresh),
            "without_band": len(truths) - len(fresh),
            "levels": levels,
            "median_largest_error": float(np.median([one[quantity].errors.max() for _, one in measured])),
        })  # fmt: skip
    return rows


def _answers(
    run: ast_sim.Run, truths: Sequence[ast_sim.Trajectory], effort: Effort
) -> list[tuple[ast_sim.Answer, ast_sim.Trajectory]]:
    return [(run.predict(truth, effort=effort, throw=False), truth) for truth in truths]


def _is_outside(answer: ast_sim.Answer) -> bool:
    """Whether the scene is outside the ranges of the training. (A scene may be unlike the calibration scenes, too.)"""
    return len(answer.notes) > _is_unlike(answer)


def _is_unlike(answer: ast_sim.Answer) -> bool:
    return answer.p_value is not None and answer.p_value <= UNUSUAL


def strange(
    name: str, run: ast_sim.Run, truths: Sequence[ast_sim.Trajectory], folder: Path
) -> dict[str, list[Question]]:
    """Questions to the run of a row, by what is strange about them. Twice a short travel may be an ordinary one, so
    those that are farther than any of the training are counted by themselves, too."""
    doubled = [(one.scene, 2 * one.position - one.position[:1]) for one in truths]
    longest = run.scope.travel[1]
    farther = [(scene, motion) for scene, motion in doubled if ast_sim.Motion(motion).travel(scene) > longest]
    kinds = {"twice the travel": doubled, "of these: farther than any scene of the training": farther}
    if truths[0].scene.material is not None:
        kinds["three times the stiffness"] = [(_stiffer(one.scene), one.position) for one in truths]
    if name == "plates":
        return kinds | _changed_plates(truths)
    (other,) = {"snap_hook", "bumper"} - {name}
    strangers = _loaded(assembly.trained(other, folder)[1])[:STRANGE]
    return kinds | {f"{ROWS[other].title} in its place": [(one.scene, one.position) for one in strangers]}


def _stiffer(scene: ast_sim.Scene) -> ast_sim.Scene:
    """Young's modulus is the first column of the material."""
    assert scene.material is not None
    return replace(scene, material=scene.material * np.float32([3, *[1] * (scene.material.shape[1] - 1)]))


def _changed_plates(truths: Sequence[ast_sim.Trajectory]) -> dict[str, list[Question]]:
    quarter = np.float32([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    upside_down = np.float32([[1, 0, 0], [0, -1, 0], [0, 0, -1]])
    kinds: dict[str, list[Question]] = {}
    for truth in truths:
        scene, motion = truth.scene, truth.position
        held = scene.node_type == ast_sim.NodeType.HANDLE
        one_end = held & (scene.rest_position[:, 0] > scene.rest_position[held, 0].mean())
        for kind, question in {
            "turned by 180 degrees: nothing strange": _turned(scene, motion, quarter @ quarter),
            "turned by 90 degrees in its plane": _turned(scene, motion, quarter),
            "pressed from below": _turned(scene, motion, upside_down),
            "pressed sideways": (scene, motion[:1] + (motion - motion[:1])[..., [2, 1, 0]]),
            "held at one end": (_free(scene, one_end), motion),
            "held by nothing": (_free(scene, held), motion),
        }.items():
            kinds.setdefault(kind, []).append(question)
    kinds["a beam in place of a plate"] = [_beam(height) for height in np.linspace(0.06, 0.14, len(truths))]
    return kinds


def _turned(scene: ast_sim.Scene, motion: np.ndarray, turn: np.ndarray) -> Question:
    return replace(scene, rest_position=scene.rest_position @ turn.T), motion @ turn.T


def _free(scene: ast_sim.Scene, nodes: np.ndarray) -> ast_sim.Scene:
    return replace(scene, node_type=np.where(nodes, ast_sim.NodeType.NORMAL, scene.node_type).astype(np.uint8))


def _beam(height: float) -> Question:
    """A beam that is held at one end and pressed at the other, within the ranges of the plates."""
    body = ast_sim.box((0, 0, 0), (0.5, 0.1, height), cells=(13, 3, 3))
    kinds = np.where(body.rest_position[:, 0] == 0, ast_sim.NodeType.HANDLE, body.node_type).astype(np.uint8)
    punch = ast_sim.box((0.4, 0.0, height + 0.01), (0.48, 0.1, height + 0.11), cells=(2, 2, 2))
    rigid = replace(punch, node_type=np.full_like(punch.node_type, ast_sim.NodeType.OBSTACLE))
    scene = ast_sim.Scene.join(replace(body, node_type=kinds), rigid)
    motion = np.repeat(scene.rest_position[None], 2, axis=0)
    motion[1, scene.body == 1] -= np.float32([0, 0, 0.06])
    return scene, motion


def unusual(run: ast_sim.Run, questions: Sequence[Question]) -> dict[str, int]:
    """The number of questions, for the last frame by one call; of them the number outside the ranges of the
    training, the number that the network finds unlike the calibration scenes, the number told by either, and the number
    of answers without a band."""
    answers = [run.predict(*one, frames=[-1], effort=Effort(), throw=False) for one in questions]
    return {
        "questions": len(answers),
        "outside": sum(map(_is_outside, answers)),
        "unlike": sum(map(_is_unlike, answers)),
        "told": sum(bool(one.notes) for one in answers),
        "no_band": sum(not one.bands for one in answers),
    }


def promises(run: ast_sim.Run, truths: Sequence[ast_sim.Trajectory]) -> dict[str, Any]:
    """The errors that each effort of a calibrated run keeps; for wanted ones the effort that is chosen, and in how many
    of the fresh scenes within its ranges it keeps them."""
    assert run.calibration is not None
    kept = run.calibration.kept
    errors = []
    for truth in truths:
        frame = deepest_frame(truth)
        answers = [run.predict(truth, frames=frame, effort=effort, throw=False) for effort in kept.efforts]
        if not answers[0].notes:
            errors.append([dict.fromkeys(WANTED, np.inf) if one.failure else one.errors(truth) for one in answers])
    told = []
    for quantity, levels in WANTED.items():
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
        for quantity in WANTED
    }
    return {
        "efforts": [effort.text for effort in kept.efforts],
        "kept": {quantity: kept.bounds(quantity) for quantity in WANTED},
        "median_error": middle,
        "promises": told,
        "promised_scenes": len(errors),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    study_rows(__doc__, ROWS, arguments, measured, _said, (RESULTS, PAGE), page)


def _said(result: dict[str, Any]) -> str:
    least = min(result["rows"], key=lambda row: _held(row) / row["fresh_scenes"])
    told = "; ".join(
        f"{kind}: {counts['told']} of {counts['questions']} told" for kind, counts in result["told"].items()
    )
    held = f"bands held in {_held(least)} of {least['fresh_scenes']} at least ({least['quantity']}, {least['effort']})"
    return f"{held}; {told}"


def _held(row: dict[str, Any]) -> int:
    return row["levels"][f"{LEVEL:g}"]["held"]


if __name__ == "__main__":
    main()

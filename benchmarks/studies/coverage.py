"""Do bands and asked errors hold? In how many of a hundred fresh plates all free nodes lie within the band, and how
many keep an error that an effort was chosen for.

`python -m benchmarks.studies.coverage` calibrates the run of plates that comes with the package on a hundred plates,
and predicts a hundred others: with one call, with the run's default effort, and with each effort to choose. It writes
benchmarks/results/coverage.json. The scenes lie in `--folder`; a second call goes on with what is there.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import betabinom

import ast_sim
from ast_sim.inference.promises.calibration import LEVEL, score
from ast_sim.simulate.jobs.rival import deepest_frame
from ast_sim.support.disk import write_json
from ast_sim.support.errors import ConfigError
from ast_sim.support.provenance import provenance

RESULTS = Path(__file__).parents[1] / "results" / "coverage.json"
PLATES = {"train": 0, "valid": 0, "test": 100, "nodes": 400, "frames": 41, "keep": (14, 24, 34)}
SEEDS = {"calibration": 911, "fresh": 912}
ASKED = {
    "displacement": (0.1, 0.08, 0.05, 0.025, 0.02, 0.015, 0.01),
    "reaction": (0.5, 0.2, 0.1, 0.05, 0.02),
    "stress": (0.2, 0.1, 0.05, 0.02, 0.01),
}


def measured(run: ast_sim.Run, calibration: Path, fresh: Path) -> dict[str, Any]:
    """The calibration of a run, and how its bands hold in the scenes of another dataset."""
    result = ast_sim.calibrate(run, calibration, "test")
    scores: list[float] = []
    outside = 0
    bands: list[float] = []
    errors: list[float] = []
    with ast_sim.Dataset(fresh) as data:
        truths = [data["test"][index] for index in range(data.count("test"))]
    for truth in truths:
        answer = run.predict(truth, throw=False)
        if answer.band is None:
            outside += 1
            continue
        true_position = truth.position[list(answer.frames)]
        scores.append(score(answer.scene, answer.position, true_position))
        bands.append(float(answer.band.max()))
        error = (answer.position - true_position)[:, ~truth.scene.prescribed]
        errors.append(float(np.linalg.norm(error, axis=2).max()))
    rank = int(np.ceil((result.scenes + 1) * LEVEL - 1e-9))
    low, high = betabinom(len(scores), rank, result.scenes + 1 - rank).interval(0.99)
    return {
        **{key: value for key, value in asdict(result).items() if key != "kept"},
        "fresh_scenes": len(scores),
        "without_band": outside,
        "held": sum(value <= result.quantile for value in scores),
        "held_interval_99": [int(low), int(high)],
        "median_band": float(np.median(bands)),
        "median_largest_error": float(np.median(errors)),
    }


def promises(run: ast_sim.Run, fresh: Path) -> dict[str, Any]:
    """The errors that each effort of a calibrated run keeps; for asked ones the effort that is chosen, and in how many
    of the fresh scenes within its ranges it keeps them."""
    assert run.calibration is not None
    kept = run.calibration.kept
    with ast_sim.Dataset(fresh) as data:
        truths = [data["test"][index] for index in range(data.count("test"))]
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
    files = {
        name: ast_sim.generate("deforming_plate", folder / f"{name}.h5", seed=seed, **PLATES).path
        for name, seed in SEEDS.items()
    }
    run = ast_sim.example_run("plates")
    rows = []
    for effort in (ast_sim.Effort(), run.effort):
        run.effort = effort
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # scenes outside the training are counted
            rows.append(measured(run, files["calibration"], files["fresh"]))
        print(f"{effort.text}: held in {rows[-1]['held']} of {rows[-1]['fresh_scenes']}", flush=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        asked = promises(run, files["fresh"])
    for one in asked["promises"]:
        print(f"{one['quantity']} {one['error']:g}: {one.get('effort', one.get('refused'))}: {one.get('held')}")
    write_json(RESULTS, {**provenance("python -m benchmarks.studies.coverage"), "rows": rows, **asked})


if __name__ == "__main__":
    main()

"""Do bands hold? In how many of a hundred fresh plates all free nodes of all frames lie within the band.

`python -m benchmarks.studies.coverage` calibrates the run of plates that comes with the package on a hundred plates,
and predicts a hundred others, with one call and with the run's default effort. It writes
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
from ast_sim.support.disk import write_json
from ast_sim.support.provenance import provenance

RESULTS = Path(__file__).parents[1] / "results" / "coverage.json"
PLATES = {"train": 0, "valid": 0, "test": 100, "nodes": 400, "frames": 41, "keep": (14, 24, 34)}
SEEDS = {"calibration": 911, "fresh": 912}


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
        **asdict(result),
        "fresh_scenes": len(scores),
        "without_band": outside,
        "held": sum(value <= result.quantile for value in scores),
        "held_interval_99": [int(low), int(high)],
        "median_band": float(np.median(bands)),
        "median_largest_error": float(np.median(errors)),
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
    write_json(RESULTS, {**provenance("python -m benchmarks.studies.coverage"), "rows": rows})


if __name__ == "__main__":
    main()

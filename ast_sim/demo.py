"""The demonstration: everything from nothing to a report, in one folder.

Plates that an obstacle presses are simulated, a small model learns from them, and predicts plates that it has not
seen. Run again in the same folder it goes on where it stopped; other settings are refused by the part that differs.
"""

from __future__ import annotations

import shlex
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ast_sim.monitor import duration
from ast_sim.results import TrainedRun, evaluate_run, open_run, report_run, write_json, write_report
from ast_sim.simulate.generate import generate
from ast_sim.train import configure, train
from ast_sim.view import export, picture

FAMILY = "deforming_plate"
NODES, FRAMES = 400, 41  # coarser and shorter than the family's default, so that all is done in minutes


@dataclass(frozen=True)
class Size:
    """How much is done: scenes of each split and training steps."""

    train: int
    valid: int
    test: int
    steps: int


FULL = Size(train=100, valid=8, test=10, steps=8000)  # at most 10 minutes on 2 cores
QUICK = Size(train=16, valid=2, test=3, steps=500)  # at most 90 seconds


def demo(out: Path, quick: bool = False, seed: int = 0) -> dict[str, Any]:
    """Generate, train, evaluate and report in the folder `out`; the numbers follow from `quick` and `seed` alone.

    Returns:
        The evaluation, as in `evaluation.json`.

    Raises:
        AstSimError: `out` holds parts made with other settings, or a part fails.
    """
    started = time.perf_counter()
    size = QUICK if quick else FULL
    data, run_folder = out / "data.h5", out / "run"

    _announce(1, f"simulating {size.train + size.valid + size.test} plates with the contact FEM")
    counts = {"train": size.train, "valid": size.valid, "test": size.test}
    generate(FAMILY, data, counts, seed=seed, nodes=NODES, frames=FRAMES)

    _announce(2, "training")
    # Plates know no left and right, and none is turned over.
    settings = [f"train.steps={size.steps}", f"train.seed={seed}", "train.mirror=x,y"]
    train(run_folder, configure(data, "tiny", settings), resume=True)

    with open_run(run_folder, data) as run:
        _announce(3, f"predicting the {size.test} test scenes, which the model has not seen")
        found = evaluate_run(run, "test", _command(out, quick, seed))
        write_json(out / "evaluation.json", found)
        _announce(4, "writing the report")
        _write_pages(run, out, found)

    for line in headlines(found):
        print(line)
    print(f"report      {out / 'report.html'}")
    print(f"picture     {out / 'picture.png'}")
    print(f"prediction  {out / 'prediction.pvd'} (for ParaView)")
    print(f"figures     {out / 'evaluation.json'}")
    print(f"run         {run_folder}")
    print(f"in all {duration(time.perf_counter() - started)}", flush=True)
    return found


def _command(out: Path, quick: bool, seed: int) -> str:
    return shlex.join(["ast-sim", "demo", "--out", str(out), *(["--quick"] if quick else []), "--seed", str(seed)])


def _announce(number: int, text: str) -> None:
    print(f"{number}/4 {text}", flush=True)


def _write_pages(run: TrainedRun, out: Path, found: dict[str, Any]) -> None:
    """The report of all test scenes; the median one also as a picture and for ParaView."""
    info = run.dataset.info
    shown = report_run(run, found)
    write_report(out / "report.html", [shown], "Deforming plates: predictions by AST")
    median = shown.scenes[(len(shown.scenes) - 1) // 2]
    picture.write(out / "picture.png", median.truth, median.prediction, info.length_unit)
    export.write(out / "prediction.pvd", median.truth, median.prediction, time_step=info.time_step or 1.0)


def headlines(found: dict[str, Any]) -> list[str]:
    """The figures that matter, in plain words."""
    lines = []
    for quantity, nodes, unit, trivial, words in (
        ("displacement", "normal", found["length_unit"], "hold_still", "that of holding still"),
        ("stress", "deforming", found["stress_unit"], "stress_frame_mean", "that of each frame's true mean"),
    ):
        errors = {
            name: found["summary"].get(name, {}).get(quantity, {}).get("rollout_all", {}).get(nodes, {})
            for name in ("model", trivial)
        }
        model, reference = (errors[name].get("rmse_sequence") for name in ("model", trivial))
        if model is not None and reference:
            lines.append(
                f"{quantity} error over whole rollouts: {model:.3g} {unit}, {100 * model / reference:.0f} % of {words}"
            )
    if found["failures"]:
        lines.append(f"{found['failures']} of {len(found['samples'])} rollouts failed")
    if found["speedup"] is not None:
        lines.append(f"speed: {found['speedup']:.3g} times as fast as the solver on the same scenes")
    return lines

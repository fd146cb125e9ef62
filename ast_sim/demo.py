"""The demonstration: from simulations to a report, in one folder.

First the run that comes with the package answers a plate, at once. Then the demonstration makes such a run: it
simulates plates that an obstacle presses, trains a small model on them, and predicts plates that the model has not
seen. A second run in the same folder goes on where the first one stopped; if its settings differ, it stops with an
error.
"""

from __future__ import annotations

import shlex
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ast_sim.dataset.reader import Dataset
from ast_sim.figures import Figures
from ast_sim.inference.effort import Effort
from ast_sim.inference.evaluation import deepest_frames
from ast_sim.inference.evaluation.evaluated_run import Evaluation
from ast_sim.inference.example_run import example_run
from ast_sim.number_arrays import percent
from ast_sim.simulate.jobs.generate import generate
from ast_sim.support.progress import duration
from ast_sim.training.start import train
from ast_sim.view import export, picture, report

FAMILY = "deforming_plate"
NODES, FRAMES = 400, 41  # fewer than the family's defaults, so that the demonstration takes minutes
KEPT = (14, 24, 34)  # of a training scene: many scenes of few frames teach more than few scenes of all frames


@dataclass(frozen=True)
class Size:
    """The size of the demonstration: the scenes of each split and the training steps."""

    train: int
    valid: int
    test: int
    steps: int


FULL = Size(train=1300, valid=8, test=10, steps=4000)  # about 15 minutes on 2 cores
QUICK = Size(train=200, valid=4, test=3, steps=250)  # 1.5 to 2.5 minutes


def demo(out: Path, quick: bool = False, seed: int = 0) -> Figures:
    """Generate, train, evaluate and report in the folder `out`. The results depend only on `quick` and `seed`.

    Returns:
        The figures of the evaluation, as in `evaluation.json`.

    Raises:
        AstSimError: `out` holds files made with other settings, or a part of the demonstration fails.
    """
    started = time.perf_counter()
    size = QUICK if quick else FULL
    data, unseen, run_folder = out / "data.h5", out / "unseen.h5", out / "run"
    plates: dict[str, Any] = {"seed": seed, "nodes": NODES, "frames": FRAMES}

    _announce(0, "a new plate, answered by the run that comes with the package")
    _show_first(out, plates)

    _announce(1, f"simulating {size.train + size.valid} plates in {len(KEPT)} frames, {size.test} in all frames")
    generate(FAMILY, data, train=size.train, valid=size.valid, test=0, keep=KEPT, **plates)
    generate(FAMILY, unseen, train=0, valid=0, test=size.test, **plates)

    _announce(2, "training")
    # A plate mirrored along x or y is as likely as the plate itself; a plate that is turned over (z) never occurs.
    run = train(data, run_folder, steps=size.steps, seed=seed, mirror=("x", "y"), resume=True)

    _announce(3, f"predicting the {size.test} plates that the model has not seen")
    command = shlex.join(["ast-sim", "demo", "--out", str(out), *(["--quick"] if quick else []), "--seed", str(seed)])
    evaluation = run.evaluate(unseen, command=command)
    evaluation.save(out / "evaluation.json")
    _announce(4, "writing the report")
    _write_pages(evaluation, out)

    for line in headlines(evaluation.figures):
        print(line)
    print(f"report      {out / 'report.html'}")
    print(f"picture     {out / 'picture.png'}")
    print(f"prediction  {out / 'prediction.pvd'} (for ParaView)")
    print(f"figures     {out / 'evaluation.json'}")
    print(f"run         {run_folder}")
    print(f"in all {duration(time.perf_counter() - started)}", flush=True)
    return evaluation.figures


def _show_first(out: Path, plates: dict[str, Any]) -> None:
    """Predict a plate that no run has seen, by the run that was trained before, and draw it beside the simulation."""
    kept = KEPT[-1:]
    data = generate(FAMILY, out / "first.h5", train=0, valid=0, test=1, keep=kept, progress=False, **plates)
    run = example_run("plates")
    with Dataset(data.path) as dataset:
        truth = dataset["test"][0]
    deepest = [truth.num_frames - 1]
    run.predict(truth, frames=deepest)  # the first answer takes longer; it does not count
    network = run.predict(truth, frames=deepest, effort=Effort())
    answer = run.predict(truth, frames=deepest)
    picture.write(out / "first.png", truth, answer.trajectory, run.settings.model.name, run.info.length_unit)
    errors = [percent(one.errors(truth)["displacement"]) for one in (network, answer)]
    print(
        f"  error {errors[0]} of the displacement by one call of the model in {1000 * network.seconds:.0f} ms,"
        f" {errors[1]} with Newton steps in {1000 * answer.seconds:.0f} ms: {out / 'first.png'}"
    )


def _announce(number: int, text: str) -> None:
    print(f"{number}/4 {text}", flush=True)


def _write_pages(evaluation: Evaluation, out: Path) -> None:
    """Write the report of all test scenes, and the median scene as a picture and for ParaView."""
    info = evaluation.run.info
    shown = evaluation.shown()
    report.write(out / "report.html", [shown], "Deforming plates: predictions by AST")
    median = shown.scenes[(len(shown.scenes) - 1) // 2]
    picture.write(out / "picture.png", median.truth, median.prediction, shown.model, info.length_unit)
    export.write(out / "prediction.pvd", median.truth, median.prediction)


def headlines(figures: Figures) -> list[str]:
    """The most important figures as sentences."""
    lines = []
    for quantity, trivial, words in (
        ("displacement", "hold_still", "the error of holding still"),
        ("stress", "stress_frame_mean", "the error of each frame's true mean"),
    ):
        model, reference = (figures.error(quantity, name) for name in ("model", trivial))
        if model and reference and model.rmse_sequence is not None and reference.rmse_sequence:
            error = model.rmse_sequence
            unit = figures.unit(quantity)
            share = 100 * error / reference.rmse_sequence
            lines.append(f"{quantity} error over whole rollouts: {error:.3g} {unit}, {share:.0f} % of {words}")
    if figures.failures:
        lines.append(f"{figures.failures} of {len(figures.scenes)} rollouts failed")
    return lines + deepest_frames.lines(figures.deepest)

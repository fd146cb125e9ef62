"""What a trained run yields on a dataset: an evaluation with its provenance, prediction files, the report."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ast_sim.data.disk import replacing
from ast_sim.data.file import Dataset, DatasetWriter
from ast_sim.data.scene import Trajectory
from ast_sim.errors import AstSimError, ConfigError
from ast_sim.evaluate import evaluate, provenance
from ast_sim.model.simulator import Simulator
from ast_sim.monitor import Progress
from ast_sim.rollout import Rollout, rollouts
from ast_sim.run import Metrics, RunConfig, load_model
from ast_sim.view import export, report
from ast_sim.view.files import make_folder

SUFFIXES = (".h5", ".pvd", ".vtkhdf")


@dataclasses.dataclass(frozen=True, eq=False)
class TrainedRun:
    """The best model of a run together with a dataset that fits it."""

    path: Path
    settings: RunConfig
    step: int
    model: Simulator
    dataset: Dataset


@contextmanager
def open_run(run: Path, data: Path | None = None) -> Iterator[TrainedRun]:
    """Open a run and a dataset; the one that the run was trained on if `data` is None.

    Raises:
        CheckpointError: no run, or no checkpoint. DatasetError: no dataset. ConfigError: it is of another kind.
    """
    model, settings, step = load_model(Path(run))
    with Dataset(data or settings.data) as dataset:
        for key, ours, theirs in (
            ("integration", settings.model.integration, dataset.info.integration),
            ("stress_location", settings.model.stress, dataset.info.stress_location),
            ("material columns", settings.model.material_width, dataset.material_width),
        ):
            if ours != theirs:
                raise ConfigError(f"{dataset.path} has {key} {theirs}, but {run} was trained with {key} {ours}")
        yield TrainedRun(Path(run), settings, step, model, dataset)


def evaluate_run(run: TrainedRun, split: str, command: str) -> dict[str, Any]:
    """What `ast-sim evaluate --json` writes: `evaluate` with its provenance; shows a bar on a terminal."""
    with Progress(run.dataset.count(split), 0, "scenes") as bar:
        result = evaluate(run.model, run.dataset, split, lambda name: bar.advance())
    return {
        **provenance(command),
        "run": str(run.path),
        "step": run.step,
        "data": str(run.dataset.path),
        "split": split,
        **result,
    }


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write a JSON file whole or not at all."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(values, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise AstSimError(f"{path} cannot be written: {error.strerror or error}; nothing was left there") from error


def predict(run: TrainedRun, split: str, index: int) -> tuple[Trajectory, Rollout]:
    """Roll out one trajectory of the dataset; a rollout that fails keeps its frames and says so in `failure`."""
    truth = run.dataset.load(split, index)
    return truth, rollouts(run.model, [truth], [f"{split}/{index:06d}"])[0]


def predicted_trajectory(run: TrainedRun, truth: Trajectory, result: Rollout, name: str) -> Trajectory:
    """A rollout as a trajectory, whose attributes tell where it is from."""
    attributes = {
        "status": "complete" if result.failure is None else "truncated",
        "predicted_by": str(run.path),
        "step": run.step,
        "source": f"{run.dataset.path}: {name}",
        "given_frames": result.given,
        "model_seconds": list(result.seconds),
    }
    return Trajectory(truth.scene, result.position, result.stress, attributes)


def write_prediction(run: TrainedRun, truth: Trajectory, result: Rollout, name: str, out: Path) -> None:
    """Write a prediction: a dataset file (.h5), or with its errors for ParaView (.pvd, .vtkhdf).

    Raises:
        AstSimError: another suffix, or the file cannot be written.
    """
    if out.suffix not in SUFFIXES:
        raise AstSimError(f"{out}: a prediction is written as {', '.join(SUFFIXES)}: name it so")
    prediction = predicted_trajectory(run, truth, result, name)
    info = run.dataset.info
    if out.suffix == ".h5":
        with DatasetWriter(out, dataclasses.replace(info, generator={"program": "ast_sim rollout"})) as writer:
            writer.add("test", prediction)
    else:
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise AstSimError(f"{out} cannot be written: {error.strerror or error}") from error
        export.write(out, truth, prediction, time_step=info.time_step or 1.0)


def report_run(run: TrainedRun, evaluation: dict[str, Any]) -> report.ReportRun:
    """One run as the report shows it: the best, the median and the worst scene of an evaluation, curves and facts."""
    errors = {
        sample["name"]: _or_infinity(sample["displacement"]["model"]["rollout_all"]["normal"])
        for sample in evaluation["samples"]
    }
    scenes = []
    for label, name in report.representative(errors):
        split, _, index = name.partition("/")
        truth, result = predict(run, split, int(index))
        scenes.append(report.ReportScene(name, label, truth, predicted_trajectory(run, truth, result, name)))
    return report.ReportRun(
        name=run.path.resolve().name,
        scenes=scenes,
        evaluation=evaluation,
        metrics=list(Metrics(run.path)),
        facts=_facts(run),
    )


def _or_infinity(error: float | None) -> float:
    return float("inf") if error is None else error


def _facts(run: TrainedRun) -> dict[str, str]:
    training, model, info = run.settings.train, run.settings.model, run.dataset.info
    scenes = training.batch_size * training.accumulate
    facts = {
        "Model": f"{type(run.model).__name__}, {sum(p.numel() for p in run.model.parameters()):,} parameters",
        **model.facts(info.length_unit),
        "Training": f"{training.steps:,} steps of {scenes} scenes, seed {training.seed}",
        "Noise": f"{training.noise:.3g} {info.length_unit}",
        "Checkpoint": f"step {run.step:,}, the best of the validations by rollout",
        "Family": info.family,
        "Scenes": ", ".join(f"{count} {split}" for split, count in run.dataset.splits.items()),
    }
    facts |= {f"Generator {key}": str(value) for key, value in info.generator.items() if not isinstance(value, dict)}
    return facts


def write_report(path: Path, runs: Sequence[report.ReportRun], title: str) -> None:
    """Write the page; its folder is made if it is not there."""
    make_folder(path.parent)
    report.write(path, runs, title)

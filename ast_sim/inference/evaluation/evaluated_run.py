"""What an evaluation of a run found, and the page that shows it."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ast_sim.dataset.reader import Dataset
from ast_sim.figures import Figures
from ast_sim.inference.answering import answers
from ast_sim.inference.evaluation.evaluate import table
from ast_sim.inference.predicting.question import Question
from ast_sim.support.argument_checks import file_name
from ast_sim.support.disk import write_json
from ast_sim.support.errors import ConfigError
from ast_sim.support.notebook_table import html_bars, html_table, one_line
from ast_sim.view import report
from ast_sim.view.files import make_folder
from ast_sim.view.page import page_name

if TYPE_CHECKING:
    from ast_sim.inference.trained_run import Run


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The predictions of a run for the scenes of a split, and their errors. `str` gives a table of the errors.

    Attributes:
        run: the run.
        data: the path of the dataset.
        figures: errors, times and their origin, as `save` writes them.
    """

    run: Run
    data: Path
    figures: Figures

    def __str__(self) -> str:
        return table(self.figures)

    def _headline(self) -> dict[str, str]:
        facts = {"run": self.run.path.name, "data": self.data.name, "scenes": f"{len(self.figures.scenes):,}"}
        for quantity in ("displacement", "stress"):
            error = self.figures.error(quantity)
            if error is not None:
                size = error.rmse_sequence
                shown = "failed" if size is None else f"{size:.4g} {self.figures.unit(quantity)}"
                facts[f"{quantity} error"] = shown
        return facts

    def __repr__(self) -> str:
        return one_line("Evaluation", self._headline())

    def _repr_html_(self) -> str:
        errors = sorted(error for scene in self.figures.scenes if (error := scene.error("displacement")) is not None)
        bars = html_bars(errors, "displacement error by scene")
        return html_table("Evaluation", self._headline(), f"{bars}<pre>{escape(str(self))}</pre>")

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all figures as JSON."""
        write_json(file_name(path, "path"), self.figures.to_json())

    def report(self, path: str | os.PathLike[str]) -> None:
        """Write a page with moving scenes, errors, times and settings."""
        report_evaluations(path, [self])

    def content(self) -> tuple[str, str]:
        """What the dataset holds, as a hash, and the split."""
        with self.run.open(self.data) as dataset:
            return dataset.fingerprint(), self.figures.origin["split"]

    def shown(self) -> report.ReportRun:
        """The content of the page: the best, the median and the worst scene, the curves of the training, facts."""
        errors = {}
        for scene in self.figures.scenes:
            error = scene.error("displacement")
            errors[scene.name] = math.inf if error is None else error
        with self.run.open(self.data) as dataset:
            scenes = [self._scene(dataset, label, name) for label, name in report.representative(errors)]
            metrics = list(self.run.folder.metrics)
            facts = self._facts(dataset, metrics)
        return report.ReportRun(
            name=self.run.path.resolve().name,
            model=self.run.settings.model.name,
            scenes=scenes,
            evaluation=self.figures,
            metrics=metrics,
            facts=facts,
        )

    def _scene(self, dataset: Dataset, label: str, name: str) -> report.ReportScene:
        """A scene to show, predicted once more: only few of many are shown."""
        split, _, index = name.partition("/")
        truth = dataset.load(split, int(index))
        (answer,) = answers(self.run.model, [Question.of(truth, name)], self.run.effort)
        return report.ReportScene(name, label, truth, dataclasses.replace(answer, info=self.run.info).trajectory)

    def _facts(self, dataset: Dataset, metrics: Sequence[dict[str, Any]]) -> dict[str, str]:
        run = self.run
        info = dataset.info
        training = run.settings.train
        model = run.settings.model
        facts = {
            "Model": f"{type(run.model).__name__}, {run.model.num_parameters:,} parameters",
            **model.facts(info.length_unit),
            "Training": f"{training.steps:,} steps of {training.batch_size * training.accumulate} scenes,"
            f" seed {training.seed}",
            "Noise": f"{training.noise:.3g} {info.length_unit}",
            "Checkpoint": f"step {run.step:,}, {_choice(metrics)}",
            "Family": info.family,
            "Scenes": ", ".join(f"{count} {split}" for split, count in dataset.splits.items()),
        }
        plain = {key: value for key, value in info.generator.items() if not isinstance(value, dict)}
        return facts | {f"Generator {key}": str(value) for key, value in plain.items()}


def report_evaluations(path: str | os.PathLike[str], evaluations: list[Evaluation]) -> None:
    """Write one page that shows several runs side by side; a missing folder is made.

    Raises:
        ConfigError: the runs were evaluated on different scenes, which have the same names.
    """
    _require_one_dataset(evaluations)
    make_folder(page_name(path).parent)
    report.write(path, [evaluation.shown() for evaluation in evaluations], "Learned simulation: predictions and errors")


def _require_one_dataset(evaluations: Sequence[Evaluation]) -> None:
    if len(evaluations) == 1:
        return
    first, *others = evaluations
    known = first.content()
    for one in others:
        if one.content() != known:
            raise ConfigError(
                f"{one.run.path} was evaluated on other scenes ({one.data.name}) than {first.run.path}"
                f" ({first.data.name}), or in another unit: a page compares runs on one dataset, data=FILE"
                " (--data FILE)"
            )


def _choice(metrics: Sequence[dict[str, Any]]) -> str:
    """How the checkpoint was chosen. A failed validation has the error None."""
    errors = [record["valid_rmse"] for record in metrics if "valid_rmse" in record]
    if not errors:
        return "the last, none was validated"
    return "the last, every validation failed" if set(errors) == {None} else "the best of the validations by rollout"

"""A trained run: its predictions and their evaluation."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim.dataset.layout import DatasetInfo
from ast_sim.dataset.reader import Dataset
from ast_sim.inference.answer import Answer
from ast_sim.inference.assembly_questions import ask
from ast_sim.inference.effort import Effort
from ast_sim.inference.evaluation import evaluate, table
from ast_sim.inference.predict import Motions, in_domain, new_question
from ast_sim.inference.question import Question
from ast_sim.inference.sweep import Sweep, sweep
from ast_sim.runs.config_toml import read_scope
from ast_sim.runs.folder import load_model, require_fit
from ast_sim.runs.metrics import Metrics
from ast_sim.scene import Scene, Trajectory
from ast_sim.simulate.own_assembly.grid import grid, read_table
from ast_sim.support.disk import write_json
from ast_sim.support.errors import ConfigError
from ast_sim.support.progress import Progress
from ast_sim.support.provenance import provenance
from ast_sim.view import report
from ast_sim.view.files import make_folder


class Run:
    """A trained run, with the model of its best checkpoint (the last one if none was validated).

    Attributes:
        path: the run folder.
        model: the trained model, an `nn.Module`.
        settings: the settings of the model and of the training.
        step: the step of the checkpoint.
        effort: how many corrections and Newton steps follow the first call by default, as validation has decided; 0
            for a model that predicts step by step.
        scope: the ranges of sizes, materials and motions in the training scenes.

    Raises:
        CheckpointError: the folder holds no run, or no checkpoint in it can be read.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.model, self.settings, self.step = load_model(self.path)
        chosen, unset = Metrics(self.path).validation(self.step) or {}, (self.settings.train.calls or 1) - 1
        self.effort = Effort(chosen.get("corrections", unset), chosen.get("newton_steps", 0))
        self._errors = chosen.get("valid_by_effort", [])
        self.scope = read_scope(self.path)

    @property
    def info(self) -> DatasetInfo:
        """The units and the kind of the predictions."""
        model, scope = self.settings.model, self.scope
        return DatasetInfo(
            family=scope.family,
            integration=model.integration,
            stress_location=model.stress,
            domain_center=model.domain_center,
            domain_half_width=model.domain_half_width,
            contact_radius=model.contact_radius,
            time_step=scope.time_step,
            length_unit=scope.length_unit,
            generator={"program": "ast_sim predict"},
        )

    def predict(
        self,
        scene: Scene | Trajectory | None = None,
        motion: Motions | None = None,
        *,
        spec: str | os.PathLike[str] | None = None,
        nodes: int | None = None,
        frames: Sequence[int] | None = None,
        corrections: int | None = None,
        newton_steps: int | None = None,
        num_frames: int | None = None,
        stress: np.ndarray | None = None,
        name: str = "scene",
        **parameters: Any,
    ) -> Answer:
        """Predict a scene. Its true trajectory need not be known.

        The scene may lie anywhere: if it leaves the model's domain, it is moved to the middle of the domain, predicted
        and moved back. A property outside its range in the training scenes gives a warning.

        Args:
            scene: a scene, with lengths in the run's unit. Or a `Trajectory`: its prescribed nodes give the motion, its
                first frames the start. Then it takes no other argument, gives no warning and is not moved.
            motion: the motion of the prescribed nodes: rigid motions by the number of the body, such as
                {1: (0, 0, -0.01)}; or positions [S, N, 3] of all nodes or [S, P, 3] of the prescribed ones; or a
                `Motion`.
            spec, nodes, parameters: instead of a scene and a motion, the specification of an assembly, about how many
                nodes (None: by its sizes), and values of its parameters: spec="SPEC.toml", travel=4.2,
                young={"bumper": 1.5e6}. Others are in the middle of their ranges.
            frames: the numbers of the frames that are wanted, such as [-1] for the last one; by default all. A model
                that jumps computes no other frame. With friction ask for [-2, -1]: a body may be in equilibrium in two
                places, and the frame before says in which.
            corrections: how many calls correct the first call of a model that jumps; by default as in `self.effort`.
            newton_steps: at most so many Newton steps of the solver follow, until one is small (`Answer.last_steps`);
                by default as in `self.effort`, and 0 if `corrections` is given. They need tetrahedra and their
                material. The stress then follows from the material.
            num_frames: S, only for rigid motions; by default so many that the prescribed nodes move as far in one frame
                as in training.
            stress: [given, N or E, 1], the stress of the given frames in pascal; by default zero. One frame is given,
                two where there is inertia.
            name: name of the scene, for messages.

        Raises:
            ConfigError: the motion does not fit the scene, the scene does not fit the run, or a specification has a
                mistake.
            RolloutError: there is no such frame.
        """
        facts: dict[str, Any] = {}
        if spec is not None:
            if not (scene is None and motion is None and stress is None):
                raise ConfigError("a specification gives the scene and the motion: leave scene, motion and stress out")
            (asked,) = ask(spec, [parameters], self.scope, num_frames, nodes)
            scene, motion, num_frames, facts = asked.scene, asked.motion, None, asked.facts
        elif parameters or nodes is not None or scene is None:
            unknown = next(iter(parameters), "nodes")
            raise ConfigError("give a scene" if scene is None else f"{unknown} belongs to a specification: give spec")
        question = new_question(self.settings.model, self.scope, scene, motion, num_frames, name, frames, stress)
        return self._answers([question], corrections, newton_steps, facts)[0]

    def sweep(
        self,
        spec: str | os.PathLike[str],
        *,
        table: str | os.PathLike[str] | Sequence[Mapping[str, Any]] | None = None,
        corrections: int | None = None,
        newton_steps: int | None = None,
        nodes: int | None = None,
        **parameters: Any,
    ) -> Sweep:
        """Predict the last frame of an assembly for many values of its parameters, in batches.

        Args:
            spec: the specification of the assembly.
            table: a CSV file whose first line names parameters, or a list of mappings from names to values.
            corrections, newton_steps, nodes: as for `predict`.
            parameters: instead of a table, values of the parameters: one, or a list. The sweep takes every combination.

        Raises:
            ConfigError: as for `predict`; or values and a table are both given.
            SimulationError: a scene cannot be made.
        """
        if table is not None and parameters:
            raise ConfigError("a table has the values of all parameters: leave the others out, or leave the table out")
        rows = table if table is not None else grid(parameters)
        rows = rows if isinstance(rows, Sequence) and not isinstance(rows, str) else read_table(rows)
        effort = self._effort(corrections, newton_steps)
        return sweep(self.predict_scenes, self.settings.model, self.scope, spec, rows, effort, nodes)

    def predict_scenes(
        self,
        asked: Sequence[tuple[Scene, Motions]],
        names: Sequence[str],
        frames: Sequence[int] | None = None,
        corrections: int | None = None,
        newton_steps: int | None = None,
        num_frames: int | None = None,
    ) -> list[Answer]:
        """Predict several scenes, each under a motion, as one batch; arguments and errors are those of `predict`."""
        config, scope, named = self.settings.model, self.scope, zip(asked, names, strict=True)
        questions = [new_question(config, scope, *pair, num_frames, name, frames) for pair, name in named]
        return self._answers(questions, corrections, newton_steps)

    def predict_motions(
        self,
        scene: Scene,
        motions: Sequence[Motions],
        *,
        frames: Sequence[int] | None = None,
        corrections: int | None = None,
        newton_steps: int | None = None,
        num_frames: int | None = None,
        name: str = "scene",
    ) -> list[Answer]:
        """Predict one scene under several motions, as one batch; the answers have the order of the motions.

        Arguments and errors are those of `predict`.
        """
        names = [f"{name}, motion {number}" for number in range(len(motions))]
        asked = [(scene, motion) for motion in motions]
        return self.predict_scenes(asked, names, frames, corrections, newton_steps, num_frames)

    def _answers(
        self, questions: list[Question], corrections: int | None, newton_steps: int | None, facts: Mapping = {}
    ) -> list[Answer]:
        """The answers with their units, their origin, to which `facts` belong, and the error that is to be expected."""
        effort = self._effort(corrections, newton_steps)
        known = self._errors[effort.corrections] if effort.corrections < len(self._errors) else [None]
        expected = known[min(effort.newton_steps, len(known) - 1)]
        origin = {"predicted_by": str(self.path), "step": self.step, **facts}
        if expected is not None:
            origin["expected_error"] = expected
        shared, answers = {"info": self.info, "expected_error": expected}, in_domain(self.model, questions, effort)
        return [dataclasses.replace(answer, source={**origin, "source": answer.name}, **shared) for answer in answers]

    def _effort(self, corrections: int | None, newton_steps: int | None) -> Effort:
        """What is asked for; where nothing is, the default."""
        if corrections is None:
            return self.effort if newton_steps is None else Effort(self.effort.corrections, newton_steps)
        return Effort(corrections, newton_steps or 0)

    def open(self, data: str | os.PathLike[str] | None = None) -> Dataset:
        """Open a dataset, by default the training data, with lengths in the run's unit. The caller closes it.

        Raises:
            DatasetError: the dataset cannot be read.
            ConfigError: its integration, stress location, material columns or elements differ from those of the
                training data.
        """
        dataset = Dataset(data or self.settings.data, self.scope.length_unit)
        try:
            require_fit(self.path, self.settings.model, self.scope, dataset)
        except BaseException:
            dataset.close()
            raise
        return dataset

    def evaluate(
        self,
        data: str | os.PathLike[str] | None = None,
        split: str = "test",
        command: str = "Run.evaluate",
        rival_scenes: int = 0,
        made_from: str | os.PathLike[str] | None = None,
    ) -> Evaluation:
        """Predict all scenes of a split and measure the errors; on a terminal a bar shows the progress.

        Args:
            data: a dataset; by default the one that the run was trained on.
            command: the command that is recorded beside the figures.
            rival_scenes: in so many scenes the solver solves the deepest frame, in several ways, to compare.
            made_from: the specification or the parts of your own of which the dataset was made; the solver needs them.
        """
        with self.open(data) as dataset:
            with Progress(dataset.count(split) + rival_scenes, 0, "scenes") as bar:
                figures, answers = evaluate(
                    self.model, dataset, split, lambda name: bar.advance(), self.effort, rival_scenes, made_from
                )
            answers = [dataclasses.replace(answer, info=self.info) for answer in answers]
            origin = {"run": str(self.path), "step": self.step, "data": str(dataset.path), "split": split}
            return Evaluation(self, dataset.path, {**provenance(command), **origin, **figures}, answers)

    def report(self, path: str | os.PathLike[str], data: str | os.PathLike[str] | None = None) -> None:
        """Evaluate on the test split and write a page with the results."""
        self.evaluate(data).report(path)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The predictions of a run for the scenes of a split, and their errors. `str` gives a table of the errors.

    Attributes:
        run: the run.
        data: the path of the dataset.
        figures: errors, times and their origin, as `save` writes them; see `ast_sim.inference.evaluation.evaluate`.
        answers: the prediction of each scene.
    """

    run: Run
    data: Path
    figures: dict[str, Any]
    answers: list[Answer]

    def __str__(self) -> str:
        return table(self.figures)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all figures as JSON."""
        write_json(Path(path), self.figures)

    def report(self, path: str | os.PathLike[str], title: str = "Learned simulation: predictions and errors") -> None:
        """Write a page with moving scenes, errors, times and settings."""
        report_evaluations(path, [self], title)

    def shown(self) -> report.ReportRun:
        """The content of the page: the best, the median and the worst scene, the curves of the training, facts."""
        errors = {}
        for sample in self.figures["samples"]:
            error = sample["displacement"]["model"]["rollout_all"]["normal"]
            errors[sample["name"]] = math.inf if error is None else error
        answers = {answer.name: answer for answer in self.answers}
        with self.run.open(self.data) as dataset:
            scenes = [
                report.ReportScene(name, label, _truth(dataset, name), answers[name].trajectory)
                for label, name in report.representative(errors)
            ]
            metrics = list(Metrics(self.run.path))
            facts = self._facts(dataset, metrics)
        return report.ReportRun(
            name=self.run.path.resolve().name,
            model=self.run.settings.model.name,
            scenes=scenes,
            evaluation=self.figures,
            metrics=metrics,
            facts=facts,
        )

    def _facts(self, dataset: Dataset, metrics: Sequence[dict[str, Any]]) -> dict[str, str]:
        run, info = self.run, dataset.info
        training, model = run.settings.train, run.settings.model
        facts = {
            "Model": f"{type(run.model).__name__}, {sum(p.numel() for p in run.model.parameters()):,} parameters",
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


def report_evaluations(path: str | os.PathLike[str], evaluations: list[Evaluation], title: str) -> None:
    """Write one page that shows several runs side by side; a missing folder is made."""
    make_folder(Path(path).parent)
    report.write(path, [evaluation.shown() for evaluation in evaluations], title)


def _truth(dataset: Dataset, name: str) -> Trajectory:
    split, _, index = name.partition("/")
    return dataset.load(split, int(index))


def _choice(metrics: Sequence[dict[str, Any]]) -> str:
    """How the checkpoint was chosen. A failed validation has the error None."""
    errors = [record["valid_rmse"] for record in metrics if "valid_rmse" in record]
    if not errors:
        return "the last, none was validated"
    return "the last, every validation failed" if set(errors) == {None} else "the best of the validations by rollout"

"""A trained run: its predictions and their evaluation."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ast_sim.dataset.layout import DatasetInfo
from ast_sim.dataset.reader import Dataset
from ast_sim.importers.scene_mesh import SceneMesh
from ast_sim.inference.answer import Answer
from ast_sim.inference.answering import answers, doubts
from ast_sim.inference.assembly_questions import one_question
from ast_sim.inference.effort import DefaultEffort, Effort, error_with
from ast_sim.inference.evaluation import SOLVER_SCENES
from ast_sim.inference.evaluation.evaluate import evaluate
from ast_sim.inference.evaluation.evaluated_run import Evaluation
from ast_sim.inference.predict_arguments import Motions, new_question, scenes_of
from ast_sim.inference.predicting.question import Question, WantedFrames
from ast_sim.inference.promises.chosen_effort import ErrorLimit, chosen_effort
from ast_sim.inference.promises.known_answers import known_answers
from ast_sim.inference.promises.known_weights import KnownWeights, forget_other_weights
from ast_sim.inference.sweep import Sweep, sweep
from ast_sim.number_arrays import percent
from ast_sim.runs import run_file
from ast_sim.scene import Scene, Trajectory
from ast_sim.simulate.own_assembly.grid import rows_of
from ast_sim.support.argument_checks import file_name, require_bool, require_type, several
from ast_sim.support.errors import ConfigError, RolloutError, warn
from ast_sim.support.notebook_table import html_bars, html_table, one_line
from ast_sim.support.progress import Progress, ShowProgress
from ast_sim.support.provenance import provenance
from ast_sim.support.toml_settings import NOTHING, required_whole


class Run:
    """A trained run, with the model of its best checkpoint (the last one if none was validated).

    Args:
        path: the run folder, or a file that `save` wrote.

    Attributes:
        path: the run folder or the file.
        model: the trained model, an `nn.Module`.
        settings: the settings of the model and of the training.
        step: the step of the checkpoint.
        folder: the files of the run.
        effort: what follows the first call by default, as validation has decided; none in predictions step by step.
        calibration: how far its answers are from the truth, as `ast_sim.calibrate` has measured; or None.
        scope: the ranges of sizes, materials and motions in the training scenes.

    Raises:
        CheckpointError: the folder holds no run, no checkpoint in it can be read, or the file is damaged.
    """

    effort = DefaultEffort()

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = file_name(path, "path")
        self.folder = run_file.open_run(self.path)
        self.settings = self.folder.settings
        self.scope = self.folder.scope
        self.model = self.folder.load_model()
        _, self.step, answers = self.folder.chosen
        corrections = self.settings.train.corrections
        self.effort, self.calibration, self.measured = known_answers(self.path, corrections, answers)
        self.folder.keep_place()
        self.weights = KnownWeights(self.model)

    def _facts(self) -> dict[str, str]:
        error = self.expected_error(self.effort)
        return {
            "path": self.path.name,
            "model": f"{self.settings.model.name}, {self.model.num_parameters:,} parameters",
            "checkpoint": f"step {self.step:,}",
            "family": f"{self.scope.family}, lengths in {self.scope.length_unit}",
            "effort": self.effort.text,
            "expected error": "not measured" if error is None else percent(error),
        }

    def __repr__(self) -> str:
        return one_line("Run", self._facts())

    def _repr_html_(self) -> str:
        bars = html_bars(self.folder.metrics.valid_errors(), "displacement error by validation")
        return html_table("Run", self._facts(), bars)

    def save(self, path: str | os.PathLike[str], licence: str | None = None) -> None:
        """Write the run as one file, `NAME.ast`, that `Run("NAME.ast")` opens on any machine.

        It holds the weights, the settings, the scope, `effort`, the curves of the training, a model card and a licence,
        as a zip of plain files. The optimizer's state and the dataset stay behind: a training cannot go on from it.

        Args:
            path: the file; an earlier one is replaced, whole or not at all.
            licence: the text of the licence of the weights; by default the one of the file that was opened, if any.

        Raises:
            CheckpointError: the name does not end in `.ast`, or the file cannot be written.
        """
        forget_other_weights(self, by_content=True)
        run_file.write(file_name(path, "path"), self.folder, self.model, dataclasses.asdict(self.effort), licence)

    @property
    def info(self) -> DatasetInfo:
        """The units and the kind of the predictions, and the names of their material."""
        model = self.settings.model
        scope = self.scope
        return DatasetInfo(
            family=scope.family,
            integration=model.data.integration,
            stress_location=model.data.stress,
            domain_center=model.data.domain_center,
            domain_half_width=model.data.domain_half_width,
            contact_radius=model.data.contact_radius,
            time_step=scope.time_step,
            length_unit=scope.length_unit,
            generator={"program": "ast_sim predict", **model.data.generator},
        )

    def predict(
        self,
        scene: Scene | SceneMesh | Trajectory | None = None,
        motion: Motions | None = None,
        *,
        spec: str | os.PathLike[str] | None = None,
        parameters: Mapping[str, Any] | None = None,
        nodes: int | None = None,
        frames: WantedFrames | None = None,
        effort: Effort | None = None,
        error: ErrorLimit | None = None,
        ms: float | None = None,
        num_frames: int | None = None,
        stress: np.ndarray | None = None,
        name: str = "scene",
        throw: bool = True,
        progress: ShowProgress = True,
    ) -> Answer:
        """Predict a scene. Its true trajectory need not be known.

        A scene outside the model's domain is moved there, predicted and moved back. Warnings tell of properties outside
        their ranges in training, of Newton steps that have not converged, and of changes of the specification.

        Args:
            scene: in the run's unit, as of `read_scene`; or a `Trajectory`, which has its motion, frames and stress.
            motion: of the prescribed nodes: rigid motions by body, such as {1: (0, 0, -0.01)}; or positions [S, N, 3]
                of all nodes or [S, P, 3] of the prescribed ones; or a `Motion`.
            spec, parameters, nodes: instead of a scene and a motion, the specification of an assembly, values of its
                parameters, and about how many nodes (None: by its sizes): spec="SPEC.toml", parameters={"travel": 4.2,
                "young": {"bumper": 1.5e6}}. Other parameters are in the middle of their ranges.
            frames: numbers of the wanted frames, such as [-1], or a slice; by default all. A model that jumps computes
                no other frame. With friction take [-2, -1]: if a body has two equilibria, the frame before decides.
            effort: what follows the first call of a model that jumps; by default `self.effort`.
            error, ms: instead, the relative error at the deepest frame that 90 % of scenes keep, of the displacement
                or {"reaction": 0.1, "stress": 0.1} (`ast_sim.calibrate` first); or milliseconds on this machine.
            num_frames: S, only for rigid motions; by default the prescribed nodes move as far in one as in training.
            stress, name: [given, N or E, 1] in pascal, of the given frames, by default zero; a name for messages.
            throw, progress: raise an error if it fails, else the answer's `failure` says why; as in `generate`.

        Raises:
            ConfigError: motion and scene, or scene and run, do not fit; or no effort keeps the error.
            DatasetError: an array has another dtype or shape, or holds numbers that are not finite.
            RolloutError: there is no such frame; or the prediction failed: the error's `answer` has the frames before.
        """
        began = time.perf_counter()
        built = None
        if spec is not None:
            if not (scene is None and motion is None and stress is None):
                raise ConfigError("a specification gives the scene and the motion: leave scene, motion and stress out")
            built = one_question(spec, parameters, self.scope, self.folder.specification, num_frames, nodes)
            scene = built.scene
            motion = built.motion
            num_frames = None
        elif parameters is not None or nodes is not None or scene is None:
            raise ConfigError("give a scene, or a specification with its parameters and nodes")
        notes = built.notes if built else ()
        question = new_question(self.settings.model, self.scope, scene, motion, num_frames, name, frames, stress, notes)
        chosen, promises = chosen_effort(self, [question], effort, error, ms)
        facts = built.facts if built else NOTHING
        return self._answers([question], chosen, began, throw, [{**facts, **promises[0]}], progress)[0]

    def sweep(
        self,
        spec: str | os.PathLike[str],
        parameters: Mapping[str, Any] | None = None,
        *,
        table: str | os.PathLike[str] | Sequence[Mapping[str, Any]] | None = None,
        effort: Effort | None = None,
        error: ErrorLimit | None = None,
        nodes: int | None = None,
        part: str | os.PathLike[str] | None = None,
        progress: ShowProgress = True,
    ) -> Sweep:
        """Predict the last frame of an assembly for many values of its parameters, in batches (failures: `Sweep.rows`).

        Args:
            spec: the specification of the assembly.
            parameters: values of the parameters by name: one, or a list. The sweep takes every combination.
            table: instead of parameters, a CSV file whose first line names parameters, or a list of mappings from names
                to values.
            effort, error, nodes, progress: as for `predict`; as for `generate`.
            part: a CSV file for the rows that are finished, written every ten seconds and where the sweep ends.

        Raises:
            ConfigError: as for `predict`; or values and a table are both given.
            SimulationError: no scene can be made.
        """
        chosen, _ = chosen_effort(self, [], effort, error)
        shared = (self.settings.model, self.scope, self.folder.specification, spec, rows_of(parameters, table))
        return sweep(self.predict_scenes, *shared, chosen, error, nodes, part, progress)

    def predict_scenes(
        self,
        scenes: Iterable[tuple[Scene, Motions]],
        *,
        names: Sequence[str] | None = None,
        frames: WantedFrames | None = None,
        effort: Effort | None = None,
        error: ErrorLimit | None = None,
        num_frames: int | None = None,
        throw: bool = True,
        progress: ShowProgress = True,
    ) -> list[Answer]:
        """Predict several scenes, each under a motion, as one batch. `progress` is as in `generate`; errors and other
        arguments are as in `predict`."""
        began = time.perf_counter()
        frames = list(frames) if isinstance(frames, Iterator) else frames  # it gives its numbers once
        questions = [
            new_question(self.settings.model, self.scope, scene, motion, num_frames, name, frames)
            for scene, motion, name in scenes_of(scenes, names)
        ]
        chosen, promises = chosen_effort(self, questions, effort, error)
        return self._answers(questions, chosen, began, throw, promises, progress)

    def predict_motions(
        self,
        scene: Scene,
        motions: Iterable[Motions],
        *,
        frames: WantedFrames | None = None,
        effort: Effort | None = None,
        error: ErrorLimit | None = None,
        num_frames: int | None = None,
        name: str = "scene",
        throw: bool = True,
        progress: ShowProgress = True,
    ) -> list[Answer]:
        """Predict one scene under several motions, as one batch; the answers have the order of the motions. Arguments
        and errors are as in `predict_scenes`."""
        scenes = [(scene, motion) for motion in several("motions", motions, "motions, as predict takes one")]
        names = [f"{name}, motion {number}" for number in range(len(scenes))]
        shared = {"frames": frames, "effort": effort, "error": error, "num_frames": num_frames}
        return self.predict_scenes(scenes, names=names, throw=throw, progress=progress, **shared)

    def _answers(
        self,
        questions: list[Question],
        effort: Effort,
        began: float,
        throw: bool,
        facts: Sequence[Mapping[str, Any]],
        progress: ShowProgress,
    ) -> list[Answer]:
        """The answers with their units, their origin, to which `facts` of each belong, and the error that is to be
        expected. What is unusual is told as warnings; `began` is when the call began."""
        require_bool(throw=throw)
        for question in questions:
            for note in question.notes:
                warn(f"{question.name}: {note}")
        predicted = answers(self.model, questions, effort, progress)
        seconds = (time.perf_counter() - began) / max(1, len(questions))
        told = []
        for question, answer, fact in zip(questions, predicted, facts, strict=True):
            p_value, unlike = (None, ()) if self.calibration is None else self.calibration.compared(answer)
            notes = (*question.notes, *unlike)
            in_doubt = notes or answer.failure is not None
            expected = None if in_doubt else self.expected_error(effort)
            origin = {"predicted_by": str(self.path), "step": self.step, **answer.source, **fact, "source": answer.name}
            if in_doubt:
                origin.pop("promise", None)
            if expected is not None:
                origin["expected_error"] = expected
            bands = {} if self.calibration is None else self.calibration.bands(answer, effort, notes)
            shared = {"info": self.info, "expected_error": expected, "seconds": seconds, "bands": bands}
            complete = dataclasses.replace(answer, source=origin, notes=notes, p_value=p_value, **shared)
            if complete.failure is not None and throw:
                raise RolloutError(complete.failure, complete)
            for doubt in (*unlike, *doubts(complete)):
                warn(f"{complete.name}: {doubt}")
            told.append(complete)
        return told

    def expected_error(self, effort: Effort) -> float | None:
        """The mean relative error of the displacement that validation scenes had at their deepest frame with this
        effort; with more Newton steps than were measured, the error after the most; None: it was not measured."""
        return error_with(effort, self.measured)

    def open(self, data: str | os.PathLike[str] | Dataset | None = None) -> Dataset:
        """Open a dataset, by default the training data, with lengths in the run's unit. The caller closes it. A dataset
        that is open already is opened once more.

        Raises:
            DatasetError: the dataset cannot be read.
            ConfigError: the run is a file, and no dataset is named; or the dataset and the training data differ in
                integration, stress location, material columns or elements.
        """
        if data is None and self.path.is_file():
            raise ConfigError(f"{self.path} holds no dataset: name one; the run learned from {self.settings.data}")
        data = self.folder.training_data() if data is None else data
        path = data.absolute_path if isinstance(data, Dataset) else file_name(data, "data")
        dataset = Dataset(path, self.scope.length_unit)
        try:
            self.folder.require_fit(dataset)
        except BaseException:
            dataset.close()
            raise
        return dataset

    def evaluate(
        self,
        data: str | os.PathLike[str] | Dataset | None = None,
        split: str = "test",
        command: str = "Run.evaluate",
        solver_scenes: int = SOLVER_SCENES,
        made_from: str | os.PathLike[str] | None = None,
        progress: ShowProgress = True,
    ) -> Evaluation:
        """Predict all scenes of a split and measure the errors.

        Args:
            data: a dataset, its path or open; by default the one that the run was trained on.
            command: the command that is recorded beside the figures.
            solver_scenes: in how many scenes the solver solves the deepest frame, too, in several variants; 0: in none.
            made_from: the specification or the parts of your own of which the dataset was made; the solver needs them.
            progress: as in `generate`; it counts scenes, once for all frames, once for the deepest, once solved.
        """
        (solver_scenes,) = required_whole(0, solver_scenes=solver_scenes)
        require_type("command", command, str, "a text")
        with self.open(data) as dataset:
            self.folder.warn_if_learned(dataset, split)
            steps = 2 * dataset.count(split) + min(solver_scenes, dataset.count(split))
            with Progress(steps, "scenes", progress) as bar:
                figures = evaluate(self.model, dataset, split, bar.advance, self.effort, solver_scenes, made_from)
            origin = {"run": str(self.path), "step": self.step, "data": str(dataset.path), "split": split}
            return Evaluation(self, dataset.path, dataclasses.replace(figures, origin=provenance(command) | origin))

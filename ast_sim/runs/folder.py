"""A run folder: its settings, its scope, its records, and the model of its best checkpoint."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from contextlib import AbstractContextManager
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.same_motions import same_motions
from ast_sim.models.registry import trained_model
from ast_sim.models.simulator import Simulator
from ast_sim.runs import checkpoint
from ast_sim.runs.config_toml import read_config, read_origin, read_scope
from ast_sim.runs.metrics import Metrics
from ast_sim.runs.scope import Scope
from ast_sim.runs.train_config import RunConfig
from ast_sim.support.disk import output_file
from ast_sim.support.errors import AstSimError, CheckpointError, ConfigError, DatasetError, counted, warn

_ANSWERS = ("effort", "valid_by_effort")  # what a validation records of answers; it is kept beside the best checkpoint


class Chosen(NamedTuple):
    """The checkpoint that a run predicts with.

    Attributes:
        path: its folder.
        step: its step.
        answers: what is known of answers with it: by validation `effort`, the default effort, and `valid_by_effort`;
            by calibration `calibration`. Empty where none was made.
    """

    path: Path
    step: int
    answers: dict[str, Any]


class RunFolder:
    """The folder of a run. Each file is read once, when it is first needed.

    Raises:
        CheckpointError: when it is read, a file is missing or damaged; the text names it.
        ConfigError: a file was edited.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.metrics = Metrics(path)

    def keep_place(self) -> None:
        """From now on the folder is where it is today, in whatever folder this process works."""
        self.path = self.path.absolute()
        self.metrics.path = self.metrics.path.absolute()

    @cached_property
    def settings(self) -> RunConfig:
        return read_config(self.path)

    @cached_property
    def scope(self) -> Scope:
        return read_scope(self.path)

    @cached_property
    def origin(self) -> dict[str, Any]:
        """The content of `run.json`: what the run was started with."""
        return read_origin(self.path)

    @property
    def licence(self) -> str | None:
        """The text of the licence of the weights; None: none is stated."""
        return None

    @property
    def specification(self) -> dict[str, Any] | None:
        """The specification that the training data was made of, as `AssemblySpec.describe` gave it; None: of none."""
        return self.origin.get("specification")

    @cached_property
    def chosen(self) -> Chosen:
        """The best checkpoint; the latest one if none was validated.

        Raises:
            CheckpointError: there is no checkpoint, none can be read, or the file `best` is missing.
        """
        best = checkpoint.read_best(self.path)
        if best is None and self.metrics.best() is not None:
            raise CheckpointError(
                f"{self.path / 'best'} is missing, but validations were recorded: ast-sim train --resume --out"
                f" {self.path} writes it again from metrics.jsonl"
            )
        newest = checkpoint.latest(self.path)
        if newest is None:
            raise CheckpointError(
                f"{self.path} has no checkpoint yet: train it with ast-sim train --resume --out {self.path}"
            )
        self.metrics.require(checkpoint.load(newest)[2]["lines"])
        marked = checkpoint.best(self.path)
        if best is None or marked is None:
            return Chosen(newest, checkpoint.step_of(newest), {})
        return Chosen(marked, best.step, best.answers)

    def load_model(self) -> Simulator:
        """The trained model of the chosen checkpoint."""
        weights, _, _ = checkpoint.load(self.chosen.path, self.origin["sha256"])
        return trained_model(self.settings.model, weights)

    def mark_best(self, validation: Mapping[str, Any]) -> None:
        """Mark the checkpoint of a validation, which is a record of `metrics.jsonl`, as the best one."""
        answers = {key: validation[key] for key in _ANSWERS if key in validation}
        checkpoint.mark_best(self.path, validation["step"], validation["valid_rmse"], answers)

    def keep_calibration(self, calibration: Mapping[str, Any]) -> None:
        """Keep what was measured of the answers of the chosen checkpoint beside it, until a better one is marked;
        errors are as in `require_best`."""
        self.require_best()
        best = checkpoint.read_best(self.path)
        assert best is not None
        answers = {**best.answers, "calibration": dict(calibration)}
        checkpoint.mark_best(self.path, best.step, best.error, answers)
        self.chosen = self.chosen._replace(answers=answers)

    def held(self) -> AbstractContextManager[None]:
        """Within the block nothing trains in the folder, so its best checkpoint stays the one that is measured.

        Raises:
            CheckpointError: something trains or calibrates there, or no calibration can be kept (`require_best`).
        """
        self.require_best()
        try:
            output_file(self.path / "best")
        except AstSimError as error:
            raise CheckpointError(
                f"{self.path} cannot be written, so it cannot keep what is measured: calibrate a copy, or a file"
                " (Run.save) whose band a file that is saved of it keeps"
            ) from error
        return checkpoint.lock(self.path)

    def forget_answers(self) -> None:
        """From now on nothing is known of answers: the caller has changed the weights. The folder stays as it is."""
        self.chosen = self.chosen._replace(answers={})

    def require_best(self) -> None:
        """Raise CheckpointError if no calibration can be kept: none was validated, a training has marked a better one
        since this folder was read, or the folder is gone."""
        if not self.path.is_dir():
            raise CheckpointError(f"{self.path} is gone since it was opened: open the run where it is now")
        best = checkpoint.read_best(self.path)
        if best is None:
            raise CheckpointError(f"{self.path} has no best checkpoint yet: train it until it is validated")
        if best.step != self.chosen.step:
            raise CheckpointError(
                f"{self.path} was opened at step {self.chosen.step:,}, and step {best.step:,} is better: open it again"
                " and calibrate it when its training has ended"
            )

    def start(self) -> dict[str, Any]:
        """What a run that starts from this one records: `run`, `step` and `sha256` of the weights."""
        path, step, _ = self.chosen
        checkpoint.load(path, self.origin["sha256"])
        return {"run": str(self.path.resolve()), "step": step, "sha256": checkpoint.weights_hash(path)}

    def require_fit(self, dataset: Dataset) -> None:
        """Raise ConfigError unless the dataset is of the kind that the run was trained on."""
        model = self.settings.model
        scope = self.scope
        for what, ours, theirs in (
            ("integration", model.data.integration, dataset.info.integration),
            ("stress_location", model.data.stress, dataset.info.stress_location),
            ("material columns", _listed(model.data.columns), _listed(dataset.material.columns)),
            ("nodes of an element", scope.corners, dataset.element_size),
            ("lengths in", scope.length_unit, dataset.info.length_unit),
        ):
            if ours != theirs:
                raise ConfigError(f"{dataset.path} has {what} {theirs}, but {self.path} was trained with {what} {ours}")
        same_place = Path(self.settings.data) == dataset.absolute_path
        if same_place and self.origin.get("data") not in (None, dataset.fingerprint()):
            warn(f"{dataset.path} holds other scenes than when {self.path} was trained on it")

    def training_data(self) -> str:
        """The path of the dataset that trained the run.

        Raises:
            DatasetError: there is no such file any more.
        """
        data = self.settings.data
        if not Path(data).exists():
            raise DatasetError(
                f"{data}, from which {self.path} learned, is not there: name the dataset where it is now"
            )
        return data

    def scenes(self, split: str) -> list[str]:
        """The hashes (`same_motions`) of the scenes of "train" or "valid" that have trained or chosen the run, and the
        run that it starts from; none in older runs."""
        return self.origin.get("scenes", {}).get(split, "").split()

    def learned(self, dataset: Dataset, split: str) -> list[int]:
        """The numbers of the scenes of a split that have trained or chosen the run, in whatever dataset they stand now.
        An older run knows the path and the fingerprint of its dataset alone."""
        same_place = Path(self.settings.data).resolve() == dataset.path.resolve()
        if split in ("train", "valid") and (same_place or self.origin.get("data") == dataset.fingerprint()):
            return list(range(dataset.count(split)))
        return same_motions(dataset, split, {*self.scenes("train"), *self.scenes("valid")})

    def warn_if_learned(self, dataset: Dataset, split: str) -> None:
        """Warn if the run learned from scenes of this split: its errors there are no errors in new scenes."""
        if split == "train" and Path(self.settings.data) == dataset.absolute_path:
            warn(f"{self.path} learned from these scenes ({dataset.path}, split train): new ones have larger errors")
        elif known := same_motions(dataset, split, set(self.scenes("train"))):
            all_of_them = counted(dataset.count(split), "scene")
            warn(
                f"{self.path} learned from {len(known)} of {all_of_them} ({dataset.path}, split {split}; the first is"
                f" {split}/{known[0]:06d}): new ones have larger errors"
            )

    def describe(self) -> dict[str, Any]:
        """What `ast-sim info` says of a run: its settings, the checkpoint that it starts from, its checkpoints and the
        best validation.

        A warning tells if the record of that validation is missing.
        """
        latest, best, mark = checkpoint.latest(self.path), checkpoint.best(self.path), checkpoint.read_best(self.path)
        validation = self.metrics.validation(mark.step) if mark else None
        if mark and not validation:
            text = f"{self.metrics.path} misses the validation after step {mark.step}, the best one"
            warn(text)
        return {
            "kind": "run",
            "path": str(self.path),
            **dataclasses.asdict(self.settings),
            "start": self.origin.get("start"),
            "latest_checkpoint": latest.name if latest else None,
            "best_checkpoint": best.name if best else None,
            "best_validation": validation,
            "answers": mark.answers if mark else {},
        }


def _listed(names: tuple[str, ...]) -> str:
    return ", ".join(names) or "none"

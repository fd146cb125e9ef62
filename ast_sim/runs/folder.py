"""The trained model in a run folder, and what the folder holds."""

from __future__ import annotations

import dataclasses
import warnings
from pathlib import Path
from typing import Any

from torch import Tensor

from ast_sim.dataset.reader import Dataset
from ast_sim.models.model_config import ModelConfig
from ast_sim.models.registry import build_model
from ast_sim.models.simulator import Simulator
from ast_sim.runs import checkpoint
from ast_sim.runs.config_toml import has_config, read_config, read_origin
from ast_sim.runs.metrics import Metrics
from ast_sim.runs.scope import Scope
from ast_sim.runs.train_config import RunConfig
from ast_sim.support.errors import CheckpointError, ConfigError


def load_model(run: Path) -> tuple[Simulator, RunConfig, int]:
    """The trained model, the settings of the run, and the step of the checkpoint.

    The checkpoint is the best one; the latest one if none was validated.

    Raises:
        CheckpointError: the folder is no run, no checkpoint in it can be read, or the file `best` is missing.
    """
    settings = read_config(run)
    weights, _, state = checkpoint.load(chosen_checkpoint(run), read_origin(run)["sha256"])
    model = build_model(settings.model)
    model.load_state_dict(weights)
    return model.eval(), settings, int(state["step"])


def chosen_checkpoint(run: Path) -> Path:
    """The best checkpoint of a run; the latest one if none was validated. Errors as in `load_model`."""
    if checkpoint.read_best(run) is None and Metrics(run).best() is not None:
        raise CheckpointError(
            f"{run / 'best'} is missing, but validations were recorded: ast-sim train --resume --out {run} writes it"
            " again from metrics.jsonl"
        )
    newest = checkpoint.latest(run)
    if newest is None:
        raise CheckpointError(f"{run} has no checkpoint yet: train it with ast-sim train --resume --out {run}")
    Metrics(run).require(checkpoint.load(newest)[2]["lines"])
    return checkpoint.best(run) or newest


def start_at(run: Path) -> dict[str, Any]:
    """What a run that starts from this one records: `run`, `step` and `sha256` of the weights. Errors as in
    `load_model`."""
    path = chosen_checkpoint(run)
    step = checkpoint.load(path, read_origin(run)["sha256"])[2]["step"]
    return {"run": str(run.resolve()), "step": step, "sha256": checkpoint.weights_hash(path)}


def first_weights(run: Path) -> dict[str, Tensor] | None:
    """The weights that a run starts from; None if it does not start from another run.

    Raises:
        CheckpointError: the checkpoint is gone, damaged, or not the one that the run recorded.
    """
    start = read_origin(run).get("start") if has_config(run) else None  # a loop of one's own may have no settings
    if start is None:
        return None
    path = checkpoint.at_step(start["run"], start["step"])
    if checkpoint.weights_hash(path) != start["sha256"]:
        raise CheckpointError(f"{path} is not the checkpoint that {run} starts from: train in another folder")
    return checkpoint.load(path)[0]


def require_fit(run: Path, model: ModelConfig, scope: Scope, dataset: Dataset) -> None:
    """Raise ConfigError unless the dataset is of the kind that the run was trained on."""
    for what, ours, theirs in (
        ("integration", model.integration, dataset.info.integration),
        ("stress_location", model.stress, dataset.info.stress_location),
        ("material columns", model.material_width, dataset.material_width),
        ("nodes of an element", scope.corners, dataset.element_size),
        ("lengths in", scope.length_unit, dataset.info.length_unit),
    ):
        if ours != theirs:
            raise ConfigError(f"{dataset.path} has {what} {theirs}, but {run} was trained with {what} {ours}")


def describe_run(path: Path) -> dict[str, Any]:
    """What `ast-sim info` says of a run: its settings, the checkpoint that it starts from, its checkpoints and the best
    validation.

    A warning tells if the record of that validation is lost.
    """
    settings = read_config(path)
    latest, best, mark = checkpoint.latest(path), checkpoint.best(path), checkpoint.read_best(path)
    validation = Metrics(path).validation(mark[0]) if mark else None
    if mark and not validation:
        warnings.warn(f"{Metrics(path).path} has lost the validation after step {mark[0]}, the best one", stacklevel=2)
    return {
        "kind": "run",
        "path": str(path),
        **dataclasses.asdict(settings),
        "start": read_origin(path).get("start"),
        "latest_checkpoint": latest.name if latest else None,
        "best_checkpoint": best.name if best else None,
        "best_validation": validation,
    }

"""A run folder: its settings (`config.toml`), its metrics (`metrics.jsonl`) and the model of its checkpoints."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from ast_sim import checkpoint, config
from ast_sim.data.disk import replacing
from ast_sim.errors import CheckpointError
from ast_sim.model.simulator import Simulator
from ast_sim.models import AnyConfig, build_model
from ast_sim.optimizer import Name as OptimizerName

CONFIG = "config.toml"
METRICS = "metrics.jsonl"


def _option(default: Any, help: str) -> Any:
    return field(default=default, metadata={"help": help})


@dataclass(frozen=True)
class TrainConfig:
    """How a model is trained. The defaults are the paper's; None means: derived from the data when training starts."""

    steps: int | None = _option(None, "optimizer steps; None: as many as `epochs` need")
    epochs: int = _option(100, "passes over the training pairs, where `steps` is None")
    batch_size: int = _option(48, "scenes (frame pairs) in a batch")
    accumulate: int = _option(1, "batches whose gradients are averaged for one step")
    optimizer: OptimizerName = _option(
        "adamw", "adamw, or muon for the matrices inside the model: slower steps of which fewer are needed"
    )
    peak_rate: float | None = _option(None, "highest learning rate; None: 1e-4 sqrt(scenes per step / 2)")
    warmup: int | None = _option(None, "steps of linear warm-up from 1e-4 of the peak; None: 5 % of all, at most 2000")
    decay: int | None = _option(None, "step where the cosine reaches zero; None: the end, or with epochs one later")
    clip: float = _option(1.0, "largest norm of the gradient")
    noise: float | None = _option(
        None,
        "std of the state noise in units of length; None: 0.45 x rms displacement, along rollouts 0.15 x, if dynamic"
        " 0.1 x rms increment",
    )
    rollout_pool: int | None = _option(
        0,
        "scenes that are rolled out while the model trains, whose states it is trained on; 0: the data's, with noise;"
        " None: 16 batches where a model goes step by step, of the baselines if dynamic",
    )
    noise_gamma: float | None = _option(None, "share of the noise that the target undoes; None: 1, and 0.1 if dynamic")
    mirror: tuple[Literal["x", "y", "z"], ...] = _option(
        (), "axes along which scenes are mirrored at random: where gravity, fibres or chirality do not forbid it"
    )
    shift: float | None = _option(
        0.0,
        "largest distance, along each axis and in units of length, by which scenes are moved at random; None: half the"
        " side of the model's cells, at most 0.05 of the domain's half width",
    )
    stress_weight: float = _option(0.01, "weight of the stress in the loss; motion has 1")
    statistics_pairs: int = _option(400, "frame pairs that the input and output scales are taken from")
    seed: int = _option(0, "initial weights, order, noise and dropout follow from it")
    validate_every: int | None = _option(None, "steps between rollouts of the validation scenes; None: a tenth")
    validate_scenes: int = _option(8, "validation scenes that are rolled out, the first ones")
    checkpoint_every: int | None = _option(None, "steps between checkpoints; None: at each validation")
    keep: int = _option(3, "newest checkpoints that are kept, besides the best")
    log_every: int = _option(100, "steps that one line of metrics.jsonl averages")


@dataclass(frozen=True)
class RunConfig:
    """All settings of a run, as kept in its `config.toml`."""

    model: AnyConfig
    train: TrainConfig
    data: str


def has_config(run: Path) -> bool:
    return (run / CONFIG).is_file()


def read_config(run: Path) -> RunConfig:
    """The settings of a run.

    Raises:
        CheckpointError: the folder holds no run. ConfigError: its settings cannot be understood.
    """
    try:
        text = (run / CONFIG).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise CheckpointError(f"{run} is not a run folder: {CONFIG} cannot be read ({error})") from error
    return config.from_toml(RunConfig, text)


def write_config(run: Path, settings: RunConfig) -> None:
    """Write the settings: there is a whole file or none."""
    with replacing(run / CONFIG) as temporary:
        temporary.write_text(config.to_toml(settings), encoding="utf-8")


def load_model(run: Path) -> tuple[Simulator, RunConfig, int]:
    """The model of a run's best checkpoint (its latest if none was validated), its settings and its step.

    Raises:
        CheckpointError: no run folder, or no checkpoint that can be read.
    """
    settings = read_config(run)
    path = checkpoint.best(run) or checkpoint.latest(run)
    if path is None:
        raise CheckpointError(f"{run} has no checkpoint yet: train it with ast-sim train --resume --out {run}")
    weights, _, state = checkpoint.load(path)
    model = build_model(settings.model)
    model.load_state_dict(weights)
    return model.eval(), settings, int(state["step"])


class Metrics:
    """`metrics.jsonl`: one JSON object a line, each with its `step`; only ever appended to, except when resuming."""

    def __init__(self, run: Path) -> None:
        self.path = run / METRICS

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """The lines that are whole, in order."""
        if not self.path.exists():
            return
        with open(self.path, encoding="utf-8", errors="replace") as file:
            for line in file:
                try:
                    record = json.loads(line)
                except json.JSONDecodeError:
                    continue  # a line that a kill cut off
                if isinstance(record, dict) and isinstance(record.get("step"), int):
                    yield record

    def append(self, record: dict[str, Any]) -> None:
        with open(self.path, "a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")
            file.flush()
            os.fsync(file.fileno())

    def forget_after(self, step: int) -> None:
        """Drop the lines of later steps: those that training is about to do again."""
        lines = [json.dumps(record) + "\n" for record in self if record["step"] <= step]
        with replacing(self.path) as temporary:
            temporary.write_text("".join(lines), encoding="utf-8")

    def best(self) -> float:
        """The lowest validation error so far; infinity before the first."""
        values = [record.get("valid_rmse") for record in self]
        return min((value for value in values if value is not None), default=float("inf"))

    def validated(self, step: int) -> bool:
        return any(record["step"] == step and "valid_rmse" in record for record in self)

"""The settings of a run: of its training, its model and the dataset. `config_toml` keeps them in a file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from ast_sim.models.data_facts import DataFacts
from ast_sim.models.model_config import ModelConfig, setting
from ast_sim.models.registry import find_model
from ast_sim.support.errors import ConfigError, is_utf8
from ast_sim.support.precisions import Precision

OptimizerName = Literal["adamw", "muon"]


@dataclass(frozen=True)
class TrainConfig:
    """How a model is trained. The defaults are the paper's. Where one is None, `resolve` fills in a value that follows
    from the data."""

    steps: int | None = setting(None, "optimizer steps; unset: as many as `epochs` asks for")
    minutes: float | None = setting(
        None, "minutes of training: 50 steps are timed, then `steps` is fixed; unset: `steps` or `epochs` decides"
    )
    scenes: int | None = setting(None, "train on this number of scenes, the first of the training split; unset: on all")
    epochs: int = setting(100, "passes over the training pairs, if neither `steps` nor `minutes` is set")
    batch_size: int = setting(48, "scenes in a batch; each scene is a pair of frames")
    accumulate: int = setting(1, "batches in a step; the step averages their gradients")
    processes: int | None = setting(
        None,
        "processes that train together, each with its part of every batch; unset: at most one for each core, each with"
        " at least 3000 nodes a step, and 1 if the training takes about a minute; with torchrun, as many as it starts",
    )
    optimizer: OptimizerName = setting(
        "adamw",
        "adamw for all weights; or muon for the matrices inside the model, and adamw for the rest: fewer steps are"
        " needed, but each is slower",
    )
    peak_rate: float | None = setting(None, "highest learning rate; unset: 1e-4 sqrt(scenes per step / 2)")
    warmup: int | None = setting(
        None,
        "steps at the beginning in which the learning rate grows from 1e-4 of its peak to the peak; unset: 5 % of"
        " all steps, at most 2000",
    )
    decay: int | None = setting(
        None,
        "step at which the learning rate reaches 0; unset: the last step, or one epoch later if `steps` is unset",
    )
    precision: Precision = setting(
        "float32",
        "number format of the factors when the model multiplies; bfloat16 keeps 8 binary digits of each, on processors"
        " that are faster with it; sums and the gradients of weights stay in float32",
    )
    clip: float = setting(1.0, "largest norm of the gradient; a longer gradient is scaled down to it")
    noise: float | None = setting(
        None,
        "standard deviation of the noise on the input state, in units of length; unset: 0.45 of the rms displacement"
        " (0.15 with a rollout pool), in dynamic scenes 0.1 of the rms increment; with model.jumps none",
    )
    rollout_pool: int | None = setting(
        0,
        "scenes that are rolled out during training, so that the model learns from states that it predicted itself;"
        " 0: it learns from the states of the dataset, with noise; unset: 16 batches if the scenes are dynamic or the"
        " model is ast or transolver, else 0; always 0 with model.jumps and without noise",
    )
    corrections: int = setting(
        0, "with model.jumps: number of calls that correct the first one in training; without jumps 0"
    )
    noise_gamma: float | None = setting(
        None, "share of the noise that the target corrects; unset: 1, in dynamic scenes 0.1"
    )
    mirror: tuple[Literal["x", "y", "z"], ...] = setting(
        (), "axes along which scenes are mirrored at random; name only axes that gravity, fibres or chirality allow"
    )
    shift: float | None = setting(
        0.0,
        "scenes are moved at random by at most this distance along each axis, in units of length; unset: half the side"
        " of the model's cells, at most 0.05 of the domain's half width",
    )
    stress_weight: float = setting(0.01, "weight of the stress in the loss; the motion has the weight 1")
    strain_weight: float | None = setting(
        0.0,
        "weight of the error of strains in the loss, measured along the edges of deforming elements; it lowers the"
        " errors of forces and stresses; unset: 1 with model.jumps, else 0",
    )
    statistics_pairs: int = setting(400, "pairs of frames from which the scales of inputs and outputs are measured")
    seed: int = setting(0, "seed of the initial weights, the order of the pairs, the noise and dropout")
    validate_every: int | None = setting(
        None, "steps from one validation (rollouts of validation scenes) to the next; unset: a tenth of all steps"
    )
    validate_scenes: int = setting(8, "number of validation scenes that are predicted: the first ones of the split")
    checkpoint_every: int | None = setting(
        None, "steps from one checkpoint to the next; unset: a checkpoint at each validation"
    )
    keep: int = setting(3, "number of newest checkpoints that are kept; the best one is kept as well")
    log_every: int = setting(100, "steps from one line of metrics.jsonl to the next; a line holds their means")


def _model_class(table: Mapping[str, Any]) -> type[ModelConfig]:
    return find_model(str(table.get("name", ""))).config


@dataclass(frozen=True)
class RunConfig:
    """All settings of a run: of its model, of its training, and the path of its dataset."""

    model: ModelConfig = field(metadata={"class_of": _model_class})
    train: TrainConfig
    data: str

    def knowing(self, facts: DataFacts) -> RunConfig:
        """The settings with the facts of the data, which no file of settings holds."""
        return replace(self, model=replace(self.model, data=facts))

    def __post_init__(self) -> None:
        if not is_utf8(self.data):
            raise ConfigError(f"{self.data}: a run cannot keep a path that is not UTF-8: rename the file or the folder")

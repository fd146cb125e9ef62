"""What the data decides before training: its scales, the settings that follow from them, the learning rates."""

from __future__ import annotations

import dataclasses
import hashlib
import math

import numpy as np

from ast_sim.data.file import Dataset
from ast_sim.data.scene import NodeType
from ast_sim.errors import ConfigError, TrainingError
from ast_sim.measures import SquaredError, rmse_pooled
from ast_sim.model.config import ModelConfig
from ast_sim.run import TrainConfig

LARGEST_SHIFT = 0.05  # of the domain's half width, where it is left open: `Domain` has more room than that
ROLLOUT_BATCHES = 16  # that take turns in a pool of rollouts
MEASURED_TRAJECTORIES = 100  # training trajectories that the scales of the data are measured on, at most


@dataclasses.dataclass(frozen=True)
class DataScales:
    """Lengths that decide whether a model can learn, measured on NORMAL nodes of the training split.

    Attributes:
        displacement, increment: root mean square per coordinate, over all frames.
        spacing: mean length of the edges of the deforming bodies at rest.
        nodes: median number of nodes of a scene.
        trajectories, pairs: how many the training split has.
    """

    displacement: float
    increment: float
    spacing: float
    nodes: int
    trajectories: int
    pairs: int


def measure(dataset: Dataset) -> DataScales:
    """Measure the training split; on at most MEASURED_TRAJECTORIES, evenly spread."""
    count = dataset.count("train")
    if count == 0:
        raise TrainingError(f"{dataset.path} has no trajectories to train on: the split train is empty")
    given = 2 if dataset.info.integration == "dynamic" else 1  # frames before the first that can be a target
    displacement, increment, lengths, nodes = [], [], [], []
    for index in np.unique(np.linspace(0, count - 1, min(count, MEASURED_TRAJECTORIES)).astype(int)):
        trajectory = dataset.load("train", int(index))
        scene, position = trajectory.scene, trajectory.position
        normal = scene.node_type == NodeType.NORMAL
        displacement.append(SquaredError.between(position, scene.rest_position, normal))
        increment.append(SquaredError.between(position[1:], position[:-1], normal))
        edges = scene.edges()
        edges = edges[(scene.node_type[edges] != NodeType.OBSTACLE).all(axis=1)]
        lengths.append(np.linalg.norm(scene.rest_position[edges[:, 0]] - scene.rest_position[edges[:, 1]], axis=1))
        nodes.append(scene.num_nodes)
    return DataScales(
        displacement=rmse_pooled(displacement),
        increment=rmse_pooled(increment),
        spacing=float(np.concatenate(lengths).mean(dtype=np.float64)),
        nodes=int(np.median(nodes)),
        trajectories=count,
        pairs=sum(max(0, dataset.num_frames("train", index) - given) for index in range(count)),
    )


def resolve_training(config: TrainConfig, scales: DataScales, model: ModelConfig) -> TrainConfig:
    """Fill in what the settings leave to the data and to the model, whose settings are resolved.

    Raises:
        ConfigError: naming a setting out of its range, or of no use to the model.
    """
    for key, least in (("batch_size", 1), ("accumulate", 1), ("epochs", 1), ("log_every", 1), ("keep", 1), ("seed", 0)):
        if getattr(config, key) < least:
            raise ConfigError(f"train.{key} is {getattr(config, key)}; it must be at least {least}")
    for key in ("steps", "validate_every", "checkpoint_every"):
        if getattr(config, key) is not None and getattr(config, key) < 1:
            raise ConfigError(f"train.{key} is {getattr(config, key)}; it must be at least 1")
    scenes = config.batch_size * config.accumulate
    epoch = math.ceil(scales.pairs / scenes)
    steps = config.steps if config.steps is not None else config.epochs * epoch
    validate_every = config.validate_every or max(1, steps // 10)
    derived = {
        "steps": steps,
        "peak_rate": 1e-4 * math.sqrt(scenes / 2),
        "warmup": min(2000, steps // 20),
        "decay": steps if config.steps is not None else steps + epoch,
        "noise_gamma": 0.1 if model.dynamic else 1.0,
        "validate_every": validate_every,
        "checkpoint_every": validate_every,
    }
    missing = {key: value for key, value in derived.items() if getattr(config, key) is None}
    pool = _rollout_pool(config, model)
    noise = _noise(config, scales, model, pool > 0)
    return dataclasses.replace(config, **missing, noise=noise, rollout_pool=pool, shift=_shift(config, model))


def _noise(config: TrainConfig, scales: DataScales, model: ModelConfig, along_rollouts: bool) -> float:
    """The standard deviation of the state noise; the shares are those found best (docs/log.md, 2026-11-23)."""
    if model.time_conditioned:  # starts from the true first frame each time: there is no drift to get used to
        return 0.0
    if config.noise is not None:
        return config.noise
    if model.dynamic:  # it is one of the velocity, too
        return 0.1 * scales.increment
    return (0.15 if along_rollouts else 0.45) * scales.displacement


def _rollout_pool(config: TrainConfig, model: ModelConfig) -> int:
    """The scenes of the pool; 0: none."""
    useless = None
    if model.time_conditioned:
        useless = "each frame follows from the first"
    elif config.noise == 0:
        useless = "without train.noise, states have no error"
    if config.rollout_pool is None:
        return ROLLOUT_BATCHES * config.batch_size if model.gains_along_rollouts and not useless else 0
    if config.rollout_pool and useless:
        raise ConfigError(f"train.rollout_pool is of no use here: {useless}")
    if config.rollout_pool and (config.rollout_pool % config.batch_size or config.rollout_pool < 2 * config.batch_size):
        raise ConfigError(
            f"train.rollout_pool is {config.rollout_pool}; it must be a multiple, at least twice, of train.batch_size ="
            f" {config.batch_size}"
        )
    return config.rollout_pool


def _shift(config: TrainConfig, model: ModelConfig) -> float:
    """The largest distance by which scenes are moved: with half a cell side all places of the cells are as likely."""
    if config.shift is None:
        return min(model.cell_side / 2, LARGEST_SHIFT * model.domain_half_width)
    if not 0 <= config.shift < math.inf:
        raise ConfigError(f"train.shift is {config.shift}; it must be at least 0")
    return config.shift


def largest_error(scales: DataScales, model: ModelConfig) -> float:
    """The error of a state, in units of length, above which it does not stay in a pool: see docs/log.md."""
    return (0.4 if model.dynamic else 1.8) * scales.displacement


def learning_rate(config: TrainConfig, step: int) -> float:
    """The rate of step 0, 1, ...: linear from 1e-4 of the peak over `warmup` steps, then a cosine to 0 at `decay`."""
    if step < config.warmup:
        return config.peak_rate * (1e-4 + (1 - 1e-4) * step / config.warmup)
    phase = (step - config.warmup) / max(1, config.decay - config.warmup)
    return 0.5 * config.peak_rate * (1 + math.cos(math.pi * min(1.0, phase)))


def step_seed(seed: int, step: int) -> int:
    """The seed of a step's dropout: 63 bits of a hash of both numbers."""
    return int.from_bytes(hashlib.sha256(f"{seed}:{step}".encode()).digest()[:8], "little") >> 1

"""The values of unset settings, which follow from the data and the model."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

from ast_sim.batches.frame_pairs import target_counts
from ast_sim.dataset.reader import Dataset
from ast_sim.models.data_facts import DataFacts
from ast_sim.models.model_config import ModelConfig
from ast_sim.named_field import REACTION, STRESS
from ast_sim.runs.train_config import RunConfig, TrainConfig
from ast_sim.support.errors import ConfigError, counted
from ast_sim.support.toml_settings import LARGEST, require_range
from ast_sim.training.data_lengths import DataScales
from ast_sim.training.rates import Schedule

# An unset shift is at most this share of the domain's half width; the margin of `Domain` is larger.
LARGEST_SHIFT = 0.05
_COUNTS = ("batch_size", "accumulate", "epochs", "statistics_pairs", "steps", "decay", "log_every", "keep")
_COUNTS += ("validate_every", "checkpoint_every", "processes")
_RANGES = {
    **dict.fromkeys(_COUNTS, (1, LARGEST)),
    **dict.fromkeys(("seed", "warmup", "validate_scenes", "noise", "corrections"), (0, LARGEST)),
    "minutes": (1e-3, LARGEST),
    "peak_rate": (1e-30, 1.0),
    "clip": (1e-30, math.inf),
    **dict.fromkeys(("stress_weight", "strain_weight"), (0, 1e6)),
    "noise_gamma": (0, 1),
}
ROLLOUT_BATCHES = 16  # batches whose scenes an unset pool of rollouts holds


def resolve(config: RunConfig, dataset: Dataset, scales: DataScales, keep_model: bool = False) -> RunConfig:
    """Fill in all unset settings, first of the model, then of the training. With `keep_model`, the model has none, and
    stays as it is.

    Raises:
        ConfigError: a setting is out of its range, or the data does not fit it; the text names the setting.
    """
    facts = DataFacts.of(
        dataset.info,
        dataset.material.columns,
        scales.spacing,
        scales.planar,
        tetrahedra=dataset.element_size != 3,
        recorded=scales.recorded,
        fields=_fields(dataset, config.model.state),
        middles=scales.middles,
    )
    if keep_model:
        newer = {key: getattr(facts, key) for key in ("corners_only", "middle_low", "middle_high", *scales.recorded)}
        model = dataclasses.replace(config.model, data=dataclasses.replace(config.model.data, **newer))
    else:
        model = config.model.resolve(facts)
    if config.train.scenes is not None:
        scales = dataclasses.replace(scales, pairs=_pairs_of_first(config.train.scenes, dataset))
    return RunConfig(model, resolve_training(config.train, scales, model), str(Path(config.data).resolve()))


def _pairs_of_first(scenes: int, dataset: Dataset) -> int:
    """The number of targets in the first scenes of the training split.

    Raises:
        ConfigError: the split has fewer scenes, or the number is below 1.
    """
    require_range("train.scenes", scenes, 1)
    count = dataset.count("train")
    if scenes > count:
        raise ConfigError(f"train.scenes is {scenes}, but {dataset.path} has {counted(count, 'training scene')}")
    return sum(target_counts(dataset, "train")[:scenes])


def _fields(dataset: Dataset, names: tuple[str, ...]) -> tuple[tuple[str, str, int, str], ...]:
    """Name, location, columns and unit of the fields to predict.

    Raises:
        ConfigError: the dataset does not have one of them, or one is named twice.
    """
    known = dataset.fields("train", 0) if names and dataset.count("train") else {}
    known.pop(STRESS, None)  # the name of the von Mises stress, which is predicted anyway
    for name in names:
        if name not in known:
            raise ConfigError(
                f"model.state: {dataset.path} has no field {name!r}; it has: {', '.join(known) or 'none'}; keep one"
                " with ast-sim convert --field NAME or --reaction NAME"
            )
        if names.count(name) > 1:
            raise ConfigError(f"model.state names {name!r} twice")
    return tuple((name, known[name].location, known[name].values.shape[2], known[name].unit) for name in names)


def resolve_training(config: TrainConfig, scales: DataScales, model: ModelConfig) -> TrainConfig:
    """Fill in the unset settings of the training; `model` has no unset settings.

    Raises:
        ConfigError: a setting is out of its range, or the model cannot use it; the text names the setting.
    """
    for key, (least, most) in _RANGES.items():
        require_range(f"train.{key}", getattr(config, key), least, most)
    _require_within_epoch(config, scales.pairs)
    scenes = config.batch_size * config.accumulate
    epoch = math.ceil(scales.pairs / scenes)
    steps = config.steps if config.steps is not None else config.epochs * epoch
    validate_every = config.validate_every or max(1, steps // 10)
    derived = {
        "steps": steps,
        "peak_rate": 1e-4 * math.sqrt(scenes / 2),
        "warmup": min(2000, steps // 20),
        "decay": steps if config.steps is not None else steps + epoch,
        "validate_every": validate_every,
        "checkpoint_every": validate_every,
        "strain_weight": 1.0 if model.scheme.jumps else 0.0,
    }
    turning = [name for name, _, columns, _ in model.data.fields if columns > 1 and name != REACTION]
    if config.mirror and turning:
        raise ConfigError(
            f"train.mirror: {turning[0]} has several columns, and nobody knows how a mirror changes them: leave it out"
        )
    missing = {key: value for key, value in derived.items() if getattr(config, key) is None}
    pool = _rollout_pool(config, model)
    noise = _noise(config, scales, model, pool > 0)
    resolved = dataclasses.replace(
        config,
        **missing,
        noise=noise,
        noise_gamma=_noise_gamma(config, model, noise),
        rollout_pool=pool,
        shift=_shift(config, scales, model),
    )
    if resolved.corrections and not model.scheme.corrects:
        raise ConfigError(f"train.corrections is {resolved.corrections}; without model.jumps it must be 0")
    schedule = Schedule.of(resolved)
    if schedule.decay <= schedule.warmup:
        raise ConfigError(f"train.warmup is {schedule.warmup}; it must be below train.decay = {schedule.decay}")
    return resolved


def _require_within_epoch(config: TrainConfig, pairs: int) -> None:
    """Raise ConfigError if more is drawn at once than an epoch has, or than the defaults draw: it would be the same
    samples again, in a step that takes all memory or never ends; or if an axis to mirror along is named twice."""
    usual = TrainConfig()
    for key in ("batch_size", "statistics_pairs"):
        most = max(pairs, getattr(usual, key))
        if getattr(config, key) > most:
            raise ConfigError(
                f"train.{key} is {getattr(config, key)}, but an epoch has {counted(pairs, 'sample')}: more would be the"
                f" same ones again; take at most {most}"
            )
    most = max(1, pairs // config.batch_size)
    if config.accumulate > most:
        raise ConfigError(
            f"train.accumulate is {config.accumulate}, but an epoch has {counted(pairs, 'sample')}: a step of batches"
            f" of {config.batch_size} would see the same ones again; take at most {most}"
        )
    if len(set(config.mirror)) < len(config.mirror):
        raise ConfigError(f"train.mirror is {', '.join(config.mirror[:10])}; name each axis once")


def _noise(config: TrainConfig, scales: DataScales, model: ModelConfig, along_rollouts: bool) -> float:
    """The standard deviation of the noise on states; measurements chose the shares (docs/log.md, 2026-11-23)."""
    if not model.scheme.errors_add_up:
        if config.noise:
            raise ConfigError(
                f"train.noise = {config.noise} is of no use here: with model.jumps, a start has errors of the model's"
                " own; leave it unset (none)"
            )
        return 0.0
    if config.noise is not None:
        return config.noise
    if model.data.dynamic:  # the noise changes the velocity as well
        return 0.1 * scales.increment
    return (0.15 if along_rollouts else 0.45) * scales.displacement


def _noise_gamma(config: TrainConfig, model: ModelConfig, noise: float) -> float | None:
    """The share of the noise that the target takes back; None without noise."""
    if noise:
        usual = 0.1 if model.data.dynamic else 1.0
        return usual if config.noise_gamma is None else config.noise_gamma
    if config.noise_gamma is not None:
        raise ConfigError(
            f"train.noise_gamma = {config.noise_gamma} is of no use here: there is no noise; leave it unset (none)"
        )
    return None


def _rollout_pool(config: TrainConfig, model: ModelConfig) -> int:
    """The number of scenes in the pool of rollouts; 0: there is no pool."""
    useless = None
    if not model.scheme.errors_add_up:
        useless = "with model.jumps, each frame follows from the first"
    elif config.noise == 0:
        useless = "without train.noise, states have no error"
    if config.rollout_pool is None:
        return ROLLOUT_BATCHES * config.batch_size if model.gains_along_rollouts and not useless else 0
    if config.rollout_pool and useless:
        raise ConfigError(f"train.rollout_pool is of no use here: {useless}")
    if config.rollout_pool and (config.rollout_pool % config.batch_size or config.rollout_pool < 2 * config.batch_size):
        raise ConfigError(
            f"train.rollout_pool is {config.rollout_pool}; it must be a multiple of train.batch_size ="
            f" {config.batch_size}, at least {2 * config.batch_size}"
        )
    return config.rollout_pool


def _shift(config: TrainConfig, scales: DataScales, model: ModelConfig) -> float:
    """The largest random shift of a scene. With half a cell's side, all positions within a cell are equally likely."""
    if config.shift is None:
        return min(model.cell_side / 2, LARGEST_SHIFT * model.data.domain_half_width)
    if not 0 <= config.shift < math.inf:
        raise ConfigError(f"train.shift is {config.shift}; it must be at least 0")
    if config.shift > scales.room:
        raise ConfigError(
            f"train.shift is {config.shift:g}, but a training scene is {scales.room:.3g} from the boundary of the"
            " domain, beyond which a model knows no place: take less than that"
        )
    return config.shift

"""Training: noisy frame pairs, a warm-up and a cosine, validation by rollout, checkpoints that resume bit for bit.

Everything random is a function of (seed, step): the order of the pairs and their noise by `PairSampler`, dropout by
seeding torch before each step. So weights, optimizer state and the step number are all that a checkpoint needs.
"""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import math
import os
import signal
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ast_sim import checkpoint
from ast_sim.config import override
from ast_sim.data.ahead import Ahead
from ast_sim.data.file import Dataset
from ast_sim.data.rollout_pool import RolloutPool
from ast_sim.data.sampling import PairSampler
from ast_sim.errors import CheckpointError, ConfigError, DatasetError, TrainingError
from ast_sim.measures import rmse_sequence
from ast_sim.models import build_model, find_preset
from ast_sim.monitor import Clock, Progress, StopSignals, duration
from ast_sim.optimizer import Optimizer
from ast_sim.processes import Processes
from ast_sim.profile import profile, table
from ast_sim.run import Metrics, RunConfig, TrainConfig, has_config, read_config, write_config
from ast_sim.schedule import DataScales, largest_error, learning_rate, measure, resolve_training, step_seed
from ast_sim.validation import validate

CONSTANT = 1e-3  # the output is constant if its standard deviation over nodes is below this share of the targets'


def configure(data: Path, preset: str, assignments: Sequence[str] = (), model: str = "ast") -> RunConfig:
    """The settings of a model's preset with `--set` assignments; what they leave to the data is filled in by `train`.

    What kind of dataset it is counts from the start, since it decides which inputs there can be.

    Raises:
        ConfigError: naming the nearest model, preset or key that there is, or an input that the dataset does not have.
        DatasetError: the dataset cannot be read.
    """
    chosen = find_preset(model, preset)
    with Dataset(data) as dataset:
        adapted = chosen.model.settings_for(dataset.info, dataset.material_width) if chosen.adapts else {}
        kind = [
            f"model.integration={dataset.info.integration}",
            f"model.stress={dataset.info.stress_location}",
            f"model.material_width={dataset.material_width}",
            *(f"model.{name}={value}" for name, value in adapted.items()),
        ]
    return override(RunConfig(chosen.model, TrainConfig(**chosen.train), str(data)), [*kind, *assignments])


def train(run: Path, config: RunConfig | None = None, resume: bool = False, profile_steps: int = 0) -> None:
    """Train a model in the run folder `run`, or go on with the one there.

    Args:
        config: the settings, as given; None takes those of the run that is resumed. With `resume` they must agree.
        resume: go on after the newest checkpoint, if there is one.
        profile_steps: print where the time of so many steps goes, instead of training; nothing of them is kept.

    Raises:
        TrainingError: a loss or gradient that is not finite, a full disk, a folder that holds a run already.
        ConfigError: settings that are out of range, or differ from those of the run that is resumed.
        CheckpointError: another process trains in this folder, or no checkpoint there can be read.
        SystemExit: SIGINT (130) or SIGTERM (143) came; the step was finished and a checkpoint written.
    """
    run = Path(run)
    try:
        run.mkdir(parents=True, exist_ok=True)
        with Processes() as processes, _lock(run, processes), StopSignals() as signals, _told_by_leader(processes):
            saved = processes.of_leader(read_config(run) if has_config(run) else None)
            if saved is not None and not resume:
                raise TrainingError(f"{run} already holds a run: go on with --resume, or choose another folder")
            if saved is None and config is None:
                raise TrainingError(f"{run} holds no run to resume: name the dataset to start one")
            with Dataset((config or saved).data) as dataset:
                scales = measure(dataset)
                resolved = resolve_run(config, dataset, scales) if config is not None else saved
                _require_equal_parts(resolved.train.batch_size, processes.count)
                if saved is not None:
                    _require_same(run, saved, resolved)
                elif processes.leads:
                    write_config(run, resolved)
                with Training(run, resolved, dataset, scales, signals, processes) as training:
                    if profile_steps:
                        training.profile(profile_steps)
                    else:
                        training.go()
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        advice = ": the last checkpoint is whole; make room, then go on with --resume" if full else ""
        raise TrainingError(f"{run}: {error}{advice}") from error


@contextmanager
def _lock(run: Path, processes: Processes) -> Iterator[None]:
    """The leading process keeps others out of the run folder; the rest learn whether it could."""
    with ExitStack() as held:
        error = None
        if processes.leads:
            try:
                held.enter_context(checkpoint.lock(run))
            except CheckpointError as refused:
                error = str(refused)
        error = processes.of_leader(error)
        if error is not None:
            raise CheckpointError(error)
        yield


@contextmanager
def _told_by_leader(processes: Processes) -> Iterator[None]:
    """What training tells comes from the leading process."""
    with ExitStack() as silent:
        if not processes.leads:
            nowhere = silent.enter_context(open(os.devnull, "w"))
            silent.enter_context(redirect_stdout(nowhere))
            silent.enter_context(redirect_stderr(nowhere))
        yield


def resolve_run(config: RunConfig, dataset: Dataset, scales: DataScales) -> RunConfig:
    """The settings with everything filled in that they leave to the data."""
    model = config.model.resolve(dataset.info, dataset.material_width, scales.spacing)
    training = resolve_training(config.train, scales, model)
    return RunConfig(model=model, train=training, data=str(Path(config.data).resolve()))


def _require_equal_parts(batch_size: int, processes: int) -> None:
    if batch_size % processes:
        raise ConfigError(f"train.batch_size = {batch_size} cannot be cut for {processes} processes")


def _require_same(run: Path, saved: RunConfig, asked: RunConfig) -> None:
    """Raise ConfigError naming the first setting that differs (the place of the data may)."""
    for part in ("model", "train"):
        old, new = getattr(saved, part), getattr(asked, part)
        for key in (field.name for field in dataclasses.fields(old)):
            if getattr(old, key) != getattr(new, key):
                raise ConfigError(
                    f"{run} was started with {part}.{key} = {getattr(old, key)!r}, not {getattr(new, key)!r}:"
                    " resume without settings, or train in another folder"
                )


def _under(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {prefix + key: value for key, value in tensors.items()}


def _without(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}


class Training:
    """The state of one training: model, optimizer, where it stands, and what it tells.

    `prepare`, then `advance` step by step is what `go` does, without records, checkpoints and validation. A context
    manager, since it draws batches in a thread.
    """

    def __init__(
        self,
        run: Path,
        config: RunConfig,
        dataset: Dataset,
        scales: DataScales,
        signals: StopSignals,
        processes: Processes | None = None,
    ) -> None:
        self.run, self.config, self.dataset, self.signals = run, config, dataset, signals
        self.options, self.processes = config.train, processes or Processes()
        torch.manual_seed(self.options.seed)
        self.model = build_model(config.model)
        self.sampler = self._sampler((self.processes.rank, self.processes.count))
        pooled, largest = self.options.rollout_pool, largest_error(scales, config.model)
        self.pool = RolloutPool(self.sampler, pooled, largest) if pooled else None
        self.ahead = Ahead(self.pool or self.sampler)
        self.optimizer = Optimizer(self.model, self.options.optimizer)
        self.metrics = Metrics(run)
        self.clock = Clock()
        self.step = 0
        self.fingerprint = self._fingerprint()
        self.sums: dict[str, float] = {}  # of the steps since the last line of metrics
        self.stopping = 0  # the signal that asks to stop, in any process
        self._introduce(scales)

    def __enter__(self) -> Training:
        return self

    def __exit__(self, *error: object) -> None:
        self.ahead.__exit__(*error)

    def _sampler(self, part: tuple[int, int]) -> PairSampler:
        return PairSampler(
            self.dataset,
            "train",
            batch_size=self.options.batch_size,
            seed=self.options.seed,
            noise=self.options.noise,
            make_graph=self.model.graph,
            dynamic=self.config.model.dynamic,
            gamma=self.options.noise_gamma,
            part=part,
            from_first=self.config.model.time_conditioned,
            mirror=self.options.mirror,
            shift=self.options.shift,
        )

    def _introduce(self, scales: DataScales) -> None:
        options = self.options
        epochs = options.steps * options.batch_size * options.accumulate / self.sampler.num_pairs
        rms, spacing = max(scales.increment, 1e-300), max(scales.spacing, 1e-300)
        unit = self.dataset.info.length_unit
        print(f"parameters  {sum(p.numel() for p in self.model.parameters()):,}")
        print(f"data        {scales.trajectories:,} scenes of about {scales.nodes:,} nodes, {scales.pairs:,} pairs")
        print(
            f"steps       {options.steps:,} of {options.batch_size * options.accumulate} scenes each:"
            f" {epochs:.3g} epochs"
        )
        print(
            f"noise       {options.noise:.3g} {unit} = {options.noise / rms:.2g} x rms increment"
            f" = {options.noise / spacing:.2g} x mesh spacing",
            flush=True,
        )
        for what, fact in self.config.model.facts(unit, spacing).items():
            print(f"{what.lower():12}{fact}", flush=True)

    def prepare(self) -> None:
        """Take up the newest checkpoint; without one, the statistics of the data."""
        self._restore()
        self.model.train()

    def profile(self, steps: int) -> None:
        """Print where the time of training steps goes."""
        self.prepare()
        print(table(profile(self.advance, steps)))

    def go(self) -> None:
        """Train from the newest checkpoint, or from the beginning, to the last step."""
        options = self.options
        self.prepare()
        with Progress(options.steps, self.step, "steps") as self.progress:
            validated = self.processes.of_leader(self.metrics.validated(self.step))
            if self.step and self._due(options.validate_every) and not validated:
                self._validate()
            self.clock = Clock()
            while self.step < options.steps:
                self.advance()
                self.progress.advance()
                if self._due(options.log_every):
                    self._log()
                validates = self._due(options.validate_every)
                self._heed_signals()
                if validates or self._due(options.checkpoint_every) or self.stopping:
                    self._save()
                self._stop_if_asked()
                self.clock.step()
                if validates:
                    self._validate()

    def _due(self, every: int) -> bool:
        return self.step % every == 0 or self.step == self.options.steps

    def _heed_signals(self) -> None:
        if self.processes.any(self.signals.received is not None):
            self.stopping = self.signals.received or signal.SIGTERM

    def _stop_if_asked(self) -> None:
        if self.stopping:
            self.progress.line(f"stopped after step {self.step:,}: go on with --resume")
            raise SystemExit(128 + self.stopping)

    def advance(self) -> None:
        """One optimizer step, on the gradients of `accumulate` batches."""
        options = self.options
        draw = self.step * self.processes.count + self.processes.rank
        torch.default_generator.manual_seed(step_seed(options.seed, draw))  # torch.manual_seed asks all devices
        self.optimizer.zero_gradient()
        names: list[str] = []
        values: dict[str, float] = {}
        for part in range(options.accumulate):
            number = self.step * options.accumulate + part
            batch, target = self.ahead.batch(number)
            try:
                prediction = self.model(batch)
            except DatasetError as error:
                raise DatasetError(f"{self.dataset.path}: in one of {', '.join(batch.names)}: {error}") from error
            losses = self.model.loss(prediction, batch, target, options.stress_weight, self.processes.share)
            found = self.processes.add(torch.stack([value.detach() for value in losses.values()]))
            whole = dict(zip(losses, found.tolist(), strict=True))
            if not math.isfinite(whole["loss"]):
                raise self._not_finite("loss", whole["loss"], batch.names)
            (losses["loss"] / options.accumulate).backward()
            if self.pool is not None:
                self.pool.advance(number, self.model.residual(prediction, batch, target))
            names += batch.names
            for key, value in whole.items():
                values[key] = values.get(key, 0.0) + value / options.accumulate
        self.processes.add(self.optimizer.gradient)
        norm = self.optimizer.clip(options.clip)
        if not math.isfinite(norm):
            raise self._not_finite("norm of the gradient", norm, names)
        self.optimizer.step(learning_rate(options, self.step))
        self.step += 1
        values |= {"grad_norm": norm, "clipped_share": float(norm > options.clip), "steps": 1}
        for key, value in values.items():
            self.sums[key] = self.sums.get(key, 0.0) + value

    def _not_finite(self, what: str, value: float, names: list[str]) -> TrainingError:
        names, last = self.processes.gathered(names), checkpoint.latest(self.run)
        kept = f"the last good checkpoint is {last}" if last else "there is no checkpoint yet"
        return TrainingError(
            f"the {what} of step {self.step + 1} is {value}, so the step was not taken: look at {', '.join(names)},"
            f" or train anew with a lower train.peak_rate ({self.options.peak_rate:.3g} here); {kept}"
        )

    def _log(self) -> None:
        count = self.sums.pop("steps")
        means = {key: value / count for key, value in self.sums.items()}
        self.sums = {}
        rate = learning_rate(self.options, self.step - 1)
        seconds = self.clock.seconds_per_step
        if self.processes.leads:
            self.metrics.append({"step": self.step, **means, "rate": rate, "seconds": seconds})
        stress = f", stress {means['stress']:.4f}" if "stress" in means else ""
        to_go = self.clock.to_go(self.options.steps - self.step, self._validations_to_go())
        self.progress.show(
            f"step {self.step:,}/{self.options.steps:,}: loss {means['loss']:.4f}, motion {means['motion']:.4f}"
            f"{stress}, {1000 * seconds:.1f} ms a step, {to_go} to go"
        )
        if means["spread"] < CONSTANT:
            # A decoder whose units all died gives every node the same output, and never recovers.
            self.progress.line(
                "warning: the predicted motion is the same at all nodes: the decoder is dead. Train anew with another"
                " train.seed, a lower train.peak_rate, or more train.noise"
            )

    def _validations_to_go(self) -> int:
        if not self.dataset.count("valid"):
            return 0
        every = self.options.validate_every
        return math.ceil(self.options.steps / every) - (self.step - 1) // every

    def _validate(self) -> None:
        """Roll out the validation scenes; the checkpoint of this step is the best if their error is the lowest."""
        count = min(self.dataset.count("valid"), self.options.validate_scenes)
        if count == 0:
            return
        self.ahead.wait()
        mine = range(self.processes.rank, count, self.processes.count)
        # Together processes end together: none may stop on its own.
        progress = self._stop_at_once if self.processes.count == 1 else None
        found = self.processes.gathered(validate(self.model, self.dataset, mine, progress))
        if not self.processes.leads:
            self.clock.validation()
            return
        record: dict[str, Any] = {"step": self.step}
        failure = next((result.failure for result in found if result.failure), None)
        if failure is None:
            found.sort(key=lambda result: result.index)
            error = rmse_sequence([result.error for result in found])
            hold = rmse_sequence([result.hold for result in found])
            record |= {"valid_rmse": error, "valid_hold_still": hold}
            best = error < self.metrics.best()
            if best:
                checkpoint.mark_best(self.run, self.step)
            share = f" = {error / hold:.2f} of hold still" if hold else ""
            unit = self.dataset.info.length_unit
            text = f"rollout error {error:.3g} {unit}{share}{', the best so far' if best else ''}"
        else:
            record |= {"valid_rmse": None, "failure": failure}
            text = f"rollout failed: {failure}"
        seconds = self.clock.validation()
        self.metrics.append({**record, "seconds": seconds})
        self.progress.line(f"validation after step {self.step:,}: {text} ({duration(seconds)})")

    def _stop_at_once(self, frame: int) -> None:
        self._heed_signals()
        self._stop_if_asked()

    def _save(self) -> None:
        rolling = self._rolling_scenes()
        if not self.processes.leads:
            return
        state = {"step": self.step, "sums": self.sums, "data": self.fingerprint}
        checkpoint.save(
            self.run,
            self.step,
            model=self.model.state_dict(),
            training={**_under("optimizer.", self.optimizer.state()), **_under("rollout_pool.", rolling)},
            state=state,
            keep=self.options.keep,
        )

    def _rolling_scenes(self) -> dict[str, Tensor]:
        """Where the scenes of the pool stand, of all processes."""
        if self.pool is None:
            return {}
        self.ahead.wait()
        return {key: value for part in self.processes.gathered([self.pool.state()]) for key, value in part.items()}

    def _restore(self) -> None:
        """The leading process finds where training stands; the others take it from there."""
        rolling = self._restore_alone() if self.processes.leads else {}
        self.step, self.sums = self.processes.of_leader((self.step, self.sums))
        self.processes.spread(self.model.state_dict().values())
        self.optimizer.restore(self.processes.of_leader(self.optimizer.state()))
        if self.pool is not None:
            self.pool.restore(self.processes.of_leader(rolling))

    def _restore_alone(self) -> dict[str, Tensor]:
        """Take up the newest checkpoint; returns where the scenes of the pool stood, of all processes."""
        path = checkpoint.latest(self.run)
        if path is None:
            self.metrics.forget_after(0)
            batches = range(math.ceil(self.options.statistics_pairs / self.options.batch_size))
            whole = self.sampler if self.processes.count == 1 else self._sampler((0, 1))
            self.model.fit_statistics(whole.batch(index) for index in batches)
            return {}
        weights, training, state = checkpoint.load(path)
        if state["data"] != self.fingerprint:
            raise TrainingError(
                f"{self.dataset.path} is not the dataset that {self.run} was trained on so far: bring that one back,"
                " or train in another folder"
            )
        self.model.load_state_dict(weights)
        self.optimizer.restore(_without("optimizer.", training))
        self.step, self.sums = state["step"], state["sums"]
        self.metrics.forget_after(self.step)
        print(f"going on after step {self.step:,}", flush=True)
        return _without("rollout_pool.", training)

    def _fingerprint(self) -> str:
        """Tells one dataset from another without reading it whole; recorded times and the file's place do not count."""
        digest = hashlib.sha256(repr((self.dataset.info, self.dataset.splits)).encode())
        for index in (0, self.dataset.count("train") - 1):
            position, _ = self.dataset.frames("train", index, 0, self.dataset.num_frames("train", index))
            digest.update(np.ascontiguousarray(position).tobytes())
        return digest.hexdigest()

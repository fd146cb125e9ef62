"""The training loop: it learns from pairs of frames, validates by rollouts and writes checkpoints.

All random numbers follow from the seed and the number of the step: `PairSampler` derives the order of the pairs and
their noise from them, and torch is seeded before each step for dropout. So a checkpoint needs only the weights, the
state of the optimizer, the pool of rollouts and the step, and a resumed training gives the same weights bit for bit.
"""

from __future__ import annotations

import math
import signal
from functools import partial

import torch

from ast_sim.batches.batch_builder import Batch, Target
from ast_sim.batches.pairs import PairSampler
from ast_sim.batches.prefetch import Ahead
from ast_sim.batches.training_corrections import JumpPool
from ast_sim.batches.training_pool import TrainingPool
from ast_sim.batches.training_rollouts import RolloutPool
from ast_sim.dataset.reader import Dataset
from ast_sim.models.node_inputs import with_proximity
from ast_sim.models.registry import build_model
from ast_sim.models.simulator import Simulator
from ast_sim.number_arrays import percent
from ast_sim.ops import products_in
from ast_sim.runs import checkpoint
from ast_sim.runs.folder import RunFolder
from ast_sim.runs.train_config import RunConfig, TrainConfig
from ast_sim.support.errors import RESUME, DatasetError, TrainingError
from ast_sim.support.progress import Clock, ShowProgress, duration
from ast_sim.support.stop_signals import Interrupted, StopSignals
from ast_sim.training.callbacks import Callback, Listener
from ast_sim.training.console import Console, StepLog, introduction
from ast_sim.training.data_lengths import DataScales, largest_error
from ast_sim.training.optimizer import Optimizer
from ast_sim.training.parallel.processes import Processes
from ast_sim.training.profile import profile, table
from ast_sim.training.rates import Schedule, step_seed
from ast_sim.training.resuming import Saver
from ast_sim.training.validation import Validated, error_share, validate, verdict

OFTEN = 16  # passes over the data, from which on little is gained (docs/log.md, 2026-11-26)
APART = 1.25  # error of validation scenes, relative to training scenes, above which the model knows its scenes by heart
JUMP_BATCHES = 64  # in the pool of jumps; with 8, steps learn less: the calls of a jump are alike


def sampler_of(model: Simulator, dataset: Dataset, options: TrainConfig, part: tuple[int, int] = (0, 1)) -> PairSampler:
    """The training pairs of a dataset, as the settings want them; `part` is (number, count) of the process."""
    return model.pairs(
        dataset,
        batch_size=options.batch_size,
        seed=options.seed,
        noise=options.noise,
        gamma=options.noise_gamma or 0.0,
        part=part,
        mirror=options.mirror,
        shift=options.shift,
        scenes=options.scenes,
    )


def fit_statistics(model: Simulator, sampler: PairSampler, options: TrainConfig) -> None:
    """Measure the statistics of inputs and outputs on the first batches of the training."""
    batches = range(math.ceil(options.statistics_pairs / options.batch_size))
    model.fit_statistics(sampler.batch(index) for index in batches)


class Training:
    """One training: its model, its optimizer and its step.

    `go` trains to the last step. A caller that wants no records, checkpoints and validations calls `prepare`, then
    `advance` for each step. This is a context manager, since a thread draws the batches.
    """

    def __init__(
        self,
        run: RunFolder,
        config: RunConfig,
        dataset: Dataset,
        scales: DataScales,
        signals: StopSignals,
        processes: Processes | None = None,
        callback: Callback | None = None,
        progress: ShowProgress = True,
    ) -> None:
        self.run = run
        self.config = config
        self.dataset = dataset
        self.scales = scales
        self.signals = signals
        self.options = config.train
        self.processes = processes or Processes()
        self.schedule = Schedule.of(config.train)
        torch.manual_seed(self.options.seed)
        self.model = build_model(config.model)
        part = self.processes.rank, self.processes.count
        self.sampler = sampler_of(self.model, dataset, self.options, part)
        self.pool = self._pool(largest_error(scales, config.model))
        self.ahead = Ahead(self.pool or self.sampler, partial(with_proximity, config.model))
        self.optimizer = Optimizer(self.model, self.options.optimizer)
        self.clock = Clock()
        self.listener = Listener(callback)
        self.log = StepLog(run.metrics, self.schedule, dataset, self.clock, self.listener)
        self.progress = Console(self.schedule.steps, signals, progress)
        self.saver = Saver(run, dataset, self.model, self.optimizer, self.pool, self.processes, self.progress.line)
        self.step = 0
        self.stopping = 0  # the number of a signal that some process has received; 0: no signal
        self.told = False  # whether the user knows that more scenes would help more than more steps

    def __enter__(self) -> Training:
        return self

    def __exit__(self, *error: object) -> None:
        self.ahead.__exit__(*error)

    def _pool(self, largest: float) -> TrainingPool | None:
        """The pool of scenes that go on from the model's own answers; None: each batch is a new draw."""
        options = self.options
        if self.config.model.scheme.jumps:
            return JumpPool(self.sampler, JUMP_BATCHES * options.batch_size, 1 + options.corrections, largest)
        return RolloutPool(self.sampler, options.rollout_pool, largest) if options.rollout_pool else None

    def prepare(self) -> None:
        """Restore the newest checkpoint. If there is none, take the weights of the run that this one starts from, or
        measure the statistics of the data."""
        restored = self.saver.restore()
        if restored is not None:
            self.step, self.log.sums = restored
        elif self.processes.leads and not self.saver.start():
            whole = self.sampler if self.processes.count == 1 else sampler_of(self.model, self.dataset, self.options)
            fit_statistics(self.model, whole, self.options)
            for line in self.model.remarks():
                self.progress.line(line)
        if self.processes.leads:
            self.log.metrics.forget_after(self.step)
            best = self.log.metrics.best()
            if best is not None and checkpoint.read_best(self.run.path) is None:
                self.run.mark_best(best)
        self.processes.spread(self.model.state_dict().values())
        self.model.train()

    def profile(self, steps: int) -> None:
        """Print how the time of a step divides between its parts, measured on `steps` steps."""
        self._introduce()
        self.prepare()
        print(table(profile(self.advance, steps)))

    def go(self) -> None:
        """Train from the newest checkpoint, or from the beginning, to the last step."""
        schedule = self.schedule
        self._introduce()
        self.prepare()
        with self.progress.begin(self.step):
            validated = self.processes.of_leader(self.log.metrics.validation(self.step) is not None)
            if self.step and self._due(schedule.validate_every) and not validated:
                self._validate()
                self._heed_callback()
                self._stop_if_requested()
            self.clock.restart()
            while self.step < schedule.steps:
                self.advance()
                self.progress.advance()
                if self._due(self.options.log_every):
                    self.log.show(self.step, self.progress, self.processes.leads)
                validates = self._due(schedule.validate_every)
                self._heed_signals()
                self._heed_callback()
                if validates or self._due(schedule.checkpoint_every) or self.stopping:
                    self.ahead.wait()
                    self.saver.save(self.step, self.log.sums, self.options.keep)
                self._stop_if_requested()
                self.clock.step()
                if validates:
                    self._validate()
                    self._heed_callback()
                    self._stop_if_requested()

    def _introduce(self) -> None:
        for line in introduction(self.model, self.config, self.dataset, self.scales, self.sampler.num_pairs):
            self.progress.line(line)

    def _due(self, every: int) -> bool:
        return self.step % every == 0 or self.step == self.schedule.steps

    def _heed_signals(self) -> None:
        if self.processes.any(self.signals.received is not None):
            self.stopping = self.signals.received or signal.SIGTERM

    def _heed_callback(self) -> None:
        if self.processes.any(self.listener.error is not None):
            self.stopping = signal.SIGTERM

    def _stop_if_requested(self) -> None:
        if self.stopping:
            self.progress.line(f"stopped after step {self.step:,}: {RESUME}")
            if self.listener.error is not None:
                raise self.listener.error
            raise Interrupted(self.stopping)

    def end_if_requested(self) -> None:
        """End a training that is only timed, if a signal asks for it."""
        self._heed_signals()
        if self.stopping:
            raise Interrupted(self.stopping)

    def advance(self) -> None:
        """One optimizer step with the mean gradient of `accumulate` batches."""
        options = self.options
        draw = self.step * self.processes.count + self.processes.rank
        torch.default_generator.manual_seed(step_seed(options.seed, draw))  # torch.manual_seed is slow: it seeds GPUs
        self.optimizer.zero_gradient()
        names: list[str] = []
        values: dict[str, float] = {}
        for part in range(options.accumulate):
            number = self.step * options.accumulate + part
            batch, target = self.ahead.batch(number)
            with products_in(options.precision):
                losses = self._add_gradient(number, batch, target)
            for key, value in losses.items():
                values[key] = values.get(key, 0.0) + value / options.accumulate
            names += batch.names
        self.processes.add(self.optimizer.gradient)
        norm = self.optimizer.clip(options.clip)
        if not math.isfinite(norm):
            raise self._not_finite("norm of the gradient", norm, names)
        self.optimizer.step(self.schedule.rate(self.step))
        self.step += 1
        self.log.add({**values, "grad_norm": norm, "clipped_share": float(norm > options.clip)})

    def _add_gradient(self, number: int, batch: Batch, target: Target) -> dict[str, float]:
        """Add the gradient of one batch; returns the losses of that batch, summed over all processes."""
        try:
            prediction = self.model(batch)
        except DatasetError as error:
            raise DatasetError(f"{self.dataset.path}: in one of {', '.join(batch.names)}: {error}") from error
        weights = None
        if self.pool is not None and self.pool.weighs:
            weights = self.pool.weights(number, self.processes.gathered(self.pool.errors(number, target)))
        options = self.options
        losses = self.model.loss(
            prediction,
            batch,
            target,
            options.stress_weight,
            self.processes.share,
            weights,
            options.strain_weight or 0.0,
        )
        added = self.processes.add(torch.stack([value.detach() for value in losses.values()]))
        whole = dict(zip(losses, added.tolist(), strict=True))
        if not math.isfinite(whole["loss"]):
            raise self._not_finite("loss", whole["loss"], batch.names)
        (losses["loss"] / options.accumulate).backward()
        if self.pool is not None:
            self.pool.advance(number, self.model.residual(prediction, batch, target))
        return whole

    def _not_finite(self, what: str, value: float, names: list[str]) -> TrainingError:
        names = self.processes.gathered(names)
        last = checkpoint.latest(self.run.path)
        kept = f"the last good checkpoint is {last}" if last else "there is no checkpoint yet"
        return TrainingError(
            f"the {what} of step {self.step + 1} is {value}, so training stopped before this step: check the samples"
            f" {', '.join(names)}, or start again with a train.peak_rate below {self.schedule.peak_rate:.3g}; {kept}"
        )

    def validated(self, split: str) -> list[Validated]:
        """The errors of the first scenes of a split, predicted by all processes together."""
        least = self.model.config.data.given_frames + 1
        scenes = self.dataset.with_frames(split, least)[: self.options.validate_scenes]
        self.ahead.wait()
        mine = scenes[self.processes.rank :: self.processes.count]
        # Several processes must stop together, so none of them may stop within its own validation.
        progress = self._stop_at_once if self.processes.count == 1 else False
        return self.processes.gathered(
            validate(
                self.model, self.dataset, split, mine, self.options.corrections, progress, efforts=split == "valid"
            )
        )

    def _validate(self) -> None:
        """Roll out the validation scenes; if their error is the lowest so far, mark the checkpoint of this step."""
        validated = self.validated("valid")
        if not validated:
            return
        self._compare_with_training_scenes(validated)
        seconds = self.clock.validation()
        if not self.processes.leads:
            return
        mark = checkpoint.read_best(self.run.path)
        best = math.inf if mark is None else mark.error
        if mark is not None and mark.step >= self.step:  # a resumed training repeats this step
            before = self.log.metrics.best()
            best = math.inf if before is None else before["valid_rmse"]
        outcome = verdict(validated, best, self.dataset.info.length_unit)
        record = {"step": self.step, **outcome.record, "seconds": seconds}
        better = outcome.error is not None and outcome.error < best
        if better:
            self.run.mark_best(record)
        self.log.metrics.append(record)
        self.listener.hear(self.step, {**outcome.record, "valid_seconds": seconds})
        self.progress.line(f"validation after step {self.step:,}: {outcome.text} ({duration(seconds)})")
        if better and mark is not None and "calibration" in mark.answers:
            self.progress.line(
                f"the calibration was of step {mark.step:,} and does not hold for this step, which is better: answers"
                " have no band until the run is calibrated again"
            )

    def _compare_with_training_scenes(self, validated: list[Validated]) -> None:
        """Say once that the training repeats its data in vain, if it does."""
        scenes = self.step * self.options.batch_size * self.options.accumulate
        passes = scenes / self.sampler.num_pairs
        if self.told or passes <= OFTEN:
            return
        known, unknown = error_share(self.validated("train")), error_share(validated)
        if known is not None and unknown is not None and unknown > APART * known:
            self.told = True
            self.progress.line(
                f"each pair of frames was seen {passes:.0f} times. The error is {percent(known)} of the displacement"
                f" on training scenes, {percent(unknown)} on validation scenes: more scenes help more than more"
                " steps"
            )

    def _stop_at_once(self, *_: object) -> None:
        self._heed_signals()
        self._stop_if_requested()

"""The lines that a training prints: an introduction, then its progress."""

from __future__ import annotations

import errno
import logging
import math
import signal
import sys
from collections.abc import Callable

from ast_sim.dataset.reader import Dataset
from ast_sim.models.simulator import FIELD, Simulator
from ast_sim.named_field import STRESS
from ast_sim.runs.metrics import Metrics
from ast_sim.runs.train_config import RunConfig
from ast_sim.support.progress import Clock, Progress, ShowProgress
from ast_sim.support.stop_signals import StopSignals
from ast_sim.training.callbacks import Listener
from ast_sim.training.data_lengths import DataScales
from ast_sim.training.rates import Schedule

# The output counts as constant if its standard deviation over the nodes, relative to the targets', is below this.
CONSTANT = 1e-3


def introduction(model: Simulator, config: RunConfig, dataset: Dataset, scales: DataScales, pairs: int) -> list[str]:
    """Lines with the sizes of the model and the data, the number of steps, and the noise relative to lengths of the
    data."""
    options = config.train
    unit = dataset.info.length_unit
    steps = Schedule.of(options).steps
    noise = options.noise or 0.0
    scenes = options.batch_size * options.accumulate
    epochs = steps * scenes / pairs
    rms, spacing = max(scales.increment, 1e-300), max(scales.spacing, 1e-300)
    used = f"{scales.trajectories:,}" if options.scenes is None else f"{options.scenes:,} of {scales.trajectories:,}"
    return [
        f"parameters  {model.num_parameters:,}",
        f"data        {used} scenes of about {scales.nodes:,} nodes, {pairs:,} pairs",
        f"steps       {steps:,} of {scenes} scenes each: {epochs:.3g} epochs",
        f"noise       {noise:.3g} {unit} = {noise / rms:.2g} x rms increment = {noise / spacing:.2g} x mesh spacing",
        *(f"{what.lower():12}{fact}" for what, fact in config.model.facts(unit, spacing).items()),
    ]


def _heard(method: Callable[..., None]) -> Callable[..., None]:
    """A method of `Progress` for `Console`."""

    def attempt(self: Console, *arguments: object) -> None:
        try:
            method(self, *arguments)
        except OSError as error:
            if error.errno not in (errno.EPIPE, errno.EIO) or not self.began:
                raise
            self.signals.received = self.signals.received or signal.SIGPIPE

    return attempt


class Console(Progress):
    """The progress of a training; where there is no bar, lines with the losses take its place. If nobody reads the
    output any more (a closed pipe, a lost terminal) once the steps have begun, the training stops as after the signal
    SIGPIPE."""

    bar_format = "{percentage:3.0f} % |{bar:24}| {n_fmt}/{total_fmt} {unit}{postfix}"

    def __init__(self, total: int, signals: StopSignals, progress: ShowProgress) -> None:
        super().__init__(total, "steps", progress)
        self.signals = signals
        self.began = False

    def begin(self, done: int) -> Console:
        """The steps begin; `done` steps were made before."""
        self.done = done
        self.began = True
        return self

    def show(self, text: str) -> None:
        """How the steps go: replace the text behind the bar, or show a line."""
        if self._bar is not None:
            self._bar.set_postfix_str(text)
        elif self.shown:
            self.print(text)
        self._report(text)

    def _report(self, text: str) -> None:
        """Give the caller's function a line that tells how the steps go."""
        if self._call is not None and self.began:
            self._call(self.done, self.total, text)

    def _line(self, text: str, level: int = logging.INFO) -> None:
        super().line(text, level)
        self._report(text)

    def print(self, text: str) -> None:
        """Show a line that stays, on the standard output."""
        if self._bar is not None:
            self._bar.write(text)
        else:
            print(text, flush=True)
        sys.stdout.flush()

    def _advance(self) -> None:
        super().advance(f"step {self.done + 1:,}")

    def _tell_count(self) -> None:
        """The lines of `show` tell it."""

    advance = _heard(_advance)
    show = _heard(show)
    line = _heard(_line)
    __exit__ = _heard(Progress.__exit__)


class StepLog:
    """Averages the losses over several steps, writes the means to `metrics.jsonl` and shows them.

    Attributes:
        sums: sums of the values of all steps since the last line; a checkpoint keeps them.
    """

    def __init__(
        self, metrics: Metrics, schedule: Schedule, dataset: Dataset, clock: Clock, listener: Listener
    ) -> None:
        self.metrics = metrics
        self.schedule = schedule
        self.clock = clock
        self.listener = listener
        self.validates = dataset.count("valid") > 0
        self.sums: dict[str, float] = {}

    def add(self, values: dict[str, float]) -> None:
        """Add the values of one step."""
        for key, value in {**values, "steps": 1}.items():
            self.sums[key] = self.sums.get(key, 0.0) + value

    def show(self, step: int, progress: Console, writes: bool) -> None:
        """Show the means, and write them to `metrics.jsonl` if this process writes."""
        count = self.sums.pop("steps")
        means = {key: value / count for key, value in self.sums.items()}
        self.sums = {}
        seconds = self.clock.seconds_per_step
        if writes:
            record = {**means, "rate": self.schedule.rate(step - 1), "seconds": seconds}
            self.metrics.append({"step": step, **record})
            self.listener.hear(step, record)
        shown = {key.removeprefix(FIELD): mean for key, mean in means.items() if key == STRESS or key.startswith(FIELD)}
        fields = "".join(f", {name} {mean:.4f}" for name, mean in shown.items())
        to_go = self.clock.to_go(self.schedule.steps - step, self._validations_to_go(step))
        progress.show(
            f"step {step:,}/{self.schedule.steps:,}: loss {means['loss']:.4f}, motion {means['motion']:.4f}"
            f"{fields}, {1000 * seconds:.1f} ms a step, {to_go} to go"
        )
        if means["spread"] < CONSTANT:
            # If all units of the decoder are dead, it gives every node the same output and never recovers.
            progress.line(
                "warning: the predicted motion is the same at all nodes: the decoder is dead. Start again with another"
                " train.seed, a lower train.peak_rate or a higher train.noise",
                logging.WARNING,
            )

    def _validations_to_go(self, step: int) -> int:
        every = self.schedule.validate_every
        return math.ceil(self.schedule.steps / every) - (step - 1) // every if self.validates else 0

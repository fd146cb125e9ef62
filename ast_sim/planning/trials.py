"""Short trainings of several settings, of which the better ones are trained longer: successive halving.

Each trial is a whole training: its learning rate falls to zero at its end (Jamieson and Talwalkar 2016). Trials that
are compared take equal minutes. Each one is a run in a folder, so a plan that was stopped goes on where it was.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ast_sim.runs.config_toml import has_config
from ast_sim.runs.folder import RunFolder
from ast_sim.runs.train_config import RunConfig
from ast_sim.support.argument_checks import file_name
from ast_sim.support.errors import RESUME, ConfigError, TrainingError, counted
from ast_sim.support.progress import Progress
from ast_sim.training.callbacks import Callback
from ast_sim.training.start import start_training

GROWTH = 3  # steps of a trial, as a multiple of a trial's steps in the round before
ROUNDS = 3
LONGEST = 1 / 6  # of the minutes of the training that is planned, for a trial of the last round
RATES = {"": 1.0, ", half the rate": 0.5, ", twice the rate": 2.0}
WIDER = 1.5  # times the width of the preset
WIDTHS = ("hidden", "decoder_hidden", "d_token", "heads", "ffn_inner")  # settings of models that a width consists of
MINUTES = (1e-3, 1e7)  # that a training may take
TIMED = 50  # steps whose time tells how many fit into a trial
FEW = 10  # steps that are enough to know that not half of `LEAST` will fit
LEAST = 20  # steps of a trial of the first round: from fewer nothing is learnt
VALIDATION_SCENES = 40  # at most, of a trial


@dataclass(frozen=True)
class Trial:
    """A short training.

    Attributes:
        name: of its settings, such as "tiny, twice the rate".
        steps, scenes: how long it was, and on how many training scenes.
        seconds: of a step.
        error: of the network alone on validation scenes, relative to their displacement.
        run: the name of its run folder.
    """

    name: str
    steps: int
    scenes: int
    seconds: float
    error: float
    run: str


def candidates(base: RunConfig, preset: str) -> dict[str, RunConfig]:
    """The settings that are tried, by name: three learning rates, and a wider model."""
    rate = base.train.peak_rate
    assert rate is not None  # a plan requires one
    tried = {
        preset + name: dataclasses.replace(base, train=dataclasses.replace(base.train, peak_rate=factor * rate))
        for name, factor in RATES.items()
    }
    widths = {name: getattr(base.model, name) for name in WIDTHS if isinstance(getattr(base.model, name, None), int)}
    wider: dict[str, Any] = {name: int(WIDER * width) for name, width in widths.items()}
    with suppress(ConfigError):  # there is no model of this width
        if wider:
            tried[f"{preset}, wider"] = dataclasses.replace(base, model=dataclasses.replace(base.model, **wider))
    return tried


def counted_minutes(minutes: float) -> str:
    """How many minutes there are, such as "1 minute is"."""
    return "1 minute is" if minutes == 1 else f"{minutes:g} minutes are"


def round_sizes(candidates: int) -> list[int]:
    """The number of trials in each round: the better half goes on."""
    sizes = [candidates]
    while len(sizes) < ROUNDS:
        sizes.append(max(1, sizes[-1] // 2))
    return sizes


class _TooSlow(Exception):
    """Steps of which far too few fit into a trial; its argument is the seconds of one."""


@contextmanager
def told_if_stopped(folder: Path, progress: Progress) -> Iterator[None]:
    """Within the block an interruption is told, with what goes on from there."""
    try:
        yield
    except KeyboardInterrupt:
        progress.line(f"stopped: the same call goes on with the trials that are in {folder}")
        raise


def trial_folder(out: str | os.PathLike[str]) -> Path:
    """The folder for trials; a ConfigError if it holds a run itself."""
    folder = file_name(out, "out")
    if has_config(folder):
        raise ConfigError(f"{folder} holds a run: choose another folder, in which the trials are made")
    return folder


class Trials:
    """Trains candidates in a folder; what is there already is not trained again.

    Args:
        folder: for the runs.
        scenes, valid: the numbers of training and validation scenes.
    """

    def __init__(self, folder: Path, scenes: int, valid: int) -> None:
        self.folder = folder
        self.scenes = scenes
        self.valid = min(valid, VALIDATION_SCENES)

    def trained(
        self, name: str, config: RunConfig, steps: int, scenes: int | None = None, callback: Callback | None = None
    ) -> Trial:
        """Train a candidate for `steps` steps, on all training scenes or on the first ones; `callback` as for `train`.

        Raises:
            TrainingError: the validation failed, or as `start_training`.
        """
        options = dataclasses.replace(
            config.train,
            steps=steps,
            minutes=None,
            scenes=scenes or config.train.scenes,
            warmup=None,
            decay=None,
            validate_every=steps,
            validate_scenes=self.valid,
            checkpoint_every=steps,
            log_every=max(1, steps // 10),
        )
        about = f"{name}, {counted(steps, 'step')}" + (f", {counted(scenes, 'scene')}" if scenes else "")
        folder = self.folder / about.replace(", ", "_").replace(" ", "-")
        changed = dataclasses.replace(config, train=options)
        try:
            start_training(folder, changed, resume=True, callback=callback, progress=False)
        except TrainingError as error:  # a plan always resumes
            raise TrainingError(str(error).replace(RESUME, "plan again in the same folder")) from error
        metrics = RunFolder(folder).metrics
        record, seconds = metrics.validation(steps), metrics.seconds_per_step()
        if record is None or record["valid_rmse"] is None or seconds is None:
            why = "it was not validated" if record is None else record.get("failure")
            raise TrainingError(f"the trial {about} has no error: {why}; see {folder}")
        if not record["valid_hold_still"]:
            raise TrainingError(f"the trial {about} has no error: nothing moves in its validation scenes; see {folder}")
        error = record["valid_rmse"] / record["valid_hold_still"]
        return Trial(name, steps, scenes or self.scenes, seconds, error, folder.name)

    def first_steps(self, tried: dict[str, RunConfig], minutes: float) -> dict[str, int]:
        """The steps of each candidate in the first round; a few steps are timed.

        Args:
            minutes: the length of the planned training.

        Raises:
            ConfigError: the trials would be too short.
        """
        seconds: dict[str, float] = {}
        first = 60 * minutes * LONGEST / GROWTH ** (ROUNDS - 1)
        for name, config in tried.items():  # a learning rate does not matter
            alike = next((other for other in seconds if tried[other].model == config.model), None)
            seconds[name] = self._step_seconds(name, config, first) if alike is None else seconds[alike]
        steps = {name: int(first / seconds[name]) for name in tried}
        if min(steps.values()) < LEAST:
            least = minutes * LEAST * max(seconds.values()) / first
            raise ConfigError(
                f"{counted_minutes(minutes)} too few to plan: the first trials would have"
                f" {counted(min(steps.values()), 'step')};"
                f" plan for {least:.2g} minutes or more, or train at once"
            )
        return steps

    def _step_seconds(self, name: str, config: RunConfig, first: float) -> float:
        """The seconds of a step; fewer steps are timed if they show that a trial of `first` seconds is too short."""

        def heed(step: int, figures: Mapping[str, float]) -> None:
            if step >= FEW and LEAST * figures.get("seconds", 0) > 2 * first:
                raise _TooSlow(figures["seconds"])

        try:
            return self.trained(name, config, TIMED, callback=heed).seconds
        except _TooSlow as few:
            return few.args[0]

    def rounds(self, tried: dict[str, RunConfig], steps: dict[str, int]) -> Iterator[Trial]:
        """The trials of all rounds, each after it was trained; the last one is of the best candidate.

        Args:
            steps: of each candidate in the first round.
        """
        order = list(tried)
        for number, size in enumerate(round_sizes(len(tried))):
            made = []
            for name in order[:size]:
                made.append(self.trained(name, tried[name], steps[name] * GROWTH**number))
                yield made[-1]
            order = [trial.name for trial in sorted(made, key=lambda trial: trial.error)]

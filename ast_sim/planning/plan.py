"""A plan of a training: the settings to take, the error to expect, and what would lower it further."""

from __future__ import annotations

import dataclasses
import math
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any

from ast_sim.batches.frame_pairs import target_counts
from ast_sim.dataset.reader import Dataset
from ast_sim.number_arrays import measured_time, percent
from ast_sim.planning.forecast import Forecast, forecast
from ast_sim.planning.trials import (
    GROWTH,
    LONGEST,
    MINUTES,
    Trial,
    Trials,
    candidates,
    round_sizes,
    told_if_stopped,
    trial_folder,
)
from ast_sim.runs.config_toml import write_settings
from ast_sim.runs.train_config import RunConfig
from ast_sim.support.argument_checks import file_name, require_type
from ast_sim.support.disk import write_json
from ast_sim.support.errors import ConfigError, counted
from ast_sim.support.progress import Progress, ShowProgress, duration
from ast_sim.support.provenance import provenance
from ast_sim.support.toml_settings import require_range
from ast_sim.training.configure import changes_of, configure, differences, path_of
from ast_sim.training.parallel.launch import usual_processes

SETTINGS, FIGURES = "best.toml", "plan.json"
LEAST_SCENES = 4  # of the training split: a trial has half of them


@dataclass(frozen=True)
class Plan:
    """What short trials say of a training. `str` gives what follows, in sentences.

    Attributes:
        minutes, steps: the length of the planned training; the steps follow from the longest trial.
        trials: in the order in which they were made; the last one has half of the training scenes, the one before it is
            the longest of the best settings.
        settings: of the training, by dotted key, where they differ from the given ones.
        expected: the error of the network alone on validation scenes, relative to their displacement; None if the
            longest trial was no better than the one before.
        passes: how often the training will see each of its frames.
        more_minutes, more_scenes: the share of the error that twice the minutes and twice the scenes leave, as the
            trials saw it.
        command: what trains.
        origin: command, commit and processor.
    """

    minutes: float
    steps: int
    trials: tuple[Trial, ...]
    settings: Mapping[str, Any]
    expected: Forecast | None
    passes: float
    more_minutes: float
    more_scenes: float
    command: str
    origin: Mapping[str, Any]

    def __str__(self) -> str:
        longest = self.trials[-2]
        minutes = self.more_minutes
        scenes = self.more_scenes
        return "\n".join([
            f"take: {longest.name}",
            f"{duration(60 * self.minutes)} are {self.steps:,} steps of {measured_time(longest.seconds)}; each frame is"
            f" seen {self.passes:.2g} times",
            self._expectation(),
            f"in the trials, twice the steps leave {percent(minutes)} of the error, twice the scenes"
            f" {percent(scenes)}: more {'minutes' if minutes < scenes else 'scenes'} help more",
            self.command,
        ])  # fmt: skip

    def _expectation(self) -> str:
        if self.expected is None:
            own = [trial for trial in self.trials[:-1] if trial.name == self.trials[-2].name]
            left = [f"{trial.steps:,} steps left {percent(trial.error)}" for trial in own[-2:]]
            return f"no forecast of the error: {', '.join(left)}; plan with more minutes or more validation scenes"
        error, low, high = map(percent, self.expected)
        return f"expected error of one call of the network: {error} of the displacement ({low} to {high})"

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all figures as JSON."""
        write_json(file_name(path, "path"), dataclasses.asdict(self))


def plan(
    data: str | os.PathLike[str] | Dataset,
    out: str | os.PathLike[str],
    minutes: float,
    *,
    model: str | None = None,
    preset: str | None = None,
    state: Sequence[str] = (),
    model_settings: Mapping[str, Any] | None = None,
    progress: ShowProgress = True,
    **settings: Any,
) -> Plan:
    """Find good settings for a training of `minutes` minutes by short trials, and say what it will give. The trials
    take about half of the minutes; each is a run in a folder, and a second call goes on with what is there.

    Three learning rates and a wider model are tried. All trials are judged by the network alone, on validation scenes.

    Args:
        data: the dataset file, or the open dataset.
        out: folder for the trials, the figures (`plan.json`) and the settings to train with (`best.toml`).
        minutes: the length of the planned training.
        model, preset, state, model_settings, settings: as for `train`, without `minutes` and `steps`.
        progress: True: a line for each trial, on a terminal a bar; False: nothing is written, but the lines go to the
            logger "ast_sim"; or a function of (trials done, all trials, which one).

    Raises:
        ConfigError: the minutes are too few to plan, the dataset has too few scenes or no validation scenes, or as for
            `train`.
        TrainingError: the validation of a trial failed, or as for `train`.
        DatasetError: the dataset cannot be read.
    """
    config = configure(path_of(data), preset, (), model, changes=changes_of(state, model_settings, settings))
    return planned(config, file_name(out, "out"), minutes, preset or "tiny", progress=progress)


def planned(
    config: RunConfig,
    out: Path,
    minutes: float,
    preset: str = "tiny",
    command: str = "ast_sim.plan",
    progress: ShowProgress = True,
) -> Plan:
    """`plan` for settings as `train` has them."""
    require_type("minutes", minutes, Real, "a number")
    require_range("minutes", minutes, *MINUTES)
    out = trial_folder(out)
    _require_open(config)
    scenes, valid, pairs = _counted(config)
    config = _with_processes(config, minutes)
    trials = Trials(out, scenes, valid)
    tried = candidates(config, preset)
    made: list[Trial] = []
    sizes = round_sizes(len(tried))
    # As many of the longest trial; one more of them has half of the scenes.
    in_longest = 1 + sum(size / GROWTH**later for later, size in enumerate(reversed(sizes)))
    with Progress(sum(sizes) + 1, "trials", progress) as bar, told_if_stopped(out, bar):
        bar.line(f"the trials take about {duration(60 * minutes * LONGEST * in_longest)}")
        for trial in trials.rounds(tried, trials.first_steps(tried, minutes)):
            made.append(trial)
            _tell(trial, bar)
        longest = made[-1]
        best = tried[longest.name]
        half = trials.trained(longest.name, best, longest.steps, scenes // 2)
        _tell(half, bar)
    own = [(trial.steps, trial.error) for trial in made if trial.name == longest.name]
    steps = int(60 * minutes / longest.seconds)
    batch = best.train.batch_size * best.train.accumulate
    settings = out / SETTINGS
    write_settings(settings, dataclasses.replace(best, train=dataclasses.replace(best.train, minutes=minutes)))
    result = Plan(
        minutes=minutes,
        steps=steps,
        trials=(*made, half),
        settings={key: new for key, _, new in differences(config, best, "model", "train")},
        expected=forecast(own, steps),
        passes=steps * batch / pairs,
        more_minutes=(own[-1][1] / own[-2][1]) ** (math.log(2) / math.log(GROWTH)),
        more_scenes=longest.error / half.error,
        command=shlex.join(["ast-sim", "train", config.data, "--config", str(settings), "--out", "RUN"]),
        origin=provenance(command),
    )
    result.save(out / FIGURES)
    return result


def _require_open(config: RunConfig) -> None:
    """Raise ConfigError if a setting that the plan chooses is given, or one that it varies is not."""
    for key in ("steps", "minutes"):
        if getattr(config.train, key) is not None:
            raise ConfigError(f"train.{key} is given, but it follows from the minutes of the plan: leave it out")
    if config.train.peak_rate is None:
        raise ConfigError("train.peak_rate is unset; a plan tries half of it and twice as much: give one")


def _with_processes(config: RunConfig, minutes: float) -> RunConfig:
    """The settings with the processes of the whole training: a trial alone would take fewer."""
    if config.train.processes is not None:
        return config
    whole = dataclasses.replace(config, train=dataclasses.replace(config.train, minutes=minutes))
    return dataclasses.replace(config, train=dataclasses.replace(config.train, processes=usual_processes(whole)))


def _counted(config: RunConfig) -> tuple[int, int, int]:
    """The training scenes, the validation scenes and the training pairs of a dataset.

    Raises:
        ConfigError: they are too few for trials.
    """
    with Dataset(config.data) as dataset:
        require_range("train.scenes", config.train.scenes, 1)
        scenes = config.train.scenes or dataset.count("train")
        valid = dataset.count("valid")
        if scenes < LEAST_SCENES:
            raise ConfigError(
                f"{dataset.path} has {counted(scenes, 'training scene')}; a plan needs {LEAST_SCENES} or more"
            )
        if valid == 0:
            raise ConfigError(f"{dataset.path} has no validation scenes, on which a plan judges its trials")
        return scenes, valid, sum(target_counts(dataset, "train")[:scenes])


def _tell(trial: Trial, bar: Progress) -> None:
    text = (
        f"{trial.name}: {counted(trial.steps, 'step')}, {counted(trial.scenes, 'scene')}, error {percent(trial.error)}"
    )
    bar.line(text)
    bar.advance(text)

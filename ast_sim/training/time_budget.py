"""The number of steps that fits into the minutes that a training may take."""

from __future__ import annotations

import statistics
import time

from ast_sim.support.errors import ConfigError, counted
from ast_sim.support.progress import duration
from ast_sim.training.loop import Training, fit_statistics

WARM_UP, TIMED = 3, 50  # steps that are made without a clock, since they fill caches; then steps whose median counts
LARGEST_SHARE = 0.1  # of the minutes: so long steps are timed at most
VALIDATIONS = 10  # of a training whose setting `validate_every` is unset
UNKNOWN_STEPS = 1_000_000  # of a training that is only timed


def steps_within(minutes: float, training: Training) -> int:
    """The number of steps of a training that takes this long with its validations, on this machine as busy as it is.

    The training is only timed: its weights are of no use afterwards. All processes get the number of the leading one.

    Raises:
        ConfigError: not one step fits.
    """
    fit_statistics(training.model, training.sampler, training.options)
    training.model.train()
    step = _seconds_per_step(training, LARGEST_SHARE * 60 * minutes)
    began = time.perf_counter()
    training.validated("valid")
    validation = time.perf_counter() - began
    count = int((60 * minutes - VALIDATIONS * validation) / step)
    count = training.processes.of_leader(count)
    text = f"a step takes {1000 * step:.1f} ms, a validation {duration(validation)}"
    if count < 1:
        raise ConfigError(f"train.minutes is {minutes:g}, too few for one step: {text}")
    training.progress.line(f"{minutes:g} min     {counted(count, 'step')}, since {text}")
    return count


def _seconds_per_step(training: Training, most: float) -> float:
    seconds: list[float] = []
    began = time.perf_counter()
    while len(seconds) < WARM_UP + TIMED:
        start = time.perf_counter()
        training.advance()
        training.end_if_requested()
        seconds.append(time.perf_counter() - start)
        late = time.perf_counter() - began > most and len(seconds) > WARM_UP
        if training.processes.any(late):
            break
    return statistics.median(seconds[WARM_UP:])

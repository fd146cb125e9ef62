"""Long computations: how they show their progress and the remaining time.

A function that may take long has the argument `progress`:

    True          a bar on a terminal, a line every ten seconds elsewhere; nothing in the first second
    False         nothing
    a function    it is called with (done, total, text), where the text says what was done or how it goes

Lines that tell more than how far the work is go to the logger "ast_sim", and where `progress` is True they are shown.
"""

from __future__ import annotations

import logging
import sys
import time
from collections import deque
from collections.abc import Callable
from typing import Self

from tqdm import tqdm

from ast_sim.support.argument_checks import require_function

ShowProgress = bool | Callable[[int, int, str], None]

LOG = logging.getLogger("ast_sim")
LOG.addHandler(logging.NullHandler())  # the user decides whether it is shown

SECONDS_BETWEEN_LINES = 10.0
SECONDS_BEFORE_BAR = 1.0


def duration(seconds: float) -> str:
    """Seconds as text: 42 s, 3 min 05 s, 2 h 10 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


class Clock:
    """Estimates the remaining time of a training from the times of its recent steps and validations.

    The time of a step is the time between two calls of `step`, with logging and checkpoints, without validations.
    """

    WINDOW = 200  # steps that count as recent

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget all measured times and measure from now on."""
        self._steps: deque[float] = deque(maxlen=self.WINDOW)
        self._validations: deque[float] = deque(maxlen=3)
        self._mark = time.perf_counter()

    def step(self) -> None:
        """Count the time since the last call as a step."""
        self._steps.append(self._lap())

    def validation(self) -> float:
        """Count the time since the last call as a validation; returns its seconds."""
        self._validations.append(self._lap())
        return self._validations[-1]

    def _lap(self) -> float:
        before = self._mark
        self._mark = time.perf_counter()
        return self._mark - before

    @property
    def seconds_per_step(self) -> float:
        return sum(self._steps) / max(len(self._steps), 1)

    def to_go(self, steps: int, validations: int) -> str:
        """The time for this many steps and validations; it says "at least" until one validation has been measured."""
        seconds = steps * self.seconds_per_step
        if not validations:
            return duration(seconds)
        if not self._validations:
            return f"at least {duration(seconds)}"
        return duration(seconds + validations * sum(self._validations) / len(self._validations))


def require_progress(progress: object) -> None:
    """Raise ConfigError unless `progress` says how progress is shown; long works check it before they begin."""
    if not isinstance(progress, bool):
        require_function("progress", progress, 0, 1, "", what="True, False or a function of (done, total, text)")


class Progress:
    """Counts up to `total`; a context manager, which begins the count.

    Args:
        unit: what is counted, such as "scenes".
        progress: how it is shown, see above.
        done: the number that was made before; rate and time to go do not count these.

    Raises:
        ConfigError: `progress` is neither True, False nor a function.
    """

    bar_format: str | None = None  # of tqdm

    def __init__(self, total: int, unit: str, progress: ShowProgress, done: int = 0) -> None:
        require_progress(progress)
        self.total = total
        self.unit = unit
        self.done = done
        self.shown = progress is True
        self._call = None if isinstance(progress, bool) else progress
        self._bar: tqdm | None = None

    def __enter__(self) -> Self:
        self._before = self.done
        self._started = time.monotonic()
        self._last_line = self._started
        if self.shown and sys.stderr.isatty():
            self._bar = tqdm(
                total=self.total,
                initial=self.done,
                unit=f" {self.unit}",
                bar_format=self.bar_format,
                delay=SECONDS_BEFORE_BAR,
                dynamic_ncols=True,
                smoothing=0,
            )
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def advance(self, text: str = "", count: int = 1) -> None:
        """`count` more are done; the text says what was."""
        self.done += count
        if self._bar is not None:
            self._bar.update(count)
        elif self._call is not None:
            self._call(self.done, self.total, text)
        elif self.shown:
            self._tell_count()

    def line(self, text: str, level: int = logging.INFO) -> None:
        """Tell what is no progress."""
        LOG.log(level, text)
        if self.shown:
            self.print(text)

    def print(self, text: str) -> None:
        """Show a line that stays, without disturbing the bar."""
        if self._bar is not None:
            self._bar.write(text, file=sys.stderr)
        else:
            print(text, file=sys.stderr, flush=True)

    def _tell_count(self) -> None:
        """Now and then, and at the end of long work, show a line that says how far it is."""
        now = time.monotonic()
        since = self._started if self.done == self.total else self._last_line
        if now - since < SECONDS_BETWEEN_LINES:
            return
        self._last_line = now
        rate = (self.done - self._before) / max(now - self._started, 1e-9)
        left = duration((self.total - self.done) / rate)
        speed = f"{rate:.3g}/s" if rate >= 1 else f"{duration(1 / rate)} each"
        self.print(f"{self.done} of {self.total} {self.unit}, {speed}, {left} to go")


class Patience:
    """Tells what takes long within one step of a progress: a line whenever `QUIET` seconds have passed without one."""

    QUIET = SECONDS_BETWEEN_LINES

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._told = time.perf_counter()

    def tell(self, text: str) -> None:
        """Tell the text, if it is time to."""
        if time.perf_counter() - self._told >= self.QUIET:
            self._progress.line(text)
            self._told = time.perf_counter()

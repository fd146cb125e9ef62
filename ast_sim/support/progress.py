"""Long computations: how they show their progress and the remaining time."""

from __future__ import annotations

import sys
import time
from collections import deque
from typing import Self

from tqdm import tqdm


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


class Patience:
    """Tells on stderr what takes long: a line whenever `QUIET` seconds have passed without one."""

    QUIET = 10.0

    def __init__(self) -> None:
        self._told = time.perf_counter()

    def tell(self, text: str) -> None:
        """Print the text, if it is time to."""
        if time.perf_counter() - self._told >= self.QUIET:
            tqdm.write(text, file=sys.stderr)
            self._told = time.perf_counter()


class Progress:
    """Shows progress: as a bar on a terminal, as plain lines elsewhere."""

    def __init__(self, total: int, done: int, unit: str) -> None:
        layout = "{percentage:3.0f} % |{bar:24}| {n_fmt}/{total_fmt} {unit}{postfix}"
        self._bar = tqdm(
            total=total, initial=done, unit=unit, bar_format=layout, disable=not sys.stderr.isatty(), dynamic_ncols=True
        )

    def advance(self) -> None:
        self._bar.update()

    def show(self, text: str) -> None:
        """Replace the text behind the bar; without a bar print a line."""
        if self._bar.disable:
            self.line(text)
        else:
            self._bar.set_postfix_str(text)

    def line(self, text: str) -> None:
        """Print a line that stays."""
        self._bar.write(text)
        sys.stdout.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

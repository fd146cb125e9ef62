"""What one sees of a long computation, and how one stops it: progress with the time to go, and signals."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections import deque
from types import FrameType, TracebackType
from typing import Self

from tqdm import tqdm


def duration(seconds: float) -> str:
    """Seconds as people read them: 42 s, 3 min 05 s, 2 h 10 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


class Clock:
    """Estimates the time to go from recent steps and validations as they were measured.

    A step's time is everything between two calls of `step` (logging and checkpoints included) but validations.
    """

    WINDOW = 200  # steps that count as recent

    def __init__(self) -> None:
        self._steps: deque[float] = deque(maxlen=self.WINDOW)
        self._validations: deque[float] = deque(maxlen=3)
        self._mark = time.perf_counter()

    def step(self) -> None:
        now = time.perf_counter()
        self._steps.append(now - self._mark)
        self._mark = now

    def validation(self) -> float:
        """Count the time since the last call of `step` as a validation; returns it."""
        now = time.perf_counter()
        seconds = now - self._mark
        self._validations.append(seconds)
        self._mark = now
        return seconds

    @property
    def seconds_per_step(self) -> float:
        return sum(self._steps) / max(len(self._steps), 1)

    def to_go(self, steps: int, validations: int) -> str:
        """The time that so many steps and validations take; "at least" until a validation has been measured."""
        seconds = steps * self.seconds_per_step
        if not validations:
            return duration(seconds)
        if not self._validations:
            return f"at least {duration(seconds)}"
        return duration(seconds + validations * sum(self._validations) / len(self._validations))


class Progress:
    """A bar on a terminal, plain lines elsewhere."""

    def __init__(self, total: int, done: int, unit: str) -> None:
        layout = "{percentage:3.0f} % |{bar:24}| {n_fmt}/{total_fmt} {unit}{postfix}"
        self._bar = tqdm(
            total=total, initial=done, unit=unit, bar_format=layout, disable=not sys.stderr.isatty(), dynamic_ncols=True
        )

    def advance(self) -> None:
        self._bar.update()

    def show(self, text: str) -> None:
        """Replace what stands behind the bar, or print it as a line."""
        if self._bar.disable:
            print(text, flush=True)
        else:
            self._bar.set_postfix_str(text)

    def line(self, text: str) -> None:
        """Print a line that stays."""
        if self._bar.disable:
            print(text, flush=True)
        else:
            self._bar.write(text)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()


class StopSignals:
    """Within the `with` block SIGINT and SIGTERM are noted in `received` rather than ending the process.

    A second signal acts as it would have outside. In threads other than the main one, signals are left alone.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._previous: dict[int, object] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._note)
        return self

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.received = number
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        self._restore()

"""Progress of a long count in which each unit takes long, too: a tqdm bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from typing import Self

from tqdm import tqdm

from ast_sim.support.progress import duration

SECONDS_BETWEEN_LINES = 10.0
SECONDS_OF_SILENCE = 30.0  # after this time without a line, unfinished units report how far they are
MOST_INSIDE = 8  # at most this many units report at once


@dataclass
class Inside:
    """How far one unit is. An earlier run may have made the first frames; those took no time in this run."""

    started: float
    first: int | None = None
    frame: int = 0
    frames: int = 0
    iterations: int = 0

    def text(self, now: float) -> str:
        """Frames, Newton iterations, time so far, and time to go. The mean time of a frame so far predicts the time to
        go.
        """
        elapsed = now - self.started
        if self.first is None:
            return f"{duration(elapsed)} so far"
        text = f"frame {self.frame} of {self.frames}, {self.iterations} iterations, {duration(elapsed)} so far"
        if self.frame > self.first:
            text += f", about {duration(elapsed * (self.frames - self.frame) / (self.frame - self.first))} to go"
        return text


class Progress:
    """Counts up to `total`. An earlier run made the first `done`; rate and time to go are those of this run only."""

    def __init__(self, total: int, done: int, unit: str, shown: bool) -> None:
        self.total, self.done, self.unit = total, done, unit
        self._before = done
        self._started = time.monotonic()
        self._last_line = self._started
        self._inside: dict[str, Inside] = {}
        self._lines = shown and not sys.stderr.isatty()
        self._bar = tqdm(total=total, initial=done, unit=f" {unit}", disable=not shown or self._lines, smoothing=0)
        if self._lines and done:
            self._print(f"{done} of {total} {unit} are there already")

    def advance(self) -> None:
        """One more is done."""
        self.done += 1
        self._bar.update()
        now = time.monotonic()
        if self._lines and (now - self._last_line >= SECONDS_BETWEEN_LINES or self.done == self.total):
            self._last_line = now
            rate = (self.done - self._before) / max(now - self._started, 1e-9)
            left = duration((self.total - self.done) / rate)
            speed = f"{rate:.3g}/s" if rate >= 1 else f"{duration(1 / rate)} each"
            self._print(f"{self.done} of {self.total} {self.unit}, {speed}, {left} to go")

    def begin(self, name: str) -> None:
        """A unit begins."""
        self._inside[name] = Inside(time.monotonic())

    def inside(self, name: str, frame: int, frames: int, iterations: int) -> None:
        """A unit has `frame` of `frames` frames after `iterations` Newton iterations."""
        unit = self._inside.setdefault(name, Inside(time.monotonic()))
        unit.first = frame if unit.first is None else unit.first
        unit.frame, unit.frames, unit.iterations = frame, frames, iterations

    def end(self, name: str) -> None:
        """A unit is done, or has failed."""
        self._inside.pop(name, None)

    def tick(self) -> None:
        """Show how far the units are; a terminal shows only the one that has run longest. Call this about once a
        second.
        """
        now = time.monotonic()
        longest = sorted(self._inside.items(), key=lambda item: item[1].started)[:MOST_INSIDE]
        if self._lines and longest and now - self._last_line >= SECONDS_OF_SILENCE:
            self._last_line = now
            for name, unit in longest:
                self._print(f"{name}: {unit.text(now)}")
        elif longest and now - longest[0][1].started >= SECONDS_BETWEEN_LINES:
            self._bar.set_postfix_str(f"{longest[0][0]}: {longest[0][1].text(now)}")
        else:
            self._bar.set_postfix_str("")

    def note(self, text: str) -> None:
        """Show a line of text without disturbing the bar."""
        if self._lines:
            self._print(text)
        else:
            self._bar.write(text, file=sys.stderr)

    def _print(self, text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

"""Progress of a long count: a tqdm bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from typing import Self

from tqdm import tqdm

SECONDS_BETWEEN_LINES = 10.0


class Progress:
    """Counts up to `total`, `done` of which an earlier run made; the rate and the time to go are those of this run."""

    def __init__(self, total: int, done: int, unit: str, shown: bool) -> None:
        self.total, self.done, self.unit = total, done, unit
        self._before, self._started = done, time.monotonic()
        self._last_line = self._started
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
            left = (self.total - self.done) / rate
            self._print(f"{self.done} of {self.total} {self.unit}, {rate:.2f}/s, {left:.0f} s to go")

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

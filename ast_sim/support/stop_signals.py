"""Ctrl-C and other signals that stop a long computation."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any, Self


class Interrupted(KeyboardInterrupt):
    """A signal has stopped a long computation, which has kept what it had.

    Attributes:
        number: of the signal; SIGPIPE where nobody reads the output.
    """

    def __init__(self, number: int) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}")
        self.number = number


class StopSignals:
    """Within the `with` block a first SIGINT, SIGTERM or SIGHUP (a lost terminal) does not end the process; its number
    is kept in `received`. A process that ignores SIGHUP (`nohup`) goes on ignoring it.

    A second signal acts as it would outside the block. Outside the main thread, signals keep their usual effect.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                    self._previous[number] = signal.signal(number, self._note)
        return self

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.received = number
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()

    def __exit__(self, *_: object) -> None:
        self._restore()

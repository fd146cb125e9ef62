"""The frames of an unfinished sample, in a file of its own. A killed solve goes on from the last of them."""

from __future__ import annotations

import time
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ast_sim.support.disk import replacing

SECONDS_BETWEEN_WRITES = 5.0


class Checkpoint:
    """Keeps the arrays of an unfinished sample in a file. Without a path it keeps nothing.

    A solve is a pure function of the state at the start of a frame, and the arrays hold this state in full precision. A
    solve that goes on from them therefore gives the same frames as one without a break. Each writing replaces the file
    before. It is due every few seconds, so short samples never write.

    Args:
        path: the file, an .npz.
        report: is called with the number of frames so far, the number of all frames and the Newton iterations so far.
    """

    def __init__(self, path: Path | None = None, report: Callable[[int, int, int], None] | None = None) -> None:
        self.path = path
        self._report = report
        self._written = time.monotonic()

    def load(self) -> dict[str, np.ndarray] | None:
        """The arrays last saved; None if there are none or they cannot be read."""
        if self.path is None:
            return None
        try:
            with np.load(self.path, allow_pickle=False) as file:
                return dict(file)
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None

    @property
    def is_due(self) -> bool:
        """Whether enough time has passed since the last writing."""
        return self.path is not None and time.monotonic() - self._written >= SECONDS_BETWEEN_WRITES

    def save(self, arrays: dict[str, np.ndarray]) -> None:
        """Write the arrays, if there is a path."""
        if self.path is None:
            return
        with replacing(self.path) as temporary, open(temporary, "wb") as file:
            np.savez(file, **arrays)  # pyright: ignore[reportArgumentType], allow_pickle is no name of theirs
        self._written = time.monotonic()

    def progress(self, frames: int, of: int, iterations: int) -> None:
        """Report how far the sample is."""
        if self._report is not None:
            self._report(frames, of, iterations)

    def remove(self) -> None:
        """Remove the file, because the sample is finished."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)

"""The frames that a sample has so far, in a file of its own, so that a killed solve goes on from the last of them."""

from __future__ import annotations

import time
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ast_sim.data.disk import replacing

SECONDS_BETWEEN_WRITES = 5.0


class Checkpoint:
    """Keeps the arrays of an unfinished sample; without a path, nowhere.

    A solve is a pure function of the state at the start of a frame, which the arrays hold in full precision: resumed,
    it gives the frames that it would have given. Writing takes the place of the file before, and is due every few
    seconds: short samples never write.

    Args:
        path: the file, an .npz.
        report: is told how many frames there are, how many there will be and the Newton iterations so far.
    """

    def __init__(self, path: Path | None = None, report: Callable[[int, int, int], None] | None = None) -> None:
        self.path = path
        self._report = report
        self._written = time.monotonic()

    def load(self) -> dict[str, np.ndarray] | None:
        """The arrays last saved; None if there are none that can be read."""
        if self.path is None:
            return None
        try:
            with np.load(self.path, allow_pickle=False) as file:
                return dict(file)
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None

    @property
    def is_due(self) -> bool:
        """Whether the last writing is long enough ago."""
        return self.path is not None and time.monotonic() - self._written >= SECONDS_BETWEEN_WRITES

    def save(self, arrays: dict[str, np.ndarray]) -> None:
        """Write the arrays; there must be a path."""
        with replacing(self.path) as temporary, open(temporary, "wb") as file:
            np.savez(file, **arrays)
        self._written = time.monotonic()

    def progress(self, frames: int, of: int, iterations: int) -> None:
        """Tell whoever waits how far the sample is."""
        if self._report is not None:
            self._report(frames, of, iterations)

    def remove(self) -> None:
        """Forget the sample: it is finished."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)

"""`metrics.jsonl` of a run: the losses and errors that training records, line by line."""

from __future__ import annotations

import os
import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ast_sim.runs.sealed_line import seal, unseal
from ast_sim.support.disk import write_text
from ast_sim.support.errors import CheckpointError, counted, warn

METRICS = "metrics.jsonl"


class Metrics:
    """The file `metrics.jsonl`. Each line is a JSON object with a `step` and a checksum. Lines are appended; only a
    resumed training removes some."""

    def __init__(self, run: Path) -> None:
        self.path = run / METRICS

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """The intact lines, in order. At the end, one warning counts the damaged ones; a kill may leave one.

        Raises:
            CheckpointError: it is a folder.
        """
        if not self.path.exists():
            return
        if self.path.is_dir():
            raise CheckpointError(f"{self.path} is a folder: remove it, and with it only the curves of the training")
        damaged: list[str] = []
        number = 0
        with open(self.path, encoding="utf-8", errors="replace") as file:
            for number, line in enumerate(file, 1):
                try:
                    yield unseal(line)
                except ValueError as error:
                    damaged.append(f"line {number}: {error}")
        if damaged:
            text = (
                f"{self.path}: {len(damaged)} of {counted(number, 'line is', 'lines are')} damaged and left out, the"
                f" first is {damaged[0]}"
            )
            warn(text)

    def append(self, record: dict[str, Any]) -> None:
        with open(self.path, "a", encoding="utf-8") as file:
            file.write(seal(record))
            file.flush()
            os.fsync(file.fileno())

    def forget_after(self, step: int) -> None:
        """Remove the lines of later steps: training is about to repeat these steps."""
        write_text(self.path, "".join(seal(record) for record in self if record["step"] <= step))

    def require(self, lines: int) -> None:
        """Warn if fewer lines are intact than a checkpoint says were written before it."""
        count = sum(1 for _ in self)
        if count < lines:
            text = f"{self.path} misses {lines - count} of {lines} lines: its curves are not complete"
            warn(text)

    def seconds_per_step(self) -> float | None:
        """The median of the seconds of a training step; None if no step was recorded."""
        seconds = [record["seconds"] for record in self if "loss" in record]
        return statistics.median(seconds) if seconds else None

    def best(self) -> dict[str, Any] | None:
        """The record of the best validation; None if no validation succeeded."""
        succeeded = (record for record in self if record.get("valid_rmse") is not None)
        return min(succeeded, key=lambda record: record["valid_rmse"], default=None)

    def valid_errors(self) -> list[float]:
        """The errors of the validations that succeeded, in order."""
        return [record["valid_rmse"] for record in self if record.get("valid_rmse") is not None]

    def validation(self, step: int) -> dict[str, Any] | None:
        """The record of the last validation after a step; None if there is none."""
        records = [record for record in self if record["step"] == step and "valid_rmse" in record]
        return records[-1] if records else None

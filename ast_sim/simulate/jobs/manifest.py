"""The state of each sample: a file for a person who watches, and the display of `generate`.

`manifest.jsonl` in the parts folder has one line of JSON for each change: `sample`, `state` ("pending", "running",
"done" or "failed"), `time`, and `where`, `bytes`, `sha256`, `seconds` or `reason`. The last line of a sample counts.
The program decides nothing by the manifest. To know whether a sample is there, it reads the sample's own file, which a
crash cannot leave half written.
"""

from __future__ import annotations

import hashlib
import json
import logging
import platform
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ast_sim.simulate.jobs.display import SceneProgress
from ast_sim.simulate.jobs.samples import Sample, sample_name, sample_path
from ast_sim.support.disk import replacing

NAME = "manifest.jsonl"


class Manifest:
    """The manifest of a parts folder. It is written again, from the sample files that are there.

    Args:
        folder: the parts folder.
        samples: all samples of the dataset.
        present: the samples whose files are there and whole.

    Attributes:
        failures: why samples failed in the previous run, by name.
    """

    def __init__(self, folder: Path, samples: list[Sample], present: set[Sample]) -> None:
        self.folder = folder
        before = self._last_states()
        self.failures = {
            name: values.get("reason", "") for name, values in before.items() if values.get("state") == "failed"
        }
        with replacing(folder / NAME) as temporary, open(temporary, "w", encoding="utf-8") as file:
            for sample in samples:
                values = {"state": "done", **self._facts(sample)} if sample in present else {"state": "pending"}
                file.write(_line(sample, values))
        self._file = open(folder / NAME, "a", encoding="utf-8", buffering=1)  # noqa: SIM115 (closed by `close`)

    def write(self, sample: Sample, state: str, **values: Any) -> None:
        """Note a change of one sample."""
        facts = self._facts(sample) if state == "done" else {}
        self._file.write(_line(sample, {"state": state, **facts, **values}))

    def close(self) -> None:
        self._file.close()

    def _facts(self, sample: Sample) -> dict[str, Any]:
        path = sample_path(self.folder, *sample)
        with open(path, "rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        return {"bytes": path.stat().st_size, "sha256": sha256}

    def _last_states(self) -> dict[str, dict[str, Any]]:
        """The last line of each sample. Lines that cannot be read, such as one cut short by a crash, are left out."""
        states: dict[str, dict[str, Any]] = {}
        try:
            lines = (self.folder / NAME).read_text(encoding="utf-8", errors="replace").splitlines()
        except OSError:
            return states
        for line in lines:
            try:
                values = json.loads(line)
                states[str(values["sample"])] = values
            except (ValueError, TypeError, KeyError):
                continue
        return states


def _line(sample: Sample, values: dict[str, Any]) -> str:
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return json.dumps({"sample": sample_name(*sample), **values, "time": now}) + "\n"


class Watch:
    """Hears what happens to each sample, and reports it to the manifest and the terminal.

    Attributes:
        failures: the samples that failed, with the reason.
    """

    def __init__(self, manifest: Manifest, bar: SceneProgress) -> None:
        self.manifest = manifest
        self.bar = bar
        self.failures: dict[Sample, str] = {}
        self._since: dict[Sample, float] = {}

    def started(self, sample: Sample, process: int, host: str | None = None) -> None:
        """A process begins to make a sample."""
        self._since[sample] = time.monotonic()
        self.bar.begin(sample_name(*sample))
        self.manifest.write(sample, "running", where=f"{host or platform.node()}, process {process}")

    def progress(self, sample: Sample, frame: int, frames: int, iterations: int) -> None:
        """A sample has `frame` of `frames` frames after `iterations` Newton iterations."""
        self.bar.inside(sample_name(*sample), frame, frames, iterations)

    def done(self, sample: Sample) -> None:
        """A sample is finished: its file is there."""
        self.bar.end(sample_name(*sample))
        self.manifest.write(sample, "done", seconds=round(self._seconds(sample), 3))
        self.bar.advance(sample_name(*sample))

    def failed(self, sample: Sample, reason: str, trace: str = "") -> None:
        """A sample cannot be made; the others go on."""
        self.failures[sample] = reason
        self.bar.end(sample_name(*sample))
        self.manifest.write(sample, "failed", reason=reason, seconds=round(self._seconds(sample), 3))
        self.bar.line(f"{sample_name(*sample)} failed: {reason}\n{trace}".strip(), logging.WARNING)

    def tick(self) -> None:
        """Call this about once a second."""
        self.bar.tick()

    def _seconds(self, sample: Sample) -> float:
        return time.monotonic() - self._since.pop(sample, time.monotonic())

"""The seconds that a solver took, in a file beside the dataset that it made.

The same settings give the same generated dataset, to the bit, but not the same times. So the times are kept in a file
of their own, `NAME.h5.seconds.json`. It holds the `generator` of the dataset and, in `samples`, for each sample (by its
name, as "train/000000") the attributes that end in `_seconds` and the processor on which they were measured.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ast_sim.dataset.layout import SPLITS
from ast_sim.dataset.reader import Dataset
from ast_sim.scene import AttributeValue
from ast_sim.support.disk import write_text
from ast_sim.support.errors import counted, warn

SUFFIX = "_seconds"

Seconds = dict[str, Any]  # attributes that end in SUFFIX, and `processor`


def split_seconds(attributes: dict[str, AttributeValue]) -> tuple[dict[str, AttributeValue], Seconds]:
    """Divide the attributes of a trajectory into what follows from its settings, and times."""
    kept = {key: value for key, value in attributes.items() if not key.endswith(SUFFIX)}
    return kept, {key: value for key, value in attributes.items() if key.endswith(SUFFIX)}


def seconds_path(dataset: str | os.PathLike[str]) -> Path:
    """The path of the file that holds a dataset's seconds."""
    path = Path(dataset)
    return path.with_name(f"{path.name}.seconds.json")


def write_seconds(dataset: str | os.PathLike[str], generator: dict[str, Any], samples: dict[str, Seconds]) -> None:
    """Write the seconds of the dataset with this `generator`, whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    values = {"generator": generator, "samples": samples}
    write_text(seconds_path(dataset), json.dumps({**values, "sha256": _hash(values)}) + "\n")


def _hash(values: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class SolverSeconds:
    """The solver's time.

    Attributes:
        samples: for each sample, by its name such as "train/000000", the seconds of each frame.
        processors: the processors on which these seconds were measured.
    """

    samples: dict[str, list[float]] = field(default_factory=dict)
    processors: tuple[str, ...] = ()


def read_seconds(dataset: Dataset) -> SolverSeconds:
    """The seconds beside a dataset; without samples if they are not known.

    A file of seconds that is damaged, or that belongs to another dataset, gives a warning.
    """
    path = seconds_path(dataset.path)
    if not path.exists():
        return SolverSeconds()
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        own = record["generator"] == dataset.info.generator
        samples = {name: list(map(float, sample["solve_seconds"])) for name, sample in record["samples"].items()}
        processors = sorted({str(sample.get("processor", "unknown")) for sample in record["samples"].values()})
        if record.pop("sha256") != _hash(record):
            raise ValueError("its content does not fit its SHA-256")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        wrong = f"is damaged ({error!r})"
    else:
        wrong = _misfit(dataset, samples) if own else "belongs to another dataset"
        if not wrong:
            return SolverSeconds(samples, tuple(processors))
    warn(f"{path} {wrong}: the solver's seconds are not known")
    return SolverSeconds()


def _misfit(dataset: Dataset, samples: dict[str, list[float]]) -> str:
    """Why these seconds cannot be true for the samples of the dataset; empty if they can."""
    frames = {
        f"{split}/{index:06d}": dataset.num_frames(split, index)
        for split in SPLITS
        for index in range(dataset.count(split))
    }
    for name, seconds in samples.items():
        if len(seconds) != frames.get(name):
            return f"has {counted(len(seconds), 'time')} of {name}, which has {frames.get(name, 'no')} frames"
        if not all(0 <= second < math.inf for second in seconds):
            return f"has times of {name} that are below 0 or not finite"
        if len(seconds) > 1 and sum(seconds) == 0:
            return f"says that {name} took no time"
    return ""

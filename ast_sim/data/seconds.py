"""The seconds that a solver took, in a file beside the dataset that it made.

A generated dataset follows from its settings alone, to the bit; times do not. They are kept in `NAME.h5.seconds.json`:
`generator` as in the dataset, and for each sample (`samples`, by "train/000000") its attributes that end in `_seconds`
and the processor that they were measured on.
"""

from __future__ import annotations

import json
import math
import os
import platform
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ast_sim.data.disk import replacing
from ast_sim.data.file import Dataset
from ast_sim.data.scene import AttributeValue

SUFFIX = "_seconds"

Seconds = dict[str, Any]  # attributes that end in SUFFIX, and `processor`


def split_seconds(attributes: dict[str, AttributeValue]) -> tuple[dict[str, AttributeValue], Seconds]:
    """The attributes of a trajectory that follow from its settings, and those that were measured with a clock."""
    kept = {key: value for key, value in attributes.items() if not key.endswith(SUFFIX)}
    return kept, {key: value for key, value in attributes.items() if key.endswith(SUFFIX)}


def seconds_path(dataset: str | os.PathLike[str]) -> Path:
    """Where the seconds of a dataset lie."""
    path = Path(dataset)
    return path.with_name(f"{path.name}.seconds.json")


def write_seconds(dataset: str | os.PathLike[str], generator: dict[str, Any], samples: dict[str, Seconds]) -> None:
    """Write the seconds of the dataset that says `generator` of itself, whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    with replacing(seconds_path(dataset)) as temporary:
        temporary.write_text(json.dumps({"generator": generator, "samples": samples}) + "\n", encoding="utf-8")


@dataclass(frozen=True)
class SolverSeconds:
    """What is known of a solver's time.

    Attributes:
        samples: seconds a frame by the name of the sample, "train/000000".
        processors: on which they were measured.
    """

    samples: dict[str, list[float]] = field(default_factory=dict)
    processors: tuple[str, ...] = ()


def read_seconds(dataset: Dataset) -> SolverSeconds:
    """The seconds beside a dataset, without samples where they are not known.

    Warns where a file lies beside the dataset that is damaged or belongs to another one.
    """
    path = seconds_path(dataset.path)
    if not path.exists():
        return SolverSeconds()
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        own = found["generator"] == dataset.info.generator
        samples = {name: list(map(float, sample["solve_seconds"])) for name, sample in found["samples"].items()}
        processors = sorted({str(sample.get("processor", "unknown")) for sample in found["samples"].values()})
        if not all(math.isfinite(number) for frames in samples.values() for number in frames):
            raise ValueError("a number is not finite")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        warnings.warn(f"{path} is damaged ({error!r}): the solver's seconds are not known", stacklevel=2)
        return SolverSeconds()
    if not own:
        warnings.warn(f"{path} belongs to another dataset: the solver's seconds are not known", stacklevel=2)
        return SolverSeconds()
    return SolverSeconds(samples, tuple(processors))


def processor() -> str:
    """The name of this machine's processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()

"""`meta.json` of the MeshGraphNets data sets (Pfaff et al. 2021): the names, shapes and dtypes of their arrays."""

from __future__ import annotations

import json
import math
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim.support.errors import DatasetError

LENGTH = "length_"  # prefix of the feature that holds, for each frame, the number of rows of another feature
LARGEST = 1 << 20  # most bytes of a meta.json; real ones have about 1,000

_TYPES = ("static", "dynamic", "dynamic_varlen")
_DTYPES = ("float32", "float64", "int32", "int64", "uint8")
_KINDS = {dict: "an object", list: "a list", str: "a text", int: "a whole number", float: "a number"}


@dataclass(frozen=True)
class Feature:
    """One array of a trajectory.

    Attributes:
        kind: "static" (one for all frames), "dynamic" (one for each frame), "dynamic_varlen" (the rows of all frames
            one after the other; each frame has its own number of rows).
        shape: the sizes; one of them may be -1, it follows from the number of bytes.
        dtype: type of the numbers, little-endian.
    """

    kind: str
    shape: tuple[int, ...]
    dtype: np.dtype


@dataclass(frozen=True)
class Meta:
    """The content of `meta.json`; times in seconds, lengths in metres.

    Attributes:
        simulator: the program that made the data.
        dt: time between two frames; 0 if time has no meaning.
        collision_radius: distance below which nodes of different bodies get an edge.
        trajectory_length: number of frames of every trajectory.
        features: the arrays of a trajectory, by name.
    """

    simulator: str
    dt: float
    collision_radius: float
    trajectory_length: int
    features: dict[str, Feature]


def read_meta(path: Path) -> Meta:
    """Read `meta.json` and check every value.

    The published files of `flag_dynamic_sizing` and `sphere_dynamic_sizing` have an error: they give `sizing_field` the
    dtype "<dtype: 'float32'>" and 4 columns, but the data have 3 (google-deepmind/deepmind-research, issues 532 and
    651). These files are accepted, and so are files in which the error was corrected.

    Raises:
        DatasetError: a value is wrong; the text names the file, the key and the value.
    """
    values = _Values(str(path), _read_json(path))
    features = values.take("features", dict)
    names = values.take("field_names", list)
    length = values.take("trajectory_length", int)
    dt, radius = values.take("dt", float), values.take("collision_radius", float)
    if length < 1 or dt < 0 or radius < 0:
        raise DatasetError(f"{path}: trajectory_length must be at least 1, dt and collision_radius at least 0")
    meta = Meta(
        simulator=values.take("simulator", str),
        dt=dt,
        collision_radius=radius,
        trajectory_length=length,
        features={name: _feature(f"{path}: the feature {name}", name, value) for name, value in features.items()},
    )
    for name, feature in meta.features.items():
        for field in (name, LENGTH + name) if feature.kind == "dynamic_varlen" else (name,):
            if field not in names:
                raise DatasetError(f"{path}: field_names does not list {field}, which the feature {name} needs")
        first = {"static": 1, "dynamic": length}.get(feature.kind, feature.shape[0])
        if feature.shape[0] != first:
            raise DatasetError(
                f"{path}: the feature {name} is {feature.kind} and its shape {list(feature.shape)}: the first size must"
                f" be {first}" + (", which is trajectory_length" if feature.kind == "dynamic" else "")
            )
    return meta


def _read_json(path: Path) -> Any:
    try:
        if path.stat().st_size > LARGEST:
            raise DatasetError(
                f"{path}: has {path.stat().st_size} bytes; no meta.json of a data set has above {LARGEST}"
            )
        return json.loads(path.read_bytes())
    except FileNotFoundError as error:
        raise DatasetError(f"{path} is missing; it says what is in the records: download it too") from error
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: cannot be read as JSON: {error}") from error


class _Values:
    """A JSON object whose values are taken by key and type."""

    def __init__(self, where: str, values: Any) -> None:
        if not isinstance(values, dict):
            raise DatasetError(f"{where}: must be a JSON object, not {_shown(values)}")
        self._where, self._values = where, values

    def take(self, key: str, kind: type) -> Any:
        if key not in self._values:
            raise DatasetError(f"{self._where}: {key} is missing")
        value = self._values[key]
        allowed = (int, float) if kind is float else kind
        fits = isinstance(value, allowed) and not isinstance(value, bool)
        # A whole number in JSON may have so many digits that no float can hold it.
        if fits and kind is float:
            fits = abs(value) <= sys.float_info.max
        if not fits:
            raise DatasetError(f"{self._where}: {key} is {_shown(value)}; must be {_KINDS[kind]}")
        return float(value) if kind is float else value


def _feature(where: str, name: str, value: Any) -> Feature:
    values = _Values(where, value)
    kind, shape, spelled = values.take("type", str), values.take("shape", list), values.take("dtype", str)
    if kind not in _TYPES:
        raise DatasetError(f"{where}: type is {_shown(kind)}; must be one of {', '.join(_TYPES)}")
    dtype = re.sub(r"^<dtype: '(\w+)'>$", r"\1", spelled)
    if dtype not in _DTYPES:
        raise DatasetError(f"{where}: dtype is {_shown(spelled)}; must be one of {', '.join(_DTYPES)}")
    whole = all(isinstance(size, int) and not isinstance(size, bool) for size in shape)
    if not shape or not whole or any(size < 1 and size != -1 for size in shape) or shape.count(-1) > 1:
        raise DatasetError(f"{where}: shape is {_shown(shape)}; must be a list of sizes, one of which may be -1")
    if abs(math.prod(shape)) > np.iinfo(np.int64).max:
        raise DatasetError(f"{where}: shape is {_shown(shape)}, which no file can hold")
    if name == "sizing_field" and shape == [-1, 4]:
        shape = [-1, 3]
    return Feature(kind, tuple(shape), np.dtype(dtype).newbyteorder("<"))


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."

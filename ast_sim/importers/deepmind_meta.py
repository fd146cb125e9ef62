"""`meta.json` of the MeshGraphNets data sets (Pfaff et al. 2021): the names, shapes and dtypes of their arrays."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim.support.errors import DatasetError

LENGTH = "length_"  # prefix of the feature that holds, for each frame, the number of rows of another feature
LARGEST = 1 << 20  # most bytes of a meta.json; real ones have about 1,000

_CHANGING = ("dynamic", "dynamic_varlen")
_ANY = ("static", *_CHANGING)
_INTEGERS = ("int32", "int64", "uint8")
_FLOATS = ("float32", "float64")

# The features that are read, all but `stress` necessary: the allowed types, numbers of columns and dtypes.
_USED = {
    "cells": (_ANY, (3, 4), _INTEGERS),
    "node_type": (_ANY, (1,), _INTEGERS),
    "mesh_pos": (_ANY, (2, 3), _FLOATS),
    "world_pos": (_CHANGING, (3,), _FLOATS),
    "stress": (_CHANGING, (1,), _FLOATS),
}

_KINDS = {dict: "an object", list: "a list", str: "a text", int: "a whole number", float: "a number"}


@dataclass(frozen=True)
class Feature:
    """One array of a trajectory.

    Attributes:
        kind: "static" (one for all frames), "dynamic" (one for each frame), "dynamic_varlen" (the rows of all frames
            one after the other; each frame has its own number of rows).
        shape: the frames (1 if static; left out if varlen), the rows (-1: as many as there are bytes for), the columns.
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
        features: the arrays of a trajectory that are read, by name.
    """

    simulator: str
    dt: float
    collision_radius: float
    trajectory_length: int
    features: dict[str, Feature]


def read_meta(path: Path) -> Meta:
    """Read `meta.json` and check every value that is used. Features that are not read may be anything.

    Raises:
        DatasetError: a value is wrong; the text names the file, the key and the value.
    """
    values = _read_json(path)
    told = _take(path, values, "features", dict)
    length = _take(path, values, "trajectory_length", int)
    dt, radius = (_take(path, values, key, float) for key in ("dt", "collision_radius"))
    if length < 1 or dt < 0 or radius < 0:
        raise DatasetError(f"{path}: trajectory_length must be at least 1, dt and collision_radius at least 0")
    features = {}
    for name in _USED:
        if name in told:
            features[name] = _feature(f"{path}: the feature {name}", told[name], length, *_USED[name])
        elif name != "stress":
            raise DatasetError(
                f"{path}: there is no feature {name}; deforming bodies have {', '.join(_USED)} (as deforming_plate;"
                f" sphere_simple has no stress), here are {', '.join(told) or 'none'}"
            )
    return Meta(_take(path, values, "simulator", str), dt, radius, length, features)


def _read_json(path: Path) -> Any:
    try:
        size = path.stat().st_size
        content = path.read_bytes() if size <= LARGEST else b""
    except FileNotFoundError as error:
        raise DatasetError(f"{path} is missing; it says what is in the records: download it too") from error
    except OSError as error:  # its text would name the file again
        raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from error
    if size > LARGEST:
        raise DatasetError(f"{path}: has {size} bytes; no meta.json of a data set has above {LARGEST}")
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: cannot be read as JSON: {error}") from error


def _take(where: Path | str, values: Any, key: str, kind: type) -> Any:
    """The value of a key of a JSON object, which must be of this type."""
    if not isinstance(values, dict):
        raise DatasetError(f"{where}: must be a JSON object, not {_shown(values)}")
    if key not in values:
        raise DatasetError(f"{where}: {key} is missing")
    value = values[key]
    fits = isinstance(value, (int, float) if kind is float else kind) and not isinstance(value, bool)
    # A whole number in JSON may be too large for a float.
    if not fits or (kind is float and not abs(value) <= sys.float_info.max):
        raise DatasetError(f"{where}: {key} is {_shown(value)}; must be {_KINDS[kind]}")
    return kind(value)


def _feature(
    where: str, value: Any, length: int, kinds: tuple[str, ...], columns: tuple[int, ...], dtypes: tuple[str, ...]
) -> Feature:
    kind, dtype, shape = (_take(where, value, *key) for key in (("type", str), ("dtype", str), ("shape", list)))
    for key, given, allowed in (("type", kind, kinds), ("dtype", dtype, dtypes)):
        if given not in allowed:
            raise DatasetError(f"{where}: {key} is {_shown(given)}; must be one of {', '.join(allowed)}")
    first = {"static": [1], "dynamic": [length], "dynamic_varlen": []}[kind]
    whole = len(shape) == len(first) + 2 and all(type(size) is int for size in shape)
    if not whole or shape[:-2] != first or not (shape[-2] == -1 or shape[-2] > 0) or shape[-1] not in columns:
        wanted = ", ".join(map(str, [*first, -1, " or ".join(map(str, columns))]))
        raise DatasetError(
            f"{where} is {kind} and has the shape {_shown(shape)}; must be [{wanted}] (trajectory_length is {length})"
        )
    return Feature(kind, tuple(shape), np.dtype(dtype).newbyteorder("<"))


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."

"""Numbers that a program has made room for in a NetCDF file, but never written: a run that was stopped, or a field that
some blocks lack. NetCDF fills their places with one number."""

from __future__ import annotations

from collections import Counter

import numpy as np

from ast_sim.support.errors import counted

_FILL = np.float32(9.9692099683868690e36)  # NC_FILL_FLOAT and NC_FILL_DOUBLE, which float32 holds exactly

_Part = dict[str, np.ndarray]


def with_nan(parts: list[_Part]) -> tuple[list[_Part], list[str]]:
    """The arrays of the parts of a mesh with NaN in place of numbers that were never written, and notes."""
    rows: Counter[str] = Counter()
    kept = [dict(part) for part in parts]
    for part in kept:
        for name, values in part.items():
            lacking = values == _FILL if values.dtype.kind == "f" else np.zeros(0, bool)
            if lacking.any():
                part[name] = np.where(lacking, np.nan, values)
                rows[name.partition(" ")[2] or name] += int(lacking.reshape(len(values), -1).any(axis=1).sum())
    told = "the field {!r} was never written at {}: it is NaN there"
    return kept, [told.format(name, counted(number, "row")) for name, number in rows.items()]


def written_time(time: float | None) -> float | None:
    """A time, NaN if it was never written."""
    return float("nan") if time is not None and np.float32(time) == _FILL else time

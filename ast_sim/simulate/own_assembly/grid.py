"""Many values of the parameters: a grid over some of them, or the rows of a table."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np

from ast_sim.simulate.own_assembly.parameters import flattened
from ast_sim.support.argument_checks import file_name, require_type
from ast_sim.support.disk import read_text
from ast_sim.support.errors import ConfigError, counted

MOST_ROWS = 100_000


def parse_settings(texts: Sequence[str]) -> dict[str, list[Any]]:
    """The parameters and their values; each text is one of `parse_setting`.

    Raises:
        ConfigError: a text has another form, or gives a parameter once more.
    """
    settings: dict[str, list[Any]] = {}
    for name, values in map(parse_setting, texts):
        if name in settings:
            raise ConfigError(f"{name} is given twice: write all its values behind one {name}=")
        settings[name] = values
    return settings


def parse_setting(text: str) -> tuple[str, list[Any]]:
    """The parameter and the values of `NAME=VALUE[,VALUE...]` or `NAME=FIRST:LAST:COUNT`.

    Raises:
        ConfigError: the text has another form (the error gives examples), or there are too many values.
    """
    name, equals, values = (part.strip() for part in text.partition("="))
    ends = values.split(":")
    try:
        if not (equals and name and values):
            raise ValueError(text)
        if len(ends) != 3:
            return name, [_number_or_text(value.strip()) for value in values.split(",")]
        first = float(ends[0])
        last = float(ends[1])
        count = int(ends[2])
        if count < 1:
            raise ValueError(text)
    except ValueError as error:
        raise ConfigError(
            f"{text!r} cannot be read; write travel=4.2, travel=1,2,3, travel=1:7:13 (from, to, how many) or"
            " hook.file=long.step"
        ) from error
    if count > MOST_ROWS:
        raise ConfigError(f"{text!r} asks for {counted(count, 'value')}; at most {MOST_ROWS:,}: take fewer")
    return name, np.linspace(first, last, count).tolist()


def required_values(name: str, values: Any) -> Mapping[str, Any]:
    """The argument `name`; ConfigError, if it is not values of parameters by their names."""
    require_type(name, values, Mapping, "values by name, such as {'travel': 4.2}")
    return values


def rows_of(
    parameters: Mapping[str, Any] | None, table: str | os.PathLike[str] | Sequence[Mapping[str, Any]] | None
) -> Sequence[Mapping[str, Any]]:
    """The rows that the arguments of `Run.sweep` ask for.

    Raises:
        ConfigError: both are given, one is of another kind, or it is as in `grid` and `read_table`.
    """
    values = {} if parameters is None else required_values("parameters", parameters)
    if table is None:
        return grid(values)
    if values:
        raise ConfigError("a table has the values of all parameters: leave the others out, or leave the table out")
    if isinstance(table, str) or not isinstance(table, Sequence):
        return read_table(table)
    for number, row in enumerate(table):
        required_values(f"row {number} of table", row)
    return table


def grid(values: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One row for each combination of the values; a number or a text stands for itself, a mapping for several
    parameters as in `completed`.

    Raises:
        ConfigError: a parameter has no value or is given twice, or there are too many rows.
    """
    flat: dict[str, Sequence[Any]] = {}
    for name, value in flattened(values):
        if name in flat:
            raise ConfigError(f"{name} is given twice: leave one out")
        flat[name] = [value] if isinstance(value, str) or np.ndim(value) == 0 else list(value)
        if not len(flat[name]):
            raise ConfigError(f"{name} has no value")
    count = math.prod(len(v) for v in flat.values())
    if count > MOST_ROWS:
        raise ConfigError(f"the grid has {counted(count, 'row')}; at most {MOST_ROWS:,}: take fewer values")
    return [dict(zip(flat, row, strict=True)) for row in product(*flat.values())]


def read_table(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """The rows of a CSV file, whose first line names the parameters.

    Raises:
        ConfigError: it cannot be read, has no rows, two columns have one name, or a row has another number of values.
    """
    try:
        lines = [line for line in csv.reader(io.StringIO(read_text(file_name(path, "table"), "utf-8-sig"))) if line]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(f"{path}: the table cannot be read: {reason}") from error
    if len(lines) < 2:
        raise ConfigError(f"{path}: the table needs a line with the names of the parameters, and a row or more")
    names = [name.strip() for name in lines[0]]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ConfigError(f"{path}: two columns have the name {twice!r}")
    for number, line in enumerate(lines[1:], 2):
        if len(line) != len(names):
            raise ConfigError(
                f"{path}: row {number} has {counted(len(line), 'value')}, but there are {counted(len(names), 'name')}"
            )
    if len(lines) - 1 > MOST_ROWS:
        raise ConfigError(f"{path}: the table has {counted(len(lines) - 1, 'row')}; at most {MOST_ROWS:,}")
    return [{n: _number_or_text(v.strip()) for n, v in zip(names, line, strict=True)} for line in lines[1:]]


def _number_or_text(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text

"""Quantities of a simulation beside positions and stress: plastic strain, contact pressure, temperature, reactions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ast_sim.number_arrays import require_array, require_finite
from ast_sim.support.errors import DatasetError
from ast_sim.support.notebook_table import one_line

# The name of the nodal reactions, [S, N, 3] in newton: the forces that act on the nodes from outside.
REACTION = "reaction"
PLASTIC_STRAIN = "PEEQ"  # the name of the equivalent plastic strain, as CalculiX and Abaqus have it
STRESS = "stress"  # the name of the von Mises stress among what a model predicts
LOCATIONS = ("node", "element")


class Output(NamedTuple):
    """A quantity that a model predicts beside the motion.

    Attributes:
        name: `STRESS`, or the name of a field of the dataset.
        location: "node" or "element".
        columns: how many numbers it has in a row.
        unit: such as "Pa"; empty where it has none.
    """

    name: str
    location: str
    columns: int
    unit: str


@dataclass(frozen=True, eq=False)
class NamedField:
    """A quantity at each node or in each element, frame by frame.

    Attributes:
        values: [S, N or E, c] float32.
        location: "node" or "element".
        unit: such as "Pa" or "N"; empty where it has none.
    """

    values: np.ndarray
    location: str
    unit: str = ""

    def __repr__(self) -> str:
        shape = " x ".join(map(str, np.shape(self.values)))
        return one_line("NamedField", {"at each": self.location, "values": shape, "unit": self.unit or "none"})

    def select(self, rows: list[int]) -> NamedField:
        """The frames in these rows."""
        return replace(self, values=self.values[rows])

    def check(self, name: str, key: str, frames: int, nodes: int, elements: int) -> None:
        """Check the name `key`, the place, dtype and shape, and that every number is finite.

        Raises:
            DatasetError: the text names the trajectory `name`, the field, and the frame and the row if there is one.
        """
        if not key or "/" in key or key == ".":
            raise DatasetError(f"{name}: a field has the name {key!r}; names must not be empty or hold a slash")
        if self.location not in LOCATIONS:
            raise DatasetError(f"{name}: the field {key} is at {self.location!r}; must be at {' or '.join(LOCATIONS)}")
        rows = nodes if self.location == "node" else elements
        require_array(name, key, self.values, np.float32, (frames, rows, None))
        if self.values.shape[2] == 0:
            raise DatasetError(f"{name}: the field {key} has no columns")
        if key == REACTION and (self.location, self.unit, self.values.shape[2]) != ("node", "N", 3):
            raise DatasetError(f"{name}: {REACTION} must have 3 columns at the nodes, in N")
        require_finite(name, key, self.location, self.values)


def require_fields(name: str, fields: Mapping[str, NamedField], wanted: Iterable[tuple[str, str, int, str]]) -> None:
    """Check that a trajectory has the wanted fields, each as in `Output`.

    Raises:
        DatasetError: one is missing, or is at another place, in another unit or of other columns.
    """
    for output in wanted:
        key, place, columns, unit = output
        one = fields.get(key)
        if one is None or (one.location, one.unit, one.values.shape[2]) != (place, unit, columns):
            has = require_same_fields(name, dict(fields), None)
            raise DatasetError(
                f"{name}: needs the field {_listed({key: (place, unit, columns)})}; it has {_listed(has)}: keep it with"
                " ast-sim convert --field, or train without it"
            )


def require_same_fields(
    name: str, fields: dict[str, NamedField], known: dict[str, tuple[str, str, int]] | None
) -> dict[str, tuple[str, str, int]]:
    """The place, the unit and the columns of each field.

    Raises:
        DatasetError: they differ from the other trajectories of the dataset, where these are `known`.
    """
    facts = {key: (one.location, one.unit, one.values.shape[2]) for key, one in sorted(fields.items())}
    if known not in (None, facts):
        raise DatasetError(f"{name}: has the fields {_listed(facts)}; other samples have {_listed(known or {})}")
    return facts


def _listed(facts: dict[str, tuple[str, str, int]]) -> str:
    told = (f"{key} ({columns} at each {place}, {unit or 'no unit'})" for key, (place, unit, columns) in facts.items())
    return ", ".join(told) or "none"

"""The named fields of a simulation, as they are read frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ast_sim.importers.formats.source_mesh import SourceMesh, known_as
from ast_sim.importers.solids.positions import fields_of_vector
from ast_sim.named_field import REACTION, NamedField
from ast_sim.support.errors import ConfigError, DatasetError, counted


def parse_field(text: str) -> tuple[str, str]:
    """The name and the unit of `NAME` or `NAME=UNIT`.

    Raises:
        ConfigError: the name is empty or holds a slash.
    """
    name, _, unit = text.partition("=")
    if not name or "/" in name or name == REACTION:
        raise ConfigError(
            f"the field {text!r} cannot be stored; write NAME or NAME=UNIT, such as PEEQ or CPRESS=MPa; the name must"
            f" hold no slash and not be {REACTION!r}"
        )
    return name, unit


@dataclass(eq=False)
class KeptFields:
    """Fields of a simulation with the points and cells of its file.

    Attributes:
        wanted: the name of each field in the files, by the name under which it is stored.
        units: by the name under which it is stored.
        frames: what each frame holds, [points or cells, c] float64.
        places: "node" or "element".
    """

    wanted: dict[str, str]
    units: dict[str, str]
    frames: dict[str, list[np.ndarray]] = field(default_factory=dict)
    places: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, fields: Sequence[str], reaction: str | None) -> KeptFields:
        """Of texts as in `parse_field`, and of the name of the nodal reactions."""
        units = dict(map(parse_field, fields))
        wanted = {name: name for name in units} | ({} if reaction is None else {REACTION: reaction})
        return cls(wanted, units | {REACTION: "N"})

    def look(self, frame: SourceMesh, cells: np.ndarray | None, read: Callable[..., np.ndarray]) -> None:
        """Keep the fields of a frame, whose cells stand at `cells` in the order of the first frame (None: as there)."""
        for key, wanted in self.wanted.items():
            name = known_as(wanted, [*frame.point_fields, *frame.cell_fields])
            place = "node" if name in frame.point_fields or name not in frame.cell_fields else "element"
            parts = fields_of_vector(name, frame.point_fields) if place == "node" else [name]
            if self.places.setdefault(key, place) != place:
                raise DatasetError(f"{frame.path}: the field {name!r} is at each {place}, before at another place")
            at = "point" if place == "node" else "cell"
            values = np.concatenate([read(frame, at, part) for part in parts], axis=1)
            kept = self.frames.setdefault(key, [])
            if kept and kept[0].shape[1] != values.shape[1]:
                raise DatasetError(
                    f"{frame.path}: the field {name!r} has {counted(values.shape[1], 'component')}, in the first frame"
                    f" {kept[0].shape[1]}: write it alike"
                )
            kept.append(values if place == "node" or cells is None else values[cells])

    def reorder(self, order: list[int]) -> None:
        self.frames = {key: [frames[index] for index in order] for key, frames in self.frames.items()}

    def named(
        self,
        path: Path,
        at_nodes: Callable[[np.ndarray], np.ndarray],
        at_elements: Callable[[np.ndarray], np.ndarray],
        rigid: dict[str, np.ndarray],
        newton: float,
    ) -> tuple[dict[str, NamedField], list[str]]:
        """The fields of the scene, and notes.

        Args:
            at_nodes: from values [points of the file, c] to values [N, c].
            at_elements: from values [cells of the file, c] to values [E, c].
            rigid: at "node" and "element", which rows are of obstacles: there a missing number is 0, with a note.
            newton: the unit of force of the files, in newton.

        Raises:
            DatasetError: a number is missing elsewhere.
        """
        fields = {}
        notes = []
        for key, frames in self.frames.items():
            place = self.places[key]
            rows = [at_nodes(values) if place == "node" else at_elements(values) for values in frames]
            values = np.stack(rows) * (newton if key == REACTION else 1.0)
            lacking = np.isnan(values).any(axis=(0, 2))
            if (lacking & ~rigid[place]).any():
                row = int(np.argmax(lacking & ~rigid[place]))
                raise DatasetError(f"{path}: the field {self.wanted[key]!r} is NaN at {place} {row}: leave it out")
            if lacking.any():
                values[:, lacking] = 0
                notes.append(f"{key} is NaN at {counted(lacking.sum(), 'row')} of obstacles: it is 0 there")
            fields[key] = NamedField(values.astype(np.float32), place, self.units[key])
        return fields, notes

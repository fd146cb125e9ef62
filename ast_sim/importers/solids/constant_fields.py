"""Fields that say what a node or an element is: its type, its body, its material. A scene has one value for all
frames."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ast_sim.importers.formats.source_mesh import SourceMesh
from ast_sim.support.errors import counted

# Names of cell fields by which programs say that an element is deleted, in small letters and without underlines.
_OF_DELETED = ("status", "erosionstatus", "elementstatus", "deletionstatus", "death", "deleted", "eroded")


class ConstantFields:
    """Fields by name that must be the same in all frames, and those by which programs say that an element is deleted;
    those that a frame does not have are not looked at."""

    def __init__(self, names: Iterable[str]) -> None:
        self.names = tuple(names)
        self.first: dict[str, np.ndarray] = {}
        self.changes: dict[str, str] = {}

    def look(self, frame: SourceMesh, cells: np.ndarray | None) -> None:
        """Compare a frame with the first. `cells` are its cells in the order of the first frame; None: as it is."""
        of_deleted = [name for name in frame.cell_fields if name.lower().replace("_", "") in _OF_DELETED]
        for name in (*self.names, *of_deleted):
            if name in frame.point_fields:
                values = frame.point_fields[name]
            elif name in frame.cell_fields:
                values = np.concatenate(frame.cell_fields[name])
                values = values if cells is None else values[cells]
            else:
                continue
            first = self.first.setdefault(name, values)
            if values.dtype.kind not in "iufb" or values.shape != first.shape:
                continue
            changed = ~np.isclose(values, first, rtol=1e-5, equal_nan=True).reshape(len(values), -1).all(axis=1)
            if changed.any() and name not in self.changes:
                taken = (
                    "are elements deleted? All are kept"
                    if name in of_deleted
                    else "the values of the first frame are taken"
                )
                self.changes[name] = (
                    f"the field {name!r} changes in {counted(changed.sum(), 'row')} of {frame.path.name}: {taken}"
                )

    def notes(self) -> list[str]:
        """A note on each field that changes."""
        return list(self.changes.values())

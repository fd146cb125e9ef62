"""Whether points that move are at rest in the first frame, which a displacement that nobody named may deny.

A program that writes the deformed mesh of each frame often writes the displacement, too, under a name of its own. The
points minus this field are then the same in all frames: these are the points at rest, and not the ones of the first
frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ast_sim.importers.formats.source_mesh import SourceMesh
from ast_sim.importers.solids.positions import fields_of_vector, stems_of_vectors
from ast_sim.support.errors import DatasetError

# Points count as equal if they differ by less than this share of the size of the mesh.
_AGREEMENT = 1e-4


class UnnamedDisplacements:
    """The vectors at points that may be displacements: points minus them are the same in all frames so far, by name."""

    def __init__(self) -> None:
        self.rest: dict[str, np.ndarray] = {}
        self.first: np.ndarray | None = None

    def look(self, frame: SourceMesh) -> None:
        """Take a frame, whose points stand in the order of the first one."""
        back = dict(_points_at_rest(frame))
        if self.first is None:
            self.first = frame.points
            self.rest = {name: points for name, points in back.items() if _size(points) > 0.5 * _size(frame.points)}
        allowed = _AGREEMENT * _size(self.first)
        kept = self.rest.keys() & back.keys()
        self.rest = {name: self.rest[name] for name in kept if _differ(back[name], self.rest[name]) <= allowed}

    def require_at_rest(self, source: Path, points: list[np.ndarray]) -> None:
        """Raise DatasetError if the points of the first of all frames [S, n, 3] are not at rest by one of the vectors.

        Points that do not move say nothing: any vector that does not change would fit.
        """
        allowed = _AGREEMENT * _size(points[0])
        if max(_differ(one, points[0]) for one in points) <= allowed:
            return
        for name, rest in sorted(self.rest.items()):
            if _differ(points[0], rest) > allowed:
                raise DatasetError(
                    f"{source}: the points of the first frame are not at rest: in all frames the field {name!r} has"
                    f" moved them from one place: name it, displacement={name!r} (--displacement {name})"
                )


def _points_at_rest(frame: SourceMesh) -> Iterator[tuple[str, np.ndarray]]:
    """The name of each vector at the points, in one field or in one for each axis, and the points minus it."""
    for name in [*frame.point_fields, *stems_of_vectors(frame.point_fields)]:
        parts = fields_of_vector(name, frame.point_fields)
        columns = [frame.point_fields[part] for part in parts if part in frame.point_fields]
        if columns and all(one.dtype.kind in "iuf" for one in columns):
            vector = np.concatenate([one.reshape(len(one), -1) for one in columns], axis=1)
            if vector.shape == frame.points.shape:
                yield name, frame.points - vector


def _size(points: np.ndarray) -> float:
    finite = points[np.isfinite(points).all(axis=1)]
    return float(np.ptp(finite, axis=0).max()) if len(finite) else 0.0


def _differ(one: np.ndarray, other: np.ndarray) -> float:
    """The largest difference of points; NaN beside a number counts as infinite."""
    return (
        float(np.abs(np.nan_to_num(one - other, nan=np.inf)).max(initial=0.0)) if one.shape == other.shape else np.inf
    )

"""Where the nodes of a simulation are: at rest and in each frame, from the points and displacements of its files."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from pathlib import Path

import numpy as np

from ast_sim.importers.formats.source_mesh import SourceMesh, known_as
from ast_sim.importers.shells import Shells
from ast_sim.support.errors import DatasetError, counted, warn

# Points count as equal if they differ by less than this share of the size of the mesh.
_AGREEMENT = 1e-4

# Positions in the first frame differ from the points by less than this share of their size; no body is so much wider.
_POSITIONS = 0.25

# Rounding to float32 may change the displacements by this share of the largest one before a warning is given.
_ROUNDING = 0.01


# What a name ends with that is a component along an axis: U1, UX, displacement_x.
_COMPONENT = re.compile(r"(.*?)[ _.:(\[-]*([xyz123])[)\]]?", re.IGNORECASE)


def fields_of_vector(named: str | None, fields: Collection[str]) -> list[str]:
    """The fields that hold a vector: one, or the ones of its components along x, y and, if there is one, z, as U1, U2
    and U3 of U. It is the displacement if it is not `named`; then none may hold it, and numbers count for nothing: they
    may be the ones of load cases. Components count if x and y are there, and none stands twice."""
    name = known_as(named or "displacement", fields)
    if name in fields:
        return [name]
    axes: dict[str, list[str]] = {}
    for field in fields:
        match = _COMPONENT.fullmatch(field.strip())
        if match and match[1].casefold() == name.casefold() and (named or not match[2].isdigit()):
            axes.setdefault("xyz"["xyz123".index(match[2].lower()) % 3], []).append(field)
    once = sorted(axes) in ([*"xy"], [*"xyz"]) and all(len(held) == 1 for held in axes.values())
    return [axes[axis][0] for axis in sorted(axes)] if once else [name] if named else []


def stems_of_vectors(fields: Collection[str]) -> list[str]:
    """What the names of fields have in common that are one number along each axis: "U" of UX, UY and UZ."""
    matches = [_COMPONENT.fullmatch(field.strip()) for field in fields]
    return sorted({match[1] for match in matches if match and match[1] and match[1] not in fields})


def told_of_components(named: str | None, fields: Collection[str]) -> list[str]:
    """A note on a displacement that is put together, if it is; see `fields_of_vector`."""
    parts = fields_of_vector(named, fields)
    return [f"the displacement is put together from {', '.join(parts)}"] if len(parts) > 1 else []


def displacement_of(frame: SourceMesh, named: str | None, read: Callable[..., np.ndarray]) -> np.ndarray | None:
    """The displacements of the points [n, 3] of a frame; None if it holds none. `read` is `raw_field`.

    Raises:
        DatasetError: they have other components than x, y and z, or x and y in a mesh that lies in a plane of these.
    """
    fields = fields_of_vector(named, frame.point_fields)
    if not fields:
        return None
    value = np.concatenate([read(frame, "point", one) for one in fields], axis=1)
    if value.shape[1] not in (2, 3):
        held = counted(value.shape[1], "component")
        raise DatasetError(f"{frame.path}: the displacement has {held}; must have 2 or 3")
    if value.shape[1] == 2:
        _require_plane(frame)
    return np.pad(value, ((0, 0), (0, 3 - value.shape[1])))


def _require_plane(frame: SourceMesh) -> None:
    """Raise DatasetError unless a mesh lies in a plane of x and y: a displacement of two components is along these."""
    if frame.is_solid:
        raise DatasetError(f"{frame.path}: the displacement of a body with a volume has 2 components; must have 3")
    points = frame.points[np.concatenate([np.zeros(0, np.int64), *(block.nodes.ravel() for block in frame.blocks)])]
    low, high = points[:, 2].min(initial=np.inf), points[:, 2].max(initial=-np.inf)
    if high - low > _AGREEMENT * np.ptp(points, axis=0).max(initial=0.0):
        raise DatasetError(
            f"{frame.path}: the displacement has 2 components, which are taken for x and y, but the mesh does not lie"
            f" in a plane of these (z is {low:g} to {high:g}): write 3 components"
        )


def rest_and_position(
    source: Path, at: np.ndarray, displacements: list[np.ndarray | None]
) -> tuple[np.ndarray, np.ndarray]:
    """The rest positions [N, 3] and the positions [S, N, 3] of nodes, from the points [S, N, 3] and the displacements
    of each frame.

    A file with displacements holds either the points at rest or the moved points. If the points are the same in all
    frames, they are the rest positions. If the points minus their displacements are the same, these are.
    """
    given = [one for one in displacements if one is not None]
    if not given:
        return at[0], at
    if len(given) < len(displacements):
        frame = next(frame for frame, one in enumerate(displacements) if one is None)
        raise DatasetError(f"{source}: frame {frame} has no displacement, others have")
    moved = np.stack(given)
    no_number = np.asarray(~np.isfinite(moved).all(axis=2))
    lacking = no_number.sum(axis=1)
    if lacking.any() and (no_number == no_number[0]).all():
        place = ", ".join(f"{x:g}" for x in at[0][np.argmax(no_number[0])])
        raise DatasetError(
            f"{source}: the displacement is no number at {counted(lacking[0], 'node')} in all frames, the first at"
            f" ({place}): does a part of the mesh lack the field? Write it for all nodes, 0 where nothing moves"
        )
    if lacking.any():
        frame = int(np.flatnonzero(lacking)[0])
        raise DatasetError(
            f"{source}: the displacement of frame {frame} is no number at {counted(lacking[frame], 'node')}: was"
            " the run stopped while it wrote this frame? Then leave the frame out"
        )
    if np.linalg.norm(_centred(moved[0]) - _centred(at[0])) < _POSITIONS * np.linalg.norm(_centred(at[0])):
        raise DatasetError(
            f"{source}: the displacement holds positions: in the first frame it is about the points themselves; write"
            " displacements, or the positions as points"
        )
    allowed = _AGREEMENT * np.ptp(at[0], axis=0).max()
    if np.abs(at - at[0]).max() <= allowed:
        return at[0], at[0] + moved
    back = at - moved
    if np.abs(back - back[0]).max() <= allowed:
        return back[0], at
    if len(at) > 1 and np.abs(np.diff(at, axis=0) - moved[1:]).max() <= allowed:
        raise DatasetError(
            f"{source}: the displacement is counted from the frame before: the points move by it from frame to frame;"
            " write the displacement from rest, or none"
        )
    raise DatasetError(
        f"{source}: the displacement does not fit the points: in some frame the points, and the points minus the"
        " displacement, differ from frame 0; name the right field"
    )


def _centred(points: np.ndarray) -> np.ndarray:
    return points - points.mean(axis=0)


def with_layers(source: Path, shells: Shells, rest: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rest points and positions with the points behind the shells, which turn with the shells.

    Raises:
        DatasetError: a shell is not rigid.
    """
    count = len(shells.nodes)
    for frame, points in enumerate(position):
        bent = shells.bent(rest, points)
        if bent is not None:
            raise DatasetError(
                f"{source}: the shell at {np.round(rest[bent[0]], 6).tolist()} is not rigid: in"
                f" frame {frame} an edge changes by {bent[1]:.3g};"
                " shells beside tetrahedra must be rigid: mesh this body with tetrahedra"
            )
    layers = np.stack([shells.behind(points) for points in position])
    return (
        np.concatenate([rest[:-count], shells.behind(rest)]),
        np.concatenate([position[:, :-count], layers], axis=1),
    )


def far_origin(points: np.ndarray) -> np.ndarray:
    """[3] float64: what is subtracted from points [N, 3] before they are rounded to float32.

    float32 has 24 bits: a mesh of size 1 at a distance of 5e6 keeps steps of 0.5. The origin is the centre of the
    points, rounded to a multiple of a power of ten that is 10 to 100 times the size of the mesh. So it is zero for a
    mesh near zero.
    """
    lowest, highest = points.min(axis=0), points.max(axis=0)
    size = (highest - lowest).max()
    if not np.isfinite(size) or size <= 0:
        return np.zeros(3)
    unit = 10.0 ** np.ceil(np.log10(10 * size))
    return np.round((lowest + highest) / 2 / unit) * unit + 0.0


def warn_of_rounding(source: Path, rest: np.ndarray, position: np.ndarray) -> None:
    """Warn if the displacements change when the rest points [N, 3] and the positions [S, N, 3] become float32."""
    small = rest.astype(np.float32).astype(np.float64)
    largest = max(np.abs(one - rest).max() for one in position)
    worst = max(np.abs(one.astype(np.float32) - small - (one - rest)).max() for one in position)
    if worst > _ROUNDING * largest:
        warn(
            f"{source}: the largest displacement is {largest:.3g}, and rounding to float32 changes displacements by up"
            f" to {worst:.3g}: the motion is too small for coordinates of up to {np.abs(position).max():.3g}"
        )

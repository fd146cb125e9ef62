"""Two axes that are exchanged in one simulation and not in others, as between programs in which z points up and
programs in which y does.

Turned as a whole, a simulation is as right as before. But two axes that are exchanged mirror a mesh: all its elements
are inside out in its files, or its points are the points of another simulation with two axes exchanged. And a flat mesh
lies across another axis than the others.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ast_sim.plausibility.findings import Finding
from ast_sim.scene import Trajectory

MIRRORED = "mirrored"  # an attribute of a simulation all of whose elements are inside out in its files

_NAMES = np.array(["x", "y", "z"])


class Axes(NamedTuple):
    """What tells the order of the axes: a digest of the elements, one of each column of the points at rest, the axis
    that a flat mesh lies across (3: it is not flat), and whether all elements are inside out in the files."""

    elements: bytes
    columns: tuple[bytes, ...]
    across: int
    mirrored: bool


def axes(trajectory: Trajectory) -> Axes:
    scene = trajectory.scene
    flat = np.flatnonzero(np.ptp(scene.rest_position, axis=0) == 0)
    return Axes(
        _digest(np.sort(scene.elements, axis=1)),
        tuple(_digest(column) for column in scene.rest_position.T),
        int(flat[0]) if len(flat) == 1 else 3,
        bool(trajectory.attributes.get(MIRRORED, False)),
    )


def other_order(known: Sequence[tuple[str, Axes]]) -> list[tuple[str, Finding]]:
    """Simulations by name two of whose axes are exchanged beside the others."""
    told = dict([*_across_another(known), *_mirrored(known), *_same_points(known)])
    what = "simulations whose axes stand in another order"
    return [(name, Finding(what, 1, where, "are two axes exchanged, such as y and z?")) for name, where in told.items()]


def _same_points(known: Sequence[tuple[str, Axes]]) -> Iterator[tuple[str, str]]:
    """With the points of other simulations, two axes exchanged. In a turned one, none or all stand elsewhere."""
    alike: dict[tuple[bytes, frozenset[bytes]], list[tuple[str, Axes]]] = {}
    for name, one in known:
        alike.setdefault((one.elements, frozenset(one.columns)), []).append((name, one))
    for simulations in alike.values():
        usual = Counter(one.columns for _, one in simulations).most_common(1)[0][0]
        other = next(name for name, one in simulations if one.columns == usual)
        if len({one.mirrored for _, one in simulations}) > 1:
            continue  # that says which ones are wrong
        for name, one in simulations:
            order = [usual.index(column) for column in one.columns]
            if len(set(order)) == 3 and sum(place == axis for axis, place in enumerate(order)) == 1:
                yield name, f"its x, y, z are {', '.join(_NAMES[order])} of {other}"


def _across_another(known: Sequence[tuple[str, Axes]]) -> Iterator[tuple[str, str]]:
    """Flat, and across another axis than most flat ones."""
    flat = [(name, one.across) for name, one in known if one.across < 3]
    usual = Counter(axis for _, axis in flat).most_common(1)
    for name, axis in flat:
        if axis != usual[0][0]:
            yield name, f"it lies across {_NAMES[axis]}, most others across {_NAMES[usual[0][0]]}"


def _mirrored(known: Sequence[tuple[str, Axes]]) -> Iterator[tuple[str, str]]:
    """Inside out in its files, where most others are not; or the other way round."""
    usual = 2 * sum(one.mirrored for _, one in known) > len(known)
    how = "are inside out in most other files, not in its own" if usual else "are inside out in its files alone"
    yield from ((name, f"all elements {how}") for name, one in known if one.mirrored != usual)


def _digest(array: np.ndarray) -> bytes:
    return hashlib.sha256(np.ascontiguousarray(array).data).digest()

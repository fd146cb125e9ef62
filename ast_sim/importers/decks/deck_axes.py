"""Where nodes and instances of a deck are: axes of their own (*SYSTEM), angles, the placement of an instance."""

from __future__ import annotations

import numpy as np

from ast_sim.importers.decks.deck_numbers import real, tokens
from ast_sim.importers.decks.keyword_lines import Keyword
from ast_sim.support.errors import DatasetError


def system_of(keyword: Keyword) -> np.ndarray | None:
    """An origin, a point on the x axis and one in the plane of x and y. The origin alone: the axes stay; without
    the third point z stays, and the x axis is projected onto the plane of x and y."""
    values = [real(text, line) for line in keyword.data for text in (*tokens(line), *[""] * 6)[:6]]
    if not values:
        return None
    if len(values) > 12:
        raise keyword.error("has more than two data lines")
    origin = np.array(values[:3])
    alone = len(values) == 6 and len(tokens(keyword.data[0])) <= 3
    x = np.array([1.0, 0, 0]) if alone else np.array(values[3:6]) - origin
    if len(values) == 6:
        x[2] = 0
    z = np.cross(x, np.array(values[6:9]) - origin) if len(values) > 6 else np.array([0.0, 0, 1])
    axes = np.stack([x, np.cross(z, x), z])
    lengths = np.linalg.norm(axes, axis=1, keepdims=True)
    if not (lengths > 0).all():
        raise keyword.error("its points lie on a line")
    return np.concatenate([axes / lengths, origin[None]])


def from_angles(points: np.ndarray, spherical: bool) -> np.ndarray:
    """Points of cylindrical (radius, angle, z) or spherical (radius, angle, angle from the plane) coordinates; angles
    are in degrees."""
    radius, angle, third = points.T
    angle = np.radians(angle)
    flat = radius * np.cos(np.radians(third)) if spherical else radius
    height = radius * np.sin(np.radians(third)) if spherical else third
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), height], axis=1)


def placement_of(keyword: Keyword, times: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and shift of an instance or a copy: it is first moved, then turned about the axis from one point to
    another, several `times`."""
    from scipy.spatial.transform import Rotation

    rows = [[real(text, line) for text in (*tokens(line), *[""] * 7)[:7]] for line in keyword.data]
    if len(rows) > 2:
        raise keyword.error("has more than two data lines")
    if rows and len(tokens(keyword.data[0])) > 3:  # an empty line for no shift is no data line here
        raise DatasetError(
            f"{keyword.data[0].place}: the first line of *{keyword.name} is its shift, three numbers: write 0, 0, 0"
            " before the line of a rotation"
        )
    if len(rows) == 2 and len(tokens(keyword.data[1])) != 7:
        raise DatasetError(
            f"{keyword.data[1].place}: a rotation has two points of its axis and an angle, seven numbers"
        )
    shift = np.array(rows[0][:3]) if rows else np.zeros(3)
    if len(rows) < 2:
        return np.eye(3), shift
    start = np.array(rows[1][:3])
    end = np.array(rows[1][3:6])
    angle = times * np.radians(rows[1][6])
    length = np.linalg.norm(end - start)
    if not length > 0:
        raise keyword.error("the axis of the rotation has no length")
    rotation = Rotation.from_rotvec(angle * (end - start) / length).as_matrix()
    return rotation, rotation @ (shift - start) + start

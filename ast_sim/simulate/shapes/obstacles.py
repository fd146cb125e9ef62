"""Rigid obstacles of seven shapes, made of structured tetrahedra around the origin. Their lower end is at negative z.

All are images of a cube of cells; each cell is cut into six tetrahedra. Lengths in metres.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from ast_sim.simulate.shapes import mesh

Mesh = tuple[np.ndarray, np.ndarray]


def _ellipsoid(size: np.ndarray, cells: int) -> Mesh:
    position, elements = mesh.ball(1.0, cells)
    return position * size, elements


def _frustum(x: np.ndarray, tip: float) -> np.ndarray:
    """Scale of the cross-section at the heights x in [-1,1]: `tip` at the lower end, 1 at the upper end."""
    return tip + (1 - tip) * (x + 1) / 2


def _cone(size: np.ndarray, cells: int) -> Mesh:
    """Truncated cone that points down."""
    along_x, elements = mesh.cylinder(1.0, 1.0, cells)
    x, y, z = along_x[:, [1, 2, 0]].T  # an even permutation: volumes keep their sign
    factor = size[0] * _frustum(z, 0.4)
    return np.stack([factor * x, factor * y, size[1] * z], axis=1), elements


def _wedge(size: np.ndarray, cells: int) -> Mesh:
    """Block whose lower face is narrow."""
    position, elements = mesh.block((1.0, 1.0, 1.0), cells)
    x, y, z = position.T
    return np.stack([x * _frustum(z, 0.3), y, z], axis=1) * size, elements


def _punch(size: np.ndarray, cells: int) -> Mesh:
    """Upright cylinder whose lower end is half an ellipsoid."""
    cells += cells % 2  # a layer of nodes in the plane between both halves
    cube, elements = mesh.block((1.0, 1.0, 1.0), cells)
    disc = mesh.rounded(cube[:, :2])
    position = np.where(cube[:, 2:] < 0, mesh.rounded(cube), np.concatenate([disc, cube[:, 2:]], axis=1))
    return position * size[[0, 0, 1]], elements


# Each function takes three drawn half sizes and the cells a side. Round shapes use only the first half size or two.
SHAPES: dict[str, Callable[[np.ndarray, int], Mesh]] = {
    "ball": lambda size, cells: mesh.ball(size[0], cells),
    "cylinder": lambda size, cells: mesh.cylinder(size[0], size[1], cells),
    "block": lambda size, cells: mesh.block(tuple(size), cells),
    "ellipsoid": _ellipsoid,
    "cone": _cone,
    "wedge": _wedge,
    "punch": _punch,
}


def _second_order(cells: int) -> np.ndarray:
    """[E,10] tetrahedra two cells long over the nodes of a cube of cells: their middles lie on the shape, too."""
    position, elements = mesh.second_order(*mesh.block((1.0, 1.0, 1.0), cells // 2))
    place = np.rint((position + 1) * cells / 2).astype(int)
    number = place @ np.array([(cells + 1) ** 2, cells + 1, 1])
    return number[elements]


def draw_obstacle(rng: np.random.Generator, cells: int, order: int = 1) -> tuple[str, np.ndarray, np.ndarray]:
    """Draw an obstacle, turned by a yaw and a small tilt: its shape, positions [N,3] and tetrahedra [E,4] or [E,10].

    Args:
        rng: where the draws come from.
        cells: number of cells along each side; an even number of second-order elements.
        order: of the elements.
    """
    shape = list(SHAPES)[rng.integers(len(SHAPES))]
    position, elements = SHAPES[shape](rng.uniform(0.035, 0.075, 3), cells)
    elements = elements if order == 1 else _second_order(cells)
    yaw, tilt, about = rng.uniform(0, np.pi), rng.uniform(0, 0.2), rng.uniform(0, 2 * np.pi)
    axis = np.array([np.cos(about), np.sin(about), 0])
    turn = Rotation.from_rotvec(-tilt * axis) * Rotation.from_rotvec([0, 0, -yaw])  # clockwise
    return shape, turn.apply(position), elements

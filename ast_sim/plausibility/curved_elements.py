"""Second-order tetrahedra of which a part is inside out: a node of an edge lies too far from its middle.

The determinant of the map from the straight element is a polynomial of the third degree. In Bernstein's form it lies
between the smallest and the largest of its 20 coefficients, and has four of them at the corners. So the coefficients
decide most elements; the others are cut into eight, and these again.

Legend: N nodes, E elements.
"""

from __future__ import annotations

from itertools import product
from math import factorial

import numpy as np

from ast_sim.element_topology import MIDDLES, linear_elements, signed_volumes, slopes_at

# A determinant below this share of the largest coefficient is none: positions are rounded to single precision.
_NONE = 1e-5

# How often an element is cut. What is not decided then has a determinant near 0 that is not below 0 at any corner.
_CUTS = 4

_BLOCK = 4096  # elements whose determinants are computed together

_POWERS = np.array([powers for powers in product(range(4), repeat=4) if sum(powers) == 3])  # [20, 4]
_LATTICE = _POWERS / 3
_CORNERS = np.flatnonzero((_POWERS == 3).any(axis=1))


def _bernstein(weights: np.ndarray) -> np.ndarray:
    """[n, 20] Bernstein's polynomials at points with these barycentric coordinates [n, 4]."""
    return np.stack([6 / np.prod([factorial(k) for k in one]) * np.prod(weights**one, axis=1) for one in _POWERS], 1)


def _of_eighths() -> np.ndarray:
    """[8, 20, 20]: from the coefficients of an element to the coefficients of each of its eighths."""
    corners = np.concatenate([np.eye(4), (np.eye(4)[[*zip(*MIDDLES, strict=True)]]).mean(axis=0)])
    eighths = corners[linear_elements(np.arange(10)[None])]  # [8, 4, 4]
    return np.stack([_FROM_VALUES @ _bernstein(_LATTICE @ one) for one in eighths])


_FROM_VALUES = np.linalg.inv(_bernstein(_LATTICE))
_SLOPES = slopes_at(_LATTICE)
_EIGHTHS = _of_eighths()


def partly_inside_out(points: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """[E] bool: the second-order tetrahedra [E, 10] whose determinant is 0 or less somewhere, with points [N, 3]. An
    element that is numbered inside out is looked at as if it were turned over."""
    wrong = np.zeros(len(elements), bool)
    sign = np.where(signed_volumes(points, elements) < 0, -1.0, 1.0)
    for first in range(0, len(elements), _BLOCK):
        rows = slice(first, first + _BLOCK)
        wrong[rows] = _not_positive(sign[rows] * (_FROM_VALUES @ _determinants(points, elements[rows])))
    return wrong


def _determinants(points: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """[20, E] the determinants at the points of the lattice."""
    at = np.ascontiguousarray(points.astype(np.float64)[elements].transpose(2, 1, 0)).reshape(3, 10, -1)
    (a, b, c), (d, e, f), (g, h, i) = np.einsum("kne,pnj->kjpe", at, _SLOPES, optimize=True)
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def _not_positive(coefficients: np.ndarray) -> np.ndarray:
    """[E] bool: whether polynomials with these coefficients [20, E] are 0 or less somewhere in their element."""
    limit = _NONE * np.abs(coefficients).max(axis=0)
    wrong = (coefficients[_CORNERS] <= limit).any(axis=0)
    owner = np.flatnonzero(~wrong & (coefficients <= limit).any(axis=0))
    parts = coefficients[:, owner]
    for _ in range(_CUTS):
        parts = np.concatenate([eighth @ parts for eighth in _EIGHTHS], axis=1)
        owner = np.tile(owner, len(_EIGHTHS))
        wrong[owner[(parts[_CORNERS] <= limit[owner]).any(axis=0)]] = True
        left = ~wrong[owner] & (parts <= limit[owner]).any(axis=0)
        owner = owner[left]
        parts = parts[:, left]
    return wrong

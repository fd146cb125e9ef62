"""The von Mises stress, from a field that holds it or from the components of a stress tensor."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ast_sim.importers.frames_in_file import XDMF
from ast_sim.support.errors import ConfigError, DatasetError

# Where the six components stand if nobody says so: the three normal stresses, then the shear stresses. CalculiX, VTK,
# Abaqus, LS-DYNA and Voigt's notation differ in the order of the shears alone, on which the von Mises stress does not
# depend.
_NORMAL_FIRST = ("xx", "yy", "zz", "xy", "yz", "xz")
_ORDERS = {
    4: ("xx", "yy", "zz", "xy"),
    6: _NORMAL_FIRST,
    9: ("xx", "xy", "xz", "yx", "yy", "yz", "zx", "zy", "zz"),
}
# A tensor of plane stress, as arrays of two rows and two columns have it.
_IN_THE_PLANE = ("xx", "xy", "yx", "yy")

# Units of stress in pascal.
STRESS_UNITS = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9, "psi": 6894.757293168}

_AXES = {"1": "x", "2": "y", "3": "z", **{axis: axis for axis in "xyz"}}


def parse_order(text: str) -> tuple[str, ...]:
    """The components of `xx,xy,xz,yy,yz,zz`.

    Raises:
        ConfigError: a component is unknown, missing or named twice.
    """
    order = tuple(part.strip().lower() for part in text.split(","))
    if not _is_order(order):
        raise ConfigError(f"{text!r} is no order of the components of a stress; an example is xx,yy,zz,xy,yz,xz")
    return order


def _is_order(order: tuple[str, ...]) -> bool:
    known = (*_ORDERS.values(), _IN_THE_PLANE)
    return sorted(map(_sorted, order)) in [sorted(map(_sorted, one)) for one in known]


def order_of(
    path: Path, name: str, values: np.ndarray, names: tuple[str, ...], given: tuple[str, ...]
) -> tuple[str, ...]:
    """The components that the columns of a stress field [rows, columns] hold; () if it holds the von Mises stress
    itself.

    Args:
        names: the names of the columns in the file, if it has any.
        given: the order that the user has named, or ().

    Raises:
        DatasetError: the field cannot be a stress, or its order is not certain.
    """
    columns = values.shape[1]
    if columns == 1:
        return ()
    if columns not in _ORDERS:
        raise DatasetError(
            f"{path}: the field {name!r} has {columns} components; must have one (von Mises stress), or 4, 6 or 9 of a"
            " stress tensor"
        )
    if given:
        if len(given) != columns:
            raise DatasetError(f"{path}: the field {name!r} has {columns} components, but the order names {len(given)}")
        if not _is_order(given):
            raise DatasetError(f"{path}: {', '.join(given)} is no order of the components of {name!r}")
        return given
    read = tuple(_component(text) for text in names)
    if len(read) == columns and _is_order(read):
        return read
    doubt = _doubt_of_order(path, values)
    if doubt:
        raise DatasetError(f"{path}: the order of the {columns} components of {name!r} is not certain: {doubt}")
    return _ORDERS[columns]


def _doubt_of_order(path: Path, values: np.ndarray) -> str:
    """Why the usual order may be wrong, and what to do; empty if nothing says so."""
    if path.suffix.lower() in XDMF and values.shape[1] == 6:
        return (
            "XDMF's own is xx, xy, xz, yy, yz, zz, but not all programs keep to it; say it, stress_order=('xx', 'yy',"
            " 'zz', 'xy', 'yz', 'xz') (--stress-order xx,yy,zz,xy,yz,xz)"
        )
    if values.shape[1] == 4 and values[:, 1].any() and np.array_equal(values[:, 1], values[:, 2]):
        return (
            "the second and the third are equal in all rows, as xy and yx are; say it, stress_order=('xx', 'xy', 'yx',"
            " 'yy') (--stress-order xx,xy,yx,yy), or xx,yy,zz,xy"
        )
    return ""


def are_components(names: Iterable[str]) -> bool:
    """Whether fields of these names seem to be the components of a stress."""
    return len({_sorted(_component(name)) for name in names} & set(_NORMAL_FIRST)) >= len(_ORDERS[4])


def von_mises(values: np.ndarray, order: tuple[str, ...]) -> np.ndarray:
    """[...]: sqrt(((xx - yy)^2 + (yy - zz)^2 + (zz - xx)^2) / 2 + 3 (xy^2 + yz^2 + xz^2)) of components [...,
    columns]."""
    parts: dict[str, np.ndarray] = {}
    for column, component in enumerate(order):
        key = _sorted(component)
        parts[key] = (parts[key] + values[..., column]) / 2 if key in parts else values[..., column]
    zero = np.zeros_like(values[..., 0])
    xx, yy, zz, xy, yz, xz = (parts.get(key, zero) for key in _NORMAL_FIRST)
    normal = (xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2
    return np.sqrt(normal / 2 + 3 * (xy**2 + yz**2 + xz**2))


def _component(text: str) -> str:
    """The component that the name of a column ends with: "xy" of SXY, S12, stress_XY; "" if none."""
    axes = re.search(r"([xyz123])[ ,_-]?([xyz123])$", text.strip().lower())
    return _AXES[axes[1]] + _AXES[axes[2]] if axes else ""


def _sorted(component: str) -> str:
    return "".join(sorted(component))

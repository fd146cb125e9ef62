"""The von Mises stress, from a field that holds it or from the components of a stress tensor."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ast_sim.importers.formats.source_mesh import SourceMesh, known_as, without_separator
from ast_sim.importers.frames_in_file import XDMF
from ast_sim.importers.mesh_file import raw_field
from ast_sim.support.errors import ConfigError, DatasetError, counted

# Where the six components stand if nobody says so: the three normal stresses, then the shear stresses. CalculiX, VTK,
# Abaqus, LS-DYNA and Voigt's notation differ in the order of the shears alone, on which the von Mises stress does not
# depend.
_NORMAL_FIRST = ("xx", "yy", "zz", "xy", "yz", "xz")
_ORDERS = {
    4: ("xx", "yy", "zz", "xy"),
    6: _NORMAL_FIRST,
    9: ("xx", "xy", "xz", "yx", "yy", "yz", "zx", "zy", "zz"),
}
_TENSORS = {(count,) for count in _ORDERS}
# A tensor of plane stress, as arrays of two rows and two columns have it.
_IN_THE_PLANE = ("xx", "xy", "yx", "yy")

_PAIRS = ("xy", "yz", "xz")

# Units of stress in pascal.
STRESS_UNITS = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9, "psi": 6894.757293168}

# A stress is symmetric if the components of a pair, such as xy and yx, differ by less than this share of the largest.
_SYMMETRIC = 1e-3

_AXES = {"1": "x", "2": "y", "3": "z", **{axis: axis for axis in "xyz"}}

# What a name ends with that is a component: stress_xy, S11, sigma-xz, Stress(y,y), and, for a normal stress, SX.
_BETWEEN = r"(.*?)[ _.:(\[-]*"
_TWO_AXES = re.compile(_BETWEEN + r"([xyz123])[ ,_-]?([xyz123])[)\]]?", re.IGNORECASE)
_ONE_AXIS = re.compile(_BETWEEN + r"([xyz])[)\]]?", re.IGNORECASE)


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
            f"{path}: the field {name!r} has {counted(columns, 'component')}; must have one (von Mises stress), or 4, 6"
            " or 9 of a stress tensor"
        )
    if given:
        if len(given) != columns:
            raise DatasetError(
                f"{path}: the field {name!r} has {counted(columns, 'component')}, but the order names {len(given)}"
            )
        if not _is_order(given):
            raise DatasetError(f"{path}: {', '.join(given)} is no order of the components of {name!r}")
        return given
    read = tuple(component for _, component in map(_split, names))
    if len(read) == columns and _is_order(read):
        return read
    if any(read):
        raise DatasetError(
            f"{path}: the columns of {name!r} are called {', '.join(names)}, which is no order of the components of a"
            " stress: say it, stress_order=('xx', ...) (--stress-order xx,...)"
        )
    doubt = _doubt_of_order(path, values)
    if doubt:
        raise DatasetError(
            f"{path}: the order of the {counted(columns, 'component')} of {name!r} is not certain: {doubt}"
        )
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


def stems_of(names: Iterable[str]) -> list[str]:
    """What the names of fields have in common that seem to be the components of one stress: "S" of S11, S22, ..."""
    components = defaultdict(set)
    written: dict[str, str] = {}
    for name in names:
        stem, component = _split(name)
        components[stem.casefold()].add(_sorted(component))
        written.setdefault(stem.casefold(), stem)
    least = len(_ORDERS[4])
    return [written[stem] for stem, held in components.items() if len(held & {*_NORMAL_FIRST}) >= least]


def stem_of(name: str, names: Iterable[str]) -> str:
    """The one of `stems_of` fields of which the field `name` is a component; "" if none."""
    stem, component = _split(name)
    return next((one for one in stems_of(names) if component and one.casefold() == stem.casefold()), "")


def of_components(frame: SourceMesh, name: str, given: tuple[str, ...]) -> SourceMesh:
    """A frame with the stress `name` as one field, if the file has a field for each component, such as S11 or
    stress_xy. Its columns stand in the `given` order, else as usual.

    Raises:
        DatasetError: a component is missing, stands twice, or has several columns; the text names it.
    """
    if name in frame.point_fields or name in frame.cell_fields:
        return frame
    whole = _under_its_name(frame, name)
    if whole is not None:
        return whole
    at_points = {field: np.asarray(values) for field, values in frame.point_fields.items()}
    of_cells = {field: np.concatenate(parts) for field, parts in frame.cell_fields.items() if parts}
    both = [_held(frame.path, name, fields) for fields in (at_points, of_cells)]
    if not any(both):
        return frame
    usual = [_NORMAL_FIRST, *([] if frame.is_solid else [_ORDERS[4]])]
    orders = [given] if given else usual
    whole = [(held, order) for held in both for order in orders if {*order} <= held.keys()]
    if whole and not given and all(held[pair] is not held[pair[::-1]] for held, _ in whole[:1] for pair in _PAIRS):
        whole = [(whole[0][0], _ORDERS[9])]
    if not whole:
        there = max(both, key=len)
        lacking = ", ".join(component for component in orders[-1] if component not in there)
        listed = ", ".join(dict.fromkeys(field for field, _ in there.values()))
        raise DatasetError(
            f"{frame.path}: of the components of {name!r}, {lacking} are missing; there are {listed}: write all of them"
            " (0 where there is no stress), or the von Mises stress"
        )
    held, order = whole[0]
    values = np.stack([held[component][1] for component in order], axis=1)
    frame = replace(frame, columns={**frame.columns, name: order})
    if held is both[0]:
        return replace(frame, point_fields={**frame.point_fields, name: values})
    parts = np.split(values, np.cumsum([len(block.nodes) for block in frame.blocks])[:-1])
    return replace(frame, cell_fields={**frame.cell_fields, name: parts})


def _under_its_name(frame: SourceMesh, name: str) -> SourceMesh | None:
    """A frame that has a whole tensor under this name as well, if it has it as `name_`; else None."""
    known = known_as(name, [*frame.point_fields, *frame.cell_fields])
    columns = {**frame.columns, name: frame.columns.get(known, ())}
    if known in frame.point_fields and frame.point_fields[known].shape[1:] in _TENSORS:
        return replace(frame, point_fields={**frame.point_fields, name: frame.point_fields[known]}, columns=columns)
    if known in frame.cell_fields and {part.shape[1:] for part in frame.cell_fields[known]} <= _TENSORS:
        return replace(frame, cell_fields={**frame.cell_fields, name: frame.cell_fields[known]}, columns=columns)
    return None


def _held(path: Path, name: str, fields: dict[str, np.ndarray]) -> dict[str, tuple[str, np.ndarray]]:
    """The field and the values of each component of a stress; xy also stands for yx. Two or three columns are a row
    of the tensor: VTK makes `stress_x` of the fields stress_xx, stress_xy and stress_xz of Exodus."""
    held: dict[str, tuple[str, np.ndarray]] = {}
    for field, values in fields.items():
        stem, component = _split(field)
        if not component or stem.casefold() != without_separator(name).casefold() or values.dtype.kind not in "iufb":
            continue
        columns = values.reshape(len(values), -1)
        count = columns.shape[1]
        if count > 1 and (count > 3 or _TWO_AXES.fullmatch(field.strip())):
            raise DatasetError(f"{path}: the field {field!r} must have one number in each row, as a part of a stress")
        parts = [component[0] + axis for axis in "xyz"[:count]] if count > 1 else [component]
        for part, column in zip(parts, columns.T, strict=True):
            if part in held:
                raise DatasetError(f"{path}: the component {part} of {name!r} is {held[part][0]!r} and {field!r}")
            held[part] = field, column
    for part in [*held]:
        held.setdefault(part[::-1], held[part])
    return held


def stress_place(
    frame: SourceMesh, stress: str | None, given: tuple[str, ...]
) -> tuple[str, tuple[str, ...], list[str]]:
    """Where a file holds the stress ("none", "node" or "element"), the components of its columns, and notes on them.

    Raises:
        DatasetError: there is no field of this name, or it is none of a whole stress; the text names what there is.
    """
    name = stress or "von_mises"
    on_points = name in frame.point_fields
    on_cells = name in frame.cell_fields
    if not on_points and not on_cells:
        if stress is not None:
            known = sorted({*frame.point_fields, *frame.cell_fields})
            stems = " or ".join(map(repr, stems_of(known)))
            parts = f"; a stress whose components are fields is named by what these have in common: {stems}"
            listed = ", ".join(known) or "none"
            why = next((f": {note}" for note in frame.notes if repr(stress) in note), "")
            told = f"there is no field {stress!r}{why}; there are: {listed}{parts if stems else ''}"
            raise DatasetError(f"{frame.path}: {told}")
        return "none", (), []
    whole = stem_of(name, [*frame.point_fields, *frame.cell_fields])
    if whole:
        raise DatasetError(f"{frame.path}: {name!r} is one component of a stress: name what all have, {whole!r}")
    values = raw_field(frame, "point" if on_points else "cell", name)
    order = order_of(frame.path, name, values, frame.columns.get(name, ()), given)
    if len(order) == 4 and not given and frame.is_solid:
        raise DatasetError(
            f"{frame.path}: the field {name!r} has the components {', '.join(order)}, and the stress of a body with a"
            " volume has six: write all of them, or the von Mises stress; if the others are 0, say"
            f" stress_order=({', '.join(map(repr, order))}) (--stress-order {','.join(order)})"
        )
    notes: list[str] = []
    if on_points and on_cells:
        notes.append(f"{name!r} is a field of points and one of cells: the one of points is taken")
    if order:
        notes.append(f"the von Mises stress is computed from the components {', '.join(order)} of {name!r}")
    return "node" if on_points else "element", order, notes


@dataclass
class Symmetry:
    """The largest component of a stress in all frames, and where xy and yx, or another pair, differ most."""

    largest: float = 0.0
    off: float = 0.0
    told: str = ""

    def look(self, path: Path, values: np.ndarray, order: tuple[str, ...]) -> None:
        """Take the stress of a frame, [rows, columns]."""
        columns = dict(zip(order, values.T, strict=False))
        self.largest = float(np.nanmax(np.abs(values), initial=self.largest)) if order else self.largest
        for pair in _PAIRS:
            if {pair, pair[::-1]} <= columns.keys():
                with np.errstate(invalid="ignore"):  # infinite values are told elsewhere
                    off = float(np.nanmax(np.abs(columns[pair] - columns[pair[::-1]]), initial=0.0))
                if off > self.off:
                    self.off = off
                    self.told = f"{pair} and {pair[::-1]} differ by up to {off:.3g} in {path.name}"

    def require(self, source: Path, name: str) -> None:
        """Raise DatasetError if the stress is not symmetric, by more than rounding."""
        if self.off > _SYMMETRIC * self.largest:
            raise DatasetError(
                f"{source}: {name!r} is not symmetric: {self.told}, and its largest component is {self.largest:.3g}: is"
                " it the first Piola-Kirchhoff stress, or a gradient? Write Cauchy's stress, or the von Mises stress"
            )


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


def _split(text: str) -> tuple[str, str]:
    """The name of a field or column without the component at its end, and the component; "" if none."""
    two = _TWO_AXES.fullmatch(text.strip())
    if two:
        return two[1], _AXES[two[2].lower()] + _AXES[two[3].lower()]
    one = _ONE_AXIS.fullmatch(text.strip())
    return (one[1], 2 * one[2].lower()) if one else (text, "")


def _sorted(component: str) -> str:
    return "".join(sorted(component))

"""MED files, in a form that meshio reads: their fields and the names of their groups; what it reads over in them."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ast_sim.support.errors import DatasetError, counted

# What MED calls the place of a field that is on all nodes, or on all cells of a kind.
_ON_ALL = "MED_NO_PROFILE_INTERNAL"

# What h5py raises where a file lacks something: it stays as it is, and meshio says what is wrong.
_LACKING = (OSError, KeyError, AttributeError, TypeError)


def plain_med(path: Path) -> tuple[bytes, list[str]]:
    """A MED file whose fields have a value for each node or cell, without the families that have no groups, for whose
    names meshio looks; the other groups have letters in place of bytes. A note tells which fields are left out.

    Raises:
        DatasetError: its coordinates are not along x, y and z.
    """
    copy = io.BytesIO(path.read_bytes())
    notes: list[str] = []
    with contextlib.suppress(OSError), h5py.File(copy, "r+") as file:
        with contextlib.suppress(*_LACKING):
            _require_cartesian(path, file)
        with contextlib.suppress(*_LACKING, ValueError):
            notes += _leave_out_fields_within_cells(file)
            _complete_fields(file)
        with contextlib.suppress(*_LACKING):
            _complete_families(file)
    return copy.getvalue(), notes


def _require_cartesian(path: Path, file: Any) -> None:
    for name, mesh in file["ENS_MAA"].items():
        if mesh.attrs.get("REP", 0) != 0:
            raise DatasetError(f"{path}: the coordinates of {name} are not along x, y and z: write Cartesian ones")


def _leave_out_fields_within_cells(file: Any) -> list[str]:
    """Take away the fields with values at the nodes of each element, or at several points in it, and tell them."""
    names = [name for name, steps in file["CHA"].items() if _is_within_cells(steps)]
    for name in names:
        del file["CHA"][name]
    fields = "with several values in a cell"
    are = counted(len(names), f"field {fields} is", f"fields {fields} are")
    return [f"{are} left out: {', '.join(map(repr, names))}"] if names else []


def _complete_fields(file: Any) -> None:
    """Write the fields with a value for each node or cell, NaN where there is none: meshio stops at fields on a part of
    the mesh."""
    (mesh,) = file["ENS_MAA"].values()
    (mesh,) = (mesh,) if "NOE" in mesh else mesh.values()
    nodes = {"NOE": mesh["NOE"]["COO"].attrs["NBR"]}
    cells = {f"MAI.{kind}": one["NOD"].attrs["NBR"] for kind, one in mesh["MAI"].items()}
    for steps in file["CHA"].values():
        for step in steps.values():
            for sizes in (nodes, cells):
                for place, size in sizes.items() if sizes.keys() & step.keys() else ():
                    values = np.full((size, steps.attrs["NCO"]), np.nan)
                    for profile, part in step.get(place, {}).items():
                        rows = slice(None) if profile == _ON_ALL else file["PROFILS"][profile]["PFL"][()] - 1
                        values[rows] = part["CO"][()].reshape(values.shape[1], -1).T
                    _write_on_all(step, place, values)


def _write_on_all(step: Any, place: str, values: np.ndarray) -> None:
    if place in step:
        del step[place]
    part = step.create_group(f"{place}/{_ON_ALL}")
    part.parent.attrs["PFL"] = np.bytes_(_ON_ALL)
    part.attrs.update(NBR=len(values), NGA=1)
    part["CO"] = values.T.ravel()


def _is_within_cells(steps: Any) -> bool:
    """Whether a field of a MED file has values at the nodes of each element, or at several points in it."""
    parts = [(place, one) for step in steps.values() for place, held in step.items() for one in held.values()]
    return any(place.startswith("NOE.") or one.attrs.get("NGA", 1) > 1 for place, one in parts)


def _complete_families(file: Any) -> None:
    """Take away the families without groups, and spell the groups of the others."""
    for place in [one[part] for one in file["FAS"].values() for part in ("ELEME", "NOEUD") if part in one]:
        for name, family in list(place.items()):
            if "GRO" in family:
                _spell(family["GRO"])
            else:
                del place[name]


def _spell(groups: Any) -> None:
    """Store the letters of the names of MED groups, which are bytes of UTF-8, or of Latin-1 in old files: meshio takes
    each byte for a letter, and fails on those that are not ASCII."""
    names = [_letters(row.tobytes()).rstrip("\0 ") for row in groups["NOM"][()]]
    width = max(1, *map(len, names))
    del groups["NOM"]
    groups.create_dataset("NOM", data=[[ord(letter) for letter in name.ljust(width)] for name in names])


def _letters(name: bytes) -> str:
    try:
        return name.decode("utf-8")
    except UnicodeDecodeError:
        return name.decode("latin-1")

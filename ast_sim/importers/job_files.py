"""Which simulations have a deck beside their results, and in which units its numbers are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ast_sim.dataset.layout import LENGTH_UNITS
from ast_sim.importers.series import FieldNames
from ast_sim.importers.stress import STRESS_UNITS
from ast_sim.material import YOUNG, listed_columns
from ast_sim.scene import Trajectory
from ast_sim.support.errors import ConfigError, DatasetError, warn

# Young's modulus of the softest gels and of diamond, in pascal.
_SOFTEST = 1e2
_STIFFEST = 2e12


def decks_of(source: Path, series: Mapping[str, Path], deck: Path | str | None, names: FieldNames) -> dict[str, Path]:
    """The decks of the simulations that have one: `deck`, or in a folder the decks with the names of `.frd` files,
    unless the field of the displacement is named: then the results are read alone.

    Raises:
        DatasetError: there is a deck, but the source is no file of CalculiX.
    """
    if deck is not None:
        if source.suffix.lower() != ".frd":
            raise DatasetError(f"{source}: beside a deck, results must be a file of CalculiX (.frd)")
        return dict.fromkeys(series, Path(deck))
    if not source.is_dir() or names.displacement is not None:
        return {}
    beside = {name: path.with_suffix(".inp") for name, path in series.items() if path.suffix.lower() == ".frd"}
    return {name: path for name, path in beside.items() if path.is_file()}


def with_units(decks: Mapping[str, Path], names: FieldNames, length_unit: str | None) -> FieldNames:
    """The names, with a unit of stress and, beside a deck, the unit of force that goes with it and with the lengths.

    Raises:
        ConfigError: the unit is unknown, or there is a deck, which does not say its units, and one is not given.
    """
    if names.stress_unit is not None and names.stress_unit not in STRESS_UNITS:
        raise ConfigError(f"there is no unit of stress {names.stress_unit!r}; known are {', '.join(STRESS_UNITS)}")
    if decks and (length_unit is None or names.stress_unit is None):
        raise ConfigError(
            f"{next(iter(decks.values()))}: a deck does not say its units; give both, for example length_unit='mm' and"
            " FieldNames(stress_unit='MPa') (--length-unit mm --stress-unit MPa), or m and Pa"
        )
    names = replace(names, stress_unit=names.stress_unit or "Pa")
    if decks and length_unit in LENGTH_UNITS:
        names = replace(names, newton=STRESS_UNITS[names.stress_unit or "Pa"] * LENGTH_UNITS[length_unit] ** 2)
    return names


def doubt_modulus(deck: Path, trajectory: Trajectory, unit: str) -> None:
    """Warn if Young's modulus is one that no common material has, or about 1: then another unit may be meant."""
    columns = listed_columns(trajectory.attributes)
    if trajectory.scene.material is None or YOUNG not in columns:
        return
    moduli = np.unique(trajectory.scene.material[trajectory.scene.deforming("element"), columns.index(YOUNG)])
    shown = moduli / STRESS_UNITS[unit]
    doubtful = (moduli < _SOFTEST) | (moduli > _STIFFEST) | ((shown > 0.1) & (shown < 10) & (unit != "GPa"))
    if doubtful.any():
        warn(
            f"{deck}: Young's modulus is {shown[doubtful][0]:g} {unit}: is this the unit of stress beside this unit of"
            " length? Rubber has about 5 MPa, steel 210000 MPa (210 GPa)"
        )

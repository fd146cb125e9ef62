"""Parts that yield: their hardening, and what of it stands in the material of a scene."""

from __future__ import annotations

import numpy as np

from ast_sim.material import FRICTION, POISSON, YIELD_STRESS, YOUNG
from ast_sim.simulate.own_assembly.assembly_spec import AssemblySpec, PartSpec
from ast_sim.simulate.own_assembly.parameters import Values
from ast_sim.support.errors import ConfigError


def hardening_of(part: PartSpec, values: Values) -> np.ndarray:
    """[rows, 2] float64: true stress in pascal and plastic strain, of a part that yields; no rows for others.

    Raises:
        ConfigError: the numbers are none of a hardening.
    """
    table = np.array([[one(values) for one in row] for row in part.hardening]).reshape(-1, 2)
    if not len(table):
        return table
    stress, strain = table.T
    told = ", ".join(f"[{a:.4g}, {b:.4g}]" for a, b in table)
    where = f"parts.{part.name}.hardening is {told}"
    if not np.isfinite(table).all() or stress[0] <= 0:
        raise ConfigError(f"{where}; stresses must be finite and above 0 (pascal)")
    if strain[0] != 0 or (np.diff(strain) <= 0).any():
        raise ConfigError(f"{where}; plastic strains, the second numbers, must begin at 0 and ascend")
    if (np.diff(stress) < 0).any():
        raise ConfigError(f"{where}; stresses, the first numbers, must not fall: metal that softens is not solved")
    return table


def hardening_columns(spec: AssemblySpec, values: Values) -> np.ndarray:
    """[bodies, columns] float64: the columns of the material that follow from the hardening of each part.

    These are the yield stress, then the stress and the plastic strain of each further row. A table with fewer rows
    repeats its last one. Parts that do not yield have zeros.
    """
    tables = [hardening_of(part, values) for part in spec.parts]
    rows = max(len(table) for table in tables)
    columns = np.zeros((len(tables), max(2 * rows - 1, 0)))
    for number, table in enumerate(tables):
        if len(table):
            stress, strain = table[np.minimum(np.arange(rows), len(table) - 1)].T
            columns[number, 0] = stress[0]
            columns[number, 1::2] = stress[1:]
            columns[number, 2::2] = strain[1:]
    return columns


def material_columns(spec: AssemblySpec, friction_is_drawn: bool) -> list[str]:
    """The names of the columns of the material in the scenes of a specification."""
    rows = max(len(part.hardening) for part in spec.parts)
    further = [f"{name}_{row}" for row in range(2, rows + 1) for name in (YIELD_STRESS, "plastic_strain")]
    return [YOUNG, POISSON, *[FRICTION] * friction_is_drawn, *[YIELD_STRESS] * bool(rows), *further]

"""The scene families that can be generated, by name; their modules are imported when they are used.

A family is a module of this package with `INFO` (DatasetInfo), `DEFAULT_NODES`, `MINIMUM_NODES`,
`draw(rng, nodes, ...) -> case`, which takes its draws from `rng` alone, and `solve(case, checkpoint) -> Trajectory`.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from types import ModuleType

from ast_sim.errors import SimulationError


@dataclass(frozen=True)
class Family:
    """What is known of a family before its module is imported.

    Attributes:
        about: one line for a user.
        options: the options that it has beside the number of nodes: "frames" and "parts" of its drawing, "solver".
        packages: what its scenes depend on beside what all depend on: their versions are recorded.
    """

    about: str
    options: tuple[str, ...] = ()
    packages: tuple[str, ...] = ()


FAMILIES = {
    "deforming_plate": Family("clamped plates that a rigid obstacle presses in and lets go", ("frames", "solver")),
    "sphere_simple": Family("a hanging cloth and a sphere that moves through it, with inertia"),
    "abcd": Family("two CAD-like parts squeezed together, 4,000 nodes", ("parts", "solver"), ("gmsh", "meshio")),
    "abcd_xl": Family("the same with 100,000 nodes: hours a scene", ("parts", "solver"), ("gmsh", "meshio")),
}


def family_module(family: str) -> ModuleType:
    """The module of a scene family.

    Raises:
        SimulationError: an unknown family.
        MissingExtra: an extra that it needs is not installed.
    """
    if family not in FAMILIES:
        raise SimulationError(f"there is no scene family {family!r}; use one of {', '.join(FAMILIES)}")
    return importlib.import_module(f"ast_sim.simulate.{family}")

"""The scene families that can be generated, by name. The module of a family is imported when it is used.

Such a module has `INFO` (DatasetInfo), `DEFAULT_NODES`, `MINIMUM_NODES`, `FRAMES` (frames of a scene, unless it is an
option), `draw(rng, nodes, ...) -> case`, which takes all of its draws from `rng`, and
`solve(case, checkpoint) -> Trajectory`. One without inertia also has `SETTINGS` (SolverSettings) and
`draw_geometry(rng, nodes, ...) -> Drawn`, which draws the same and can be meshed again. One with the option order also
has `SECOND_ORDER_NODES`, the `MINIMUM_NODES` of such scenes. The family `assembly` has
`info`, `check_spec` and `draw_scene` instead of `INFO` and the two: they depend on a specification.
What it needs of the solver is imported from `ast_sim.mechanics`. docs/how-to/new-family.md shows a family.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from types import ModuleType

from ast_sim.support.errors import ConfigError, nearest_name


@dataclass(frozen=True)
class Family:
    """What is known of a family before its module is imported.

    Attributes:
        about: one line for a user.
        options: the options of `generate` that it has beside the number of nodes: "frames", "keep", "order", "parts",
            "solver", "spec" (which is an argument).
        packages: packages that only its scenes depend on. The dataset records their versions.
    """

    about: str
    options: tuple[str, ...] = ()
    packages: tuple[str, ...] = ()


_PARTS = ("gmsh", "meshio")
FAMILIES = {
    "deforming_plate": Family(
        "clamped plates that a rigid obstacle presses in and lets go", ("frames", "keep", "order", "solver")
    ),
    "sphere_simple": Family("a hanging cloth and a sphere that pushes into it, with inertia"),
    "abcd": Family("two CAD-like parts squeezed together, 4,000 nodes", ("keep", "parts", "solver"), _PARTS),
    "abcd_xl": Family("abcd with 100,000 nodes: a scene takes hours", ("keep", "parts", "solver"), _PARTS),
    "assembly": Family(
        "your own parts with your own motion and ranges, from SPEC.toml", ("spec", "frames", "keep", "solver"), _PARTS
    ),
}

MODULES = {family: f"{__package__}.{family}" for family in FAMILIES}


def family_module(family: str) -> ModuleType:
    """The module of a scene family.

    Raises:
        ConfigError: the family is unknown.
        MissingExtra: an extra that the family needs is not installed.
    """
    if family not in FAMILIES:
        raise ConfigError(f"there is no scene family {family!r}{nearest_name(family, FAMILIES)}")
    return importlib.import_module(MODULES[family])

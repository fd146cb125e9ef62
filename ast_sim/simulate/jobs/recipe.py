"""The settings that determine a dataset, as the dataset records them. The same settings give the same bytes."""

from __future__ import annotations

import importlib.metadata
import shlex
from collections.abc import Sequence
from dataclasses import asdict
from itertools import pairwise
from operator import index
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import ast_sim
from ast_sim.simulate.families.names import FAMILIES
from ast_sim.simulate.jobs.samples import Recipe
from ast_sim.support.errors import SimulationError

if TYPE_CHECKING:
    from ast_sim.simulate.shapes.part_source import PartSource

# Another linear solver gives other last bits, so it is also recorded which solvers are not installed.
PACKAGES = ("numpy", "scipy", "ipctk", "pypardiso", "mkl", "cholespy")
SOLVERS = ("own", "calculix")


def checked_recipe(
    module: ModuleType,
    family: str,
    seed: int,
    nodes: int | None,
    frames: int | None,
    solver: str | None,
    parts: str | Path | None,
    patient: bool = False,
    keep: Sequence[int] | None = None,
) -> Recipe:
    """The recipe with these settings, after a check. A setting that is None takes the family's default.

    Raises:
        SimulationError: a value is invalid, or the family does not have an option.
    """
    for name, value in (("frames", frames), ("keep", keep), ("solver", solver), ("parts", parts)):
        if value is not None and name not in FAMILIES[family].options:
            having = ", ".join(key for key, known in FAMILIES.items() if name in known.options)
            raise SimulationError(f"{family} has no option {name}; these families have it: {having}")
    nodes = module.DEFAULT_NODES if nodes is None else nodes
    if "frames" in FAMILIES[family].options:
        frames = module.FRAMES if frames is None else frames
        if frames < module.MINIMUM_FRAMES:
            raise SimulationError(f"frames is {frames}; must be at least {module.MINIMUM_FRAMES}")
    for name, value, minimum in (("seed", seed, 0), ("nodes", nodes, module.MINIMUM_NODES)):
        if value < minimum:
            raise SimulationError(f"{name} is {value}; must be at least {minimum}")
    solver = solver or "own"
    if solver not in SOLVERS:
        raise SimulationError(f"there is no solver {solver!r}; use one of {', '.join(SOLVERS)}")
    if patient and solver != "own":
        raise SimulationError(f"patient is for the own solver; {solver} has limits of its own")
    if parts is not None:
        _source(parts)
    if keep is not None:
        keep = _checked_keep(keep, (frames or module.FRAMES) - 1)
    parts = None if parts is None else str(Path(parts).resolve())
    return Recipe(family, seed, nodes, frames, solver, parts, patient, keep)


def _checked_keep(keep: Sequence[int], last: int) -> tuple[int, ...]:
    """The numbers of the frames to keep, after a check; `last` is the number of the last frame."""
    kept = tuple(map(index, keep))
    if not kept or not all(1 <= frame <= last for frame in kept):
        raise SimulationError(f"keep is {list(kept)}; must be numbers of frames from 1 to {last}, beside frame 0")
    if any(later <= earlier for earlier, later in pairwise(kept)):
        raise SimulationError(f"keep is {list(kept)}; the numbers of frames must ascend")
    return kept


def recorded(recipe: Recipe) -> dict[str, Any]:
    """All settings that the arrays of a sample depend on, except its split and index. The dataset keeps them.

    Raises:
        SimulationError: the parts or the solver are not there.
        MissingExtra: a package that the solver or the parts need is not installed.
    """
    used = {key: value for key, value in asdict(recipe).items() if value is not None and value is not False}
    if recipe.keep is not None:
        used["keep"] = list(recipe.keep)  # as the file gives it back
    if "parts" in FAMILIES[recipe.family].options:
        used |= _source(recipe.parts).describe()
    return {
        "program": f"ast_sim {ast_sim.__version__}",
        "versions": _versions(recipe),
        **used,
        "command": _command(recipe),
        "licence": "CC0-1.0",
    }


def difference(found: dict[str, Any], wanted: dict[str, Any], there: str = "there", here: str = "here") -> str:
    """The first setting that differs, in words; empty if all agree."""
    for key, value in wanted.items():
        other = found.get(key)
        if isinstance(value, dict) and isinstance(other, dict):
            inner = difference(other, value, there, here) or next((f"{k} {there}" for k in other.keys() - value), "")
            if inner:
                return f"{key}: {inner}"
        elif other != value:
            return f"{key} {other} {there}, {value} {here}"
    return ""


def check_parts(recipe: Recipe) -> None:
    """Raise SimulationError if one of the user's parts is broken."""
    if recipe.parts is not None:
        _source(recipe.parts).check()


def _source(parts: str | Path | None) -> PartSource:
    from ast_sim.simulate.shapes.part_source import part_source

    return part_source(None if parts is None else Path(parts))


def _versions(recipe: Recipe) -> dict[str, str | None]:
    versions: dict[str, str | None] = {}
    for name in (*PACKAGES, *FAMILIES[recipe.family].packages):
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = None
    if recipe.solver == "calculix":
        from ast_sim.simulate.calculix.solve import find_ccx, version

        versions["calculix"] = version(find_ccx())
    return versions


def _command(recipe: Recipe) -> str:
    words = ["ast-sim", "generate", recipe.family, "--seed", str(recipe.seed), "--nodes", str(recipe.nodes)]
    if recipe.frames is not None:
        words += ["--frames", str(recipe.frames)]
    if recipe.solver != "own":
        words += ["--solver", recipe.solver]
    if recipe.parts is not None:
        words += ["--parts", Path(recipe.parts).name]
    if recipe.patient:
        words += ["--patient"]
    if recipe.keep is not None:
        words += ["--keep", ",".join(map(str, recipe.keep))]
    return shlex.join(words)

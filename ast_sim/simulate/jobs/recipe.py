"""The settings that determine a dataset, as the dataset records them. The same settings give the same bytes."""

from __future__ import annotations

import importlib.metadata
import os
import shlex
from collections.abc import Sequence
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import ast_sim
from ast_sim.dataset.layout import DatasetInfo
from ast_sim.simulate.families.known_families import FAMILIES, family_module
from ast_sim.simulate.jobs.samples import Recipe
from ast_sim.simulate.own_assembly.spec_reader import read_spec
from ast_sim.simulate.own_assembly.standing import friction_is_drawn
from ast_sim.simulate.own_assembly.yielding import material_columns
from ast_sim.support.argument_checks import file_name, several
from ast_sim.support.errors import ConfigError
from ast_sim.support.toml_settings import required_whole, whole

if TYPE_CHECKING:
    from ast_sim.simulate.shapes.part_source import PartSource

# Another linear solver gives other last bits, so it is also recorded which solvers are not installed.
PACKAGES = ("numpy", "scipy", "ipctk", "pypardiso", "mkl", "cholespy")
SOLVERS = ("own", "calculix")
LARGEST_SEED = 2**63 - 1


def checked_recipe(
    module: ModuleType,
    family: str,
    seed: int,
    nodes: int | None,
    frames: int | None,
    solver: str | None,
    parts: str | os.PathLike[str] | None,
    patient: bool = False,
    keep: Sequence[int] | None = None,
    spec: str | os.PathLike[str] | None = None,
    order: int | None = None,
) -> Recipe:
    """The recipe with these settings, after a check. A setting that is None takes the family's default.

    Raises:
        ConfigError: a value is invalid, or the family does not have an option.
    """
    seed, nodes, frames, order = whole(seed=seed, nodes=nodes, frames=frames, order=order)
    options = {"frames": frames, "keep": keep, "order": order, "parts": parts, "solver": solver, "spec": spec}
    for name, value in options.items():
        if value is not None and name not in FAMILIES[family].options:
            having = ", ".join(key for key, known in FAMILIES.items() if name in known.options)
            raise ConfigError(f"{family} has no option {name}; these families have it: {having}")
    nodes = module.DEFAULT_NODES if nodes is None else nodes
    yielding: tuple[str, ...] = ()
    if "spec" in FAMILIES[family].options:
        if spec is None:
            raise ConfigError(f"{family} needs a specification: spec=FILE (ast-sim generate {family} FILE --out DATA)")
        read = read_spec(spec)
        frames = read.frames if frames is None else frames
        yielding = read.yielding
    if "frames" in FAMILIES[family].options:
        frames = module.FRAMES if frames is None else frames
        if frames < module.MINIMUM_FRAMES:
            raise ConfigError(f"frames is {frames}; must be at least {module.MINIMUM_FRAMES}")
    if order not in (None, 1, 2):
        raise ConfigError(f"order is {order}; must be 2 (tetrahedra of ten nodes) or 1 (of four nodes)")
    order = None if order == 1 else order
    fewest = module.MINIMUM_NODES if order is None else module.SECOND_ORDER_NODES
    if seed is None or not 0 <= seed <= LARGEST_SEED:
        raise ConfigError(f"seed is {seed}; must be from 0 to 2^63 - 1, the largest number that the file can hold")
    if nodes is not None and nodes < fewest:
        raise ConfigError(f"nodes is {nodes}; must be at least {fewest}")
    solver = solver or ("calculix" if yielding else "own")
    if solver == "own" and yielding:
        raise ConfigError(
            f"{', '.join(yielding)}: the own solver knows elastic laws only, and this one is elastoplastic: CalculiX"
            " solves it: solver='calculix' (--solver calculix), which is what no solver= stands for here"
        )
    if solver not in SOLVERS:
        raise ConfigError(f"there is no solver {solver!r}; use one of {', '.join(SOLVERS)}")
    if patient and solver != "own":
        raise ConfigError(f"patient is for the own solver; {solver} has limits of its own")
    if parts is not None:
        parts = file_name(parts, "parts")
        _source(parts)
    keep = None if keep is None else _checked_keep(keep, (frames or module.FRAMES) - 1)
    return Recipe(family, seed, nodes, frames, solver, _resolved(parts), _resolved(spec), patient, keep, order)


def _resolved(file: str | os.PathLike[str] | None) -> str | None:
    return None if file is None else str(Path(file).resolve())


def recipe_of(name: str, info: DatasetInfo, made_from: str | os.PathLike[str] | None = None) -> Recipe:
    """The recipe by which the bundled solver made a dataset of a family without inertia.

    Args:
        name: the dataset's name in messages.
        info: what the dataset says of itself.
        made_from: where the user's parts or the specification lie, if it was made of such: a dataset records their
            content, not their place.

    Raises:
        ConfigError: it was made otherwise, its settings cannot be read, or its parts are others.
    """
    made = info.generator
    family = info.family
    if made.get("solver") != "own" or family not in FAMILIES or info.integration != "quasi_static":
        raise ConfigError(
            f"{name} was not generated by the bundled solver from a family without inertia: no solver to compare with"
        )
    own = {"parts": "parts of your own", "spec": "a specification"}
    key = next((key for key in own if key in made), None)
    if key is None and made_from is not None:
        raise ConfigError(f"{name} was made without parts of your own or a specification: leave {made_from} out")
    if key is not None and made_from is None:
        raise ConfigError(f"{name} was made of {own[key]}: say where to find that: made_from=PATH (--made-from PATH)")
    parts, spec = (None if made_from is None or key != which else file_name(made_from, "made_from") for which in own)
    try:
        seed, nodes, frames = whole(seed=made["seed"], nodes=made.get("nodes"), frames=made.get("frames"))
    except (KeyError, ConfigError) as error:
        raise ConfigError(f"{name}: its settings cannot be read ({error!r})") from error
    try:
        keep, order = made.get("keep"), made.get("order")
        module = family_module(family)
        recipe = checked_recipe(module, family, seed, nodes, frames, None, parts, False, keep, spec, order)
    except TypeError as error:
        raise ConfigError(f"{name}: its settings cannot be read ({error!r})") from error
    if parts is not None and _source(parts).describe().get("parts") != made["parts"]:
        raise ConfigError(f"{parts} does not hold the parts that {name} was made of")
    if spec is not None and read_spec(spec).describe() != made["spec"]:
        raise ConfigError(f"{spec} or a file that it names differs from what {name} was made of")
    return recipe


def _checked_keep(keep: Sequence[int], last: int) -> tuple[int, ...]:
    """The numbers of the frames to keep, after a check; `last` is the number of the last frame."""
    listed = several("keep", keep, "whole numbers")
    kept = tuple(required_whole(**{f"keep[{place}]": frame for place, frame in enumerate(listed)}))
    if not kept or not all(1 <= frame <= last for frame in kept):
        raise ConfigError(f"keep is {list(kept)}; must be numbers of frames from 1 to {last}, beside frame 0")
    if any(later <= earlier for earlier, later in pairwise(kept)):
        raise ConfigError(f"keep is {list(kept)}; the numbers of frames must ascend")
    return kept


def recorded(recipe: Recipe) -> dict[str, Any]:
    """All settings that the arrays of a sample depend on, except its split and index. The dataset keeps them.

    Raises:
        ConfigError: the parts or the solver are not there.
        MissingExtra: a package that the solver or the parts need is not installed.
    """
    used = {key: value for key, value in asdict(recipe).items() if value is not None and value is not False}
    if recipe.keep is not None:
        used["keep"] = list(recipe.keep)  # as the file gives it back
    if "parts" in FAMILIES[recipe.family].options:
        used |= _source(recipe.parts).describe()
    if recipe.spec is not None:
        spec = read_spec(recipe.spec)
        used["spec"] = spec.describe()
        used |= {"material": material_columns(spec, friction_is_drawn(spec))} if spec.yielding else {}
    return {
        "program": f"ast_sim {ast_sim.__version__}",
        "versions": _versions(recipe),
        **used,
        "command": _command(recipe),
        "licence": "CC0-1.0",
    }


def difference(stored: dict[str, Any], wanted: dict[str, Any], there: str = "there", here: str = "here") -> str:
    """The first setting that differs, in words; empty if all agree."""
    for key, value in wanted.items():
        other = stored.get(key)
        if isinstance(value, dict) and isinstance(other, dict):
            inner = difference(other, value, there, here) or next((f"{k} {there}" for k in other.keys() - value), "")
            if inner:
                return f"{key}: {inner}"
        elif other != value:
            return f"{key} {other} {there}, {value} {here}"
    return ""


def check_parts(recipe: Recipe) -> None:
    """Raise an error if one of the user's parts is broken, or a specification gives scenes that cannot be made."""
    if recipe.spec is not None:
        from ast_sim.simulate.families import assembly

        assert recipe.frames is not None  # the specification has them
        assembly.check_spec(read_spec(recipe.spec), recipe.nodes, recipe.frames, recipe.keep)
    if recipe.parts is not None:
        _source(recipe.parts).check()


def _source(parts: str | os.PathLike[str] | None) -> PartSource:
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
        from ast_sim.simulate.calculix.program import find_ccx, version

        versions["calculix"] = version(find_ccx())
    return versions


def _command(recipe: Recipe) -> str:
    words = ["ast-sim", "generate", recipe.family, *([] if recipe.spec is None else [Path(recipe.spec).name])]
    words += ["--seed", str(recipe.seed)]
    if recipe.nodes is not None:
        words += ["--nodes", str(recipe.nodes)]
    if recipe.frames is not None:
        words += ["--frames", str(recipe.frames)]
    if recipe.order is not None:
        words += ["--order", str(recipe.order)]
    if recipe.solver != "own":
        words += ["--solver", recipe.solver]
    if recipe.parts is not None:
        words += ["--parts", Path(recipe.parts).name]
    if recipe.patient:
        words += ["--patient"]
    if recipe.keep is not None:
        words += ["--keep", ",".join(map(str, recipe.keep))]
    return shlex.join(words)

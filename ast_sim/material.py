"""What deforming bodies are made of: the law, and what each number of a scene's material is, by its name."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from numbers import Real
from typing import Any

import numpy as np

from ast_sim.support.argument_checks import in_short, require_line, require_type, several
from ast_sim.support.errors import ConfigError, DatasetError, counted

YOUNG, POISSON, FRICTION = "young", "poisson", "friction"
ELASTIC = (YOUNG, POISSON)  # Young's modulus in pascal, Poisson's ratio
YIELD_STRESS = "yield_stress"  # with this column a body yields, and its law is none that is known here
PRESSURES = (YOUNG, YIELD_STRESS)  # columns in pascal
# The numbers that materials have: above the first one, or from it on, and below the last one.
_LIMITS = {
    YOUNG: (0.0, False, math.inf),
    POISSON: (-1.0, False, 0.5),
    FRICTION: (0.0, True, math.inf),
    YIELD_STRESS: (0.0, True, math.inf),
}
_OF_SOLVER = {**_LIMITS, POISSON: (0.0, True, 0.5)}  # what the bundled solver can compute with
# Names that others have for them, in lower case, without apostrophes.
_TAKEN_FOR = {
    YOUNG: ("e", "young", "youngs modulus", "young modulus", "elastic modulus"),
    POISSON: ("nu", "poisson", "poissons ratio", "poisson ratio"),
    FRICTION: ("friction", "friction coefficient", "coefficient of friction"),
}


def impossible(name: str, values: Any, solved: bool = False) -> np.ndarray:
    """Which numbers of a constant with this name no material has; with `solved`, none that the bundled solver can take.
    Names without a meaning here have any number."""
    low, included, high = (_OF_SOLVER if solved else _LIMITS).get(name, (-math.inf, True, math.inf))
    values = np.asarray(values)
    return ~(((values > low) | (included & (values == low))) & (values < high))


def possible(name: str, solved: bool = False) -> str:
    """The numbers of a constant in words, for an error."""
    low, included, high = (_OF_SOLVER if solved else _LIMITS)[name]
    most = f" and below {high:g}" if math.isfinite(high) else ""
    return f"{'at least' if included else 'above'} {low:g}{most}{' (pascal)' if name in PRESSURES else ''}"


def hints(columns: Iterable[str]) -> list[str]:
    """A sentence for each column whose name looks like another one that has a meaning."""
    told = []
    for column in columns:
        plain = " ".join(column.casefold().replace("'", "").replace("_", " ").split())
        meant = next((name for name, names in _TAKEN_FOR.items() if plain in names and column != name), None)
        if meant is not None:
            told.append(
                f"the column {column!r} of the material has no meaning here: if it is what {meant!r} means"
                " (ast_sim.Material), give it this name, and forces and Newton steps know the law"
            )
    return told


def listed_columns(attributes: Mapping[str, Any]) -> list[str]:
    """The names of the columns of the material, as the attributes of a trajectory from other programs list them."""
    listed = str(attributes.get("material", ""))
    return listed.split(", ") if listed else []


@dataclass(frozen=True)
class Material:
    """The material of all scenes of a dataset, or of one scene.

    Attributes:
        columns: the name of each column of `Scene.material`: "young" (Young's modulus in pascal), "poisson" (Poisson's
            ratio), "friction", or what else the data have.
        constants: numbers that are the same in all elements of all scenes, by name. A column wins over a constant.

    Raises:
        ConfigError: names are no lines of text, or a set, which has no order, or two are equal; or a constant is no
            number, or one that no material has.
    """

    columns: tuple[str, ...] = ()
    constants: Mapping[str, float] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        what = "names, such as ['young', 'poisson']"
        if isinstance(self.columns, AbstractSet):
            raise ConfigError(f"columns is {in_short(self.columns)}, which has no order; it must be a list of {what}")
        names = tuple(several("columns", self.columns, what))
        object.__setattr__(self, "columns", names)
        require_type("constants", self.constants, Mapping, "numbers by name, such as {'poisson': 0.3}")
        for name in (*names, *self.constants):
            require_line("the name of a number of the material", name)
        if len(set(names)) != len(names):
            raise ConfigError(f"two columns of the material have one name: {', '.join(names)}")
        for name, value in self.constants.items():
            if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
                raise ConfigError(f"{name} of a material is {in_short(value)}; it must be a number")
            if impossible(name, value):
                raise ConfigError(f"{name} of a material is {value:g}; it must be {possible(name)}")

    @property
    def yields(self) -> bool:
        """Whether the state of the material depends on the load path."""
        return YIELD_STRESS in {*self.columns, *self.constants}

    @property
    def law(self) -> str | None:
        """ "neo_hookean" (of Ciarlet, as the bundled solver has it), if Young's modulus and Poisson's ratio are known
        and no yield stress; None: the law is not known."""
        known = {*self.columns, *self.constants}
        return "neo_hookean" if known.issuperset(ELASTIC) and not self.yields else None

    def require_law(self) -> None:
        """Raise ConfigError unless the law is known; the text says what there is."""
        if self.law is None:
            columns = f"the columns {', '.join(self.columns)}" if self.columns else "no columns"
            raise ConfigError(
                f"the law of the material is not known: it has {columns}, but needs Young's modulus and Poisson's ratio"
                " and no yield stress. Name the columns where the data are made: DatasetInfo(generator={'material':"
                " ['young', 'poisson']}), or --material young poisson"
            )

    def require_possible(self, name: str, values: np.ndarray | None, deforming: np.ndarray) -> None:
        """Raise DatasetError if an element of `deforming` [E] bool has a number in its columns, `values` [E, m], that
        no material has; the text names `name`, the column, the first element and their number."""
        for column in self.columns:
            numbers = np.broadcast_to(self.numbers(column, values), deforming.shape)
            rows = np.flatnonzero(impossible(column, numbers) & deforming)
            if len(rows):
                raise DatasetError(
                    f"{name}: {column} of the material is {numbers[rows[0]]:g} in element {rows[0]}, and must be"
                    f" {possible(column)}; so in {len(rows)} of {deforming.sum()} elements that deform: are the columns"
                    f" in the order {', '.join(self.columns)}?"
                )

    def numbers(self, name: str, values: np.ndarray | None) -> np.ndarray | float:
        """[E] float64, the column of this name in `values` [E, m]; or the constant of this name.

        Raises:
            ConfigError: there is neither; or `values` has other columns.
        """
        if values is not None:
            values = np.asarray(values)
            if values.ndim != 2 or values.dtype.kind not in "fiu":
                raise ConfigError(
                    f"the values of a material are {in_short(values)}; they must be numbers [elements, columns]"
                )
        width = 0 if values is None else values.shape[1]
        if width != len(self.columns):
            raise ConfigError(
                f"the material has {counted(width, 'column')}, but {counted(len(self.columns), 'name')}:"
                f" {', '.join(self.columns)}"
            )
        if values is not None and name in self.columns:
            return values[:, self.columns.index(name)].astype(np.float64)
        if name not in self.constants:
            raise ConfigError(
                f"the material has no {name}; it has {', '.join(dict.fromkeys((*self.columns, *self.constants)))}"
            )
        return self.constants[name]

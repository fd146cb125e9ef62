"""What deforming bodies are made of: the law, and what each number of a scene's material is, by its name."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from numbers import Real

import numpy as np

from ast_sim.support.argument_checks import in_short, require_type, several
from ast_sim.support.errors import ConfigError, counted

YOUNG, POISSON, FRICTION = "young", "poisson", "friction"
ELASTIC = (YOUNG, POISSON)  # Young's modulus in pascal, Poisson's ratio
YIELD_STRESS = "yield_stress"  # with this column a body yields, and its law is none that is known here
PRESSURES = (YOUNG, YIELD_STRESS)  # columns in pascal


@dataclass(frozen=True)
class Material:
    """The material of all scenes of a dataset, or of one scene.

    Attributes:
        columns: the name of each column of `Scene.material`: "young" (Young's modulus in pascal), "poisson" (Poisson's
            ratio), "friction", or what else the data have.
        constants: numbers that are the same in all elements of all scenes, by name. A column wins over a constant.

    Raises:
        ConfigError: names are no texts, or two are equal; or a constant is no number.
    """

    columns: tuple[str, ...] = ()
    constants: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = several("columns", self.columns, "names, such as ['young', 'poisson']")
        require_type("constants", self.constants, Mapping, "numbers by name, such as {'poisson': 0.3}")
        for name in names:
            require_type("the name of a column", name, str, "a text")
        if len(set(names)) != len(names):
            raise ConfigError(f"two columns of the material have one name: {', '.join(names)}")
        for name, value in self.constants.items():
            if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
                raise ConfigError(f"{name} of a material is {in_short(value)}; it must be a number")

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

    def numbers(self, name: str, values: np.ndarray | None) -> np.ndarray | float:
        """[E] float64, the column of this name in `values` [E, m]; or the constant of this name.

        Raises:
            ConfigError: there is neither; or `values` has other columns.
        """
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

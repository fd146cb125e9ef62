"""The parameters of a specification: constants, ranges and choices, and how they are drawn.

The values of a scene follow from the seed, the split and the number of the scene alone: they are a point of a scrambled
Sobol sequence, whose points fill the ranges evenly however many of them are taken.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ast_sim.material import impossible, possible
from ast_sim.simulate.own_assembly.expressions import Expression, expression
from ast_sim.support.errors import ConfigError, nearest_name

Values = dict[str, float | str]
PARAMETER = "parameter "  # the names of attributes that record values begin so


@dataclass(frozen=True)
class Parameter:
    """What a parameter may be: one value, a range, one of several texts, or an expression over other parameters.

    Attributes:
        name: the name; for a quantity of a part, `PART.QUANTITY`.
        low, high: the ends of the range; equal for a constant.
        log: whether its logarithm is drawn evenly.
        choices: the texts, one of which is drawn; empty for a number.
        formula: the expression; None for all others.
    """

    name: str
    low: float = 0.0
    high: float = 0.0
    log: bool = False
    choices: tuple[str, ...] = ()
    formula: Expression | None = None

    @property
    def is_drawn(self) -> bool:
        """Whether scenes differ in it."""
        return len(self.choices) > 1 or self.high > self.low

    @property
    def middle(self) -> float | str:
        """Its value where nobody gives one: the middle of the range, the first of the choices."""
        return self.choices[0] if self.choices else self.at(0.5)

    @property
    def ends(self) -> tuple[float | str, ...]:
        """The values between which it is drawn."""
        return self.choices or (self.low, self.high)

    def at(self, share: float) -> float | str:
        """The value at a share in [0, 1) of the range."""
        if self.choices:
            return self.choices[min(int(share * len(self.choices)), len(self.choices) - 1)]
        if self.log:
            return math.exp(math.log(self.low) + share * (math.log(self.high) - math.log(self.low)))
        return self.low + share * (self.high - self.low)

    def checked(self, value: Any) -> float | str:
        """A value that a user gives.

        Raises:
            ConfigError: it is no number, or none of the choices.
        """
        if self.choices:
            if value not in self.choices:
                raise ConfigError(f"{self.name} is {value!r}; must be one of {', '.join(self.choices)}")
            return str(value)
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = math.nan
        if isinstance(value, bool) or not math.isfinite(number):
            raise ConfigError(f"{self.name} is {value!r}; must be a finite number")
        return number


def parameter(name: str, value: Any, known: Mapping[str, Parameter] | None = None) -> Parameter:
    """The parameter that stands in the specification under `name`: a number, [low, high], or a table with `low`, `high`
    and `log`; where there are `known` parameters, also an expression over these.

    Raises:
        ConfigError: it is none of these.
    """
    log = False
    if isinstance(value, str) and known is not None:
        return Parameter(name, formula=expression(name, value, plain(known)))
    if isinstance(value, dict):
        unknown = next((key for key in value if key not in ("low", "high", "log")), None)
        if unknown is not None:
            raise ConfigError(f"there is no key {name}.{unknown}{nearest_name(unknown, ('low', 'high', 'log'))}")
        log = value.get("log", False)
        value = [value.get("low"), value.get("high")]
    ends = value if isinstance(value, list) else [value, value]
    if len(ends) != 2 or not all(isinstance(end, int | float) and not isinstance(end, bool) for end in ends):
        also = ", or an expression" if known is not None else ""
        raise ConfigError(f"{name} is {value!r}; must be a number or a range [low, high]{also}")
    low, high = map(float, ends)
    if not (math.isfinite(low) and math.isfinite(high) and low <= high):
        raise ConfigError(f"the range of {name} is {low:g} to {high:g}; must be finite and ascend")
    if log and low <= 0:
        raise ConfigError(f"the range of {name} starts at {low:g}; a logarithm needs numbers above 0")
    return Parameter(name, low, high, bool(log))


def plain(parameters: Mapping[str, Parameter]) -> list[str]:
    """The names that an expression may use."""
    return [name for name, one in parameters.items() if name.isidentifier() and not one.choices]


def drawn(parameters: Mapping[str, Parameter], seed: int, split: int, index: int, attempt: int = 0) -> Values:
    """The values of a scene.

    Args:
        parameters: all of them, in the order of the specification.
        seed, split, index: which scene.
        attempt: 0, or the number of times that the scene could not be made of what was drawn before.
    """
    moving = [one for one in parameters.values() if one.is_drawn]
    sequence = np.random.SeedSequence(seed, spawn_key=(split,) if attempt == 0 else (split, index, attempt))
    shares = np.zeros(0)
    if moving and attempt == 0:
        from scipy.stats import qmc  # takes 0.3 s

        sobol = qmc.Sobol(len(moving), scramble=True, rng=np.random.default_rng(sequence))
        shares = (sobol.fast_forward(index) if index else sobol).random(1)[0]
    elif moving:
        shares = np.random.default_rng(sequence).random(len(moving))
    given = {one.name: one.at(share) for one, share in zip(moving, shares.tolist(), strict=True)}
    return completed(parameters, given)


def completed(parameters: Mapping[str, Parameter], given: Mapping[str, Any]) -> Values:
    """The values of all parameters; parameters that are not given are in the middle of their ranges.

    Args:
        given: values by name. `{"young": {"bumper": 1e6}}` is the same as `{"bumper.young": 1e6}`.

    Raises:
        ConfigError: there is no such parameter (the text names the nearest one), or a value does not fit.
    """
    flat = dict(flattened(given))
    for name in flat:
        if name not in parameters:
            raise ConfigError(f"there is no parameter {name!r}{nearest_name(name, parameters)}")
    values: Values = {}
    for name, one in parameters.items():
        if name in flat:
            values[name] = one.checked(flat[name])
        elif one.formula is None:
            values[name] = one.middle
        else:
            values[name] = one.formula(values)
        if not one.choices:
            require_solvable(name, values[name])
    return values


def require_solvable(name: str, *values: Any) -> None:
    """Raise ConfigError if a number of a material, `PART.QUANTITY`, is one that the solver cannot take."""
    part, _, quantity = name.rpartition(".")
    if part and impossible(quantity, values, solved=True).any():
        shown = " to ".join(f"{value:g}" for value in values)
        raise ConfigError(f"{name} is {shown}; must be {possible(quantity, solved=True)}")


def flattened(given: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Values by the names of their parameters, where a quantity of several parts may be given as a mapping by part."""
    for name, value in given.items():
        if isinstance(value, Mapping):
            yield from ((f"{part}.{name}", one) for part, one in value.items())
        else:
            yield name, value


def recorded(values: Values) -> dict[str, Any]:
    """The attributes of a trajectory that record the values of its parameters."""
    return {PARAMETER + name: value for name, value in values.items()}


def values_of(attributes: Mapping[str, Any]) -> Values:
    """The values of the parameters that a trajectory records."""
    return {key.removeprefix(PARAMETER): value for key, value in attributes.items() if key.startswith(PARAMETER)}


def told(parameters: Mapping[str, Parameter], values: Values) -> str:
    """The drawn values as a text for messages."""
    shown = {name: values[name] for name, one in parameters.items() if one.is_drawn}
    texts = {name: f"{value:.4g}" if isinstance(value, float) else value for name, value in shown.items()}
    return ", ".join(f"{name}={text}" for name, text in texts.items()) or "its values"

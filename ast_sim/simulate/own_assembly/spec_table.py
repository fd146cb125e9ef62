"""A table of a specification that is read key by key. Whatever is wrong is told with its place, in one line."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from ast_sim.simulate.own_assembly.expressions import Expression, expression
from ast_sim.support.errors import ConfigError, nearest_name

VectorExpression = tuple[Expression, Expression, Expression]


class Table:
    """A TOML table.

    Args:
        values: what stands in it.
        place: its name in messages, such as "parts.bumper".
        known: names of the parameters that its expressions may use.

    Raises:
        ConfigError: it is no table. The methods raise it for a value that is missing or wrong.
    """

    def __init__(self, values: Any, place: str, known: Iterable[str] = ()) -> None:
        if not isinstance(values, dict):
            raise ConfigError(f"{place} is {values!r}; must be a table")
        self.values = values
        self.place = place
        self.known = list(known)
        self._read: list[str] = []

    def key(self, name: str) -> str:
        """The name of a key in messages."""
        return f"{self.place}.{name}" if self.place else name

    def take(self, name: str, default: Any = None) -> Any:
        """The value of a key as it stands, or the default."""
        self._read.append(name)
        return self.values.get(name, default)

    def text(self, name: str, default: str | None = None) -> str | None:
        value = self.take(name, default)
        if value is not None and not isinstance(value, str):
            raise ConfigError(f"{self.key(name)} is {value!r}; must be a text")
        return value

    def flag(self, name: str) -> bool:
        value = self.take(name, False)
        if not isinstance(value, bool):
            raise ConfigError(f"{self.key(name)} is {value!r}; must be true or false")
        return value

    def number(self, name: str, default: Any = None) -> Expression | None:
        value = self.take(name, default)
        return None if value is None else expression(self.key(name), value, self.known)

    def vector(self, name: str, default: Any = None) -> VectorExpression | None:
        """Three numbers or expressions."""
        value = self.take(name, default)
        return None if value is None else self._vector(name, value)

    def path(self, name: str) -> tuple[VectorExpression, ...] | None:
        """One vector, or a list of them."""
        value = self.take(name)
        if value is None:
            return None
        if isinstance(value, list) and value and isinstance(value[0], list):
            return tuple(self._vector(name, one) for one in value)
        return (self._vector(name, value),)

    def pairs(self, name: str) -> tuple[tuple[Expression, Expression], ...]:
        """A list of pairs of numbers or expressions; empty if there is none."""
        value = self.take(name, [])
        if not isinstance(value, list) or not all(isinstance(row, list) and len(row) == 2 for row in value):
            raise ConfigError(f"{self.key(name)} is {value!r}; must be a list of pairs of numbers")
        key = self.key(name)
        rows = [[expression(f"{key}[{i}]", one, self.known) for one in row] for i, row in enumerate(value)]
        return tuple((first, second) for first, second in rows)

    def tables(self, name: str) -> list[Table]:
        """The tables of a list of tables; one table may stand for a list of one."""
        value = self.take(name, [])
        rows = value if isinstance(value, list) else [value]
        several = len(rows) > 1
        return [Table(row, self.key(name) + f"[{i}]" * several, self.known) for i, row in enumerate(rows)]

    def done(self) -> None:
        """Raise ConfigError if the table has a key that was not read; the text names the nearest known one."""
        unknown = next((name for name in self.values if name not in self._read), None)
        if unknown is not None:
            raise ConfigError(f"there is no key {self.key(unknown)}{nearest_name(unknown, self._read)}")

    def _vector(self, name: str, value: Any) -> VectorExpression:
        if not isinstance(value, list) or len(value) != 3:
            raise ConfigError(f"{self.key(name)} is {value!r}; must be three numbers, such as [0, 0, '-travel']")
        x, y, z = (expression(f"{self.key(name)}[{i}]", one, self.known) for i, one in enumerate(value))
        return x, y, z

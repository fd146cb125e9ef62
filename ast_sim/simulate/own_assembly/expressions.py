"""Arithmetic over the drawn parameters, such as "-travel * cos(skew)". Angles are in degrees, as everywhere."""

from __future__ import annotations

import ast
import math
import operator
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from ast_sim.support.errors import ConfigError, nearest_name

_OPERATORS: dict[type, Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: math.pow,  # in floating point: as a whole number, 9 ** 9 ** 9 has 370 million digits
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}
FUNCTIONS: dict[str, Callable[..., Any]] = {
    "sin": lambda angle: math.sin(math.radians(angle)),
    "cos": lambda angle: math.cos(math.radians(angle)),
    "tan": lambda angle: math.tan(math.radians(angle)),
    "sqrt": math.sqrt,
    "abs": abs,
    "min": min,
    "max": max,
}
_MOST_LETTERS = 200


@dataclass(frozen=True)
class Expression:
    """A number, or an arithmetic expression over parameters.

    Attributes:
        key: where it stands in the specification, for messages.
        text: the expression.
    """

    key: str
    text: str

    @property
    def names(self) -> set[str]:
        """The parameters that it depends on."""
        used = {node.id for node in ast.walk(self._tree) if isinstance(node, ast.Name)}
        return used - FUNCTIONS.keys()

    def __call__(self, values: Mapping[str, Any]) -> float:
        """Its value for these values of the parameters.

        Raises:
            ConfigError: it cannot be computed, or the result is not finite.
        """
        try:
            result = float(_value(self._tree, values))
        except (ArithmeticError, ValueError, TypeError) as error:
            raise ConfigError(f"{self.key} = {self.text!r} cannot be computed: {error}") from error
        if not math.isfinite(result):
            raise ConfigError(f"{self.key} = {self.text!r} is {result}; must be finite")
        return result

    @property
    def _tree(self) -> ast.expr:
        return ast.parse(self.text, mode="eval").body


def expression(key: str, value: Any, known: Iterable[str]) -> Expression:
    """The expression that a number or a text of the specification stands for.

    Args:
        key: where it stands.
        value: what stands there.
        known: the names of the parameters.

    Raises:
        ConfigError: it is neither, uses anything but arithmetic, is not finite, or names an unknown parameter (the text
            gives the nearest one).
    """
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ConfigError(f"{key} is {value!r}; must be a number or an expression such as '-travel'")
    if not isinstance(value, str):
        if not abs(value) <= sys.float_info.max:
            raise ConfigError(f"{key} is {value}; must be finite")
        return Expression(key, repr(float(value)))
    try:
        if len(value) > _MOST_LETTERS:
            raise ValueError("it is too long")
        tree = ast.parse(value.strip(), mode="eval").body
        _check(tree)
    except (SyntaxError, ValueError, RecursionError) as error:
        reason = error.msg if isinstance(error, SyntaxError) else error
        raise ConfigError(f"{key} = {value!r} is no arithmetic of numbers and parameters: {reason}") from error
    parsed = Expression(key, value.strip())
    known = list(known)
    for name in sorted(parsed.names - set(known)):
        raise ConfigError(f"{key} = {value!r}: there is no parameter {name!r}{nearest_name(name, known)}")
    if not parsed.names:
        parsed({})
    return parsed


def _check(node: ast.expr) -> None:
    number = isinstance(node, ast.Constant) and type(node.value) in (int, float)
    if not number and not (isinstance(node, ast.Name) and node.id not in FUNCTIONS):
        for operand in _operation(node)[1]:
            _check(operand)


def _value(node: ast.expr, values: Mapping[str, Any]) -> Any:
    if isinstance(node, ast.Name):
        return values[node.id]
    if isinstance(node, ast.Constant):
        return node.value
    compute, operands = _operation(node)
    return compute(*(_value(operand, values) for operand in operands))


def _operation(node: ast.expr) -> tuple[Callable[..., float], list[ast.expr]]:
    """What a node computes, and of which operands. Raises ValueError if it is no arithmetic."""
    if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
        return _OPERATORS[type(node.op)], [node.left, node.right]
    if isinstance(node, ast.UnaryOp) and type(node.op) in _OPERATORS:
        return _OPERATORS[type(node.op)], [node.operand]
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in FUNCTIONS:
        if node.keywords or not node.args:
            raise ValueError(f"{node.func.id} takes numbers")
        return FUNCTIONS[node.func.id], node.args
    raise ValueError(f"{ast.unparse(node)!r} is not allowed; functions are {', '.join(FUNCTIONS)}")

"""The precisions in which ops multiply."""

from typing import Literal, get_args

from ast_sim.support.errors import ConfigError

Precision = Literal["float32", "bfloat16"]
PRECISIONS: tuple[Precision, ...] = get_args(Precision)


def require_precision(precision: object) -> None:
    """Raise ConfigError unless there is such a precision."""
    if precision not in PRECISIONS:
        raise ConfigError(f"precision is {precision!r}: choose of {', '.join(PRECISIONS)}")

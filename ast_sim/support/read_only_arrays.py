"""Arrays that nobody can write to, since what follows from them is kept."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np


def kept(array: np.ndarray) -> np.ndarray:
    """The array, to which nobody can write from now on."""
    array.flags.writeable = False
    return array


class ReadOnlyArrays:
    """Base of a frozen dataclass whose arrays nobody can write to.

    An array that can be written to is copied, so the caller's array stays as it is. A copy or a pickle of the object
    is read-only, too.
    """

    def __post_init__(self) -> None:
        for name, value in _values(self).items():
            if isinstance(value, np.ndarray) and value.flags.writeable:
                object.__setattr__(self, name, kept(value.copy()))

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return type(self), tuple(_values(self).values())


def _values(of: Any) -> dict[str, Any]:
    return {one.name: getattr(of, one.name) for one in fields(of)}

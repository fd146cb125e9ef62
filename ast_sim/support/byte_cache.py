"""A cache with a limit in bytes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import is_dataclass
from typing import Any, Generic, TypeVar

V = TypeVar("V")


class ByteCache(Generic[V]):
    """Keeps the values that were used last, together at most `limit` bytes; the newest value is always kept.

    Only one thread at a time may use it.
    """

    def __init__(self, limit: int) -> None:
        self.limit, self.held = limit, 0
        self._values: OrderedDict[Hashable, tuple[V, int]] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], V]) -> V:
        """The value of a key; `make` makes a missing one. Each call measures the value anew: it may have grown."""
        value, counted = self._values.pop(key, None) or (make(), 0)
        size = array_bytes(value)
        self._values[key] = value, size
        self.held += size - counted
        while self.held > self.limit and len(self._values) > 1:
            self.held -= self._values.popitem(last=False)[1][1]
        return value


def array_bytes(value: Any) -> int:
    """The bytes of all arrays and tensors in a value, which may be a dataclass or a list of such values."""
    if is_dataclass(value):
        return sum(map(array_bytes, vars(value).values()))
    if isinstance(value, list | tuple):
        return sum(map(array_bytes, value))
    return getattr(value, "nbytes", 0)

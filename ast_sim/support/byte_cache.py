"""A cache with a limit in bytes."""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import is_dataclass
from itertools import islice
from threading import Lock
from typing import Any, Generic, TypeVar

from ast_sim.support.environment import processes_on_machine

V = TypeVar("V")

RECENT = 512  # the scenes of a pool of jumps, which come again while they are corrected

SHARE = 8  # a cache may take the memory of the machine divided by this
MOST = 1 << 32


def cache_bytes() -> int:
    """The limit of a cache of scenes: an eighth of the machine's memory, at most 4 GiB; processes that train one model
    together divide it among them."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min(memory // SHARE, MOST) // processes_on_machine()


class ByteCache(Generic[V]):
    """Keeps values of together at most `limit` bytes; the newest value is always kept.

    The RECENT values that were used last stay. Of the others the one that was used last is let go first: a training
    asks for all its scenes once in each pass, and what was used longest ago comes next.

    Several threads may use it: a training asks for scenes of its pool while a thread makes the next batch.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.held = 0
        self._values: OrderedDict[Hashable, tuple[V, int]] = OrderedDict()
        self._lock = Lock()

    def get(self, key: Hashable, make: Callable[[], V]) -> V:
        """The value of a key; `make` makes a missing one. Each call measures the value again: it may have grown."""
        with self._lock:
            known = self._values.get(key)
        value = known[0] if known else make()
        size = array_bytes(value)
        with self._lock:
            _, counted = self._values.pop(key, (None, 0))
            self._values[key] = value, size
            self.held += size - counted
            while self.held > self.limit and len(self._values) > 1:
                recent = min(RECENT, len(self._values) - 1)
                self.held -= self._values.pop(next(islice(reversed(self._values), recent, None)))[1]
        return value


def array_bytes(value: Any) -> int:
    """The bytes of all arrays and tensors in a value, which may be a dataclass or a list of such values."""
    if is_dataclass(value):
        return sum(map(array_bytes, vars(value).values()))
    if isinstance(value, list | tuple):
        return sum(map(array_bytes, value))
    return getattr(value, "nbytes", 0)

"""A cache with a limit of bytes: what is counted, what is let go, what is kept."""

import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from ast_sim.support import byte_cache
from ast_sim.support.byte_cache import ByteCache, array_bytes


@dataclass
class Held:
    array: np.ndarray
    more: object = None


def test_arrays_and_tensors_are_counted_however_deep():
    tensors = (torch.zeros(5), [torch.zeros(2, dtype=torch.int64)])
    assert array_bytes(Held(np.zeros(10), Held(np.zeros(3, np.float32), tensors))) == 80 + 12 + 20 + 16
    assert array_bytes("text") == array_bytes(None) == 0


def test_among_few_values_the_least_lately_used_is_let_go():
    made = []

    def value(key, count=10):
        return cache.get(key, lambda: made.append(key) or np.full(count, key, np.uint8))

    cache = ByteCache(30)
    for key in (1, 2, 3, 1, 4, 1, 3):  # 4 takes the place of 2
        assert (value(key) == key).all()
    assert made == [1, 2, 3, 4] and cache.held == 30
    assert value(2)[0] == 2 and made == [1, 2, 3, 4, 2] and cache.held == 30
    assert len(value(5, 100)) == 100 and cache.held == 100  # too large, and yet it is kept until the next comes
    assert value(5) is value(5) and value(6)[0] == 6 and cache.held == 10


def test_passes_over_more_values_than_fit_find_some_of_them(monkeypatch):
    monkeypatch.setattr(byte_cache, "RECENT", 2)
    made: list[int] = []
    cache = ByteCache(40)
    for key in [*range(8), *range(8)]:
        cache.get(key, lambda key=key: made.append(key) or np.zeros(10, np.uint8))
    assert made == [*range(8), 2, 3, 4, 5]  # all of them, twice, if the one used longest ago were let go
    assert cache.held == 40


def test_a_value_that_grew_counts_as_it_is():
    cache = ByteCache(100)
    first = cache.get("a", lambda: Held(np.zeros(10, np.uint8)))
    first.more = np.zeros(70, np.uint8)
    assert cache.get("a", list) is first and cache.held == 80
    cache.get("b", lambda: np.zeros(30, np.uint8))
    assert cache.held == 30 and cache.get("a", lambda: None) is None


def test_what_could_not_be_made_is_not_kept():
    cache = ByteCache(10)
    with pytest.raises(ZeroDivisionError):
        cache.get("a", lambda: 1 / 0)
    assert cache.get("a", lambda: 1) == 1 and cache.held == 0


def test_threads_share_a_cache(monkeypatch):
    """Without an error, and what is held is what is counted."""
    monkeypatch.setattr(byte_cache, "RECENT", 2)
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    cache = ByteCache(200)

    def use(seed):
        for key in np.random.default_rng(seed).integers(40, size=5000).tolist():
            assert cache.get(key, lambda key=key: np.full(10, key, np.uint8))[0] == key

    try:
        with ThreadPoolExecutor(4) as threads:
            list(threads.map(use, range(4)))
    finally:
        sys.setswitchinterval(interval)
    assert cache.held == sum(cache.get(key, None).nbytes for key in list(cache._values)) == 200

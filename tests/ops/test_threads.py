"""Every op gives the same bits for any number of threads, and for a scene alone or in a batch; so do its gradients."""

from collections.abc import Sequence

import pytest
import torch
from every_op import ALL, BY_PLACE, OPS
from torch import Tensor

THREADS = (1, 2, 3, 4, 8)


def assert_same_bits(first: Sequence[Tensor], second: Sequence[Tensor], what: str) -> None:
    assert len(first) == len(second)
    for i, (x, y) in enumerate(zip(first, second, strict=True)):
        assert x.shape == y.shape and x.numpy().tobytes() == y.numpy().tobytes(), f"{what}: result {i} differs"


@pytest.mark.parametrize("op", OPS)
def test_same_bits_for_any_number_of_threads(op):
    before = torch.get_num_threads()
    try:
        results = {}
        for threads in THREADS:
            torch.set_num_threads(threads)
            per_scene, of_all = OPS[op](ALL)
            results[threads] = [x for scene in per_scene for x in scene] + of_all
    finally:
        torch.set_num_threads(before)
    for threads in THREADS[1:]:
        assert_same_bits(results[1], results[threads], f"{threads} threads")


@pytest.mark.parametrize("op", [op for op in OPS if op not in BY_PLACE])
def test_a_scene_alone_has_the_bits_that_it_has_in_a_batch(op):
    batch, _ = OPS[op](ALL)
    reverse, _ = OPS[op](ALL[::-1])
    for scene in ALL:
        (alone,), _ = OPS[op]([scene])
        assert_same_bits(alone, batch[scene], f"scene {scene} alone")
        assert_same_bits(alone, reverse[len(ALL) - 1 - scene], f"scene {scene} in another order")

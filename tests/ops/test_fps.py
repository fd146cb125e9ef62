"""Farthest point sampling against its composition, its contract and the greedy definition in Python integers."""

import numpy as np
import pytest
import torch
from checks import assert_same_everywhere, assert_same_for_threads, misaligned_read_only
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from ast_sim.ops import _fps as fps
from ast_sim.ops import farthest_point_sample, octree


def points(*rows: tuple[int, int, int]) -> Tensor:
    return torch.tensor(rows, dtype=torch.int32).reshape(-1, 3)


def random_points(n: int, extent: int, seed: int = 0) -> Tensor:
    return torch.randint(0, extent, (n, 3), generator=torch.Generator().manual_seed(seed)).int()


def greedy(rows: list[tuple[int, ...]], num: int) -> list[int]:
    if len(rows) <= num:
        return list(range(len(rows)))
    picks, distance = [0], [float("inf")] * len(rows)
    while len(picks) < num:
        for i, row in enumerate(rows):
            distance[i] = min(distance[i], sum((a - b) ** 2 for a, b in zip(row, rows[picks[-1]], strict=True)))
        picks.append(max((i for i in range(len(rows)) if i not in picks), key=lambda i: (distance[i], -i)))
    return picks


def assert_kernel_equals_composition(coordinates: Tensor, offsets: Tensor, num: int) -> None:
    for x, y in zip(
        farthest_point_sample(coordinates, offsets, num), fps._sample.reference(coordinates, offsets, num), strict=True
    ):
        assert x.dtype == y.dtype == torch.int64 and torch.equal(x, y)


def test_values_by_hand():
    line = points((0, 0, 0), (1, 0, 0), (4, 0, 0), (9, 0, 0))
    indices, offsets = farthest_point_sample(line, torch.tensor([0, 4]), 3)
    assert indices.tolist() == [0, 3, 2] and offsets.tolist() == [0, 3]


def test_ties_go_to_the_lowest_index():
    corners = points((0, 0, 0), (0, 0, 2), (0, 2, 0), (2, 0, 0))
    assert farthest_point_sample(corners, torch.tensor([0, 4]), 3)[0].tolist() == [0, 1, 2]


def test_duplicates_come_last_and_never_twice():
    rows = points((5, 5, 5), (5, 5, 5), (7, 5, 5), (5, 5, 5), (7, 5, 5), (6, 5, 5))
    offsets = torch.tensor([0, 6])
    assert farthest_point_sample(rows, offsets, 5)[0].tolist() == [0, 2, 5, 1, 3]
    assert farthest_point_sample(rows, offsets, 6)[0].tolist() == [0, 1, 2, 3, 4, 5]


def test_a_scene_with_few_points_gives_all_in_order():
    rows = points((9, 0, 0), (0, 0, 0), (5, 0, 0), (1, 1, 1), (2, 2, 2))
    indices, offsets = farthest_point_sample(rows, torch.tensor([0, 0, 3, 5, 5]), 3)
    assert indices.tolist() == [0, 1, 2, 3, 4] and offsets.tolist() == [0, 0, 3, 5, 5]


@given(
    rows=st.lists(st.tuples(*[st.integers(-3, 3)] * 3), max_size=25),
    cut=st.integers(0, 25),
    num=st.integers(1, 30),
    scale=st.sampled_from([1, 7, 1 << 12, 299593]),
)
@settings(deadline=None, max_examples=80, derandomize=True)
def test_the_greedy_definition_full_of_ties(rows, cut, num, scale):
    rows = [tuple(scale * x for x in row) for row in rows]
    cut = min(cut, len(rows))
    offsets = torch.tensor([0, cut, len(rows)])
    indices, out_offsets = farthest_point_sample(points(*rows), offsets, num)
    expected = greedy(rows[:cut], num) + [cut + i for i in greedy(rows[cut:], num)]
    assert indices.tolist() == expected
    assert out_offsets.tolist() == [0, min(num, cut), min(num, cut) + min(num, len(rows) - cut)]
    assert_kernel_equals_composition(points(*rows), offsets, num)


@pytest.mark.parametrize("extent", [2, 11, 1 << 12, 26754, 26756, (1 << 21) - 1])
@pytest.mark.parametrize("n, num", [(2, 1), (64, 63), (65, 64), (129, 5), (1001, 300), (10001, 20)])
def test_kernel_equals_composition(n, num, extent):
    coordinates = random_points(n, extent) - extent // 2
    assert_kernel_equals_composition(coordinates, torch.tensor([0, n // 2, n // 2, n]), num)


def test_distances_are_exact_up_to_the_largest_extent():
    """Squared distances that differ by 1 in about 1.3e13: float32 cannot tell them apart."""
    far = (1 << 21) - 1
    rows = points((0, 0, 0), (far, far, far - 1), (far, far, far), (far, far - 1, far))
    assert farthest_point_sample(rows, torch.tensor([0, 4]), 2)[0].tolist() == [0, 2]
    one = points((0, 0, 0), (far, 1, 0), (far, 1, 1), (far, 0, 1))
    assert farthest_point_sample(one, torch.tensor([0, 4]), 2)[0].tolist() == [0, 2]


@pytest.mark.parametrize("depth", [3, 6, 12, 21])
def test_octree_cells(depth):
    positions = 2 * torch.rand(3000, 3, generator=torch.Generator().manual_seed(2)) - 1
    tree = octree(positions, torch.tensor([0, 1000, 3000]), (0, 0, 0), 1, depth)
    assert_kernel_equals_composition(tree.coordinates(), tree.cell_offsets, 128)


def test_scene_alone_equals_scene_in_batch():
    parts = [random_points(n, 50, n) for n in (300, 0, 40, 1, 500)]
    offsets = torch.tensor([0, *np.cumsum([len(p) for p in parts])])
    indices, out = farthest_point_sample(torch.cat(parts), offsets, 60)
    for s, part in enumerate(parts):
        alone = farthest_point_sample(part, torch.tensor([0, len(part)]), 60)[0]
        assert torch.equal(indices[out[s] : out[s + 1]] - offsets[s], alone)


def test_bitwise_equal_for_threads():
    coordinates, offsets = random_points(30000, 4096), torch.tensor([0, 12000, 12000, 25000, 30000])
    assert_same_for_threads(lambda: farthest_point_sample(coordinates, offsets, 200))


CODE = """
import hashlib, torch
from ast_sim.ops._fps import farthest_point_sample
g = torch.Generator().manual_seed(5)
digest = hashlib.sha256()
for extent in (5, 4096, 2**21):
    x = torch.randint(0, extent, (3001, 3), generator=g).int()
    indices, offsets = farthest_point_sample(x, torch.tensor([0, 9, 9, 3001]), 500)
    digest.update(indices.numpy().tobytes() + offsets.numpy().tobytes())
print(digest.hexdigest())
"""


def test_every_instruction_set_and_backend():
    assert_same_everywhere(CODE)


def test_opcheck():
    torch.library.opcheck(fps._sample.overload, (random_points(40, 9), torch.tensor([0, 15, 40]), 8))


def test_unusual_layouts_and_unchanged_inputs():
    x, offsets = random_points(60, 100), torch.tensor([0, 20, 60])
    expected = farthest_point_sample(x, offsets, 10)[0]
    read_only = misaligned_read_only(x)
    for y in (x.t().contiguous().t(), torch.cat([x, x], 1)[:, 3:], read_only):
        before = y.clone()
        assert torch.equal(farthest_point_sample(y, offsets, 10)[0], expected) and torch.equal(y, before)
    assert farthest_point_sample(x[:1].expand(60, 3), offsets, 2)[0].tolist() == [0, 1, 20, 21]
    strided = torch.stack([offsets, offsets], 1)[:, 0]
    assert torch.equal(farthest_point_sample(x, strided, 10)[0], expected)


POINTS = random_points(30, 9)
OFFSETS = torch.tensor([0, 10, 30])


@pytest.mark.parametrize(
    "arguments, message",
    [
        ((POINTS, OFFSETS, 0), "num must be at least 1, not 0"),
        ((POINTS, OFFSETS, -5), "num must be at least 1, not -5"),
        ((POINTS[:, :2], OFFSETS, 4), r"coordinates must have shape \[C, 3\], not \(30, 2\)"),
        ((POINTS.long(), OFFSETS, 4), "coordinates must be int32"),
        ((POINTS, OFFSETS.int(), 4), "offsets must be int64"),
        ((POINTS, OFFSETS[:0], 4), r"offsets must have shape \[B\+1\], not \(0,\)"),
        ((POINTS, torch.tensor([0, 20, 10, 30]), 4), "offsets must never fall, but falls to 10 at 2"),
        ((POINTS, torch.tensor([0, 10, 31]), 4), "offsets must end at the number of rows 30, not 31"),
        (
            (torch.cat([POINTS, points((0, 0, 0), (0, 1 << 21, 0))]), torch.tensor([0, 30, 32]), 4),
            r"scene 1 differ by 2\^21",
        ),
        ((points((-(1 << 20), 0, 0), (1 << 20, 0, 0)), torch.tensor([0, 2]), 1), r"scene 0 differ by 2\^21"),
    ],
)
@pytest.mark.parametrize("reference", [False, True])
def test_errors_name_op_argument_and_value(monkeypatch, reference, arguments, message):
    if reference:
        monkeypatch.setattr(fps, "_sample", fps._sample.reference)
    with pytest.raises((ValueError, TypeError), match=f"farthest_point_sample: .*{message}"):
        farthest_point_sample(*arguments)


@pytest.mark.parametrize("offsets", [[0], [0, 0], [0, 0, 0]])
def test_no_points_give_no_samples(offsets):
    indices, out = farthest_point_sample(points(), torch.tensor(offsets), 7)
    assert len(indices) == 0 and out.tolist() == offsets

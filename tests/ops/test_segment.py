"""segment_sum and segment_mean against their compositions and their contracts."""

import hashlib

import numpy as np
import pytest
import torch
from checks import assert_accurate, assert_same_for_threads, instruction_sets, misaligned_read_only, run_forked
from hypothesis import given, settings
from hypothesis import strategies as st

from ast_sim.ops import _segment as segment
from ast_sim.ops import segment_mean, segment_sum


def case(rows: int, segments: int, channels: int, seed: int = 0):
    g = torch.Generator().manual_seed(seed)
    ends = torch.randint(0, rows + 1, (max(segments - 1, 0),), generator=g).sort().values
    offsets = (
        torch.cat([torch.tensor([0]), ends, torch.tensor([rows])]) if segments else torch.zeros(1, dtype=torch.int64)
    )
    return torch.randn(rows, channels, generator=g), torch.randperm(rows, generator=g), offsets


SIZES = [(0, 0, 3), (0, 4, 3), (1, 1, 1), (2, 5, 2), (63, 7, 17), (1000, 129, 64), (4097, 300, 128), (50, 50, 0)]


@pytest.mark.parametrize("rows, segments, channels", SIZES)
@pytest.mark.parametrize("mean", [False, True])
def test_accuracy_of_sum_mean_and_spread(rows, segments, channels, mean):
    x, order, offsets = case(rows, segments, channels)
    assert_accurate(
        lambda x: segment._sum(x, order, offsets, mean), lambda x: segment._sum_reference(x, order, offsets, mean), [x]
    )
    dout = torch.randn(segments, channels)
    assert_accurate(
        lambda y: segment._spread(y, order, offsets, mean),
        lambda y: segment._spread_reference(y, order, offsets, mean),
        [dout],
    )


def test_values_by_hand():
    x = torch.tensor([[1.0, 10.0], [2.0, 20.0], [4.0, 40.0]])
    order, offsets = torch.tensor([2, 0, 1]), torch.tensor([0, 1, 1, 3])
    assert segment_sum(x, order, offsets).tolist() == [[4.0, 40.0], [0.0, 0.0], [3.0, 30.0]]
    assert segment_mean(x, order, offsets).tolist() == [[4.0, 40.0], [0.0, 0.0], [1.5, 15.0]]


def test_sums_run_in_stored_order():
    x = torch.tensor([[1e8], [1.0], [-1e8]])
    offsets = torch.tensor([0, 3])
    assert segment_sum(x, torch.tensor([0, 1, 2]), offsets).item() == 0.0
    assert segment_sum(x, torch.tensor([0, 2, 1]), offsets).item() == 1.0


@given(rows=st.integers(0, 40), segments=st.integers(1, 9), channels=st.integers(0, 20), seed=st.integers(0, 2**31))
@settings(deadline=None, max_examples=60, derandomize=True)
def test_any_shape_agrees_with_numpy(rows, segments, channels, seed):
    x, order, offsets = case(rows, segments, channels, seed)
    expected = np.stack(
        [x.double().numpy()[order[a:b].numpy()].sum(0) for a, b in zip(offsets[:-1], offsets[1:], strict=True)]
    )
    np.testing.assert_allclose(segment_sum(x, order, offsets).numpy(), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("special", [float("nan"), float("inf"), -float("inf"), 3.4e38, 1e-42])
def test_extreme_values_stay_in_their_segment(special):
    x, order, offsets = case(20, 4, 5)
    x[order[int(offsets[1])]] = special
    out, expected = segment_sum(x, order, offsets), segment._sum_reference(x, order, offsets, False)
    assert torch.equal(out.isnan(), expected.isnan()) and torch.equal(out[~out.isnan()], expected[~expected.isnan()])


def test_bitwise_equal_for_threads():
    x, order, offsets = case(20000, 500, 64)
    dout = torch.randn(500, 64)
    assert_same_for_threads(lambda: [segment_mean(x, order, offsets), segment._spread(dout, order, offsets, True)])


CODE = """
import torch, hashlib
from ast_sim.ops import _segment as segment
g = torch.Generator().manual_seed(3)
x, order = torch.randn(999, 37, generator=g), torch.randperm(999, generator=g)
offsets = torch.arange(0, 1000, 27)
out = segment.segment_mean(x, order, offsets)
assert (out - segment._sum_reference(x, order, offsets, True)).abs().max() < 1e-6
print(hashlib.sha256(out.numpy().tobytes()).hexdigest())
"""


def test_every_instruction_set():
    prints = {isa: run_forked(CODE, AST_SIM_ISA=isa).strip() for isa in instruction_sets()}
    assert "base" in prints and len(set(prints.values())) == 1, prints
    assert len(next(iter(prints.values()))) == len(hashlib.sha256().hexdigest())


def test_scene_alone_equals_scene_in_batch():
    x, order, offsets = case(300, 40, 16)
    alone = segment_mean(x, order, offsets)
    both = segment_mean(torch.cat([x, x]), torch.cat([order, order + 300]), torch.cat([offsets, offsets[1:] + 300]))
    assert torch.equal(both[:40], alone) and torch.equal(both[40:], alone)


def test_opcheck():
    x, order, offsets = case(30, 4, 5)
    torch.library.opcheck(segment._sum.overload, (x.requires_grad_(), order, offsets, True))
    torch.library.opcheck(segment._spread.overload, (torch.randn(4, 5, requires_grad=True), order, offsets, False))


@pytest.mark.parametrize("rows, channels", [(0, 3), (1, 1), (3, 0), (511, 17), (512, 128), (5000, 33)])
def test_column_sum(rows, channels):
    x = torch.randn(rows, channels)
    assert_accurate(segment.column_sum, lambda x: x.sum(0), [x])
    assert_same_for_threads(lambda: [segment.column_sum(x)])
    torch.library.opcheck(segment._column_sum.overload, (x.requires_grad_(),))
    with pytest.raises(ValueError, match="column_sum: x must have shape"):
        segment.column_sum(x[None])


@pytest.mark.parametrize("channels", [3, 44])
def test_a_million_rows_of_one_segment(channels):
    """Of values that do not cancel, where one long chain of sums would be off by 2e-5 (the sum, the mean, and the
    gradient of what is spread over the rows)."""
    rows, one = torch.arange(1_000_000), torch.tensor([0, 1_000_000])
    x = 1 + torch.rand(len(rows), channels)
    sums = x.double().sum(0)
    spread = torch.zeros(1, channels, requires_grad=True)
    (gradient,) = torch.autograd.grad(segment.segment_spread(spread, rows, one), spread, x)
    for result in (segment_sum(x, rows, one), segment_mean(x, rows, one) * len(rows), gradient):
        torch.testing.assert_close(result[0].double(), sums, rtol=1e-6, atol=0)


def test_chains_are_counted_within_a_segment():
    """Rows before and behind a segment change none of its bits."""
    x = 1 + torch.rand(2000, 20)
    alone = segment_sum(x, torch.arange(2000), torch.tensor([0, 2000]))
    batch = torch.cat([torch.rand(100, 20), x, torch.rand(700, 20)])
    assert torch.equal(segment_sum(batch, torch.arange(2800), torch.tensor([0, 100, 2100, 2800]))[1:2], alone)


def test_column_sum_of_a_million_rows():
    """Of values that do not cancel, where one long chain of sums would collect rounding errors."""
    assert_accurate(segment.column_sum, lambda x: x.sum(0), [torch.rand(1_000_000, 3)])


@pytest.mark.parametrize("value", [0.1, 0.3])
@pytest.mark.parametrize("rows", [512, 5000, 1_000_000])
def test_column_sum_of_equal_rows(rows, value):
    """All roundings of a chain have one sign."""
    assert_accurate(segment.column_sum, lambda x: x.sum(0), [torch.full((rows, 3), value)])


def test_gradients_in_float64():
    x, order, offsets = case(9, 4, 3)
    assert torch.autograd.gradcheck(lambda x: segment_mean(x, order, offsets), x.double().requires_grad_())


def test_unusual_layouts_and_unchanged_inputs():
    x, order, offsets = case(60, 6, 8)
    expected = segment_sum(x, order, offsets)
    wide = torch.randn(60, 16)
    wide[:, ::2] = x
    transposed = x.t().contiguous().t()
    read_only = misaligned_read_only(x)
    for y in (wide[:, ::2], transposed, read_only):
        before = y.clone()
        assert torch.equal(segment_sum(y, order, offsets), expected) and torch.equal(y, before)
    expanded = x[:1].expand(60, 8)
    assert torch.equal(segment_sum(expanded, order, offsets), segment_sum(expanded.clone(), order, offsets))


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda x, o, f: (x[:, 0], o, f), "x must have shape"),
        (lambda x, o, f: (x, o.int(), f), "node_order must be int64"),
        (lambda x, o, f: (x, o + 1, f), "is not an index below 30"),
        (lambda x, o, f: (x, o * 0, f), "permutation"),
        (lambda x, o, f: (x, o, f.flip(0)), "node_offsets must start with 0"),
        (lambda x, o, f: (x, o, torch.tensor([0, 20, 10, 30])), "falls to 10 at 2"),
        (lambda x, o, f: (x, o, torch.tensor([0, 29])), "must end at the number of rows 30"),
        (lambda x, o, f: (x, o[:-1], f), "node_order must have shape"),
    ],
)
def test_errors_name_op_argument_and_value(change, message):
    with pytest.raises((ValueError, TypeError), match=message) as error:
        segment_sum(*change(*case(30, 4, 5)))
    assert "segment_sum" in str(error.value)

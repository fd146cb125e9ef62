"""attention against its composition, its contract, and the generator of its dropout against the paper's."""

import numpy as np
import pytest
import torch
from checks import (
    assert_accurate,
    assert_same_for_threads,
    instruction_sets,
    misaligned_read_only,
    run_forked,
    run_python,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from ast_sim.ops import _attention as ops
from ast_sim.ops import attention, library
from ast_sim.ops._attention import dropout_factors


def offsets_of(*sizes: int) -> Tensor:
    return torch.tensor([0, *sizes]).cumsum(0)


def case(queries, keys, heads=2, width=32, amplitude=1.0, seed=0) -> list[Tensor]:
    """q, k, v and the offsets of scenes with these numbers of queries and keys."""
    g = torch.Generator().manual_seed(seed)
    q, k, v = (torch.randn(sum(n), heads, width, generator=g) for n in (queries, keys, keys))
    return [amplitude * q, amplitude * k, v, offsets_of(*queries), offsets_of(*keys)]


def fused(scale, p=0.0, seed=0):
    return lambda *inputs: attention(*inputs, scale, p, seed)


def composed(scale, p=0.0, seed=0):
    def function(*inputs):
        out, maximum, total = ops._reference(*inputs, scale, p, seed)
        return out, (maximum + total.log()).detach()

    return function


SHAPES = [
    ([1], [1], 1, 16),
    ([2], [1], 1, 16),
    ([1], [2], 3, 16),
    ([7], [5], 2, 48),
    ([33], [17], 1, 128),
    ([65], [127], 2, 80),
    ([129], [257], 1, 64),
    ([90, 90, 90, 90], [90, 90, 90, 90], 4, 32),
    ([5, 0, 70, 3], [40, 6, 1, 300], 2, 64),
]


@pytest.mark.parametrize("queries, keys, heads, width", SHAPES)
@pytest.mark.parametrize("p", [0.0, 0.1])
def test_accuracy(queries, keys, heads, width, p):
    inputs = case(queries, keys, heads, width)
    assert_accurate(fused(width**-0.5, p, 3), composed(width**-0.5, p, 3), inputs)


@pytest.mark.parametrize("amplitude", [0.0, 4.0, 40.0, 1e15])
@pytest.mark.parametrize("p", [0.0, 0.3])
def test_accuracy_of_equal_and_of_large_scores(amplitude, p):
    """Scores up to some 1e4 and 1e30."""
    inputs = case([200, 100], [300, 150], 2, 64, amplitude)
    assert_accurate(fused(0.125, p), composed(0.125, p), inputs)


def test_accuracy_over_many_keys():
    inputs = case([64], [9000], 2, 64)
    assert_accurate(fused(0.125), composed(0.125), inputs)


def test_values_by_hand():
    q = torch.zeros(1, 1, 16)
    q[..., 0] = 2.0
    k = torch.zeros(2, 1, 16)
    k[1, :, 0] = np.log(3) / 2  # scores 0 and log 3, weights 1/4 and 3/4
    v = torch.tensor([4.0, 8.0])[:, None, None].expand(2, 1, 16)
    out, lse = attention(q, k, v, offsets_of(1), offsets_of(2), 1.0)
    torch.testing.assert_close(out, torch.full((1, 1, 16), 7.0))
    torch.testing.assert_close(lse, torch.tensor([[np.log(4)]], dtype=torch.float32))


def test_default_scale():
    inputs = case([5], [6], 2, 64)
    assert torch.equal(attention(*inputs)[0], attention(*inputs, 0.125)[0])


def test_agrees_with_torch():
    q, k, v, *offsets = case([50], [70], 4, 64)
    expected = torch.nn.functional.scaled_dot_product_attention(*(x.transpose(0, 1)[None] for x in (q, k, v)))
    torch.testing.assert_close(attention(q, k, v, *offsets)[0], expected[0].transpose(0, 1), rtol=1e-5, atol=1e-6)


@given(
    queries=st.lists(st.integers(0, 20), max_size=4),
    keys=st.lists(st.integers(0, 20), min_size=4, max_size=4),
    heads=st.integers(0, 3),
    seed=st.integers(0, 2**31),
)
@settings(deadline=None, max_examples=40, derandomize=True)
def test_any_batch_agrees_with_the_composition(queries, keys, heads, seed):
    inputs = case(queries, keys[: len(queries)], heads, 16, 1.0, seed)
    for x, y in zip(fused(0.25, 0.2, seed)(*inputs), composed(0.25, 0.2, seed)(*inputs), strict=True):
        torch.testing.assert_close(x, y, rtol=1e-5, atol=1e-5)


# ---- extremes ----


def test_scenes_without_keys_or_queries():
    q, k, v, q_offsets, k_offsets = case([3, 0, 4], [0, 5, 2])
    leaves = [x.requires_grad_() for x in (q, k, v)]
    out, lse = attention(*leaves, q_offsets, k_offsets)
    assert (out[:3] == 0).all() and (lse[:3] == -torch.inf).all() and (out[3:] != 0).any()
    out.sum().backward()
    assert (q.grad[:3] == 0).all() and (k.grad[:5] == 0).all() and (v.grad[:5] == 0).all() and (v.grad[5:] != 0).all()


@pytest.mark.parametrize("which", [0, 1, 2])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_not_finite_inputs_reach_the_rows_that_the_formula_says(which, value):
    inputs = case([70, 5], [300, 8], 2, 16)
    inputs[which][37, 1, 5] = value
    double = [x.double() if x.is_floating_point() else x for x in inputs]
    clean = list(inputs)
    clean[which] = inputs[which].nan_to_num(0, 0, 0)
    for got, exact, untouched in zip(fused(0.25)(*inputs), composed(0.25)(*double), fused(0.25)(*clean), strict=True):
        assert torch.equal(got.isnan(), exact.isnan()) and torch.equal(got.isinf(), exact.isinf())
        torch.testing.assert_close(got.double(), exact, rtol=1e-4, atol=1e-5, equal_nan=True)
        assert torch.equal(got[:, 0], untouched[:, 0]) and torch.equal(got[70:], untouched[70:])


def test_first_block_of_keys_at_minus_infinity():
    inputs = case([4], [600], 1, 16)
    inputs[0][..., 0], inputs[1][:500, :, 0] = 1.0, -torch.inf
    q, k, v, *_ = inputs
    out, _ = attention(*inputs)
    expected, _ = attention(q, k[500:], v[500:], offsets_of(4), offsets_of(100))
    torch.testing.assert_close(out, expected)
    k[:, :, 0] = -torch.inf
    assert all(x.isnan().all() for x in attention(*inputs))


def test_no_overflow_that_the_result_does_not_have():
    q, k, v, *offsets = case([3], [1000], 1, 16)
    q[:], k[:], v[:] = 0, 0, 3e38
    torch.testing.assert_close(attention(q, k, v, *offsets)[0], v[:3], rtol=1e-5, atol=0)
    q[:, :, 0], k[::2, :, 0], k[1::2, :, 0] = 3e38, 1.0, -1.0  # scores of +-3e38
    out, lse = attention(q, k, v, *offsets, 1.0)
    torch.testing.assert_close(out, v[:3], rtol=1e-5, atol=0)
    assert (lse == 3e38).all()


@pytest.mark.parametrize("scale", [1e9, -1e9])
@pytest.mark.parametrize("p", [0.0, 0.1])
def test_a_scale_that_would_overflow_with_the_queries_alone(scale, p):
    """scale q is up to 1e40, the scores are about 10."""
    q, k, v, *offsets = case([40, 3], [150, 20], 2, 48)
    assert_accurate(fused(scale, p), composed(scale, p), [1e30 * q, 1e-38 * k, 1e-6 * v, *offsets])


@pytest.mark.parametrize("keys", [1000, 20000])
def test_small_values_among_many_keys_keep_their_digits(keys):
    """A power of two more or less changes no digit of the output, where weight times value is below normal numbers."""
    q, k, v, *offsets = case([3], [keys])
    tiny = 2.0**-123
    out, small = (attention(q, k, values, *offsets, None, 0.0, 0)[0] for values in (v, tiny * v))
    assert ((small / tiny - out).abs() <= 1e-6 * v.abs().max()).all()


# ---- dropout ----


def test_generator_is_threefry():
    """The known answer of 20 rounds for key 0 and counter 0."""
    zero = torch.zeros((), dtype=torch.int64)
    words = [int(x) for x in ops._threefry(20, [zero] * 4, [zero] * 4)]
    assert words == [0x9C6CA96A, 0xE17EAE66, 0xFC10ECD4, 0x5256A7D8]


@pytest.mark.parametrize("p", [0.1, 0.5, 1e-3, 1e-9, 0.99999])
def test_kept_share_is_within_1e_4(p):
    factors = dropout_factors(p, 11, 0, (8, 500, 1000), torch.zeros(1, dtype=torch.float64))
    share = 65536 / factors.max().item() / 65536
    assert abs(share - (1 - p)) <= 1e-4
    noise = 4 * (share * (1 - share) / factors.numel()) ** 0.5
    assert abs((factors > 0).double().mean().item() - share) <= noise + 1e-12


def test_weights_are_dropped_independently():
    kept = (dropout_factors(0.5, 1, 0, (4, 256, 512), torch.zeros(1)) > 0).double() * 2 - 1
    others = [
        dropout_factors(0.5, seed, scene, (4, 256, 512), torch.zeros(1))
        for seed, scene in ((2, 0), (1, 1), (1 << 40, 0))
    ]
    pairs = [(kept, (x > 0).double() * 2 - 1) for x in others]
    pairs += [(kept.roll(1, d), kept) for d in range(3)] + [(kept.roll(n, 2), kept) for n in (8, 16, 128)]
    for x, y in pairs:
        assert abs((x * y).mean().item()) < 5 / kept.numel() ** 0.5


@pytest.mark.parametrize("seed", [0, -1, 2**63 - 1, 2**64 - 1, -(2**63)])
def test_kernel_drops_what_the_composition_drops(seed):
    """With equal scores and the unit vectors as values, out holds the factors themselves."""
    keys = 128
    q, k = torch.zeros(40, 2, keys), torch.zeros(keys, 2, keys)
    v = torch.eye(keys)[:, None].expand(keys, 2, keys) * keys
    out, _ = attention(q, k, v, offsets_of(40), offsets_of(keys), dropout_p=0.4, seed=seed)
    expected = dropout_factors(0.4, seed % 2**64, 0, (2, 40, keys), q)
    torch.testing.assert_close(out, expected.transpose(0, 1), rtol=1e-6, atol=0)


def test_gradients_use_the_same_mask_as_the_output():
    """out is linear in v: <out(v), y> = <v, dv>, which fails for any other mask."""
    q, k, v, *offsets = case([30, 140], [60, 300], 2, 16)
    v.requires_grad_()
    out, _ = attention(q, k, v, *offsets, dropout_p=0.5, seed=9)
    y = torch.randn(out.shape)
    (out * y).sum().backward()
    left, right = (out.detach().double() * y.double()).sum(), (v.detach().double() * v.grad.double()).sum()
    assert abs(left - right) <= 1e-5 * abs(out.detach() * y).sum()


def test_gradients_in_float64():
    q, k, v, *offsets = case([2, 0, 1], [2, 1, 2], 1, 16)
    leaves = [x.double().requires_grad_() for x in (q, k, v)]
    assert torch.autograd.gradcheck(lambda *x: attention(*x, *offsets, 0.3, 0.25, 5)[0], leaves)


# ---- determinism ----


def test_bitwise_equal_for_threads():
    inputs = case([200, 60], [300, 500], 3, 64)
    dout = torch.randn(260, 3, 64)
    for p in (0.0, 0.2):

        def function(p=p):
            out, maximum, total = ops._attention(*inputs, 0.125, p, 3)
            return out, maximum, total, *ops._attention_backward(*inputs, 0.125, p, 3, out, maximum, total, dout)

        assert_same_for_threads(function)


def test_scene_alone_equals_scene_in_batch():
    q, k, v, q_offsets, k_offsets = case([130, 0, 70], [257, 9, 300], 2, 32)
    batch, lse = attention(q, k, v, q_offsets, k_offsets)
    alone, lse_alone = attention(q[130:], k[266:], v[266:], offsets_of(70), offsets_of(300))
    assert torch.equal(batch[130:], alone) and torch.equal(lse[130:], lse_alone)
    with_dropout = attention(q, k, v, q_offsets, k_offsets, dropout_p=0.2)[0][:130]
    first = attention(q[:130], k[:257], v[:257], offsets_of(130), offsets_of(257), dropout_p=0.2)[0]
    assert torch.equal(with_dropout, first)


CODE = """
import sys; sys.path[:0] = ["tests", "tests/ops"]
import torch
from checks import assert_accurate
from test_attention import case, composed, fused
inputs = case([65, 3], [300, 40], 1, 48)
for p in (0.0, 0.3):
    assert_accurate(fused(0.2, p, 7), composed(0.2, p, 7), inputs)
from ast_sim.ops.library import configuration
print(configuration()["instruction_set"])
"""


def test_every_instruction_set():
    for isa in instruction_sets():
        assert run_forked(CODE, AST_SIM_ISA=isa).strip() == isa


# ---- the op ----


def test_opcheck():
    q, k, v, *offsets = case([5, 4], [6, 3], 2, 16)
    leaves = [x.requires_grad_() for x in (q, k, v)]
    torch.library.opcheck(ops._attention.overload, (*leaves, *offsets, 0.25, 0.1, 3))
    out, maximum, total = ops._attention(*(x.detach() for x in leaves), *offsets, 0.25, 0.1, 3)
    inputs = (q.detach(), k.detach(), v.detach(), *offsets, 0.25, 0.1, 3, out, maximum, total, torch.randn(out.shape))
    torch.library.opcheck(ops._attention_backward.overload, inputs)


@pytest.mark.parametrize("wanted", [(0,), (1,), (2,), (0, 2)])
def test_any_subset_requires_grad(wanted):
    inputs = case([20], [30])
    every = [x.clone().requires_grad_() for x in inputs[:3]]
    attention(*every, *inputs[3:])[0].square().sum().backward()
    for i in wanted:
        inputs[i].requires_grad_()
    out, lse = attention(*inputs)
    out.square().sum().backward()
    assert not lse.requires_grad
    for i in range(3):
        assert torch.equal(inputs[i].grad, every[i].grad) if i in wanted else inputs[i].grad is None


def test_slices_of_a_fused_projection_are_read_in_place():
    qkv = torch.randn(150, 3, 4, 32)
    q, k, v = qkv.unbind(1)
    for x in (q, k, v):
        assert library.contiguous(x, ops._attention.spec.taken[0]) is x
    offsets = offsets_of(100, 50)
    dense = attention(q.contiguous(), k.contiguous(), v.contiguous(), offsets, offsets)
    for x, y in zip(attention(q, k, v, offsets, offsets), dense, strict=True):
        assert torch.equal(x, y)


def test_gradients_of_slices_are_the_ones_of_three_tensors():
    """To the bit."""
    q, k, v, i, _ = case([70, 0, 41], [70, 0, 41], 4, 32)
    leaves, packed = [x.requires_grad_() for x in (q, k, v)], torch.stack([q, k, v], 1).detach().requires_grad_()
    out, _ = attention(*leaves, i, i, dropout_p=0.2, seed=5)
    of_slices, _ = attention(*packed.unbind(1), i, i, dropout_p=0.2, seed=5)
    assert torch.equal(of_slices, out)
    dout = torch.randn(out.shape)
    gradients = torch.autograd.grad(out, leaves, dout)
    assert torch.equal(torch.autograd.grad(of_slices, packed, dout)[0], torch.stack(gradients, 1))


@pytest.mark.parametrize("queries, keys", [(1300, 40), (40, 2500), (600, 1200)])
def test_scenes_of_few_tasks_are_cut_and_merged(queries, keys):
    """Over queries or keys, in parts that depend on the scene alone: the same bits beside other scenes."""
    inputs = case([queries], [keys], 1, 32)
    assert_accurate(fused(0.2, 0.1, 3), composed(0.2, 0.1, 3), inputs)
    q, k, v, *_ = inputs
    other = case([5], [7], 1, 32, seed=1)
    both = [torch.cat([x, y]) for x, y in zip((q, k, v), other, strict=False)]
    offsets = offsets_of(queries, 5), offsets_of(keys, 7)
    results = []
    for x, ends in ((both, offsets), ((q, k, v), inputs[3:])):
        leaves = [y.clone().requires_grad_() for y in x]
        out, _ = attention(*leaves, *ends, dropout_p=0.1, seed=3)
        results.append([out, *torch.autograd.grad(out[:queries].square().sum(), leaves)])
    for a, b in zip(*results, strict=True):
        assert torch.equal(a[: len(b)], b)


def test_unusual_layouts_and_unchanged_inputs():
    q, k, v, *offsets = case([60], [60], 4, 16)
    expected, _ = attention(q, k, v, *offsets)
    wide = torch.randn(60, 4, 32)
    wide[:, :, ::2] = q
    transposed = q.transpose(0, 1).contiguous().transpose(0, 1)
    for x in (wide[:, :, ::2], transposed, misaligned_read_only(q)):
        before = x.clone()
        assert torch.equal(attention(x, k, v, *offsets)[0], expected) and torch.equal(x, before)
    one = k[:1].expand(60, 4, 16)
    assert torch.equal(attention(q, one, v, *offsets)[0], attention(q, one.clone(), v, *offsets)[0])


def test_other_dtypes_and_autocast():
    inputs = case([9], [11], 2, 16)
    exact = composed(0.25)(*(x.double() if x.is_floating_point() else x for x in inputs))[0]
    half = [x.bfloat16() if x.is_floating_point() else x for x in inputs]
    out, _ = attention(*half)
    assert out.dtype == torch.bfloat16
    torch.testing.assert_close(out.double(), exact, rtol=0.05, atol=0.05)
    with torch.autocast("cpu", torch.bfloat16):
        out, _ = attention(*half)
    assert out.dtype == torch.float32


MEMORY = """
import resource, torch
from ast_sim.ops._attention import attention
torch.set_num_threads(1)
def peak(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
def run(n):
    x = [torch.randn(n, 4, 64, requires_grad=True) for _ in range(3)]
    offsets = torch.tensor([0, n])
    attention(*x, offsets, offsets, dropout_p=0.1)[0].sum().backward()
run(256)
before = peak()
run(4096)
print(peak() - before)
"""


def test_memory_is_in_proportion_to_the_tokens():
    """4096 x 4096 x 4 heads are 256 MiB a score matrix; the tensors of this run are 4 MiB each."""
    assert int(run_python(MEMORY, AST_SIM_DEBUG="0")) * 1024 < 64 * 2**20


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda q, k, v, i, j: (q[0], k, v, i, j), "q must have shape|q, k and v must have shapes"),
        (lambda q, k, v, i, j: (q, k[:, :1], v, i, j), "k must have shape|q, k and v must have shapes"),
        (lambda q, k, v, i, j: (q, k, v[1:], i, j), "v must have shape|q, k and v must have shapes"),
        (lambda q, k, v, i, j: (q[..., :8], k[..., :8], v[..., :8], i, j), "multiple of 16 up to 128, not 8"),
        (lambda q, k, v, i, j: (q, k, v, i[1:], j[1:]), "q_offsets must start with 0"),
        (lambda q, k, v, i, j: (q, k, v, i, j[:-1]), "k_offsets must have shape"),
        (lambda q, k, v, i, j: (q, k, v, offsets_of(3, 3), j), "q_offsets must end at the number of rows 5, not 6"),
        (lambda q, k, v, i, j: (q, k, v, i, offsets_of(9, -2)), "k_offsets must never fall, but falls to 7 at 2"),
        (lambda q, k, v, i, j: (q, k, v, i.int(), j), "q_offsets must be int64"),
        (lambda q, k, v, i, j: (q, k, v, i, j, 1.0, 1.0), r"dropout_p must lie in \[0, 1\)"),
        (lambda q, k, v, i, j: (q, k, v, i, j, 1.0, float("nan")), r"dropout_p must lie in \[0, 1\)"),
    ],
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_errors_name_op_argument_and_value(change, message, dtype):
    """The kernel and the composition, which runs for float64, refuse alike."""
    inputs = [x.to(dtype) if x.is_floating_point() else x for x in case([3, 2], [4, 3], 2, 16)]
    with pytest.raises((ValueError, TypeError), match=message) as error:
        attention(*change(*inputs))
    assert "attention" in str(error.value)

"""message_sum and message_edges against their composition and their contracts."""

import re

import pytest
import torch
from checks import (
    assert_accurate,
    assert_same_for_threads,
    errors,
    instruction_sets,
    misaligned_read_only,
    run_forked,
    run_python,
)
from torch import Tensor

from ast_sim.ops import EdgeSet, message_edges, message_sum
from ast_sim.ops import _message as ops


def random_edges(edges: int, senders: int, receivers: int, seed: int = 0) -> EdgeSet:
    g = torch.Generator().manual_seed(seed)
    pairs = (torch.randint(0, max(n, 1), (edges if n else 0,), generator=g) for n in (senders, receivers))
    return EdgeSet.from_pairs(*pairs, senders, receivers)


def inputs_of(edges: EdgeSet, width: int, hidden: int = 0, raw: int = 0, out: int | None = None, seed: int = 1) -> list:
    """of_senders, of_receivers, edge_features, A1, a1, A2, W2, b2, gamma, beta; no encoder if hidden is 0, then raw is
    0 or, for latents, the width."""
    g = torch.Generator().manual_seed(seed)
    out = width if out is None else out
    senders, receivers = edges.num_senders, edges.num_receivers

    def normal(*shape: int, scale: float = 1.0) -> Tensor:
        return scale * torch.randn(*shape, generator=g)

    encoder = [normal(hidden, raw), normal(hidden), normal(width, hidden, scale=hidden**-0.5)] if hidden else [None] * 3
    return [
        normal(senders, width),
        normal(receivers, width),
        normal(len(edges), raw) if hidden or raw else None,
        *encoder,
        normal(out, width, scale=width**-0.5),
        normal(out),
        1 + normal(out, scale=0.1),
        normal(out),
    ]


def fused(edges: EdgeSet, function=message_sum):
    def call(P, Q, e, A1, a1, A2, *layer):
        return function(edges, P, Q, e, None if A1 is None else (A1, a1, A2), *layer)

    return call


def leaves_of(inputs: list) -> list:
    return [None if x is None else x.clone().requires_grad_() for x in inputs]


def composed(edges: EdgeSet, with_messages: bool = False):
    def call(P, Q, e, A1, a1, A2, *layer):
        encoder = None if A1 is None else (A1, a1, A2)
        of_edges = ops._of_edges(edges, P, e, encoder)
        both = ops._reference(P, Q, *of_edges, *layer, edges.senders, edges.receivers, None, True)
        return both if with_messages else both[0]

    return call


SIZES = [(0, 3, 2), (0, 0, 0), (1, 1, 1), (2, 1, 3), (95, 7, 5), (97, 300, 200), (700, 60, 1), (4000, 500, 700)]
WIDTHS = [(16, 16, 3, 16), (24, 40, 8, 40), (1, 1, 1, 1), (33, 7, 16, 65), (128, 128, 8, 128), (64, 0, 0, 64)]
WIDTHS += [(1, 0, 1, 4), (33, 0, 33, 65), (128, 0, 128, 128)]  # latents
with_and_without_encoder = pytest.mark.parametrize("width, hidden, raw", [(24, 16, 3), (24, 0, 24)])


def test_accuracy_of_a_million_equal_edges():
    """All roundings of a chain of sums have one sign."""
    nodes = torch.arange(1000)
    edges = EdgeSet.from_pairs(nodes.repeat(1000), nodes.repeat_interleave(1000), 1000, 1000)
    inputs = inputs_of(edges, 5, out=4)
    inputs[:2] = [x[:1].repeat(1000, 1) for x in inputs[:2]]
    factors = torch.tensor([0.1, 0.2, -0.3, 0.7])
    ends = [lambda *x, of=of: (of(*x) * factors.to(x[0].dtype)).sum(0) for of in (fused(edges), composed(edges))]
    assert_accurate(*ends, inputs)


@pytest.mark.parametrize("width, hidden, raw, out", [*WIDTHS, (40, 0, 0, 24), (16, 16, 0, 16)])
@pytest.mark.parametrize("size", SIZES)
def test_accuracy(size, width, hidden, raw, out):
    edges = random_edges(*size)
    assert_accurate(fused(edges), composed(edges), inputs_of(edges, width, hidden, raw, out))


@pytest.mark.parametrize("width, hidden, raw, out", WIDTHS)
@pytest.mark.parametrize("size", [(0, 3, 2), (2, 1, 3), (700, 60, 50)])
def test_accuracy_of_messages(size, width, hidden, raw, out):
    edges = random_edges(*size)
    assert_accurate(fused(edges, message_edges), composed(edges, True), inputs_of(edges, width, hidden, raw, out))


WIDE = [(4096, 8, 3, 8, False), (8, 4096, 3, 8, False), (8, 8, 4096, 8, False), (8, 8, 3, 4096, False)]
WIDE += [(8, 4096, 3, 8, True), (4096, 0, 4096, 8, True)]


@pytest.mark.parametrize("width, hidden, raw, out, positive", WIDE)
def test_accuracy_of_wide_layers(width, hidden, raw, out, positive):
    """Sums over features, hidden units and channels are cut into chains: one long chain loses a digit of positive
    terms."""
    edges = random_edges(200, 50, 30)
    inputs = inputs_of(edges, width, hidden, raw, out)
    if positive:
        inputs = [None if x is None else x.abs() for x in inputs]
    assert_accurate(fused(edges), composed(edges), inputs)


@with_and_without_encoder
def test_accuracy_over_several_rounds(width, hidden, raw):
    edges = random_edges(40_000, 3000, 2000)
    assert_accurate(fused(edges), composed(edges), inputs_of(edges, width, hidden, raw))


def test_values_by_hand():
    """Two channels: LayerNorm gives +-1, up to eps, whatever the layers say."""
    edges = EdgeSet.from_pairs(torch.tensor([0, 1, 1]), torch.tensor([2, 0, 2]), 2, 3)
    P, Q = torch.tensor([[1.0, 0.0], [0.0, 3.0]]), torch.zeros(3, 2)
    layer = (torch.eye(2), torch.zeros(2), torch.tensor([1.0, 10.0]), torch.tensor([0.0, 1.0]))
    total = message_sum(edges, P, Q, None, None, *layer)
    expected = torch.tensor([[-1.0, 11.0], [0.0, 0.0], [0.0, 2.0]])
    torch.testing.assert_close(total, expected, rtol=1e-4, atol=1e-4)
    latents = torch.tensor([[0.0, -2.0], [2.0, 0.0], [4.0, -9.0]])  # of 1 -> 0, 0 -> 2, 1 -> 2
    total = message_sum(edges, P, Q, latents, None, *layer)
    expected = torch.tensor([[-1.0, 11.0], [0.0, 0.0], [2.0, -18.0]])
    torch.testing.assert_close(total, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("out", [20, 64, 131, 300])
@pytest.mark.parametrize("value", [0.3, 1.1, 1e5 / 3, 1e15 / 3])
def test_messages_of_equal_channels_are_beta(out, value):
    edges = random_edges(200, 9, 50)
    P, Q, e, *encoder, W2, b2, gamma, beta = inputs_of(edges, 24, 16, 3, out)
    layer = (torch.zeros_like(W2), torch.full_like(b2, value), gamma, beta)
    assert torch.equal(fused(edges, message_edges)(P, Q, e, *encoder, *layer)[1], beta.expand(len(edges), out))


def test_latents_are_added_as_they_are():
    """With one edge a receiver they and their gradient equal the receiver's share and its gradient, to the bit."""
    edges = EdgeSet.from_pairs(torch.arange(500) % 7, torch.arange(500), 7, 500)
    P, Q, e, *_, W2, b2, gamma, beta = inputs_of(edges, 40, 0, 40)
    layer, zero, dsum = (W2, b2, gamma, beta), torch.zeros(500, 40), torch.randn(500, 40)
    latents, shares = e.clone().requires_grad_(), e.clone().requires_grad_()
    by_edge = message_sum(edges, P, zero, latents, None, *layer)
    by_receiver = message_sum(edges, P, shares, None, None, *layer)
    assert torch.equal(by_edge, by_receiver)
    gradients = [torch.autograd.grad(y, x, dsum)[0] for y, x in ((by_edge, latents), (by_receiver, shares))]
    assert torch.equal(*gradients) and gradients[0].count_nonzero() > 0.4 * e.numel()


@with_and_without_encoder
def test_nothing_but_the_inputs_is_kept_for_the_gradients(width, hidden, raw):
    edges = random_edges(400, 30, 40)
    inputs = leaves_of(inputs_of(edges, width, hidden, raw))
    kept = []
    with torch.autograd.graph.saved_tensors_hooks(lambda x: kept.append(x) or x, lambda x: x):
        fused(edges)(*inputs)
    given = {x.data_ptr() for x in (*inputs, edges.senders, edges.receivers, edges.receiver_offsets) if x is not None}
    assert len(kept) == 13 and all(x.numel() == 0 or x.data_ptr() in given for x in kept)


def test_sums_run_in_stored_order():
    edges = random_edges(500, 20, 5)
    inputs = inputs_of(edges, 16, 16, 2)
    total, messages = fused(edges, message_edges)(*inputs)
    assert torch.equal(total, fused(edges)(*inputs))
    for r in range(5):
        expected = torch.zeros(16)
        for m in range(int(edges.receiver_offsets[r]), int(edges.receiver_offsets[r + 1])):
            expected = expected + messages[m]
        assert torch.equal(total[r], expected)


def test_one_receiver_and_one_sender_of_all_edges():
    index, zero = torch.arange(3000), torch.zeros(3000, dtype=torch.int64)
    for edges in (EdgeSet.from_pairs(index, zero, 3000, 1), EdgeSet.from_pairs(zero, index, 1, 3000)):
        assert_accurate(fused(edges), composed(edges), inputs_of(edges, 32, 16, 4))
        assert_accurate(fused(edges), composed(edges), inputs_of(edges, 32, 0, 32))


@pytest.mark.parametrize("raw, bound", [(4, 1e-6), (0, 1e-5)])
def test_sums_over_many_edges_are_cut_into_chains(raw, bound):
    """One chain of a million edges would be off by 4e-4, and its gradients by 2e-5; if the edges are equal, so that
    each addition is rounded the same way, by 1e-2. The sums do not cancel."""
    zero = torch.zeros(1_000_000, dtype=torch.int64)
    edges = EdgeSet.from_pairs(zero, zero, 1, 1)
    inputs = inputs_of(edges, 4, 0, raw)
    inputs[-1] = 1 + inputs[-1].abs()
    total, of_sender, of_receiver, *_ = errors(fused(edges), composed(edges), inputs)
    for error, _, largest in (total, of_sender, of_receiver):
        assert error <= bound * largest


SPECIAL = [float("nan"), float("inf"), -float("inf"), 3.4e38, 1e30, 1e-30, 1e-42]


@pytest.mark.parametrize("special", SPECIAL)
def test_extreme_values_stay_with_their_edges(special):
    edges = random_edges(300, 40, 30)
    inputs = inputs_of(edges, 24, 16, 3)
    wanted = [x.clone().requires_grad_() for x in inputs[:2]]
    expected = fused(edges)(*wanted, *inputs[2:])
    gradients = torch.autograd.grad(expected.sum(), wanted)
    inputs[0][7] = special
    leaves = [x.clone().requires_grad_() for x in inputs[:2]]
    out = fused(edges)(*leaves, *inputs[2:])
    mine = edges.receivers[edges.senders == 7].unique()
    others = torch.ones(30, dtype=torch.bool).index_fill(0, mine, False)
    assert torch.equal(out[others], expected[others])
    exact = composed(edges)(*(x.double() for x in inputs))
    if special != special or abs(special) == float("inf"):
        assert torch.equal(out.isnan(), exact.isnan()) and out.isnan().any() == (special != -torch.inf)
    elif abs(special) < 1:
        torch.testing.assert_close(out.double(), exact, rtol=1e-4, atol=1e-4)
    of_senders = torch.autograd.grad(out.sum(), leaves)[0]
    untouched = torch.ones(40, dtype=torch.bool).index_fill(0, torch.tensor([7]), False)
    assert torch.equal(of_senders[untouched], gradients[0][untouched])


@pytest.mark.parametrize("special", SPECIAL)
def test_extreme_latents_stay_with_their_edge(special):
    edges = random_edges(300, 40, 30)
    inputs, dsum, dmessages = inputs_of(edges, 24, 0, 24), torch.randn(30, 24), torch.randn(300, 24)

    def results(e: Tensor, function) -> list[Tensor]:
        """Sums, messages, and the gradients of the nodes' shares and of the latents."""
        leaves = [x.clone().to(e.dtype).requires_grad_() for x in (*inputs[:2], e)]
        outputs = function(*leaves, *(None if x is None else x.to(e.dtype) for x in inputs[3:]))
        cotangents = [dsum.to(e.dtype), dmessages.to(e.dtype)]
        return [*(x.detach() for x in outputs), *torch.autograd.grad(outputs, leaves, cotangents)]

    expected = results(inputs[2], fused(edges, message_edges))
    changed = inputs[2].clone()
    changed[77] = special
    found = results(changed, fused(edges, message_edges))
    exact = results(changed.double(), composed(edges, True))
    rows = [edges.receivers[77], 77, edges.senders[77], edges.receivers[77], 77]
    for mine, x, y, z in zip(rows, found, expected, exact, strict=True):
        others = torch.arange(len(x)) != mine
        assert torch.equal(x[others], y[others])
        if special != special or abs(special) == float("inf"):
            assert torch.equal(x.isnan(), z.isnan()) and x.isnan().any() == (special != -torch.inf)
        elif abs(special) < 1:
            torch.testing.assert_close(x.double(), z, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("hidden, raw", [(24, 5), (0, 40)])
def test_scene_alone_equals_scene_in_batch(hidden, raw):
    """Also the gradients of both nodes' shares and of the edge features, whatever comes before in the batch."""
    scenes = [random_edges(n, 150, 200, seed=n) for n in (4000, 0, 333, 20_000, 17)]
    both = EdgeSet.concatenate(scenes)
    inputs = inputs_of(both, 40, hidden, raw)
    leaves = [x.clone().requires_grad_() for x in inputs[:3]]
    total = fused(both)(*leaves, *inputs[3:])
    dsum = torch.randn(total.shape)
    expected = [total, *torch.autograd.grad(total, leaves, dsum)]
    starts = [0, 0, 0, 0]
    for edges in scenes:
        rows = [slice(at, at + n) for at, n in zip(starts, (200, 150, 200, len(edges)), strict=True)]
        starts = [x.stop for x in rows]
        leaves = [x[part].clone().requires_grad_() for x, part in zip(inputs[:3], rows[1:], strict=True)]
        total = fused(edges)(*leaves, *inputs[3:])
        for x, y, part in zip([total, *torch.autograd.grad(total, leaves, dsum[rows[0]])], expected, rows, strict=True):
            assert torch.equal(x, y[part])


@with_and_without_encoder
@pytest.mark.parametrize("size", [(5000, 700, 600), (30_000, 700, 600)])
def test_bitwise_equal_for_threads(size, width, hidden, raw):
    edges = random_edges(*size)
    inputs = inputs_of(edges, width, hidden, raw)
    dsum = torch.randn(size[2], width)

    def function():
        leaves = leaves_of(inputs)
        out = fused(edges)(*leaves)
        return out, *torch.autograd.grad(out, [x for x in leaves if x is not None], dsum)

    assert_same_for_threads(function)


CODE = """
import sys; sys.path[:0] = ["tests", "tests/ops"]
from checks import assert_accurate
from test_message import composed, fused, inputs_of, message_edges, random_edges
edges = random_edges(1500, 200, 150)
latents = ((33, 0, 33, 65), (128, 0, 128, 128))
for widths in ((24, 40, 8, 40), (33, 7, 16, 65), (128, 128, 8, 128), (64, 0, 0, 64), *latents):
    assert_accurate(fused(edges), composed(edges), inputs_of(edges, *widths))
    assert_accurate(fused(edges, message_edges), composed(edges, True), inputs_of(edges, *widths))
from ast_sim.ops.library import configuration
print(configuration()["instruction_set"])
"""


def test_every_instruction_set():
    for isa in instruction_sets():
        assert run_forked(CODE, AST_SIM_ISA=isa).strip() == isa


TORCH = """
import sys, torch; sys.path[:0] = ["tests", "tests/ops"]
from test_message import composed, fused, inputs_of, message_edges, random_edges
edges = random_edges(150, 20, 15)
for widths in ((24, 40, 8, 40), (64, 0, 0, 64), (64, 0, 64, 64)):
    inputs = inputs_of(edges, *widths)
    out = fused(edges)(*(None if x is None else x.requires_grad_() for x in inputs))
    assert torch.equal(out, composed(edges)(*inputs)) and "message" not in out.grad_fn.name().lower()
    assert fused(edges, message_edges)(*inputs)[1].shape == (150, widths[-1])
"""


def test_torch_backend_is_the_composition_under_autograd():
    run_python(TORCH, AST_SIM_BACKEND="torch")


def op_inputs_of(edges: EdgeSet, width: int, hidden: int, raw: int) -> list[Tensor]:
    """The same as the tensors that the op itself takes: empty ones where there are none."""
    inputs = inputs_of(edges, width, hidden, raw)
    absent = [torch.empty(shape) for shape in ((len(edges), 0), (0, raw), (0,), (width, 0))]
    return [*inputs[:2], *(y if x is None else x for x, y in zip(inputs[2:6], absent, strict=True)), *inputs[6:]]


@pytest.mark.parametrize("hidden, raw", [(5, 3), (0, 6)])
@pytest.mark.parametrize("with_messages", [False, True])
def test_opcheck(with_messages, hidden, raw):
    edges = random_edges(30, 4, 5)
    inputs = [x.requires_grad_() for x in op_inputs_of(edges, 6, hidden, raw)]
    lists = (edges.senders, edges.receivers, edges.receiver_offsets)
    torch.library.opcheck(ops._message.overload, (*inputs, *lists, with_messages))
    values = [x.detach() for x in inputs]
    dmessages = torch.randn(30, 6) if with_messages else None
    torch.library.opcheck(
        ops._message_backward.overload, (torch.randn(5, 6), dmessages, *values, *lists, with_messages)
    )


def test_gradients_in_float64():
    edges = random_edges(12, 4, 5)
    inputs = [x.double().requires_grad_() for x in inputs_of(edges, 4, 3, 2)]
    assert torch.autograd.gradcheck(fused(edges, message_edges), inputs)
    inputs = inputs_of(edges, 4)
    floats = [x.double().requires_grad_() for x in inputs if x is not None]
    assert torch.autograd.gradcheck(lambda P, Q, *layer: fused(edges)(P, Q, *[None] * 4, *layer), floats)
    floats = [x.double().requires_grad_() for x in inputs_of(edges, 4, 0, 4) if x is not None]
    function = fused(edges, message_edges)
    assert torch.autograd.gradcheck(lambda P, Q, e, *layer: function(P, Q, e, *[None] * 3, *layer), floats)


def test_the_op_without_edge_features_has_no_latents():
    """On both paths; the composition also serves other dtypes."""
    edges = random_edges(30, 4, 5)
    lists = (edges.senders, edges.receivers, edges.receiver_offsets)
    inputs = op_inputs_of(edges, 6, 0, 0)
    expected = message_sum(edges, *inputs[:2], None, None, *inputs[6:])
    for dtype in (torch.float32, torch.float64):
        leaves = [x.to(dtype, copy=True).requires_grad_() for x in inputs]
        total = ops._message(*leaves, *lists, False)[0]
        torch.testing.assert_close(total.float(), expected)
        total.sum().backward()
        assert leaves[2].grad.shape == (30, 0) and leaves[1].grad.shape == (5, 6)


def subsets_of(given: list[int]) -> list[tuple[int, ...]]:
    return [tuple(i for k, i in enumerate(given) if n >> k & 1) for n in range(1, 1 << len(given))]


@pytest.mark.parametrize("with_messages", [False, True])
def test_latents_with_every_subset_that_requires_grad(with_messages):
    """Every subset of all inputs that there are without an encoder."""
    edges, given = random_edges(20, 5, 6), [0, 1, 2, 6, 7, 8, 9]
    inputs, function = inputs_of(edges, 8, 0, 8), fused(edges, message_edges if with_messages else message_sum)

    def loss(inputs: list) -> Tensor:
        out = function(*inputs)
        return sum(x.square().sum() for x in (out if with_messages else [out]))

    every = leaves_of(inputs)
    loss(every).backward()
    for wanted in subsets_of(given):
        some = [None if x is None else x.clone().requires_grad_(i in wanted) for i, x in enumerate(inputs)]
        loss(some).backward()
        for i in given:
            assert torch.equal(some[i].grad, every[i].grad) if i in wanted else some[i].grad is None, (wanted, i)


@pytest.mark.parametrize("wanted", [(0,), (1,), (2,), (3, 5), (6,), (8, 9), (0, 2, 4, 7)])
def test_any_subset_requires_grad(wanted):
    edges = random_edges(200, 30, 40)
    inputs = inputs_of(edges, 24, 16, 3)
    every = leaves_of(inputs)
    fused(edges)(*every).square().sum().backward()
    for i in wanted:
        inputs[i].requires_grad_()
    fused(edges)(*inputs).square().sum().backward()
    for i, x in enumerate(inputs):
        assert torch.equal(x.grad, every[i].grad) if i in wanted else x.grad is None


@with_and_without_encoder
def test_messages_alone_are_differentiated(width, hidden, raw):
    edges = random_edges(200, 30, 40)
    inputs = inputs_of(edges, width, hidden, raw)
    assert_accurate(lambda *x: fused(edges, message_edges)(*x)[1], lambda *x: composed(edges, True)(*x)[1], inputs)


@with_and_without_encoder
def test_unusual_layouts_and_unchanged_inputs(width, hidden, raw):
    edges = random_edges(200, 30, 40)
    inputs = inputs_of(edges, width, hidden, raw)
    expected = fused(edges)(*inputs)
    for i, x in enumerate(inputs):
        if x is None:
            continue
        strange = [misaligned_read_only(x), torch.stack([x, x], -1)[..., 0]]
        for y in [*strange, x.t().contiguous().t()] if x.dim() == 2 else strange:
            before = y.clone()
            assert torch.equal(fused(edges)(*inputs[:i], y, *inputs[i + 1 :]), expected) and torch.equal(y, before)
    for i in (0, 2):
        one = inputs[i][:1].expand(inputs[i].shape)
        results = [fused(edges)(*inputs[:i], x, *inputs[i + 1 :]) for x in (one, one.clone())]
        assert torch.equal(*results)


def test_gradients_of_strange_latents():
    """Cotangents of any layout, and latents that are a view: their gradient is the same as for dense ones."""
    edges = random_edges(200, 30, 40)
    P, Q, e, *rest = inputs_of(edges, 24, 0, 24)
    wide = torch.cat([e, e], 1).requires_grad_()
    latents, dsum = e.clone().requires_grad_(), torch.randn(24, 40).t()
    expected = torch.autograd.grad(fused(edges)(P, Q, latents, *rest), latents, dsum.contiguous())[0]
    of_wide = torch.autograd.grad(fused(edges)(P, Q, wide[:, 24:], *rest), wide, dsum)[0]
    assert torch.equal(of_wide[:, 24:], expected) and not of_wide[:, :24].any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_errors_name_op_argument_and_value(dtype):
    edges = random_edges(30, 4, 5)
    floats = [x.to(dtype) for x in inputs_of(edges, 6, 5, 3)]
    inputs = [*floats, edges.senders, edges.receivers, edges.receiver_offsets]

    def call(i: int, changed: Tensor):
        return ops._message(*inputs[:i], changed, *inputs[i + 1 :], False)

    beyond, other = edges.senders.clone(), edges.receivers.clone()
    beyond[3], other[4] = 4, 9
    for message, i, changed in (
        (r"of_senders must have shape", 0, floats[0][0]),
        (r"of_receivers must have shape \[R, 6\]", 1, floats[1][:, 1:]),
        (r"edge_features must have shape|A1 must have shape", 2, floats[2][:, 1:]),
        (r"A1 must have shape|a1 must have shape", 3, floats[3][1:]),
        (r"[aA]1 must have shape", 4, floats[4][1:]),
        (r"A2 must have shape \[6, 5\]", 5, floats[5][1:]),
        (r"W2 must have shape|b2 must have shape", 6, floats[6][1:]),
        (r"b2 must have shape|W2 must have shape", 7, floats[7][1:]),
        (r"gamma must have shape \[6\]", 8, floats[8][1:]),
        (r"beta must have shape \[6\]", 9, floats[9][1:]),
        (r"senders must have shape \[30\]", 10, edges.senders[1:]),
        (r"senders\[3\] = 4 is not an index below 4", 10, beyond),
        (r"receivers\[4\] is 9", 11, other),
        (r"receiver_offsets must have shape \[6\]", 12, edges.receiver_offsets[1:]),
        (r"receiver_offsets must end at the number of rows 30", 12, edges.receiver_offsets.clamp(max=7)),
    ):
        with pytest.raises(ValueError, match=message) as error:
            call(i, changed)
        assert "message" in str(error.value)
    with pytest.raises(ValueError, match="message: an encoder needs edge_features; give them together"):
        message_sum(edges, floats[0], floats[1], None, tuple(floats[3:6]), *floats[6:])
    inputs[3:6] = (x.to(dtype) for x in op_inputs_of(edges, 6, 0, 3)[3:6])
    with pytest.raises(ValueError, match="message: a1 is empty: an encoder needs hidden channels"):
        message_sum(edges, *inputs[:3], tuple(inputs[3:6]), *inputs[6:10])
    gradients = (torch.zeros(5, 6, dtype=dtype), None)
    for function, arguments in ((ops._message, (*inputs, False)), (ops._message_backward, (*gradients, *inputs, True))):
        with pytest.raises(ValueError, match="edge_features without an encoder must have the 6 channels of.*, not 3"):
            function(*arguments)


LATENTS = [(30, 3), (30, 0), (30, 1), (30, 7), (1, 6), (29, 6), (6,), (30, 6, 1)]


def test_latents_of_another_shape_are_refused():
    """Also such as torch would stretch to the right one."""
    edges = random_edges(30, 4, 5)
    inputs = inputs_of(edges, 6, 0, 6)
    for shape in LATENTS:
        text = rf"message: edge_features without an encoder must have shape \[30, 6\], not {re.escape(str(shape))}"
        with pytest.raises(ValueError, match=text):
            message_sum(edges, *inputs[:2], torch.zeros(shape), None, *inputs[6:])

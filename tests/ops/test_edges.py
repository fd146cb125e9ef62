"""Edge sets: sorted by receiver, then sender; several as one; wrong indices."""

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.fx.experimental.proxy_tensor import make_fx

from ast_sim.ops import EdgeSet, segment_sum


def test_edges_are_sorted_by_receiver_then_sender():
    generator = torch.Generator().manual_seed(1)
    senders, receivers = (torch.randint(0, n, (50,), generator=generator) for n in (7, 9))
    edges = EdgeSet.from_pairs(senders, receivers, 7, 9)
    pairs = sorted(zip(receivers.tolist(), senders.tolist(), strict=True))
    assert list(zip(edges.receivers.tolist(), edges.senders.tolist(), strict=True)) == pairs
    assert edges.receiver_offsets.tolist() == [sum(r < n for r, _ in pairs) for n in range(10)]
    assert (edges.num_senders, edges.num_receivers, len(edges)) == (7, 9, 50)


def test_several_sets_as_one_have_shifted_indices():
    one = EdgeSet.from_pairs(torch.tensor([0, 2]), torch.tensor([1, 0]), 3, 2)
    other = EdgeSet.from_pairs(torch.tensor([1, 0, 1]), torch.tensor([0, 2, 2]), 2, 3)
    both = EdgeSet.concatenate([one, other, one])
    assert both.senders.tolist() == [2, 0, 4, 3, 4, 7, 5] and both.receivers.tolist() == [0, 1, 2, 4, 4, 5, 6]
    assert both.receiver_offsets.tolist() == [0, 1, 2, 3, 3, 5, 6, 7]
    assert (both.num_senders, both.num_receivers) == (8, 7)
    assert EdgeSet.concatenate([one]) is one


def test_the_orders_lie_where_the_edges_lie():
    edges = EdgeSet.from_pairs(torch.tensor([0, 2, 1]), torch.tensor([1, 0, 1]), 3, 2)
    there = EdgeSet(*(x.to("meta") for x in (edges.senders, edges.receivers, edges.receiver_offsets)), 3)
    assert [x.device.type for x in there.by_receiver] == ["meta", "meta"]
    with torch.device("meta"):
        assert [x.device.type for x in edges.by_receiver] == ["cpu", "cpu"]
    assert edges.by_receiver[0].tolist() == [0, 1, 2]


def in_fake_mode(function):
    def call(x):
        with FakeTensorMode(allow_non_fake_inputs=True) as mode:
            return function(mode.from_tensor(x))

    return call


FIRST = {
    "grad": torch.func.grad,
    "hessian": torch.func.hessian,
    "vmap": lambda f: lambda x: torch.func.vmap(f)(x[None]),
    "make_fx": lambda f: lambda x: make_fx(f)(x)(x),
    "fake": in_fake_mode,
    "compile": lambda f: torch.compile(f, backend="aot_eager", fullgraph=True),
    "compiled grad": lambda f: torch.compile(torch.func.grad(f), backend="aot_eager"),
    "compiled hessian": lambda f: torch.compile(torch.func.hessian(f), backend="aot_eager"),
}


@pytest.mark.parametrize("order", ["by_receiver", "by_sender"])
@pytest.mark.parametrize("first", FIRST)
def test_orders_have_values_after_torch_has_traced_or_transformed(first, order):
    edges = EdgeSet.from_pairs(torch.tensor([0, 2, 1, 3]), torch.tensor([1, 0, 1, 2]), 4, 3)
    again = EdgeSet.from_pairs(torch.tensor([0, 2, 1, 3]), torch.tensor([1, 0, 1, 2]), 4, 3)
    wanted = [x.tolist() for x in getattr(again, order)]

    def squares(of):
        return lambda x: (segment_sum(x, *getattr(of, order)) ** 2).sum()

    torch._dynamo.reset()
    x = torch.randn(4, 3)
    result, same = FIRST[first](squares(edges))(x), FIRST[first](squares(again))(x)
    assert [type(x) for x in getattr(edges, order)] == [torch.Tensor, torch.Tensor]
    assert [x.tolist() for x in getattr(edges, order)] == wanted
    assert getattr(edges, order) is getattr(edges, order)
    assert torch.equal(segment_sum(x, *getattr(edges, order)), segment_sum(x, *getattr(again, order)))
    if first != "fake":
        torch.testing.assert_close(result, same)


def test_no_edges_and_wrong_indices():
    empty = torch.empty(0, dtype=torch.int64)
    edges = EdgeSet.from_pairs(empty, empty, 3, 2)
    assert len(edges) == 0 and edges.receiver_offsets.tolist() == [0, 0, 0]
    with pytest.raises(ValueError, match=r"senders\[1\] = 3 is not an index below 3"):
        EdgeSet.from_pairs(torch.tensor([0, 3]), torch.tensor([0, 1]), 3, 2)
    with pytest.raises(ValueError, match=r"receivers\[0\] = -1 is not an index below 2"):
        EdgeSet.from_pairs(torch.tensor([0, 2]), torch.tensor([-1, 1]), 3, 2)

"""An op gives the same whether it is called directly or through torch's dispatcher, and whoever must see it does."""

import os
import subprocess
import sys

import pytest
import torch
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx
from torch.utils._python_dispatch import TorchDispatchMode

from ast_sim.ops import EdgeSet, attention_block, linear, message_edges, message_sum, mlp, segment_sum
from ast_sim.ops import _segment as segment

ORDER, OFFSETS = torch.tensor([2, 0, 1]), torch.tensor([0, 2, 3])


class Seen(TorchDispatchMode):
    """Writes down the ops that pass."""

    def __init__(self):
        super().__init__()
        self.names = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.names.append(str(func))
        return func(*args, **(kwargs or {}))


def test_both_ways_give_the_same_with_gradients():
    results = []
    for op in (segment._sum, segment._sum.overload):
        x = torch.arange(6.0).view(3, 2).requires_grad_()
        out = op(x, ORDER, OFFSETS, True)
        (gradient,) = torch.autograd.grad(out, x, torch.tensor([[1.0, 2.0], [3.0, 4.0]]))
        results.append((out, gradient))
    for found in results:
        assert torch.equal(found[0], torch.tensor([[2.0, 3.0], [2.0, 3.0]]))
        assert torch.equal(found[1], torch.tensor([[0.5, 1.0], [3.0, 4.0], [0.5, 1.0]]))


def test_no_gradient_is_kept_where_none_is_asked_for():
    x = torch.ones(3, 2, requires_grad=True)
    with torch.no_grad():
        assert not segment.segment_sum(x, ORDER, OFFSETS).requires_grad
    assert not segment.segment_sum(x.detach(), ORDER, OFFSETS).requires_grad
    assert segment.segment_sum(x, ORDER, OFFSETS).requires_grad


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16])
def test_other_dtypes_take_the_composition(dtype):
    out = segment.segment_sum(torch.ones(3, 2, dtype=dtype), ORDER, OFFSETS)
    assert out.dtype == dtype and torch.equal(out, torch.tensor([[2, 2], [1, 1]], dtype=dtype))


def test_autocast_brings_low_precision_to_float32():
    with torch.autocast("cpu", torch.bfloat16):
        assert segment.segment_sum(torch.ones(3, 2, dtype=torch.bfloat16), ORDER, OFFSETS).dtype == torch.float32


def test_a_negative_view_is_read_as_what_it_stands_for():
    """The imaginary part of a conjugate is the memory of its negative, with a mark."""
    x = torch.complex(torch.zeros(3, 2), torch.arange(6.0).view(3, 2)).conj().imag
    assert x.is_neg() and torch.equal(segment.segment_sum(x, ORDER, OFFSETS), torch.tensor([[-4.0, -6], [-2, -3]]))


def test_modes_and_tracers_see_the_op():
    x = torch.ones(3, 2)
    with Seen() as seen:
        segment.segment_sum(x, ORDER, OFFSETS)
    assert seen.names == ["ast_sim.segment_sum.default"]
    traced = make_fx(lambda x: segment.segment_sum(x, ORDER, OFFSETS))(x)
    assert torch.ops.ast_sim.segment_sum.default in [node.target for node in traced.graph.nodes]


class Layers(torch.nn.Module):
    """One op of those that keep the inputs of few rows, and of many rows compute them again."""

    def __init__(self, op: str) -> None:
        super().__init__()
        self.op, self.weight = op, torch.nn.Parameter(torch.arange(24.0).view(4, 6) - 12)

    def forward(self, x: Tensor) -> Tensor:
        if self.op == "mlp":
            return mlp(x, self.weight, None, self.weight.T[:, :4], None)
        return linear(x, self.weight, None, "geglu")


class Block(torch.nn.Module):
    """An attention block that keeps the inputs of few vectors."""

    def __init__(self) -> None:
        super().__init__()
        shapes = [(16,), (16,), (16,), (16,), (16, 16), (32, 16), (16, 16), (16,), (16,), (16,), (8, 16), (8,), (16, 4)]
        self.weights = torch.nn.ParameterList([torch.randn(shape) for shape in (*shapes, (16,))])

    def forward(self, x: Tensor, turns: Tensor, offsets: Tensor) -> Tensor:
        return attention_block(x, x, turns, turns, offsets, offsets, list(self.weights), 1)


class Messages(torch.nn.Module):
    """Messages without an encoder, which lets the op make an array of as many rows as there are edges, and their sum by
    sender."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.arange(30.0).view(6, 5) - 12)

    def forward(self, senders: Tensor, receivers: Tensor, offsets: Tensor, x: Tensor, latents: Tensor | None) -> Tensor:
        edges, ones = EdgeSet(senders, receivers, offsets, 4), x.new_ones(6)
        inputs = (x, x, latents, None, self.weight, ones, ones, ones)
        total, messages = message_edges(edges, *inputs)
        by_receiver = segment_sum(messages, *edges.by_receiver)
        return torch.cat([total, messages, by_receiver, message_sum(edges, *inputs)])


def rows_of(kind: str, num: int) -> tuple[Tensor | None, ...]:
    """What `kind` takes."""
    if kind == "attention_block":
        return torch.randn(num, 16), torch.randn(num, 16), torch.tensor([0, num])
    if "message" not in kind:
        return (torch.randn(num, 6),)
    receivers = torch.arange(num) * 4 // num
    offsets = torch.searchsorted(receivers, torch.arange(5))
    latents = torch.randn(num, 5) if kind == "message latents" else None
    return torch.arange(num) % 4, receivers, offsets, torch.randn(4, 5), latents


@pytest.mark.parametrize("strict", [False, True])
@pytest.mark.parametrize("kind", ["linear", "mlp", "attention_block", "message", "message latents"])
def test_an_exported_graph_takes_any_number_of_rows(kind, strict):
    module = Block() if kind == "attention_block" else Messages() if "message" in kind else Layers(kind)
    few, rows = rows_of(kind, 7), {0: torch.export.Dim("rows")}
    shapes = tuple([rows if x is not None and len(x) == 7 else None for x in few])
    graph = torch.export.export(module, few, dynamic_shapes=shapes, strict=strict).module()
    for given in (few, rows_of(kind, 17)):
        assert torch.equal(graph(*given), module(*given))


WITHOUT_SYMBOLS = "ctypes.CDLL = lambda path: object()"
WITHOUT_LIBRARY = "torch.__file__ = '/nowhere/torch/__init__.py'"


@pytest.mark.parametrize("missing", [WITHOUT_SYMBOLS, WITHOUT_LIBRARY])
def test_one_thread_for_want_of_torchs_is_a_warning(missing):
    code = f"""
import ctypes, torch
{missing}
import ast_sim, ast_sim.ops
from ast_sim.ops import library
assert torch.get_num_threads() == 2 and library.configuration()["core_threads"] == 1
order, offsets = torch.arange(4), torch.tensor([0, 3, 4])
assert ast_sim.ops.segment_sum(torch.ones(4, 5), order, offsets)[:, 0].tolist() == [3, 1]
"""
    environment = {**os.environ, "AST_SIM_BACKEND": "c", "OMP_NUM_THREADS": "2"}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr
    (warning,) = [line for line in run.stderr.splitlines() if "Warning: " in line]
    assert "run on one thread" in warning and "install torch 2.10 or later" in warning

"""The accuracy rule of every float op on sizes, widths and magnitudes drawn at random: outputs and all gradients.

Legend: a case is an op, its composition and its floating inputs. `python tests/ops/test_accuracy_random.py 400` looks
for cases that miss the rule among more draws, and prints them with the errors of op and composition.

Some attentions must miss it: where scores are large, a few rows decide both largest errors, and of two computations
rounded alike either may have the larger one. The composition with channels and keys in another order misses the rule
beside itself in 7 of 100 draws, the kernel in 5, or in 9 without FMA (docs/log.md). So the draws that are tested are
few and fixed, and a mean over many draws is tested as well.
"""

import math
import sys
from collections.abc import Callable

import pytest
import torch
from checks import assert_accurate, errors
from torch import Tensor

from ast_sim.ops import (
    EdgeSet,
    TetrahedronSet,
    _attention,
    _elastic_forces,
    _linear,
    _message,
    _mlp,
    _segment,
    _sparse_conv,
    attention,
    elastic_forces,
    library,
    linear,
    message_sum,
    mlp,
    octree,
    segment_mean,
    segment_sum,
    sparse_conv,
    sparse_conv_transposed,
)

DRAWS = 8  # of each op
SEED = 2026

Case = tuple[Callable, Callable, list[Tensor]]


class Draw:
    """Random numbers of one seed."""

    def __init__(self, seed: int) -> None:
        self.generator = torch.Generator().manual_seed(seed)

    def real(self, least: float, most: float) -> float:
        """Evenly by the logarithm."""
        return float(least * (most / least) ** float(torch.rand(1, generator=self.generator)))

    def number(self, least: int, most: int) -> int:
        return min(most, int(self.real(least, most + 1)))

    def one_of(self, *values):
        return values[int(torch.randint(len(values), (1,), generator=self.generator))]

    def normal(self, *shape: int, scale: float = 1.0) -> Tensor:
        return scale * torch.randn(*shape, generator=self.generator)

    def indices(self, n: int, below: int) -> Tensor:
        return torch.randint(below, (n,), generator=self.generator)

    def offsets(self, scenes: int, most: int) -> Tensor:
        """Some scenes are empty."""
        sizes = [0 if self.one_of(*range(6)) == 0 else self.number(1, most) for _ in range(scenes)]
        return torch.tensor([0, *sizes]).cumsum(0)


def attention_problem(draw: Draw) -> tuple[list[Tensor], tuple]:
    """Inputs, and what follows them."""
    scenes, heads, width = draw.number(1, 3), draw.number(1, 4), 16 * draw.number(1, 8)
    q_offsets, k_offsets = (draw.offsets(scenes, 400) for _ in range(2))
    while not (q_offsets.diff() * k_offsets.diff()).any():  # somebody attends to somebody
        q_offsets, k_offsets = (draw.offsets(scenes, 400) for _ in range(2))
    amplitude, p = draw.real(0.1, 1e4) ** 0.5, draw.one_of(0.0, 0.0, 0.1)
    q, k, v = (draw.normal(int(n[-1]), heads, width) for n in (q_offsets, k_offsets, k_offsets))
    return [amplitude * q, amplitude * k, v], (q_offsets, k_offsets, width**-0.5, p, 7)


def attention_case(draw: Draw) -> Case:
    inputs, settings = attention_problem(draw)
    return (
        lambda q, k, v: attention(q, k, v, *settings)[0],
        lambda q, k, v: _attention._reference(q, k, v, *settings)[0],
        inputs,
    )


def reordered_attention_case(draw: Draw) -> Case:
    """The composition in the kernel's place, with channels, and keys unless they are dropped, in another order."""
    inputs, settings = attention_problem(draw)
    _, k_offsets, _, p, _ = settings
    channels, keys = torch.randperm(inputs[0].shape[-1], generator=draw.generator), torch.arange(len(inputs[1]))
    if p == 0:
        parts = [
            part[torch.randperm(len(part), generator=draw.generator)] for part in keys.split(k_offsets.diff().tolist())
        ]
        keys = torch.cat(parts)
    return (
        lambda q, k, v: _attention._reference(q[..., channels], k[keys][..., channels], v[keys], *settings)[0],
        lambda q, k, v: _attention._reference(q, k, v, *settings)[0],
        inputs,
    )


def linear_case(draw: Draw) -> Case:
    rows, inputs, outputs = draw.number(1, 600), draw.number(1, 600), 2 * draw.number(1, 300)
    activation = draw.one_of(*_linear.ACTIVATIONS)
    number = _linear.ACTIVATIONS.index(activation)
    return (
        lambda x, w, b: linear(x, w, b, activation),
        lambda x, w, b: _linear._linear_reference(x, w, b, None, number, False)[0],
        [
            draw.normal(rows, inputs, scale=draw.real(1e-3, 1e3)),
            draw.normal(outputs, inputs, scale=inputs**-0.5),
            draw.normal(outputs, scale=draw.real(1e-3, 1e3)),
        ],
    )


def mlp_case(draw: Draw) -> Case:
    rows, inputs, hidden, outputs = (draw.number(*n) for n in ((1, 200), (1, 300), (16, 300), (16, 300)))
    inputs_of = [
        draw.normal(rows, inputs, scale=draw.real(1e-2, 1e2)),
        draw.normal(hidden, inputs, scale=inputs**-0.5),
        draw.normal(hidden),
        draw.normal(outputs, hidden, scale=hidden**-0.5),
        *(draw.normal(outputs) for _ in range(3)),
    ]
    return (
        lambda x, w1, b1, w2, b2, c, d: mlp(x, w1, b1, w2, b2, None, (c, d)),
        lambda x, w1, b1, w2, b2, c, d: _mlp._reference(x, None, w1, b1, w2, b2, c, d, None, False)[0],
        inputs_of,
    )


def norm_case(draw: Draw) -> Case:
    """Rows for the LayerNorm that are exact in float32: spreads down to the last place of a mean, or none at all."""
    rows, hidden, outputs = draw.number(1, 50), draw.number(1, 20), draw.number(2, 400)
    mean, spread = draw.real(1e-3, 1e12), draw.one_of(0.0, draw.real(1e-8, 1e-2), draw.real(1e-8, 1e-2))
    inputs = [
        draw.normal(rows, hidden),
        mean * (1 + draw.normal(outputs, scale=spread)),
        *(draw.normal(outputs) for _ in range(2)),
    ]

    def layers(function: Callable) -> Callable:
        """`function` with weights of the second layer that are 0, so that its bias is the row."""
        return lambda x, b, c, d: function(x, torch.eye(hidden).to(x), None, x.new_zeros(outputs, hidden), b, c, d)

    return (
        layers(lambda x, w1, b1, w2, b2, c, d: mlp(x, w1, b1, w2, b2, None, (c, d))),
        layers(lambda x, w1, b1, w2, b2, c, d: _mlp._reference(x, None, w1, b1, w2, b2, c, d, None, False)[0]),
        inputs,
    )


def message_case(draw: Draw) -> Case:
    senders, receivers, num = draw.number(1, 300), draw.number(1, 300), draw.number(1, 1000)
    edges = EdgeSet.from_pairs(draw.indices(num, senders), draw.indices(num, receivers), senders, receivers)
    width, hidden, raw, out = draw.number(8, 200), draw.number(8, 200), draw.number(1, 12), draw.number(16, 200)
    lists = (edges.senders, edges.receivers)
    inputs = [
        draw.normal(senders, width, scale=draw.real(0.1, 30)),
        draw.normal(receivers, width),
        draw.normal(len(edges), raw),
        draw.normal(hidden, raw),
        draw.normal(hidden),
        draw.normal(width, hidden, scale=hidden**-0.5),
        draw.normal(out, width, scale=width**-0.5),
        *(draw.normal(out) for _ in range(3)),
    ]
    return (
        lambda P, Q, e, A1, a1, A2, *layer: message_sum(edges, P, Q, e, (A1, a1, A2), *layer),
        lambda P, Q, e, A1, a1, A2, *layer: _message._reference(P, Q, e, A1, a1, A2, *layer, *lists, None, False)[0],
        inputs,
    )


def convolution_case(draw: Draw) -> Case:
    points = 2 * torch.rand(draw.number(1, 800), 3, generator=draw.generator) - 1
    cells = octree(points, torch.tensor([0, len(points)]), (0.0, 0.0, 0.0), 1.0, draw.number(1, 6)).coarsen()
    inputs, outputs, transposed = draw.number(1, 200), draw.number(1, 200), draw.one_of(False, True)
    lists = [(cells.fine, cells.coarse_index), (cells.coarse_by_fine, cells.fine_by_fine)]
    num_in, num_out = cells.num_fine, len(cells.coarse.keys)
    if transposed:
        lists, num_in, num_out = lists[::-1], num_out, num_in
    op = sparse_conv_transposed if transposed else sparse_conv
    return (
        lambda x, w, b: op(x, w, cells, b),
        lambda x, w, b: _sparse_conv._reference(x, w, b, False, cells.pair_offsets, *lists[0], *lists[1], num_out),
        [
            draw.normal(num_in, inputs, scale=draw.real(1e-3, 1e3)),
            draw.normal(27, inputs, outputs),
            draw.normal(outputs, scale=draw.real(1e-3, 1e3)),
        ],
    )


def segment_case(draw: Draw) -> Case:
    rows, segments, mean = draw.number(1, 3000), draw.number(1, 200), draw.one_of(False, True)
    offsets = torch.cat([torch.tensor([0]), draw.indices(segments - 1, rows + 1).sort().values, torch.tensor([rows])])
    order = torch.randperm(rows, generator=draw.generator)
    op = segment_mean if mean else segment_sum
    return (
        lambda x: op(x, order, offsets),
        lambda x: _segment._sum_reference(x, order, offsets, mean),
        [draw.normal(rows, draw.number(1, 100), scale=draw.real(1e-3, 1e3))],
    )


def elastic_case(draw: Draw) -> Case:
    nodes = draw.number(4, 300)
    elements = torch.stack([torch.randperm(nodes, generator=draw.generator)[:4] for _ in range(draw.number(1, 300))])
    rest = draw.normal(nodes, 3, scale=draw.real(1e-2, 1e2))
    edges = rest[elements[:, 1:]] - rest[elements[:, :1]]
    elements = torch.where((torch.linalg.det(edges) < 0)[:, None], elements[:, [0, 2, 1, 3]], elements)
    flat = torch.linalg.det(edges).abs() / edges.norm(dim=2).prod(1) < 0.1
    elements = elements[~flat]
    lame = 0.5 + torch.rand(len(elements), 2, generator=draw.generator)
    tets = TetrahedronSet.from_elements(elements, nodes)

    def composed(x: Tensor) -> Tensor:
        stiff = (rest.to(x.dtype), lame.to(x.dtype))
        return _elastic_forces._reference(x, *stiff, tets.elements, tets.node_order, tets.node_offsets)

    moved = rest + draw.real(1e-3, 0.3) * rest.std() * draw.normal(nodes, 3)
    return lambda x: elastic_forces(x, rest, lame, tets), composed, [moved]


CASES = [attention_case, linear_case, mlp_case, norm_case, message_case, convolution_case, segment_case, elastic_case]
MISSED_WITHOUT_FMA = {(attention_case, 3)}


@pytest.mark.parametrize("family", CASES, ids=lambda f: f.__name__.removesuffix("_case"))
@pytest.mark.parametrize("number", range(DRAWS))
def test_accuracy(family, number, request):
    if (family, number) in MISSED_WITHOUT_FMA and library.configuration()["instruction_set"] == "base":
        request.applymarker(pytest.mark.xfail(strict=True, reason="products are rounded, too (docs/log.md)"))
    assert_accurate(*family(Draw(SEED + number)))


def test_attention_is_more_accurate_than_its_composition_in_the_mean():
    """The geometric mean of the ratios of largest errors is 0.8, or 0.84 without FMA."""
    ratios = []
    for number in range(100):
        found = errors(*attention_case(Draw(SEED + number)))
        ratios += [math.log(c / t) for c, t, m in found if c > 0 and t > 1e-7 * m]
    assert len(ratios) > 300
    assert math.exp(sum(ratios) / len(ratios)) < 1


if __name__ == "__main__":
    for case in [*CASES, reordered_attention_case]:
        missed = 0
        for seed in range(int(sys.argv[1])):
            found = errors(*case(Draw(seed)))
            found = [(c, t, m) for c, t, m in found if m == 0 or m > 2**-120]  # kernels take subnormal numbers for 0
            shares = [c / (2 * t + 1e-6 * m + 1e-300) for c, t, m in found]
            if max(shares, default=0) > 1:
                missed += 1
                worst = shares.index(max(shares))
                c, t, m = found[worst]
                print(f"{case.__name__} {seed}: result {worst} off by {c:.1e}, composition {t:.1e}, largest {m:.1e}")
        print(f"{case.__name__}: {missed} of {sys.argv[1]} miss the rule")

"""Writes docs/results/accuracy.md: the worst error of every float op, and the worst error of its torch composition.

`python -m benchmarks.kernels.accuracy`. Each op gets many random inputs of many sizes and magnitudes. Float64 gives the
exact result. e(C) is the largest error of the op, and e(T) is the largest error of the float32 composition. Both are
relative to the largest magnitude of the exact result. Every op must keep the rule e(C) <= 2 e(T) + 1e-6.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import torch

from ast_sim.ops import (
    EdgeSet,
    TetrahedronSet,
    attention,
    linear,
    message_sum,
    mlp,
    octree,
    segment_mean,
    segment_sum,
    sparse_conv,
    sparse_conv_transposed,
)
from ast_sim.ops import elastic_forces as forces_of
from ast_sim.ops.library import OPS, configuration
from benchmarks.kernels.elastic_forces import box
from tests.checks import errors

SEEDS = 12
OUT = Path(__file__).parents[2] / "docs" / "results" / "accuracy.md"

# op, composition, inputs, and the names of the results: outputs, then gradients
Case = tuple[Callable, Callable, list, list[str]]


def segments(seed: int) -> Iterator[tuple[str, Case]]:
    g = torch.Generator().manual_seed(seed)
    rows, groups, width = (int(torch.randint(1, n, (1,), generator=g)) for n in (5000, 400, 200))
    order = torch.randperm(rows, generator=g)
    offsets = torch.cat([torch.tensor([0]), torch.randint(0, rows + 1, (groups - 1,), generator=g).sort().values])
    offsets = torch.cat([offsets, torch.tensor([rows])])
    x = torch.randn(rows, width, generator=g)
    for name, op, mean in (("segment_sum", segment_sum, False), ("segment_mean", segment_mean, True)):
        yield (
            name,
            (
                lambda x, op=op: op(x, order, offsets),
                lambda x, mean=mean: OPS["segment_sum"].composition(x, order, offsets, mean),
                [x],
                ["out", "dx"],
            ),
        )


def elastic_forces(seed: int) -> Iterator[tuple[str, Case]]:
    g = torch.Generator().manual_seed(seed)
    nodes, elements = box(tuple(int(n) for n in torch.randint(1, 9, (3,), generator=g)))
    scale, shift = 10.0 ** (seed % 7 - 3), 10.0 * (seed % 2)
    rest = scale * (nodes + 0.15 * torch.rand(nodes.shape, generator=g) + shift)
    lame = torch.rand(len(elements), 2, generator=g) + 0.5
    tets = TetrahedronSet.from_elements(elements, len(nodes))

    def composition(x):
        stiff = (rest.to(x.dtype), lame.to(x.dtype))
        return OPS["elastic_forces"].composition(x, *stiff, tets.elements, tets.node_order, tets.node_offsets)

    position = rest + scale * (0.01, 0.1, 0.5)[seed % 3] * torch.randn(nodes.shape, generator=g)
    yield (
        "elastic_forces",
        (lambda x: forces_of(x, rest, lame, tets), composition, [position], ["force", "dposition"]),
    )


def attentions(seed: int) -> Iterator[tuple[str, Case]]:
    g = torch.Generator().manual_seed(seed)
    sizes = torch.randint(1, 600, (2, 2), generator=g)
    heads, width = (1, 2, 4)[seed % 3], (16, 32, 64, 128)[seed % 4]
    q, k, v = (torch.randn(int(n.sum()), heads, width, generator=g) for n in (sizes[0], sizes[1], sizes[1]))
    q = q * 4.0 ** (seed % 3)
    offsets = [torch.cat([torch.tensor([0]), n.cumsum(0)]) for n in sizes]
    for name, p in (("attention", 0.0), ("attention, dropout 0.1", 0.1)):
        settings = (width**-0.5, p, seed)
        yield (
            name,
            (
                lambda q, k, v, s=settings: attention(q, k, v, *offsets, *s)[0],
                lambda q, k, v, s=settings: OPS["attention"].composition(q, k, v, *offsets, *s)[0],
                [q, k, v],
                ["out", "dq", "dk", "dv"],
            ),
        )


def convolutions(seed: int) -> Iterator[tuple[str, Case]]:
    g = torch.Generator().manual_seed(seed)
    points = torch.rand(int(torch.randint(1, 3000, (1,), generator=g)), 3, generator=g) * 2 - 1
    level = octree(points, torch.tensor([0, len(points)]), (0.0, 0.0, 0.0), 1.0, 2 + seed % 6)
    cells = level.coarsen()
    widths = [int(n) for n in torch.randint(1, 160, (2,), generator=g)]
    weight = torch.randn(27, *widths, generator=g)
    for name, op, rows, pairs, out in (
        ("sparse_conv", sparse_conv, cells.num_fine,
         (cells.fine, cells.coarse_index, cells.coarse_by_fine, cells.fine_by_fine), len(cells.coarse.keys)),
        ("sparse_conv_transposed", sparse_conv_transposed, len(cells.coarse.keys),
         (cells.coarse_by_fine, cells.fine_by_fine, cells.fine, cells.coarse_index), cells.num_fine),
    ):  # fmt: skip
        yield (
            name,
            (
                lambda x, w, b, op=op: op(x, w, cells, b),
                lambda x, w, b, pairs=pairs, out=out: OPS["sparse_conv"].composition(
                    x, w, b, False, cells.pair_offsets, *pairs, out
                ),
                [torch.randn(rows, widths[0], generator=g), weight, torch.randn(widths[1], generator=g)],
                ["out", "dx", "dweight", "dbias"],
            ),
        )


def messages(seed: int) -> Iterator[tuple[str, Case]]:
    g = torch.Generator().manual_seed(seed)
    senders, receivers = (int(torch.randint(1, 2000, (1,), generator=g)) for _ in range(2))
    pairs = (torch.randint(0, n, (4 * receivers,), generator=g) for n in (senders, receivers))
    edges = EdgeSet.from_pairs(*pairs, senders, receivers)
    width = (16, 40, 64, 128)[seed % 4]
    shapes = [(senders, width), (receivers, width), (width, width), (width,), (width,), (width,)]
    plain = [torch.randn(shape, generator=g) * (shape[0] ** -0.5 if i == 2 else 1) for i, shape in enumerate(shapes)]
    shapes = [(len(edges), 8), (width, 8), (width,), (width, width)]
    encoder = [torch.randn(shape, generator=g) * (width**-0.5 if i == 3 else 1) for i, shape in enumerate(shapes)]
    lists = (edges.senders, edges.receivers, None, False)
    none = [torch.empty(shape) for shape in ((len(edges), 0), (0, 0), 0, (width, 0))]
    results = ["out", "dof_senders", "dof_receivers", "dW2", "db2", "dgamma", "dbeta"]
    yield (
        "message_sum",
        (
            lambda P, Q, *layer: message_sum(edges, P, Q, None, None, *layer),
            lambda P, Q, *layer: OPS["message"].composition(P, Q, *(x.to(P) for x in none), *layer, *lists)[0],
            plain,
            results,
        ),
    )
    yield (
        "message_sum, encoder",
        (
            lambda P, Q, a, b, c, d, e, *x: message_sum(edges, P, Q, e, tuple(x), a, b, c, d),
            lambda P, Q, a, b, c, d, e, *x: OPS["message"].composition(P, Q, e, *x, a, b, c, d, *lists)[0],
            [*plain, *encoder],
            [*results, "dedge_features", "dA1", "da1", "dA2"],
        ),
    )


def layers(seed: int) -> Iterator[tuple[str, Case]]:
    g = torch.Generator().manual_seed(seed)
    rows = int(torch.randint(1, 3000, (1,), generator=g)) * (1 if seed % 4 else 20)
    inputs, beside, hidden, outputs = (2 * int(n) for n in torch.randint(8, 130, (4,), generator=g))
    x, extra, dout = (torch.randn(rows, n, generator=g) for n in (inputs, beside, outputs))
    weight, bias = torch.randn(outputs, inputs, generator=g), torch.randn(outputs, generator=g)
    results = ["out", "dx", "dweight", "dbias"]
    for number, activation in enumerate(("none", "relu", "geglu")):
        yield (
            f"linear, {activation}",
            (
                lambda x, w, b, a=activation: linear(x, w, b, a),
                lambda x, w, b, a=number: OPS["linear"].composition(x, w, b, None, a, False)[0],
                [x, weight, bias],
                results,
            ),
        )
    x, extra, dout = (y[:300] for y in (x, extra, dout))  # seldom a unit so near 0 that rounding turns it on
    w1, b1 = torch.randn(hidden, inputs + beside, generator=g), torch.randn(hidden, generator=g)
    w2, gamma = torch.randn(outputs, hidden, generator=g), torch.randn(outputs, generator=g)
    yield (
        "mlp",
        (
            lambda x, y, w1, b1, w2, b2, c, d, r: mlp(x, w1, b1, w2, b2, y, (c, d), r),
            lambda x, y, w1, b1, w2, b2, c, d, r: OPS["mlp"].composition(x, y, w1, b1, w2, b2, c, d, r, False)[0],
            [x, extra, w1, b1, w2, bias, gamma, bias.clone(), dout],
            ["out", "dx", "dbeside", "dweight1", "dbias1", "dweight2", "dbias2", "dgamma", "dbeta", "dresidual"],
        ),
    )


def main() -> None:
    worst: dict[tuple[str, str], tuple[float, float, float]] = {}
    for seed in range(SEEDS):
        for family in (segments, elastic_forces, attentions, convolutions, messages, layers):
            for name, (op, reference, inputs, results) in family(seed):
                for result, (c, t, magnitude) in zip(results, errors(op, reference, inputs), strict=True):
                    c, t = c / max(magnitude, 1e-300), t / max(magnitude, 1e-300)
                    share = c / (2 * t + 1e-6)
                    worst[name, result] = max(worst.get((name, result), (-1.0, 0.0, 0.0)), (share, c, t))
    facts = configuration()
    lines = [
        "# Accuracy",
        "",
        f"Made by `python -m benchmarks.kernels.accuracy`: the worst of {SEEDS} random inputs an op, relative to the",
        "largest magnitude of the exact (float64) result. e(C) is the error of the C kernel, e(T) of the float32",
        "torch composition on the same input. The rule is e(C) <= 2 e(T) + 1e-6: the share of the bound is at most 1.",
        f"Instruction set {facts['instruction_set']}, torch {facts['torch']}. Octree, neighbours, pairs and farthest",
        "point sampling are exact. Layers have 16 to 258 inputs, hidden units and outputs: with fewer hidden units",
        "before a LayerNorm, one row whose values are nearly equal decides the largest error, ours above torch's or",
        "torch's above ours, so that two single maxima say nothing of the kernel.",
        "",
        "| op | result | e(C) | e(T) | share of the bound |",
        "| --- | --- | --- | --- | --- |",
    ]
    lines += [f"| {op} | {result} | {c:.1e} | {t:.1e} | {s:.2f} |" for (op, result), (s, c, t) in worst.items()]
    OUT.write_text("\n".join(lines) + "\n")
    print("\n".join(lines))
    assert all(share <= 1 for share, _, _ in worst.values()), "an op breaks the accuracy rule"


if __name__ == "__main__":
    main()

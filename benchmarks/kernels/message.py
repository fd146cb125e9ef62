"""Fused message passing beside the composition in torch, which holds every layer of every edge.

The flops counted are the flops executed: to find the gradients, the layers are computed again. Per edge, a layer costs
2 x its weights forward. Backward it costs 2 x again to recompute it, and 4 x for its two gradients. The first layer
needs only 2 x there, because raw features need no gradient. Latents of the edges, whose gradient is taken, are added
without flops that count.
"""

from __future__ import annotations

import torch

from ast_sim.ops import EdgeSet, message_sum
from ast_sim.ops.library import OPS
from benchmarks.kernels.case import Case

WIDTH = 128


def cases() -> list[Case]:
    graphs = [_elements_to_nodes(100_000), _mesh(1600), _nodes_to_cells(1600), _latents(1300)]
    return [_case(*graph, backward) for graph in graphs for backward in (False, True)]


def _elements_to_nodes(nodes: int) -> tuple[str, EdgeSet, int]:
    """Tetrahedra of a mesh numbered along a line: each has 4 nodes close to each other."""
    g = torch.Generator().manual_seed(0)
    elements = torch.arange(3 * nodes)
    corners = (elements // 3)[:, None] + torch.randint(-300, 300, (3 * nodes, 4), generator=g)
    senders = elements.repeat_interleave(4)
    return "elements to nodes", EdgeSet.from_pairs(senders, corners.flatten() % nodes, 3 * nodes, nodes), 8


def _mesh(nodes: int) -> tuple[str, EdgeSet, int]:
    g = torch.Generator().manual_seed(0)
    receivers = torch.arange(nodes).repeat_interleave(10)
    senders = (receivers + torch.randint(-40, 40, (len(receivers),), generator=g)) % nodes
    return "nodes to nodes", EdgeSet.from_pairs(senders, receivers, nodes, nodes), 8


def _nodes_to_cells(nodes: int) -> tuple[str, EdgeSet, int]:
    index = torch.arange(nodes)
    return "nodes to cells", EdgeSet.from_pairs(index, index * 2 // 9, nodes, (nodes * 2 + 8) // 9), 0


def _latents(nodes: int) -> tuple[str, EdgeSet, int]:
    """A mesh of the size of a plate, whose edges carry latents along: their share of the first layer is given."""
    _, edges, _ = _mesh(nodes)
    return "nodes to nodes, latents", edges, WIDTH


def _case(name: str, edges: EdgeSet, raw: int, backward: bool) -> Case:
    g = torch.Generator().manual_seed(0)
    senders, receivers = edges.num_senders, edges.num_receivers

    def normal(*shape: int, scale: float = 1.0) -> torch.Tensor:
        return scale * torch.randn(*shape, generator=g)

    square = WIDTH**-0.5
    layer = [normal(WIDTH, WIDTH, scale=square), normal(WIDTH), 1 + normal(WIDTH, scale=0.1), normal(WIDTH)]
    nodes = [normal(senders, WIDTH), normal(receivers, WIDTH)]
    features = normal(len(edges), raw) if raw else None
    encodes, latents = 0 < raw < WIDTH, raw == WIDTH
    encoder = [normal(WIDTH, raw), normal(WIDTH), normal(WIDTH, WIDTH, scale=square)] if encodes else []
    leaves = [x.requires_grad_(backward) for x in (*nodes, *([features] if latents else []), *encoder, *layer)]
    dsum = normal(receivers, WIDTH)

    def ours_of(P, Q, *weights):
        encoder = weights[:3] if encodes else None
        return message_sum(edges, P, Q, features, encoder, *weights[-4:])

    def composition_of(P, Q, *weights):
        empty = [P.new_empty(shape) for shape in ((0, raw), 0, (WIDTH, 0))]
        encoder = weights[:3] if encodes else empty
        of_edges = P.new_empty(len(edges), 0) if features is None else features
        lists = (edges.senders, edges.receivers, None, False)
        return OPS["message"].composition(P, Q, of_edges, *encoder, *weights[-4:], *lists)[0]

    def call(function):
        if not backward:
            return lambda: [function(*leaves)]

        def with_gradients():
            out = function(*leaves)
            return [out, *torch.autograd.grad(out, leaves, dsum)]

        return with_gradients

    ours, peer = call(ours_of), call(composition_of)

    def check() -> None:
        for a, b in zip(ours(), peer(), strict=True):
            assert (a - b).abs().max() <= 1e-3 * b.abs().max()

    first, others = (2 * raw * WIDTH, 4 * WIDTH * WIDTH) if encodes else (0, 2 * WIDTH * WIDTH)
    flops = len(edges) * ((3 * first + 4 * others) if backward else first + others)
    op = f"message passing, {'forward and backward' if backward else 'forward'}"
    shape = f"{name}: {len(edges)} edges, {senders} senders, {receivers} receivers, {WIDTH} channels"
    return Case(op, shape, ours, {"torch composition": peer}, len(edges), flops, check)

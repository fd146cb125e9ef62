"""Sparse convolution of stride 2 beside the composition (gather, product, index_add) and spconv's on the same pairs."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ast_sim.ops import sparse_conv as ops
from ast_sim.ops.octree import CellMap, octree
from ast_sim.ops.sparse_conv import sparse_conv
from benchmarks.case import Case

CHANNELS = 128
CLOUDS = [(1000, 4), (100_000, 10), (400_000, 8)]  # points on a sphere, depth


def _spconv(x: Tensor, weight: Tensor, map: CellMap) -> tuple[Callable[[], Tensor] | None, str]:
    """One call of spconv's kernel on our pairs, without its search for them; or why there is none."""
    try:
        from spconv.pytorch.ops import indice_conv
    except ImportError as error:
        return None, f"cannot be imported: {error}"
    num, offsets = map.pair_offsets.diff().int(), map.pair_offsets.tolist()
    pairs = torch.full((2, 27, int(num.max())), -1, dtype=torch.int32)
    for k in range(27):
        pairs[0, k, : num[k]] = map.fine[offsets[k] : offsets[k + 1]]
        pairs[1, k, : num[k]] = map.coarse_index[offsets[k] : offsets[k + 1]]
    filters = weight.reshape(3, 3, 3, *weight.shape[1:]).permute(4, 0, 1, 2, 3).contiguous()
    return lambda: indice_conv(x, filters, pairs, num, len(map.coarse.keys)), ""


def _with_gradients(function: Callable[[Tensor, Tensor], Tensor], x: Tensor, weight: Tensor, dout: Tensor):
    leaves = [x.detach().requires_grad_(), weight.detach().requires_grad_()]

    def call() -> list[Tensor]:
        out = function(*leaves)
        return [out, *torch.autograd.grad(out, leaves, dout)]

    return call


def cases() -> list[Case]:
    return [_case(points, depth, backward) for points, depth in CLOUDS for backward in (False, True)]


def _case(points: int, depth: int, backward: bool) -> Case:
    g = torch.Generator().manual_seed(0)
    positions = 0.9 * torch.nn.functional.normalize(torch.randn(points, 3, generator=g), dim=1)
    map = octree(positions, torch.tensor([0, points]), (0.0, 0.0, 0.0), 1.0, depth).coarsen()
    x = torch.randn(map.num_fine, CHANNELS, generator=g)
    weight = torch.randn(27, CHANNELS, CHANNELS, generator=g) * CHANNELS**-0.5
    dout = torch.randn(len(map.coarse.keys), CHANNELS, generator=g)
    pairs = (map.pair_offsets, map.fine, map.coarse_index, map.coarse_by_fine, map.fine_by_fine)

    def composition(x, weight):
        return ops._reference(x, weight, False, *pairs, len(map.coarse.keys))

    peers: dict[str, Callable] = {}
    missing = {}
    if backward:
        call = _with_gradients(lambda x, w: sparse_conv(x, w, map), x, weight, dout)
        peers["torch composition"] = _with_gradients(composition, x, weight, dout)
        missing["spconv"] = "its backward asks for CUDA"
    else:

        def call():
            return [sparse_conv(x, weight, map)]

        peers["torch composition"] = lambda: [composition(x, weight)]
        theirs, reason = _spconv(x, weight, map)
        if theirs:
            peers["spconv"] = lambda: [theirs()]
        else:
            missing["spconv"] = reason

    def check() -> None:
        for name, peer in peers.items():
            for a, b in zip(call(), peer(), strict=True):
                wrong = int(((a - b).abs() > 1e-3 + 1e-4 * b.abs()).flatten(1).any(1).sum())
                # Threads of spconv's scatter now and then overwrite each other's sums: some of its rows are wrong.
                allowed = max(16, len(a) // 1000) if name == "spconv" else 0
                assert wrong <= allowed, f"{wrong} rows differ from {name}"

    num_pairs = len(map.fine)
    shape = f"{map.num_fine} cells to {len(map.coarse.keys)}, {num_pairs} pairs, {CHANNELS} channels"
    flops = (6 if backward else 2) * num_pairs * CHANNELS**2
    op = f"sparse_conv, {'forward and backward' if backward else 'forward'}"
    return Case(op, shape, call, peers, num_pairs, flops, check, missing)

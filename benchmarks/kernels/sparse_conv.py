"""Sparse convolution of stride 2 beside two peers on the same pairs: the composition and spconv.

The composition is gather, product, index_add. A useful operation is a multiplication or addition for a pair that
exists: 2 pairs C_in C_out forward, three times as many with both gradients.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ast_sim.ops import CellMap, Octree, octree, sparse_conv
from ast_sim.ops.library import OPS
from benchmarks.kernels.case import Case

CHANNELS = 128
CLOUDS = [(1000, 4), (400_000, 8)]  # points on a sphere, the surface of a body; depth
LEVELS = (100_000, 12, 8)  # the same, from this depth to that one

Call = Callable[[], list[Tensor]]


def cases() -> list[Case]:
    singles = [[_sphere(*cloud).coarsen()] for cloud in CLOUDS]
    points, finest, coarsest = LEVELS
    levels = [_sphere(points, finest).coarsen()]
    while levels[-1].coarse.depth > coarsest:
        levels.append(levels[-1].coarse.coarsen())
    singles += [[level] for level in levels]
    return [_case(maps, backward) for maps in (*singles, levels) for backward in (False, True)]


def _sphere(points: int, depth: int) -> Octree:
    g = torch.Generator().manual_seed(0)
    positions = 0.9 * torch.nn.functional.normalize(torch.randn(points, 3, generator=g), dim=1)
    return octree(positions, torch.tensor([0, points]), (0.0, 0.0, 0.0), 1.0, depth)


def _spconv(x: Tensor, weight: Tensor, dout: Tensor, map: CellMap, backward: bool) -> Call:
    """spconv's kernels on our pairs, without its search for them."""
    from spconv.pytorch import ops as peer

    peer.get_current_stream = lambda: 0  # its backward looks for a CUDA stream before it finds that it needs none
    num, offsets = map.pair_offsets.diff().int(), map.pair_offsets.tolist()
    pairs = torch.full((2, 27, int(num.max())), -1, dtype=torch.int32)
    for k in range(27):
        pairs[0, k, : num[k]] = map.fine[offsets[k] : offsets[k + 1]]
        pairs[1, k, : num[k]] = map.coarse_index[offsets[k] : offsets[k + 1]]
    filters = weight.reshape(3, 3, 3, *weight.shape[1:]).permute(4, 0, 1, 2, 3).contiguous()

    def call() -> list[Tensor]:
        out = peer.indice_conv(x, filters, pairs, num, len(map.coarse.keys))
        if not backward:
            return [out]
        dx, dfilters = peer.indice_conv_backward(x, filters, dout, pairs, num)
        return [out, dx, dfilters.permute(1, 2, 3, 4, 0).reshape(weight.shape)]

    return call


def _with_gradients(function: Callable[[Tensor, Tensor], Tensor], x: Tensor, weight: Tensor, dout: Tensor) -> Call:
    leaves = [x.detach().requires_grad_(), weight.detach().requires_grad_()]

    def call() -> list[Tensor]:
        out = function(*leaves)
        return [out, *torch.autograd.grad(out, leaves, dout)]

    return call


def _level(map: CellMap, backward: bool) -> tuple[Call, dict[str, Call], dict[str, str]]:
    """Ours, the peers and the missing peers for one level."""
    g = torch.Generator().manual_seed(0)
    x = torch.randn(map.num_fine, CHANNELS, generator=g)
    weight = torch.randn(27, CHANNELS, CHANNELS, generator=g) * CHANNELS**-0.5
    dout = torch.randn(len(map.coarse.keys), CHANNELS, generator=g)
    pairs = (map.pair_offsets, map.fine, map.coarse_index, map.coarse_by_fine, map.fine_by_fine)

    def composition(x, weight):
        return OPS["sparse_conv"].composition(x, weight, None, False, *pairs, len(map.coarse.keys))

    functions = {"ours": lambda x, w: sparse_conv(x, w, map), "torch composition": composition}
    if backward:
        calls = {name: _with_gradients(f, x, weight, dout) for name, f in functions.items()}
    else:
        calls = {name: lambda f=f: [f(x, weight)] for name, f in functions.items()}
    ours, missing = calls.pop("ours"), {}
    try:
        name = "spconv, without its lookup of a CUDA stream" if backward else "spconv"
        calls[name] = _spconv(x, weight, dout, map, backward)
    except ImportError as error:
        missing["spconv"] = f"cannot be imported: {error}"
    return ours, calls, missing


def _in_turn(calls: list[Call]) -> Call:
    return lambda: [result for call in calls for result in call()]


def _case(maps: list[CellMap], backward: bool) -> Case:
    levels = [_level(map, backward) for map in maps]
    ours = _in_turn([level[0] for level in levels])
    peers = {name: _in_turn([level[1][name] for level in levels]) for name in levels[0][1]}

    def check() -> None:
        """On one thread: several threads of spconv's scatter overwrite each other's sums, and some rows are wrong."""
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        for name, peer in peers.items():
            for a, b in zip(ours(), peer(), strict=True):
                wrong = int(((a - b).abs() > 1e-3 + 1e-4 * b.abs()).flatten(1).any(1).sum())
                assert wrong == 0, f"{wrong} rows differ from {name}"
        torch.set_num_threads(threads)

    num_pairs = sum(len(map.fine) for map in maps)
    cells = f"{maps[0].num_fine} cells to {len(maps[-1].coarse.keys)}"
    if len(maps) > 1:
        cells = f"levels {maps[0].coarse.depth + 1} to {maps[-1].coarse.depth}, {cells}"
    op = f"sparse_conv, {'forward and backward' if backward else 'forward'}"
    flops = (6 if backward else 2) * num_pairs * CHANNELS**2
    shape = f"{cells}, {num_pairs} pairs, {CHANNELS} channels"
    return Case(op, shape, ours, peers, num_pairs, flops, check, levels[0][2])

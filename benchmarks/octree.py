"""The octree and its coarser levels with their convolution pairs, beside the torch composition."""

from __future__ import annotations

import torch
from torch import Tensor

from ast_sim.ops import octree as ops
from ast_sim.ops.octree import octree
from benchmarks.case import Case

ORIGIN, DEPTH, COARSEST = [0.0, 0.0, 0.0], 12, 8


def sphere(points: int) -> Tensor:
    x = torch.randn(points, 3, generator=torch.Generator().manual_seed(0))
    return 0.9 * torch.nn.functional.normalize(x, dim=1)


def _levels(keys: Tensor, cell_offsets: Tensor, coarsen) -> list[Tensor]:
    results = []
    for _ in range(DEPTH - COARSEST):
        results += coarsen(keys, cell_offsets)
        keys, cell_offsets = results[-9:-7]
    return results


def _assert_equal(ours, theirs) -> None:
    assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))


def cases() -> list[Case]:
    found = []
    for points in (10_000, 100_000, 1_000_000):
        positions, offsets = sphere(points), torch.tensor([0, points])
        tree = octree(positions, offsets, ORIGIN, 1, DEPTH)
        build = (positions, offsets, ORIGIN, 1.0, DEPTH)
        down = (tree.keys, tree.cell_offsets)
        shape = f"{points} points on a sphere, depth {DEPTH}"
        found.append(
            Case(
                "octree",
                shape,
                lambda build=build: ops._octree(*build),
                {"torch": lambda build=build: ops._octree_reference(*build)},
                points,
                None,
                lambda build=build: _assert_equal(ops._octree(*build), ops._octree_reference(*build)),
            )
        )
        if points > 100_000:
            continue  # the composition takes many seconds
        found.append(
            Case(
                "octree_coarsen",
                f"{shape} to {COARSEST}, with pairs",
                lambda down=down: _levels(*down, ops._coarsen),
                {"torch": lambda down=down: _levels(*down, ops._coarsen_reference)},
                points,
                None,
                lambda down=down: _assert_equal(_levels(*down, ops._coarsen), _levels(*down, ops._coarsen_reference)),
            )
        )
    return found

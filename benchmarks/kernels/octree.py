"""The octree, its coarser levels and their convolution pairs, beside the torch composition."""

from __future__ import annotations

import torch
from torch import Tensor

from ast_sim.ops import octree
from ast_sim.ops.library import OPS
from benchmarks.kernels.case import Case

ORIGIN, DEPTH, COARSEST = [0.0, 0.0, 0.0], 12, 8


def sphere(points: int) -> Tensor:
    x = torch.randn(points, 3, generator=torch.Generator().manual_seed(0))
    return 0.9 * torch.nn.functional.normalize(x, dim=1)


def _assert_equal(ours, theirs) -> None:
    assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))


def _case(op: str, shape: str, items: int, ours, composed) -> Case:
    return Case(op, shape, ours, {"torch": composed}, items, None, lambda: _assert_equal(ours(), composed()))


def _all_levels(positions: Tensor, offsets: Tensor, depth: int, levels: int, build, coarsen) -> list[Tensor]:
    """The cells of the nodes, and `levels` coarser levels with their pairs."""
    cells = build(positions, offsets, *ORIGIN, 1.0, depth)
    return [*cells, *coarsen(*cells[:2], levels)]


def cases() -> list[Case]:
    all_cases = []
    for points in (10_000, 100_000, 1_000_000):
        build = (sphere(points), torch.tensor([0, points]), *ORIGIN, 1.0, DEPTH)
        tree = octree(*build[:2], ORIGIN, 1.0, DEPTH)
        shape = f"{points} points on a sphere, depth {DEPTH}"
        all_cases.append(
            _case(
                "octree",
                shape,
                points,
                lambda build=build: OPS["octree"](*build),
                lambda build=build: OPS["octree"].reference(*build),
            )
        )
        if points > 100_000:
            continue  # the composition takes many seconds
        down = (tree.keys, tree.cell_offsets, DEPTH - COARSEST)
        all_cases.append(
            _case(
                "octree_coarsen",
                f"{shape} to {COARSEST}, with pairs",
                points,
                lambda down=down: OPS["octree_coarsen"](*down),
                lambda down=down: OPS["octree_coarsen"].reference(*down),
            )
        )
    plate = torch.cat([sphere(400) * torch.tensor([1, 1, 0.02]) for _ in range(4)])
    for shape, *args in (
        (f"100000 points on a sphere, depths {DEPTH} to {COARSEST} with pairs", sphere(100_000), 1, DEPTH, 4),
        ("4 plates of 400 points, depths 5 to 3 with pairs", plate, 4, 5, 2),
    ):
        positions, scenes, depth, levels = args
        offsets = torch.arange(scenes + 1) * (len(positions) // scenes)
        inputs = (positions, offsets, depth, levels)
        all_cases.append(
            _case(
                "octree_levels",
                shape,
                len(positions),
                lambda inputs=inputs: _all_levels(*inputs, OPS["octree"], OPS["octree_coarsen"]),
                lambda inputs=inputs: _all_levels(*inputs, OPS["octree"].reference, OPS["octree_coarsen"].reference),
            )
        )
    return all_cases

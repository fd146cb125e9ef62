"""The gap to the nearest other body, beside the signed distances of libigl."""

from __future__ import annotations

import numpy as np
import torch

from ast_sim.element_topology import surface_triangles
from ast_sim.ops import proximity
from ast_sim.ops.library import OPS
from benchmarks.kernels.case import Case
from benchmarks.kernels.elastic_forces import box

CELLS = [(12, 6, 2), (30, 14, 3), (60, 60, 20), (100, 100, 60)]  # of each of two bodies


def cases() -> list[Case]:
    return [_case(cells) for cells in CELLS]


def _case(cells: tuple[int, int, int]) -> Case:
    """Two boxes, one above the other, whose rough faces meet."""
    nodes, elements = box(cells)
    size = len(nodes)
    triangles = torch.from_numpy(surface_triangles(nodes.numpy(), elements.numpy()).astype(np.int64))
    above = torch.tensor([0.3, 0.4, cells[2] - 0.1])
    generator = torch.Generator().manual_seed(0)
    position = torch.cat([nodes, nodes + above]) + 0.2 * torch.rand(2 * size, 3, generator=generator)
    body = torch.arange(2).repeat_interleave(size)
    surface = torch.cat([triangles, triangles + size])
    ends = [torch.tensor([0, n]) for n in (2 * size, len(surface))]
    arguments = (position, torch.zeros_like(position), ends[0], body, surface, ends[1], 1.5)

    def check() -> None:
        assert (proximity(*arguments) - OPS["proximity"].composition(*arguments)).abs().max() <= 1e-6

    shape = f"{2 * size} nodes, {len(surface)} triangles"
    peers = {"libigl": lambda: OPS["proximity"].composition(*arguments)}
    return Case("proximity", shape, lambda: proximity(*arguments), peers, 2 * size, None, check)

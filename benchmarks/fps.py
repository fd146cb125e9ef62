"""Farthest point sampling of octree cells, beside fpsample's exact bucket method at its best tree height."""

from __future__ import annotations

import time

import fpsample
import numpy as np
import torch

from ast_sim.ops.fps import _sample_reference, farthest_point_sample
from ast_sim.ops.octree import octree
from benchmarks.case import Case


def _best_height(points: np.ndarray, num: int) -> int:
    def seconds(height: int) -> float:
        start = time.perf_counter()
        fpsample.bucket_fps_kdline_sampling(points, num, height, start_idx=0)
        return time.perf_counter() - start

    return min(range(2, 11), key=lambda height: min(seconds(height) for _ in range(3)))


def _assert_exact(ours: torch.Tensor, theirs: np.ndarray, composed: torch.Tensor) -> None:
    """Ours is the composition's, to the index. The peer breaks ties another way, and differs from the first tie on."""
    assert torch.equal(ours, composed)
    assert len(set(theirs.tolist())) == len(ours) and theirs[0] == 0


def cases() -> list[Case]:
    found = []
    for points, num in ((4096, 1024), (50_000, 4096), (100_000, 512), (1_000_000, 512)):
        positions = 2 * torch.rand(points, 3, generator=torch.Generator().manual_seed(0)) - 1
        tree = octree(positions, torch.tensor([0, points]), (0.0, 0.0, 0.0), 1, 12)
        coordinates, offsets = tree.coordinates(), tree.cell_offsets
        floats = coordinates.numpy().astype(np.float32)
        height = _best_height(floats, num)

        def ours(coordinates=coordinates, offsets=offsets, num=num):
            return farthest_point_sample(coordinates, offsets, num)[0]

        def theirs(floats=floats, num=num, height=height):
            return fpsample.bucket_fps_kdline_sampling(floats, num, height, start_idx=0)

        def composed(coordinates=coordinates, offsets=offsets, num=num):
            return _sample_reference(coordinates, offsets, num)[0]

        found.append(
            Case(
                "farthest_point_sample",
                f"{points} cells to {num}",
                ours,
                {f"fpsample kdline h={height}": theirs},
                points,
                None,
                lambda ours=ours, theirs=theirs, composed=composed: _assert_exact(ours(), theirs(), composed()),
            )
        )
    return found

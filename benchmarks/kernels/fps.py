"""Farthest point sampling of octree cells beside fpsample's exact bucket method at its best tree height."""

from __future__ import annotations

import time

import fpsample
import numpy as np
import torch

from ast_sim.ops import farthest_point_sample, octree
from ast_sim.ops.library import OPS
from benchmarks.kernels.case import Case


def _sample_scenes(points: np.ndarray, scenes: int, num: int, height: int) -> np.ndarray:
    """The peer knows one scene at a time."""
    size = len(points) // scenes
    return np.concatenate(
        [
            begin + fpsample.bucket_fps_kdline_sampling(points[begin : begin + size], num, height, start_idx=0)
            for begin in range(0, len(points), size)
        ]
    )


def _best_height(points: np.ndarray, scenes: int, num: int) -> int:
    def seconds(height: int) -> float:
        start = time.perf_counter()
        _sample_scenes(points, scenes, num, height)
        return time.perf_counter() - start

    heights = [height for height in range(2, 11) if 2**height <= len(points) // scenes]
    return min(heights, key=lambda height: min(seconds(height) for _ in range(5)))


def _assert_exact(ours: torch.Tensor, theirs: np.ndarray, composed: torch.Tensor) -> None:
    """Ours is the composition's, to the index. The peer breaks ties another way, and differs from the first tie on."""
    assert torch.equal(ours, composed)
    assert len(set(theirs.tolist())) == len(ours) and theirs[0] == 0


def _cells(points: int, scenes: int, depth: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Coordinates and offsets of the cells of random points, as many cells in each scene."""
    positions = 2 * torch.rand(points * scenes, 3, generator=torch.Generator().manual_seed(0)) - 1
    tree = octree(positions, torch.arange(scenes + 1) * points, (0.0, 0.0, 0.0), 1, depth)
    size = int(tree.cell_offsets.diff().min())
    rows = torch.cat([tree.coordinates()[begin : begin + size] for begin in tree.cell_offsets[:-1].tolist()])
    return rows, torch.arange(scenes + 1) * size


def cases() -> list[Case]:
    all_cases = []
    for scenes, points, depth, num in (
        (4, 360, 5, 90),
        (1, 4096, 12, 1024),
        (1, 50_000, 12, 4096),
        (1, 100_000, 12, 512),
        (1, 1_000_000, 12, 512),
    ):
        coordinates, offsets = _cells(points, scenes, depth)
        floats = coordinates.numpy().astype(np.float32)
        height = _best_height(floats, scenes, num)

        def ours(coordinates=coordinates, offsets=offsets, num=num):
            return farthest_point_sample(coordinates, offsets, num)[0]

        def theirs(floats=floats, scenes=scenes, num=num, height=height):
            return _sample_scenes(floats, scenes, num, height)

        def composed(coordinates=coordinates, offsets=offsets, num=num):
            return OPS["farthest_point_sample"].reference(coordinates, offsets, num)[0]

        all_cases.append(
            Case(
                "farthest_point_sample",
                f"{f'{scenes} scenes of ' if scenes > 1 else ''}{points} cells to {num}",
                ours,
                {f"fpsample kdline h={height}": theirs},
                len(coordinates),
                None,
                lambda ours=ours, theirs=theirs, composed=composed: _assert_exact(ours(), theirs(), composed()),
            )
        )
    return all_cases

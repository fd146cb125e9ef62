"""Octree cells of point clouds, and coarser levels with the pairs of cells that a stride-2 convolution connects.

Legend: B scenes, N nodes, C cells, P pairs. A cell's Morton key interleaves the bits of its x, y and z, x first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from ast_sim.ops.library import IndexSet, Kernel, Op
from ast_sim.ops.spec import Given, Sizes, segment_of


@dataclass(frozen=True)
class Octree(IndexSet):
    """The occupied cells of one level, in Morton order within each scene.

    Attributes:
        keys: [C] int64, Morton keys, rising within a scene.
        cell_offsets: [B + 1] int64; the cells of scene b are cell_offsets[b]:cell_offsets[b + 1].
        node_cell: [N] int64, the cell of each node.
        node_order: [N] int64, the nodes sorted by scene, cell and index.
        node_offsets: [C + 1] int64; the nodes of cell c are node_order[node_offsets[c]:node_offsets[c + 1]].
        depth: the domain is cut into 2^depth cells per axis.
    """

    keys: Tensor
    cell_offsets: Tensor
    node_cell: Tensor
    node_order: Tensor
    node_offsets: Tensor
    depth: int

    def coordinates(self) -> Tensor:
        """[C, 3] int32: x, y and z of each cell, 0..2^depth - 1."""
        return _coordinates(self.keys)

    def centers(self) -> Tensor:
        """[C, 3] float32: the middle of each cell, if the domain is scaled to [-1, 1]. Exact."""
        return (2 * self.coordinates() + (1 - (1 << self.depth))).float() * 0.5**self.depth

    def coarsen(self) -> CellMap:
        """The next coarser level, whose nodes are the cells of this one.

        Raises:
            ValueError: at depth 0.
        """
        return self.coarsen_all(1)[0]

    def coarsen_all(self, levels: int) -> list[CellMap]:
        """The next coarser levels, each made from the one before it. One call is cheaper than several.

        Raises:
            ValueError: unless 0 <= levels <= depth.
        """
        if not 0 <= levels <= self.depth:
            raise ValueError(f"octree: a tree of depth {self.depth} has no coarser level {levels} steps up")
        parts = _coarsen(self.keys, self.cell_offsets, levels)
        maps = []
        order = torch.arange(len(self.keys), device=self.keys.device)
        for level in range(levels):
            keys, cell_offsets, node_offsets, node_cell, *pairs = parts[9 * level : 9 * level + 9]
            num_fine = node_cell.shape[0]
            coarse = Octree(keys, cell_offsets, node_cell, order[:num_fine], node_offsets, self.depth - level - 1)
            maps.append(CellMap(coarse, num_fine, *pairs))
        return maps


@dataclass(frozen=True)
class CellMap(IndexSet):
    """The pairs of a fine and a coarse cell that the 3x3x3 kernel with stride 2 connects.

    Kernel offset k = 9(a+1) + 3(b+1) + (c+1) pairs the coarse cell X with the fine cell 2 X + (a, b, c), for a, b, c in
    {-1, 0, 1}. The pairs of offset k are the rows pair_offsets[k]:pair_offsets[k + 1] of each list.

    Attributes:
        coarse: the coarser level; its nodes are the cells of the finer one.
        num_fine: the number of cells of the finer level.
        pair_offsets: [28] int64.
        fine, coarse_index: [P] int64, the pairs, sorted by coarse cell within each offset.
        fine_by_fine, coarse_by_fine: [P] int64, the same pairs, sorted by fine cell within each offset.
    """

    coarse: Octree
    num_fine: int
    pair_offsets: Tensor
    fine: Tensor
    coarse_index: Tensor
    fine_by_fine: Tensor
    coarse_by_fine: Tensor


# ---- cells ----


# Bits move apart in five steps. Step s shifts some bits by 2^(5 - s) and then keeps the bits of mask s + 1.
_MASKS = (
    0x1FFFFF, 0x001F00000000FFFF, 0x001F0000FF0000FF, 0x100F00F00F00F00F, 0x10C30C30C30C30C3, 0x1249249249249249,
)  # fmt: skip


def _spread(x: Tensor) -> Tensor:
    """Move bit i of x < 2^21 to bit 3i."""
    for step in range(5):
        x = (x | x << (32 >> step)) & _MASKS[step + 1]
    return x


def _gather(x: Tensor) -> Tensor:
    """The inverse of `_spread`: move bit 3i to bit i."""
    x = x & _MASKS[5]
    for step in reversed(range(5)):
        x = (x | x >> (32 >> step)) & _MASKS[step]
    return x


def _keys_of(coordinates: Tensor) -> Tensor:
    x, y, z = coordinates.unbind(1)
    return _spread(x) << 2 | _spread(y) << 1 | _spread(z)


def _unit(positions: Tensor, center: Sequence[float], half_width: float) -> Tensor:
    """The positions where the domain is scaled to [0, 1], in float64."""
    return (positions.double() - positions.new_tensor(center, dtype=torch.float64) + half_width) / (2 * half_width)


def _check_domain(name: str, sizes: Sizes, given: Given) -> None:
    positions = given["positions"]
    half_width = given["half_width"]
    center = [given[axis] for axis in "xyz"]
    if not 0 < half_width < 1e300:
        raise ValueError(f"{name}: half_width must be positive and finite")
    if not all(abs(x) < 1e300 for x in center):
        raise ValueError(f"{name}: center must be finite")
    unit = _unit(positions, center, half_width)
    finite = positions.isfinite().all(1)
    inside = ((unit >= -1e-6) & (unit <= 1 + 1e-6)).all(1)
    bad = (~(finite & inside)).nonzero()
    if len(bad):
        node = int(bad[0])
        position = ", ".join(f"{x:.9g}" for x in positions[node].tolist())
        problem = f"lies outside the domain of half width {half_width:.9g}" if finite[node] else "is not finite"
        raise ValueError(f"{name}: positions[{node}] = ({position}) {problem}")


_octree_kernel = Kernel(
    "octree",
    "positions[N,3], offsets[B+1] offsets(N), x number, y number, z number, half_width number, depth integer(0,21)"
    " -> keys[C] int64, cell_offsets[B+1] int64, node_cell[N] int64, node_order[N] int64, node_offsets[C+1] int64",
    _check_domain,
)
_coarsen_kernel = Kernel(
    "octree_coarsen",
    "keys[N] int64, cell_offsets[B+1] offsets(N) scenes(keys), levels integer(0,21)"
    " -> coarse_keys[C] int64, coarse_offsets[B+1] int64, first_child[C+1] int64, node_cell[N] int64,"
    " pair_offsets[28] int64, fine[P] int64, coarse[P] int64, fine_by_fine[P] int64, coarse_by_fine[P] int64",
)


def _octree_reference(positions: Tensor, offsets: Tensor, x: float, y: float, z: float, half_width: float, depth: int):
    unit = _unit(positions, (x, y, z), half_width)
    keys = _keys_of((unit * 2**depth).floor().long().clamp(0, 2**depth - 1))
    scenes = segment_of(offsets)
    order = torch.argsort(keys, stable=True)
    if len(offsets) > 2:
        order = order[torch.argsort(scenes[order], stable=True)]
    keys, cell_offsets, node_offsets, node_cell = _runs(keys[order], scenes[order], offsets, order)
    return [keys, cell_offsets, node_cell, order, node_offsets]


def _runs(keys: Tensor, scenes: Tensor, offsets: Tensor, order: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The cells of rows sorted by (scene, key): keys, cell_offsets, node_offsets and node_cell.

    `order` [N] are the nodes of the sorted rows.
    """
    head = torch.ones_like(keys, dtype=torch.bool)
    head[1:] = (keys[1:] != keys[:-1]) | (scenes[1:] != scenes[:-1])
    starts = head.nonzero()[:, 0]
    node_cell = torch.empty_like(keys)
    node_cell[order] = head.cumsum(0) - 1
    node_offsets = torch.cat([starts, offsets[-1:]])
    return keys[starts], torch.searchsorted(starts, offsets), node_offsets, node_cell


def _coordinates_reference(keys: Tensor) -> Tensor:
    return torch.stack([_gather(keys >> 2), _gather(keys >> 1), _gather(keys)], 1).int()


# ---- the coarser level ----


def _after_reference(keys: Tensor, scenes: Tensor) -> Tensor:
    """[C, 8]: the cell of the same scene at +(i, j, k), in column 4i + 2j + k, or -1."""
    if len(keys) == 0:
        return keys.new_empty(0, 8)
    unique, rank = keys.unique(return_inverse=True)
    place = scenes * len(unique) + rank  # ascending like (scene, key), but without overflow
    shift = torch.tensor([[d >> 2, d >> 1 & 1, d & 1] for d in range(8)], device=keys.device)
    wanted = _keys_of((_coordinates_reference(keys)[:, None] + shift).reshape(-1, 3)).reshape(-1, 8)
    rank = torch.searchsorted(unique, wanted).clamp(max=len(unique) - 1)
    wanted_place = scenes[:, None] * len(unique) + rank
    cell = torch.searchsorted(place, wanted_place).clamp(max=len(place) - 1)
    return torch.where((unique[rank] == wanted) & (place[cell] == wanted_place), cell, -1)


def _level_by_level(once: Callable, keys: Tensor, cell_offsets: Tensor, levels: int) -> list[Tensor]:
    """The outputs of all levels, where `once` gives the outputs of one."""
    parts: list[Tensor] = []
    for _ in range(levels):
        parts += once(keys, cell_offsets, 1)
        keys, cell_offsets = parts[-9:-7]
    return parts


def _coarsen_once(keys: Tensor, cell_offsets: Tensor, levels: int) -> list[Tensor]:
    scenes = segment_of(cell_offsets)
    rows = torch.arange(len(keys), device=keys.device)
    coarse_keys, coarse_offsets, node_offsets, node_cell = _runs(keys >> 3, scenes, cell_offsets, rows)
    after = _after_reference(coarse_keys, segment_of(coarse_offsets))
    groups = []
    for k in range(27):
        step = (k // 9 - 1, k // 3 % 3 - 1, k % 3 - 1)
        octant = sum((a != 0) << (2 - i) for i, a in enumerate(step))
        successor = sum((a < 0) << (2 - i) for i, a in enumerate(step))
        fine = ((keys & 7) == octant).nonzero()[:, 0]
        coarse = after[node_cell[fine], successor]
        fine, coarse = fine[coarse >= 0], coarse[coarse >= 0]
        order = coarse.argsort()
        groups.append((fine[order], coarse[order], fine, coarse))
    counts = torch.tensor([0] + [len(group[0]) for group in groups], device=keys.device)
    pairs = (torch.cat(parts) for parts in zip(*groups, strict=True))
    return [coarse_keys, coarse_offsets, node_offsets, node_cell, counts.cumsum(0), *pairs]


_octree = Op(_octree_kernel, _octree_reference)
_coordinates = Op(Kernel("octree_coordinates", "keys[C] int64 -> coordinates[C,3] int32"), _coordinates_reference)
_coarsen = Op(_coarsen_kernel, partial(_level_by_level, _coarsen_once), partial(_level_by_level, _coarsen_kernel.fake))


def octree(positions: Tensor, offsets: Tensor, center: Sequence[float], half_width: float, depth: int) -> Octree:
    """The occupied cells of each scene. The cube center +- half_width is cut into 2^depth cells per axis.

    The cell of a node p is floor((p - center + half_width) / (2 half_width) 2^depth) per axis, in float64, clamped to
    0..2^depth - 1. So a node on the far face of the cube belongs to the last cell.

    Args:
        positions: [N, 3].
        offsets: [B + 1] int64, from 0 to N; the nodes of scene b are offsets[b]:offsets[b + 1].
        center: the middle of the domain, in the unit of positions.
        half_width: half the side of the domain.
        depth: 0..21.

    Raises:
        ValueError: a node is not finite or lies outside the domain by more than 1e-6 of its width (the message names
            the first one and its position), or the offsets, the depth or the domain are not as above.
    """
    if len(center) != 3:
        raise ValueError(f"octree: center must be three numbers, not {len(center)}")
    return Octree(*_octree(positions, offsets, *map(float, center), float(half_width), depth), depth=depth)

"""From mesh to cells and back: the octree of the current positions, and the convolutions that coarsen its cells.

Legend: N nodes, C cells, B scenes.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ast_sim.models.ast.ast_config import ASTConfig
from ast_sim.ops import CellMap, EdgeSet, Octree, octree, sparse_conv, sparse_conv_transposed
from ast_sim.support.errors import DatasetError, RolloutError


@dataclass(frozen=True)
class Cells:
    """The cells of one batch at level L, and coarser cells. The coarsest ones become tokens.

    Attributes:
        finest: the cells of level L, which hold the mesh nodes.
        maps: the l_ocnn steps from finer to coarser cells.
        growth: how often the domain was doubled to hold all nodes.
    """

    finest: Octree
    maps: list[CellMap]
    growth: int

    @property
    def coarsest(self) -> Octree:
        return self.maps[-1].coarse if self.maps else self.finest

    def centers(self) -> Tensor:
        """[C, 3]: centres of the coarsest cells, in half widths of the domain before it was doubled."""
        return self.coarsest.centers() * 2.0**self.growth

    def places(self) -> Tensor:
        """[C, 3] float64: `places` of the centres of the coarsest cells. Exact."""
        return self.coarsest.centers().double() * 2.0 ** (self.coarsest.depth - 1)

    def from_mesh(self) -> EdgeSet:
        """M2C: an edge from every node to its cell."""
        o = self.finest
        return EdgeSet(o.node_order, o.node_cell.index_select(0, o.node_order), o.node_offsets, len(o.node_cell))

    def to_mesh(self) -> EdgeSet:
        """C2M: an edge from every cell to each of its nodes."""
        o = self.finest
        nodes = torch.arange(len(self.finest.node_cell) + 1)
        return EdgeSet(o.node_cell, nodes[:-1], nodes, len(o.keys))


def doublings(config: ASTConfig, position: Tensor) -> int | None:
    """How often the domain must double around its centre to hold positions [N, 3]; None if L would pass 21."""
    center = torch.tensor(config.data.domain_center, dtype=torch.float64)
    reach = float((position.detach().double() - center).abs().max()) if len(position) else 0.0
    for growth in range(22 - config.level):
        if reach <= config.data.domain_half_width * 2.0**growth:
            return growth
    return None


def places(config: ASTConfig, position: Tensor) -> Tensor:
    """[N, 3] float64: positions [N, 3] relative to the centre of the domain, in sides of the coarsest cells."""
    center = torch.tensor(config.data.domain_center, dtype=torch.float64)
    return (position.double() - center) / (config.cell_side * 2.0**config.l_ocnn)


def build_cells(config: ASTConfig, position: Tensor, offsets: Tensor, may_grow: bool) -> Cells:
    """The cells of positions [N, 3] in the scenes of `offsets` [B + 1].

    With `may_grow`, as in a rollout, the domain doubles around its centre until all nodes lie inside, and each time L
    grows by one. This does not change the cells, because their size stays the same.

    Raises:
        DatasetError: without `may_grow`, a node lies outside the domain or is not finite.
        RolloutError: with `may_grow`, a node is not finite, or so far away that L would pass 21.
    """
    growth = doublings(config, position) if may_grow and bool(torch.isfinite(position).all()) else 0
    error = RolloutError if may_grow else DatasetError
    if growth is None:
        raise error(
            f"a node is so far from the domain centre {config.data.domain_center} that the octree would pass level 21"
        )
    try:
        half_width, depth = config.data.domain_half_width * 2.0**growth, config.level + growth
        finest = octree(position, offsets, config.data.domain_center, half_width, depth)
    except ValueError as problem:
        advice = "; give the dataset a domain_half_width that holds all frames with train.noise and train.shift"
        advice += " (a run that starts from another one keeps the domain of that one)"
        raise error(f"{problem}{'' if may_grow else advice}") from problem
    return Cells(finest, finest.coarsen_all(config.l_ocnn), growth)


class SparseConv(nn.Module):
    """One convolution over cells, kernel 3 x 3 x 3, stride 2. With `up` it leads from coarse to fine cells."""

    def __init__(self, width: int, up: bool):
        super().__init__()
        self.convolve = sparse_conv_transposed if up else sparse_conv
        self.weight = nn.Parameter(nn.init.xavier_uniform_(torch.empty(27 * width, width)).view(27, width, width))
        self.bias = nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor, cell_map: CellMap) -> Tensor:
        return self.convolve(x, self.weight, cell_map, self.bias)

"""BSMS-GNN (Cao et al. 2023, arXiv 2210.02573, with the contact edges of its plate): a U-Net of message passing.

    down  x_l = B_l(x_l-1 pooled) on each mesh of a bi-stride hierarchy,  bottom  x_L,
    up    x_l + U_l(x_l+1 unpooled)

A block B, U on one mesh, with LN an MLP that ends in a LayerNorm without weights, and p0, p the pooled positions:

    x'_j = x_j + LN_V(x_j, sum_i LN_M(p0_ij, |p0_ij|, p_ij, |p_ij|, x_i, x_j), sum_i LN_C(p_ij, |p_ij|, x_i, x_j))

The first sum is over mesh edges, the second over contact edges. Contact edges are pooled at each step down. Edges
carry no latents from block to block.

Legend: N nodes, M edges of a set, L levels below the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Literal

import torch
from torch import Tensor, nn

from ast_sim.batches.batch_builder import Batch
from ast_sim.batches.graph import Graph
from ast_sim.models.bistride import Hierarchy, build_hierarchy, subset
from ast_sim.models.model_config import PAPER_TRAINING, Preset, count, setting, tiny
from ast_sim.models.node_inputs import normalizer_of
from ast_sim.models.registry import Model
from ast_sim.models.simulator import Prediction
from ast_sim.models.world_edge_model import Decoder, DeepMLP, Edges, WorldEdgeConfig, WorldEdgeSimulator, messages
from ast_sim.ops import EdgeSet
from ast_sim.scene import Scene


@dataclass(frozen=True)
class BSMSConfig(WorldEdgeConfig):
    """The settings of BSMS-GNN."""

    name: Literal["bsms"] = setting("bsms", "BSMS-GNN")
    levels: int = count(6, "coarser meshes below the finest one")
    repeat_ends: bool = setting(False, "apply the blocks of the finest and of the coarsest mesh twice")
    contacts: Literal["all", "components"] = setting("all", "world edges: all, or only between components of the mesh")
    prescribed_edges: bool = setting(True, "keep mesh edges between two prescribed nodes")


class PlainNorm(nn.Module):
    """Weight 1 and bias 0 in place of the parameters of a LayerNorm."""

    weight: Tensor
    bias: Tensor

    def __init__(self, width: int):
        super().__init__()
        self.register_buffer("weight", torch.ones(width), persistent=False)
        self.register_buffer("bias", torch.zeros(width), persistent=False)


class EdgeMessages(nn.Module):
    """The sums of the messages along one set of edges."""

    def __init__(self, config: BSMSConfig, edge_inputs: int):
        super().__init__()
        self.mlp = DeepMLP(config, edge_inputs + 2 * config.hidden, norm=PlainNorm)

    def forward(self, edges: Edges, x: Tensor) -> Tensor:
        """[N, hidden] -> [N, hidden]."""
        return messages(self.mlp, *edges, x)[0]


class MessagePassingBlock(nn.Module):
    """One step on the mesh and the contacts of a level."""

    def __init__(self, config: BSMSConfig):
        super().__init__()
        self.mesh = EdgeMessages(config, 8)
        self.contact = EdgeMessages(config, 4)
        self.node = DeepMLP(config, 3 * config.hidden, norm=PlainNorm)

    def forward(self, x: Tensor, mesh: Edges, contacts: Edges) -> Tensor:
        """[N, hidden] -> [N, hidden]."""
        return self.node(torch.cat([x, self.mesh(mesh, x), self.contact(contacts, x)], dim=1), residual=x)


class BSMS(WorldEdgeSimulator[BSMSConfig]):
    """BSMS-GNN. Edge lengths grow from level to level, so each level has statistics of its own."""

    def __init__(self, config: BSMSConfig):
        super().__init__(config)
        self.mesh_inputs = nn.ModuleList(normalizer_of(config, "edge") for _ in range(config.levels + 1))
        self.world_inputs = nn.ModuleList(normalizer_of(config, "world_edge") for _ in range(config.levels + 1))
        self.node_encoder = DeepMLP(config, self.node_inputs.width, norm=PlainNorm)
        self.down = nn.ModuleList(MessagePassingBlock(config) for _ in range(config.levels))
        self.bottom = MessagePassingBlock(config)
        self.up = nn.ModuleList(MessagePassingBlock(config) for _ in range(config.levels))
        self.decoder = Decoder(config)

    def graph(self, scene: Scene) -> Graph:
        """See `Simulator`. `own` is the hierarchy of meshes."""
        graph = super().graph(scene)
        edges = graph.edges
        prescribed = graph.prescribed
        if not self.config.prescribed_edges:
            edges = subset(edges, ~(prescribed[edges.senders] & prescribed[edges.receivers]))
        own = build_hierarchy(edges, graph.rest_position, self.config.levels, pooled=True, mesh=graph.edges)
        return replace(graph, own=own)

    def world(self, batch: Batch) -> EdgeSet:
        """The contact edges of the finest mesh."""
        edges = super().world(batch)
        return Hierarchy.of(batch.graph).between_components(edges) if self.config.contacts == "components" else edges

    def contacts(self, batch: Batch) -> list[EdgeSet]:
        """The contact edges of each mesh, the finest first."""
        poolings = Hierarchy.of(batch.graph).poolings
        return list(accumulate(poolings, lambda finer, step: step.pool_contacts(finer), initial=self.world(batch)))

    def forward(self, batch: Batch) -> Prediction:
        """Normalised outputs for the frame after `batch`."""
        nodes, *edges = self.inputs_of(batch)
        levels = list(zip(*edges, strict=True))
        poolings = Hierarchy.of(batch.graph).poolings
        x = self.node_encoder(nodes)
        skipped = []
        for i, block in enumerate(self.down):
            skipped.append(self._steps(block, x, levels[i], end=i == 0))
            x = poolings[i].pool(skipped[-1])
        x = self._steps(self.bottom, x, levels[-1], end=True)
        for i, block in reversed(list(enumerate(self.up))):
            x = skipped[i] + self._steps(block, poolings[i].unpool(x), levels[i], end=i == 0)
        return self.decoder(x, batch)

    def _steps(self, block: nn.Module, x: Tensor, level: tuple[Edges, Edges], end: bool) -> Tensor:
        for _ in range(2 if end and self.config.repeat_ends else 1):
            x = block(x, *level)
        return x


PRESETS = {
    "tiny": tiny(BSMSConfig(hidden=64, hidden_layers=1, levels=3, contacts="components"), peak_rate=1e-3, batch_size=4),
    # As the AST paper trains it (sections "Batch Size and Learning Rate", "Baselines").
    "paper": Preset(BSMSConfig(), PAPER_TRAINING),
    # As its authors train it on the plate, except for their schedule (0.794 per epoch) and for stress, which they omit.
    "original": Preset(
        BSMSConfig(repeat_ends=True, contacts="components", prescribed_edges=False),
        {"epochs": 50, "batch_size": 12, "peak_rate": 1e-4, "warmup": 0, "noise": 0.003, "stress_weight": 0.01},
    ),
}

MODEL = Model(BSMSConfig, BSMS, PRESETS)

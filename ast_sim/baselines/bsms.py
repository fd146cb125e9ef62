"""BSMS-GNN (Cao et al. 2023, arXiv 2210.02573, with the contact edges of its plate): a U-Net of message passings.

    down  x_l = B_l(x_l-1 pooled) on each mesh of a bi-stride hierarchy,  bottom  x_L,
    up    x_l + U_l(x_l+1 unpooled)

A block B, U on one mesh, with LN an MLP that ends in a LayerNorm without weights, and p0, p the pooled positions:

    x'_j = x_j + LN_V(x_j, sum_i LN_M(p0_ij, |p0_ij|, p_ij, |p_ij|, x_i, x_j), sum_i LN_C(p_ij, |p_ij|, x_i, x_j))

where the first sum is over mesh edges and the second over contact edges, which are pooled at each step. Nothing is
kept on edges.

Legend: N nodes, M edges of a set, L levels below the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor, nn

from ast_sim.baselines.bistride import Hierarchy, build_hierarchy, subset
from ast_sim.baselines.common import (
    Decoder,
    DeepMLP,
    WorldEdgeConfig,
    WorldEdgeSimulator,
    messages,
    world_normalizer,
)
from ast_sim.data.batch import Batch
from ast_sim.data.graph import Graph, edge_vectors
from ast_sim.data.scene import Scene
from ast_sim.model.config import Preset, setting
from ast_sim.model.features import node_features, normalizer_of
from ast_sim.model.simulator import Prediction
from ast_sim.ops.edges import EdgeSet


@dataclass(frozen=True)
class BSMSConfig(WorldEdgeConfig):
    """The settings of BSMS-GNN."""

    name: Literal["bsms"] = setting("bsms", "BSMS-GNN")
    levels: int = setting(6, "meshes below the finest")
    repeat_ends: bool = setting(False, "the blocks of the finest and of the coarsest mesh act twice")
    contacts: Literal["all", "components"] = setting("all", "world edges: all, or between components of the mesh only")
    prescribed_edges: bool = setting(True, "keep mesh edges between two prescribed nodes")

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_positive("levels")


class PlainNorm(nn.Module):
    """The weights of a LayerNorm that has none."""

    def __init__(self, width: int):
        super().__init__()
        self.register_buffer("weight", torch.ones(width), persistent=False)
        self.register_buffer("bias", torch.zeros(width), persistent=False)


def plain_mlp(inputs: int, hidden: int, layers: int) -> DeepMLP:
    """Hidden layers, a linear one and a LayerNorm without weights."""
    mlp = DeepMLP(inputs, hidden, hidden, layers)
    mlp.norm = PlainNorm(hidden)
    return mlp


@dataclass(frozen=True, eq=False)
class Level:
    """The edges of one mesh and of its contacts at one time, with their inputs [M, 8] and [M, 4]."""

    mesh: EdgeSet
    mesh_features: Tensor
    contacts: EdgeSet
    contact_features: Tensor


class Messages(nn.Module):
    """Sums of the messages along the edges of one set."""

    def __init__(self, edge_inputs: int, hidden: int, layers: int):
        super().__init__()
        self.mlp = plain_mlp(edge_inputs + 2 * hidden, hidden, layers)

    def forward(self, edges: EdgeSet, features: Tensor, nodes: Tensor) -> Tensor:
        """features [M, edge_inputs], nodes [N, hidden] -> [N, hidden]."""
        return messages(self.mlp, edges, features, nodes)[0]


class Block(nn.Module):
    """One step on the mesh and the contacts of a level."""

    def __init__(self, hidden: int, layers: int):
        super().__init__()
        self.mesh, self.contact = Messages(8, hidden, layers), Messages(4, hidden, layers)
        self.node = plain_mlp(3 * hidden, hidden, layers)

    def forward(self, x: Tensor, level: Level) -> Tensor:
        """[N, hidden] -> [N, hidden]."""
        on_mesh = self.mesh(level.mesh, level.mesh_features, x)
        in_contact = self.contact(level.contacts, level.contact_features, x)
        return self.node(torch.cat([x, on_mesh, in_contact], dim=1), residual=x)


class BSMS(WorldEdgeSimulator):
    """BSMS-GNN; edge lengths grow from level to level, so each has statistics of its own."""

    config: BSMSConfig

    def __init__(self, config: BSMSConfig):
        super().__init__(config)
        width, layers, levels = config.hidden, config.hidden_layers, config.levels
        self.mesh_inputs = nn.ModuleList(normalizer_of(config, "edge") for _ in range(levels + 1))
        self.world_inputs = nn.ModuleList(world_normalizer() for _ in range(levels + 1))
        self.node_encoder = plain_mlp(self.node_inputs.width, width, layers)
        self.down = nn.ModuleList(Block(width, layers) for _ in range(levels))
        self.bottom = Block(width, layers)
        self.up = nn.ModuleList(Block(width, layers) for _ in range(levels))
        self.decoder = Decoder(config)

    def graph(self, scene: Scene) -> Graph:
        """See `Simulator`; with the hierarchy as its `own`."""
        graph = super().graph(scene)
        edges, prescribed = graph.m2m, graph.prescribed
        if not self.config.prescribed_edges:
            edges = subset(edges, ~(prescribed[edges.senders] & prescribed[edges.receivers]))
        own = build_hierarchy(edges, graph.rest_position, self.config.levels, pooled=True, mesh=graph.m2m)
        return replace(graph, own=own)

    def world(self, batch: Batch) -> EdgeSet:
        """The contact edges of the finest mesh."""
        found = super().world(batch)
        return batch.graph.own.between_components(found) if self.config.contacts == "components" else found

    def levels(self, batch: Batch) -> list[Level]:
        """The meshes and contacts of a batch, the finest first, with raw inputs."""
        hierarchy: Hierarchy = batch.graph.own
        position, contacts, found = batch.position, self.world(batch), []
        for i, (mesh, rest) in enumerate(zip(hierarchy.edges, hierarchy.rest_edges, strict=True)):
            if i:
                pooling = hierarchy.poolings[i - 1]
                position, contacts = pooling.pool(position), pooling.pool_contacts(contacts)
            features = self.edge_features(mesh, rest, position)
            found.append(Level(mesh, features, contacts, edge_vectors(contacts, position, position)))
        return found

    def observe(self, batch: Batch) -> None:
        """Add the batch to the statistics of the inputs."""
        self.node_inputs.observe(node_features(self.config, batch))
        for mesh, world, level in zip(self.mesh_inputs, self.world_inputs, self.levels(batch), strict=True):
            mesh.observe(level.mesh_features)
            world.observe(level.contact_features)

    def forward(self, batch: Batch) -> Prediction:
        """Normalised outputs for the frame after `batch`."""
        levels = [
            Level(level.mesh, mesh(level.mesh_features), level.contacts, world(level.contact_features))
            for mesh, world, level in zip(self.mesh_inputs, self.world_inputs, self.levels(batch), strict=True)
        ]
        poolings = batch.graph.own.poolings
        x, skipped = self.node_encoder(self.nodes(batch)), []
        for i, block in enumerate(self.down):
            skipped.append(self._steps(block, x, levels[i], end=i == 0))
            x = poolings[i].pool(skipped[-1])
        x = self._steps(self.bottom, x, levels[-1], end=True)
        for i, block in reversed(list(enumerate(self.up))):
            x = skipped[i] + self._steps(block, poolings[i].unpool(x), levels[i], end=i == 0)
        return self.decoder(x, batch)

    def _steps(self, block: Block, x: Tensor, level: Level, end: bool) -> Tensor:
        for _ in range(2 if end and self.config.repeat_ends else 1):
            x = block(x, level)
        return x


PRESETS = {
    # A size that two cores train in minutes.
    "tiny": Preset(
        BSMSConfig(hidden=64, hidden_layers=1, levels=3, contacts="components"),
        {"batch_size": 4, "optimizer": "muon", "peak_rate": 1e-3, "stress_weight": 0.1, "rollout_pool": None},
        adapts=True,
    ),
    # As the AST paper trains it (sections "Batch Size and Learning Rate", "Baselines").
    "paper": Preset(
        BSMSConfig(), {"batch_size": 48, "peak_rate": 1e-4, "noise": 0.003, "stress_weight": 0.01}, adapts=True
    ),
    # As its authors train it on the plate, but for their schedule (0.794 per epoch) and stress, which they leave out.
    "original": Preset(
        BSMSConfig(repeat_ends=True, contacts="components", prescribed_edges=False),
        {"epochs": 50, "batch_size": 12, "peak_rate": 1e-4, "warmup": 0, "noise": 0.003, "stress_weight": 0.01},
        adapts=True,
    ),
}

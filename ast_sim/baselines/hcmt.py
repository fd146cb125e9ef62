"""Hierarchical Contact Mesh Transformer (Yu et al. 2024, arXiv 2312.12467), on bi-stride hierarchies.

    contact blocks on the mesh and its contacts
    down  x_l = D_l(x_l-1 of the kept nodes) on each mesh of the hierarchy,  bottom,
    up    U_l(x_l with the rows of the kept nodes replaced by x_l+1)

A block on the mesh, and on contacts beside it with the same projections, LN with a weight of its own each time:

    y = x + O [attention(LN x, LN e), attention(LN x, LN c)],    x' = y + FFN(LN y)

where the attention (`channel_attention`) gets q, k and v from nodes and p and g from edges. Edges are encoded on each
mesh by one MLP and stay as they are.

Legend: N nodes, M edges of a set, L levels below the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor, nn

from ast_sim.baselines.bistride import Hierarchy, build_hierarchy, subset
from ast_sim.baselines.channel_attention import channel_attention
from ast_sim.baselines.common import Decoder, DeepMLP, WorldEdgeConfig, WorldEdgeSimulator
from ast_sim.data.batch import Batch
from ast_sim.data.graph import Graph, edge_vectors
from ast_sim.data.scene import NodeType, Scene
from ast_sim.model.config import Preset, setting
from ast_sim.model.features import node_features
from ast_sim.model.linear import Linear
from ast_sim.model.simulator import Prediction
from ast_sim.ops.edges import EdgeSet


@dataclass(frozen=True)
class HCMTConfig(WorldEdgeConfig):
    """The settings of HCMT."""

    name: Literal["hcmt"] = setting("hcmt", "Hierarchical Contact Mesh Transformer")
    heads: int = setting(4, "attention heads: the scores of their channels are divided by the root of their width")
    contact_blocks: int = setting(2, "blocks on the mesh and its contacts, before the hierarchy")
    levels: int = setting(6, "meshes below the finest")
    contacts: Literal["all", "obstacles"] = setting("all", "world edges: all, or between obstacles and moving nodes")

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_positive("levels", "heads")
        self.check_heads()


class Block(nn.Module):
    """Attention along one or two sets of edges, then a feed-forward network; all layers without bias."""

    def __init__(self, config: HCMTConfig, edge_sets: int):
        super().__init__()
        width = config.hidden
        self.head_width = width // config.heads
        self.norm = nn.LayerNorm(width)
        self.edge_norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(edge_sets))
        self.q, self.k, self.v, self.p, self.g = (_layer(width, width) for _ in range(5))
        self.out = _layer(edge_sets * width, width)
        self.forward_norm = nn.LayerNorm(width)
        self.feed_forward = nn.ModuleList(_layer(width, width) for _ in range(3))

    def forward(self, x: Tensor, *edge_sets: tuple[EdgeSet, Tensor]) -> Tensor:
        """x [N, hidden] and, of each set, its edges and their features [M, hidden] -> [N, hidden]."""
        y, found = self.norm(x), []
        q, k, v = self.q(y), self.k(y), self.v(y)
        for norm, (edges, features) in zip(self.edge_norms, edge_sets, strict=True):
            e = norm(features)
            found.append(channel_attention(edges, q, k, v, self.p(e), self.g(e), self.head_width))
        x = self.out(torch.cat(found, dim=1), residual=x)
        first, second, last = self.feed_forward
        return last(second(first(self.forward_norm(x), "relu"), "relu"), residual=x)


def _layer(inputs: int, outputs: int) -> Linear:
    layer = Linear(inputs, outputs, bias=False)
    nn.init.xavier_uniform_(layer.weight)
    return layer


class HCMT(WorldEdgeSimulator):
    """The Hierarchical Contact Mesh Transformer."""

    config: HCMTConfig

    def __init__(self, config: HCMTConfig):
        super().__init__(config)
        width, layers = config.hidden, config.hidden_layers
        self.node_encoder = DeepMLP(self.node_inputs.width, width, width, layers)
        self.mesh_encoder = DeepMLP(self.mesh_inputs.width, width, width, layers)
        self.world_encoder = DeepMLP(self.world_inputs.width, width, width, layers)
        self.contact = nn.ModuleList(Block(config, 2) for _ in range(config.contact_blocks))
        self.down = nn.ModuleList(Block(config, 1) for _ in range(config.levels))
        self.bottom = Block(config, 1)
        self.up = nn.ModuleList(Block(config, 1) for _ in range(config.levels))
        self.decoder = Decoder(config)

    def graph(self, scene: Scene) -> Graph:
        """See `Simulator`; with the hierarchy as its `own`."""
        graph = super().graph(scene)
        own = build_hierarchy(graph.m2m, graph.rest_position, self.config.levels, pooled=False, mesh=graph.m2m)
        return replace(graph, own=own)

    def world(self, batch: Batch) -> EdgeSet:
        """The contact edges."""
        found = super().world(batch)
        if self.config.contacts == "all":
            return found
        ends = torch.stack([batch.graph.node_type[found.senders], batch.graph.node_type[found.receivers]])
        return subset(found, (ends == NodeType.OBSTACLE).any(0) & (ends == NodeType.NORMAL).any(0))

    def mesh_levels(self, batch: Batch) -> list[Tensor]:
        """Raw inputs [M, 8] of the edges of each mesh, the finest first."""
        hierarchy: Hierarchy = batch.graph.own
        position, found = batch.position, []
        for i, (mesh, rest) in enumerate(zip(hierarchy.edges, hierarchy.rest_edges, strict=True)):
            if i:
                position = position.index_select(0, hierarchy.poolings[i - 1].kept)
            found.append(self.edge_features(mesh, rest, position))
        return found

    def observe(self, batch: Batch) -> None:
        """Add the batch to the statistics of the inputs: those of mesh edges are of all meshes, as is their encoder."""
        self.node_inputs.observe(node_features(self.config, batch))
        for features in self.mesh_levels(batch):
            self.mesh_inputs.observe(features)
        self.world_inputs.observe(edge_vectors(self.world(batch), batch.position, batch.position))

    def forward(self, batch: Batch) -> Prediction:
        """Normalised outputs for the frame after `batch`."""
        hierarchy, world = batch.graph.own, self.world(batch)
        encoded = [self.mesh_encoder(self.mesh_inputs(features)) for features in self.mesh_levels(batch)]
        meshes = list(zip(hierarchy.edges, encoded, strict=True))
        kept = [pooling.kept for pooling in hierarchy.poolings]
        contacts = (world, self.world_encoder(self.world_edges(batch, world)))

        x, saved = self.node_encoder(self.nodes(batch)), []
        for block in self.contact:
            x = block(x, meshes[0], contacts)
        for block, mesh, chosen in zip(self.down, meshes, kept, strict=False):
            saved.append(block(x, mesh))
            x = saved[-1].index_select(0, chosen)
        x = self.bottom(x, meshes[-1])
        for i, block in reversed(list(enumerate(self.up))):
            x = block(saved[i].index_copy(0, kept[i], x), meshes[i])
        return self.decoder(x, batch)


PRESETS = {
    # A size that two cores train in minutes.
    "tiny": Preset(
        HCMTConfig(hidden=64, hidden_layers=1, levels=3),
        {"batch_size": 4, "optimizer": "muon", "peak_rate": 2e-3, "stress_weight": 0.1, "rollout_pool": None},
        adapts=True,
    ),
    # As the AST paper trains it, one scene on each of four GPUs (sections "Batch Size and Learning Rate", "Baselines").
    "paper": Preset(
        HCMTConfig(), {"batch_size": 4, "peak_rate": 1e-4, "noise": 0.003, "stress_weight": 0.01}, adapts=True
    ),
    # As its authors train it, but for their schedule, 0.1^(step / 1e6).
    "original": Preset(
        HCMTConfig(contacts="obstacles"),
        {"steps": 2_000_000, "batch_size": 1, "peak_rate": 1e-4, "warmup": 0, "noise": 0.003, "stress_weight": 1.0},
        adapts=True,
    ),
}

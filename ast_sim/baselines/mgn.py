"""MeshGraphNets (Pfaff et al. 2021, arXiv 2010.03409): encode, process by message passing on two edge sets, decode.

A block, with LN an MLP that ends in a LayerNorm:

    e'_ij = LN_M(e_ij, v_i, v_j),    w'_ij = LN_W(w_ij, v_i, v_j),    v'_j = LN_V(v_j, sum_i e'_ij, sum_i w'_ij)

and e, w and v grow by what was found.

Legend: N nodes, M edges of a set.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from ast_sim.baselines.common import Decoder, DeepMLP, WorldEdgeConfig, WorldEdgeSimulator, messages
from ast_sim.data.batch import Batch
from ast_sim.model.config import Preset, setting
from ast_sim.model.simulator import Prediction
from ast_sim.ops.edges import EdgeSet


@dataclass(frozen=True)
class MGNConfig(WorldEdgeConfig):
    """The settings of MeshGraphNets."""

    name: Literal["mgn"] = setting("mgn", "MeshGraphNets")
    blocks: int = setting(15, "message-passing blocks, none of which share weights")


class EdgeUpdate(nn.Module):
    """New latents of the edges of one set and their sums at the receivers."""

    def __init__(self, hidden: int, layers: int):
        super().__init__()
        self.update = DeepMLP(3 * hidden, hidden, hidden, layers)

    def forward(self, edges: EdgeSet, latents: Tensor, nodes: Tensor) -> tuple[Tensor, Tensor]:
        """latents [M, hidden], nodes [N, hidden] -> latents with what was found, and its sums [N, hidden]."""
        total, found = messages(self.update, edges, latents, nodes)
        return latents + found, total


class Block(nn.Module):
    """One step on both edge sets."""

    def __init__(self, hidden: int, layers: int):
        super().__init__()
        self.mesh, self.world = EdgeUpdate(hidden, layers), EdgeUpdate(hidden, layers)
        self.node = DeepMLP(3 * hidden, hidden, hidden, layers)

    def forward(
        self, nodes: Tensor, mesh: tuple[EdgeSet, Tensor], world: tuple[EdgeSet, Tensor]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Nodes [N, hidden] and the latents of both sets, after the step."""
        on_mesh, mesh_sum = self.mesh(*mesh, nodes)
        on_world, world_sum = self.world(*world, nodes)
        return self.node(torch.cat([nodes, mesh_sum, world_sum], dim=1), residual=nodes), on_mesh, on_world


class MGN(WorldEdgeSimulator):
    """MeshGraphNets."""

    config: MGNConfig

    def __init__(self, config: MGNConfig):
        super().__init__(config)
        width, layers = config.hidden, config.hidden_layers
        self.node_encoder = DeepMLP(self.node_inputs.width, width, width, layers)
        self.mesh_encoder = DeepMLP(self.mesh_inputs.width, width, width, layers)
        self.world_encoder = DeepMLP(self.world_inputs.width, width, width, layers)
        self.blocks = nn.ModuleList(Block(width, layers) for _ in range(config.blocks))
        self.decoder = Decoder(config)

    def forward(self, batch: Batch) -> Prediction:
        """Normalised outputs for the frame after `batch`."""
        mesh, world = batch.graph.m2m, self.world(batch)
        nodes = self.node_encoder(self.nodes(batch))
        on_mesh = self.mesh_encoder(self.mesh_edges(batch))
        on_world = self.world_encoder(self.world_edges(batch, world))
        for block in self.blocks:
            nodes, on_mesh, on_world = block(nodes, (mesh, on_mesh), (world, on_world))
        return self.decoder(nodes, batch)


PRESETS = {
    # A size that two cores train in minutes.
    "tiny": Preset(
        MGNConfig(hidden=64, hidden_layers=1, blocks=8),
        {"batch_size": 4, "optimizer": "muon", "peak_rate": 4e-3, "stress_weight": 0.1, "rollout_pool": None},
        adapts=True,
    ),
    # As the AST paper trains it (sections "Batch Size and Learning Rate", "Baselines").
    "paper": Preset(
        MGNConfig(), {"batch_size": 48, "peak_rate": 1e-4, "noise": 0.003, "stress_weight": 0.01}, adapts=True
    ),
    # As its authors train it, but for their schedule: 0.1^(step / 5e6) over 1e7 steps.
    "original": Preset(
        MGNConfig(),
        {"steps": 10_000_000, "batch_size": 2, "peak_rate": 1e-4, "warmup": 0, "noise": 0.003, "stress_weight": 1.0},
        adapts=True,
    ),
}

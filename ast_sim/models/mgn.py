"""MeshGraphNets (Pfaff et al. 2021, arXiv 2010.03409): encoders, message passing along two sets of edges, decoder.

A block, with LN an MLP that ends in a LayerNorm:

    e'_ij = LN_M(e_ij, v_i, v_j),    w'_ij = LN_W(w_ij, v_i, v_j),    v'_j = LN_V(v_j, sum_i e'_ij, sum_i w'_ij)

Then e', w' and v' are added to e, w and v.

Legend: N nodes, M edges of a set.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from ast_sim.batches.batch_builder import Batch
from ast_sim.models.model_config import PAPER_TRAINING, Preset, count, setting, tiny
from ast_sim.models.registry import Model
from ast_sim.models.simulator import Prediction
from ast_sim.models.world_edge_model import Decoder, DeepMLP, Edges, WorldEdgeConfig, WorldEdgeSimulator, messages
from ast_sim.ops import EdgeSet


@dataclass(frozen=True)
class MGNConfig(WorldEdgeConfig):
    """The settings of MeshGraphNets."""

    name: Literal["mgn"] = setting("mgn", "MeshGraphNets")
    blocks: int = count(15, "message-passing blocks, each with its own weights")


class EdgeUpdate(nn.Module):
    """New latents of the edges of one set, and the sums of their messages at the receivers."""

    def __init__(self, config: MGNConfig):
        super().__init__()
        self.update = DeepMLP(config, 3 * config.hidden)

    def forward(self, edges: EdgeSet, latents: Tensor, nodes: Tensor) -> tuple[Tensor, Tensor]:
        """latents [M, hidden], nodes [N, hidden] -> latents plus messages, and sums of the messages [N, hidden]."""
        total, sent = messages(self.update, edges, latents, nodes)
        return latents + sent, total


class GraphNetBlock(nn.Module):
    """One step on both edge sets."""

    def __init__(self, config: MGNConfig):
        super().__init__()
        self.mesh = EdgeUpdate(config)
        self.world = EdgeUpdate(config)
        self.node = DeepMLP(config, 3 * config.hidden)

    def forward(self, nodes: Tensor, mesh: Edges, world: Edges) -> tuple[Tensor, Tensor, Tensor]:
        """The nodes [N, hidden] and the latents [M, hidden] of both sets after the step."""
        on_mesh, mesh_sum = self.mesh(*mesh, nodes)
        on_world, world_sum = self.world(*world, nodes)
        return self.node(torch.cat([nodes, mesh_sum, world_sum], dim=1), residual=nodes), on_mesh, on_world


class MGN(WorldEdgeSimulator[MGNConfig]):
    """MeshGraphNets."""

    def __init__(self, config: MGNConfig):
        super().__init__(config)
        self.node_encoder, self.mesh_encoder, self.world_encoder = self.encoders()
        self.blocks = nn.ModuleList(GraphNetBlock(config) for _ in range(config.blocks))
        self.decoder = Decoder(config)

    def forward(self, batch: Batch) -> Prediction:
        """Normalised outputs for the frame after `batch`."""
        nodes, [(mesh, on_mesh)], [(world, on_world)] = self.inputs_of(batch)
        nodes, on_mesh, on_world = self.node_encoder(nodes), self.mesh_encoder(on_mesh), self.world_encoder(on_world)
        for block in self.blocks:
            nodes, on_mesh, on_world = block(nodes, (mesh, on_mesh), (world, on_world))
        return self.decoder(nodes, batch)


PRESETS = {
    "tiny": tiny(MGNConfig(hidden=64, hidden_layers=1, blocks=8), peak_rate=4e-3, batch_size=4),
    # As the AST paper trains it (sections "Batch Size and Learning Rate", "Baselines").
    "paper": Preset(MGNConfig(), PAPER_TRAINING),
    # As its authors train it, except for their schedule: 0.1^(step / 5e6) over 1e7 steps.
    "original": Preset(
        MGNConfig(),
        {"steps": 10_000_000, "batch_size": 2, "peak_rate": 1e-4, "warmup": 0, "noise": 0.003, "stress_weight": 1.0},
    ),
}

MODEL = Model(MGNConfig, MGN, PRESETS)

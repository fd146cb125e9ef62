"""What the models with world edges share: settings, inputs, the MLP of MeshGraphNets and the outputs.

Legend: N nodes, E elements, M mesh edges, W world edges.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor, nn

from ast_sim.baselines.world_edges import world_edges
from ast_sim.data.batch import Batch
from ast_sim.data.file import DatasetInfo
from ast_sim.data.graph import edge_vectors
from ast_sim.errors import ConfigError
from ast_sim.model.config import ModelConfig, setting
from ast_sim.model.features import beside_rest, node_features, normalizer_of
from ast_sim.model.mlp import MLP, layer
from ast_sim.model.normalizer import FeatureNormalizer
from ast_sim.model.simulator import Prediction, Simulator
from ast_sim.ops.edges import EdgeSet
from ast_sim.ops.linear import linear
from ast_sim.ops.message import message_edges
from ast_sim.ops.mlp import mlp
from ast_sim.ops.segment import segment_sum


@dataclass(frozen=True)
class WorldEdgeConfig(ModelConfig):
    """Settings of a model with world edges. On moving meshes nodes have a velocity, and no state elsewhere."""

    node_inputs: tuple[str, ...] = setting((), "node features: displacement, velocity, material, proximity")
    hidden: int = setting(128, "width of node and edge features")
    hidden_layers: int = setting(2, "hidden layers of each MLP: 2, or 1, where message passing is one fused op")
    edge_strain: bool = setting(
        False, "mesh edge features as differences to rest, [dp0, |dp0|, dp - dp0, |dp| - |dp0|]"
    )
    world_radius: float | None = setting(None, "length of world edges at most; unset: the dataset's contact radius")
    most_world_edges: int | None = setting(None, "world edges of a scene at most, the shortest; unset: all")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.hidden_layers not in (1, 2):
            raise ConfigError(f"model.hidden_layers is {self.hidden_layers}; it must be 1 or 2")

    def resolve(self, info: DatasetInfo, material_width: int, mesh_spacing: float) -> Self:
        """See `ModelConfig`."""
        resolved = super().resolve(info, material_width, mesh_spacing)
        radius = float(info.contact_radius) if self.world_radius is None else self.world_radius
        return replace(resolved, world_radius=radius)

    def facts(self, length_unit: str, mesh_spacing: float | None = None) -> dict[str, str]:
        """See `ModelConfig`."""
        share = f" = {self.world_radius / mesh_spacing:.2g} x mesh spacing" if mesh_spacing else ""
        return {"World": f"edges up to {self.world_radius:.3g} {length_unit}{share}"}


class WorldEdgeSimulator(Simulator):
    """A model on mesh edges and world edges, with the inputs of MeshGraphNets (section A.1).

    Nodes: type, what `node_inputs` names, motion of the boundary. Mesh edges [M, 8]: differences of the rest positions
    and of the positions, each with its length. World edges [W, 4]: differences of the positions, with their length.
    """

    config: WorldEdgeConfig

    def __init__(self, config: WorldEdgeConfig):
        super().__init__(config)
        self.node_inputs = normalizer_of(config, "node")
        self.mesh_inputs, self.world_inputs = normalizer_of(config, "edge"), world_normalizer()

    def world(self, batch: Batch) -> EdgeSet:
        """The world edges of a batch."""
        return world_edges(batch, self.config.world_radius, self.config.most_world_edges)

    def observe(self, batch: Batch) -> None:
        """Add the batch to the statistics of the inputs."""
        self.node_inputs.observe(node_features(self.config, batch))
        self.mesh_inputs.observe(self.edge_features(batch.graph.m2m, batch.graph.rest_edges, batch.position))
        self.world_inputs.observe(edge_vectors(self.world(batch), batch.position, batch.position))

    def edge_features(self, edges: EdgeSet, rest_edges: Tensor, position: Tensor) -> Tensor:
        """[M, 8]: [dp0, |dp0|, dp, |dp|] with d = sender - receiver, of a mesh with `rest_edges` [M, 4] at `position`;
        with `edge_strain` dp and |dp| less those at rest."""
        return beside_rest(rest_edges, edge_vectors(edges, position, position), self.config.edge_strain)

    def nodes(self, batch: Batch) -> Tensor:
        """Normalised inputs of the nodes, [N, *]."""
        return self.node_inputs(node_features(self.config, batch))

    def mesh_edges(self, batch: Batch) -> Tensor:
        """Normalised inputs of the mesh edges, [M, 8]."""
        return self.mesh_inputs(self.edge_features(batch.graph.m2m, batch.graph.rest_edges, batch.position))

    def world_edges(self, batch: Batch, world: EdgeSet) -> Tensor:
        """Normalised inputs of the world edges, [W, 4]."""
        return self.world_inputs(edge_vectors(world, batch.position, batch.position))


def world_normalizer() -> FeatureNormalizer:
    """For a difference of positions with its length."""
    return FeatureNormalizer([("vector", 3), ("scalar", 1)])


class DeepMLP(nn.Module):
    """Hidden layers with ReLU and a linear one (MeshGraphNets, section A.1), then LayerNorm unless it decodes.

    Args:
        inputs, hidden, outputs: widths.
        layers: hidden layers, 1 or 2.
        norm: whether it ends in a LayerNorm.
    """

    def __init__(self, inputs: int, hidden: int, outputs: int, layers: int, norm: bool = True):
        super().__init__()
        self.first = layer(inputs, hidden, factorized=False)
        rest = MLP(hidden, hidden, outputs, factorized=False)
        self.rest = rest if layers == 2 else layer(hidden, outputs, factorized=False)
        self.norm = nn.LayerNorm(outputs) if norm else None

    def forward(self, x: Tensor, residual: Tensor | None = None) -> Tensor:
        """x [*, inputs] -> [*, outputs], plus the residual."""
        weights = (self.first.weight, self.first.bias)
        if isinstance(self.rest, MLP):
            return self.rest(linear(x, *weights, "relu"), norm=self.norm, residual=residual)
        norm = None if self.norm is None else (self.norm.weight, self.norm.bias)
        return mlp(x, *weights, self.rest.weight, self.rest.bias, None, norm, residual)


def messages(edge_mlp: DeepMLP, edges: EdgeSet, features: Tensor, nodes: Tensor) -> tuple[Tensor, Tensor]:
    """The MLP of [edge, sender, receiver] on every edge of a set: its sums at the receivers [N, hidden], in stored
    order, and itself [M, hidden], from features [M, *] and nodes [N, hidden].

    The first layer acts on its inputs separately, so that of the nodes is applied to nodes, not to edges.
    """
    width = nodes.shape[1]
    of_edge, of_sender, of_receiver = edge_mlp.first.weight.split([features.shape[1], width, width], dim=1)
    of_senders, of_receivers = linear(nodes, of_sender), linear(nodes, of_receiver, edge_mlp.first.bias)
    rest, norm = edge_mlp.rest, edge_mlp.norm
    if not isinstance(rest, MLP):
        weights = (rest.weight, rest.bias, norm.weight, norm.bias)
        return message_edges(edges, of_senders, of_receivers, linear(features, of_edge), None, *weights)
    of_nodes = of_senders.index_select(0, edges.senders) + of_receivers.index_select(0, edges.receivers)
    found = rest(torch.relu(linear(features, of_edge, residual=of_nodes)), norm=norm)
    return segment_sum(found, *edges.by_receiver), found


class Decoder(nn.Module):
    """Node features [N, hidden] -> motion, and stress where the data has it: of the nodes, or of the elements from the
    mean over their nodes."""

    def __init__(self, config: WorldEdgeConfig):
        super().__init__()
        self.stress = config.stress
        width, layers = config.hidden, config.hidden_layers
        self.of_nodes = DeepMLP(width, width, 4 if config.stress == "node" else 3, layers, norm=False)
        if config.stress == "element":
            self.of_elements = DeepMLP(width, width, 1, layers, norm=False)

    def forward(self, nodes: Tensor, batch: Batch) -> Prediction:
        out = self.of_nodes(nodes)
        stress = out[:, 3:] if self.stress == "node" else None
        if self.stress == "element":
            stress = self.of_elements(batch.graph.element_mean(nodes))
        return Prediction(out[:, :3], stress)

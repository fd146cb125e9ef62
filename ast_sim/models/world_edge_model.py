"""What the models with world edges share: settings, inputs, the MLP of MeshGraphNets, messages and outputs.

Legend: N nodes, E elements, M mesh edges, W world edges.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, Self, TypeVar

import torch
from torch import Tensor, nn

from ast_sim.batches.batch_builder import Batch
from ast_sim.batches.graph import edge_vectors
from ast_sim.models.bistride import Hierarchy
from ast_sim.models.data_facts import DataFacts
from ast_sim.models.layers import MLP, Norm, layer
from ast_sim.models.model_config import ModelConfig, count, setting
from ast_sim.models.node_inputs import edge_features, node_features, normalizer_of
from ast_sim.models.normalizer import Normalizer
from ast_sim.models.simulator import Latent, Prediction, Simulator, Use
from ast_sim.models.world_edges import world_edges
from ast_sim.ops import EdgeSet, linear, message_edges, mlp, segment_sum
from ast_sim.support.toml_settings import known

Edges = tuple[EdgeSet, Tensor]  # with the features of each edge

SEEN = 0.5  # a contact radius below this share of the mesh spacing joins hardly any nodes


@dataclass(frozen=True)
class WorldEdgeConfig(ModelConfig):
    """Settings of a model with world edges."""

    hidden: int = count(128, "width of node and edge features")
    hidden_layers: int = setting(2, "hidden layers of each MLP: 1 or 2; with 1 message passing is one fused op", 1, 2)
    edge_strain: bool = setting(False, "mesh edges have dp - dp0 and |dp| - |dp0| as inputs, not dp and |dp|")
    world_radius: float | None = setting(
        None,
        "largest length of a world edge; unset: the dataset's contact radius, or the mesh spacing if that radius is"
        " below half of it, since edges so short would join no nodes",
        least=0,
    )
    most_world_edges: int | None = setting(None, "join at most this many pairs of a scene, the shortest; unset: all", 0)

    def resolve(self, facts: DataFacts) -> Self:
        """See `ModelConfig`."""
        resolved = super().resolve(facts)
        if self.world_radius is not None:
            return resolved
        seen = resolved.data.contact_radius >= SEEN * facts.mesh_spacing
        return replace(resolved, world_radius=resolved.data.contact_radius if seen else facts.mesh_spacing)

    def facts(self, length_unit: str, mesh_spacing: float | None = None) -> dict[str, str]:
        """See `ModelConfig`."""
        radius = known(self.world_radius)
        share = f" = {radius / mesh_spacing:.2g} x mesh spacing" if mesh_spacing else ""
        return {"World": f"edges up to {radius:.3g} {length_unit}{share}"}


Config = TypeVar("Config", bound=WorldEdgeConfig)


class WorldEdgeSimulator(Simulator, Generic[Config]):
    """A model with mesh edges and world edges, and with the inputs of MeshGraphNets (section A.1).

    Nodes have their type, `node_inputs` and the boundary motion. Mesh edges [M, 8] have the differences of the rest
    positions and of the positions, each with its length. World edges [W, 4] have the difference of the positions and
    its length. If the graph's `own` is a `Hierarchy`, all its meshes have mesh edges.
    """

    config: Config

    def __init__(self, config: Config):
        super().__init__(config)
        self.node_inputs, self.mesh_inputs, self.world_inputs = (
            normalizer_of(config, what) for what in ("node", "edge", "world_edge")
        )
        self._scenes = self._world_edges = 0  # in the observed batches

    def encoders(self) -> list[DeepMLP]:
        """New encoders of the nodes, the mesh edges and the world edges."""
        inputs = (self.node_inputs, self.mesh_inputs, self.world_inputs)
        return [DeepMLP(self.config, normalizer.width) for normalizer in inputs]

    def world(self, batch: Batch) -> EdgeSet:
        """The world edges of a batch."""
        return world_edges(batch, known(self.config.world_radius), self.config.most_world_edges)

    def contacts(self, batch: Batch) -> list[EdgeSet]:
        """The world edges of each mesh that has some, the finest first."""
        return [self.world(batch)]

    def inputs_of(self, batch: Batch, use: Use = Normalizer.__call__) -> tuple[Tensor, list[Edges], list[Edges]]:
        """See `Simulator`: of the nodes, and the mesh edges and world edges of each mesh, the finest first."""
        graph = batch.graph
        now = batch.position
        own = graph.own
        meshes = own.meshes(now) if isinstance(own, Hierarchy) else [(graph.edges, graph.rest_edges, now)]
        on_mesh, on_world = [], []
        for level, (edges, rest, position) in enumerate(meshes):
            features = edge_features(edges, rest, position, position, self.config.edge_strain)
            on_mesh.append((edges, use(_of_level(self.mesh_inputs, level), features)))
        for level, edges in enumerate(self.contacts(batch)):
            position = meshes[level][2]
            features = edge_vectors(edges, position, position)
            on_world.append((edges, use(_of_level(self.world_inputs, level), features)))
        return use(self.node_inputs, node_features(self.config, batch)), on_mesh, on_world

    def observe(self, batch: Batch) -> None:
        """See `Simulator`. Counts the world edges, too."""
        _, _, on_world = self.inputs_of(batch, Normalizer.observe)
        self._scenes += batch.graph.num_scenes
        self._world_edges += len(on_world[0][0])

    def remarks(self) -> list[str]:
        """See `Simulator`: how many world edges a scene has."""
        if self._world_edges:
            mean = self._world_edges / self._scenes
            return [f"world edges {mean:.3g} a scene, on average over {self._scenes} scenes"]
        return [
            f"warning: no node has a world edge of at most {self.config.world_radius:.3g} in {self._scenes} scenes, so"
            " the model sees no contact: give it a larger model.world_radius"
        ]


def _of_level(normalizers: nn.Module, level: int) -> Normalizer:
    """A model has a normalizer for each mesh, or one for all."""
    normalizer = normalizers[level] if isinstance(normalizers, nn.ModuleList) else normalizers
    assert isinstance(normalizer, Normalizer)
    return normalizer


class DeepMLP(nn.Module):
    """Hidden layers with ReLU and a linear layer (MeshGraphNets, section A.1), then a LayerNorm unless it decodes.

    Args:
        config: its `hidden` and `hidden_layers`.
        inputs: width of the inputs.
        outputs: of a decoder; None: `hidden` outputs and a LayerNorm.
        norm: makes the LayerNorm.
    """

    def __init__(
        self,
        config: WorldEdgeConfig,
        inputs: int,
        outputs: int | None = None,
        norm: Callable[[int], Norm] = nn.LayerNorm,
    ):
        super().__init__()
        hidden = config.hidden
        width = outputs or hidden
        self.first = layer(inputs, hidden)
        rest = MLP(hidden, hidden, width)
        self.rest = rest if config.hidden_layers == 2 else layer(hidden, width)
        self.norm = norm(width) if outputs is None else None

    def forward(self, x: Tensor, residual: Tensor | None = None) -> Tensor:
        """x [*, inputs] -> [*, outputs], plus the residual."""
        weights = (self.first.weight, self.first.bias)
        if isinstance(self.rest, MLP):
            return self.rest(linear(x, *weights, "relu"), norm=self.norm, residual=residual)
        norm = None if self.norm is None else (self.norm.weight, self.norm.bias)
        return mlp(x, *weights, self.rest.weight, self.rest.bias, None, norm, residual)


def messages(edge_mlp: DeepMLP, edges: EdgeSet, features: Tensor, nodes: Tensor) -> tuple[Tensor, Tensor]:
    """Messages along the edges of a set: an MLP of [edge, sender, receiver] for each edge.

    The first layer acts on the three inputs separately, so its products with nodes are computed once for each node.

    Args:
        features: [M, *], of the edges.
        nodes: [N, hidden].

    Returns:
        The sums of the messages at the receivers [N, hidden], in stored order, and the messages [M, hidden].
    """
    width = nodes.shape[1]
    of_edge, of_sender, of_receiver = edge_mlp.first.weight.split([features.shape[1], width, width], dim=1)
    of_senders, of_receivers = linear(nodes, of_sender), linear(nodes, of_receiver, edge_mlp.first.bias)
    rest = edge_mlp.rest
    norm = edge_mlp.norm
    if not isinstance(rest, MLP):
        assert norm is not None  # it does not decode
        weights = (rest.weight, rest.bias, norm.weight, norm.bias)
        return message_edges(edges, of_senders, of_receivers, linear(features, of_edge), None, *weights)
    of_nodes = of_senders.index_select(0, edges.senders) + of_receivers.index_select(0, edges.receivers)
    sent = rest(torch.relu(linear(features, of_edge, residual=of_nodes)), norm=norm)
    return segment_sum(sent, *edges.by_receiver), sent


class Decoder(nn.Module):
    """Node features [N, hidden] -> motion, stress and named fields. What is predicted on an element follows from the
    mean of its nodes' features."""

    def __init__(self, config: WorldEdgeConfig):
        super().__init__()
        self.data = config.data
        self.of_nodes = DeepMLP(config, config.hidden, 3 + config.data.output_columns("node"))
        on_elements = config.data.output_columns("element")
        self.of_elements = DeepMLP(config, config.hidden, on_elements) if on_elements else None

    def forward(self, nodes: Tensor, batch: Batch) -> Prediction:
        of_elements = self.of_elements if batch.wants_elements else None
        on_elements = None if of_elements is None else of_elements(batch.graph.element_mean(nodes))
        latent = Latent(nodes, batch.graph.node_offsets)
        return Prediction.of(self.data, self.of_nodes(nodes), on_elements, latent)

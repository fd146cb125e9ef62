"""The input features of nodes, elements and edges (paper, table "Input and output features").

Legend: N nodes, E elements, M edges.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ast_sim.batches.batch_builder import Batch
from ast_sim.batches.graph import edge_vectors
from ast_sim.models.model_config import ModelConfig
from ast_sim.models.normalizer import FeatureNormalizer, Kind
from ast_sim.ops import PROXIMITY_WIDTH, EdgeSet, proximity
from ast_sim.scene import NodeType


def _states(names: tuple[str, ...], batch: Batch) -> list[Tensor]:
    """Displacement and velocity of the nodes, if they are among `names`."""
    values = []
    if "displacement" in names:
        values.append(batch.position - batch.graph.rest_position)
    if "velocity" in names:
        values.append(batch.position - batch.previous_position)
    return values


def node_features(config: ModelConfig, batch: Batch) -> Tensor:
    """[N, *]: node type (one-hot), displacement and velocity, material, proximity, forces out of balance, the
    displacement from the source and what is known there, and boundary motion, as far as they are inputs.
    docs/reference/model.md explains them."""
    values = [batch.graph.one_hot, *_states(config.node_inputs, batch)]
    if "material" in config.node_inputs:
        values.append(batch.graph.node_material)
    if "proximity" in config.node_inputs:
        values.append(_proximity(batch, config.proximity_radius) if batch.proximity is None else batch.proximity)
    if "out_of_balance" in config.node_inputs:
        values.append(batch.graph.elasticity.out_of_balance(batch.position, batch.graph.rest_position))
    if "history" in config.node_inputs:
        values += [batch.position - batch.source, batch.history]
    if config.boundary_motion:
        values.append(batch.boundary_motion)
    return torch.cat(values, dim=1)


def with_proximity(config: ModelConfig, batch: Batch) -> Batch:
    """The batch with its `proximity`, if that is an input."""
    if "proximity" not in config.node_inputs:
        return batch
    return replace(batch, proximity=_proximity(batch, config.proximity_radius))


def _proximity(batch: Batch, radius: float) -> Tensor:
    """[N, 5]: `proximity` with the prescribed nodes at their next positions and the others at their current ones. So
    it tells whether contact begins in the next frame."""
    graph, motion = batch.graph, batch.boundary_motion
    offsets, surface_offsets = graph.node_offsets, graph.surface_offsets
    return proximity(batch.position, motion, offsets, graph.body, graph.surface, surface_offsets, radius)


def element_features(config: ModelConfig, batch: Batch) -> Tensor:
    """[E, *]: displacement and velocity (means of the element's nodes), material and stress, if they are inputs."""
    values = [batch.graph.element_mean(value) for value in _states(config.element_inputs, batch)]
    if "material" in config.element_inputs:
        values.append(batch.graph.material)
    if "stress" in config.element_inputs:
        values.append(batch.stress)
    return torch.cat(values, dim=1)


def edge_features(config: ModelConfig, edges: EdgeSet, rest: Tensor, senders: Tensor, receivers: Tensor) -> Tensor:
    """[M, 8]: [dp0, |dp0|, dp, |dp|] from the edges at `rest` [M, 4] and the positions of senders and receivers now,
    d = sender - receiver. With `edge_strain` dp and |dp| are relative to rest, and so have the scale of strains."""
    now = edge_vectors(edges, senders, receivers)
    return torch.cat([rest, now - rest if config.edge_strain else now], dim=1)


def normalizer_of(config: ModelConfig, what: str) -> FeatureNormalizer:
    """The normalizer of the "node", "element", "edge" or "world_edge" features."""
    vector, scalar = ("vector", 3), ("scalar", 1)
    if what in ("edge", "world_edge"):
        return FeatureNormalizer([vector, scalar] * (2 if what == "edge" else 1))
    # Where metal yields, each column of the material has a scale of its own, or the yield stress would drown in Young's
    # modulus. The columns of elastic materials share one.
    material = ("scalar", config.data.material_width)
    known: dict[str, list[tuple[Kind | None, int]]] = {  # in the order of the columns
        "displacement": [vector],
        "velocity": [vector],
        "material": [material] if config.history is None else [scalar] * config.data.material_width,
        "stress": [scalar],
        "proximity": [(None, PROXIMITY_WIDTH)],
        "out_of_balance": [(None, 3)],
        "history": [vector, *[scalar] * sum(output.columns for output in config.history or ())],
    }
    inputs = config.node_inputs if what == "node" else config.element_inputs
    kinds = [kind for name, kinds in known.items() if name in inputs for kind in kinds]
    if what == "node":
        kinds = [(None, len(NodeType)), *kinds]
        kinds += [vector] * config.boundary_motion
    return FeatureNormalizer(kinds)

"""The input features of nodes, elements and edges (paper, table "Input and output features").

Legend: N nodes, E elements, M edges.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor

from ast_sim.batches.batch_builder import Batch
from ast_sim.batches.graph import edge_vectors
from ast_sim.models.model_config import ModelConfig
from ast_sim.models.normalizer import Columns, FeatureNormalizer
from ast_sim.ops import PROXIMITY_WIDTH, EdgeSet, proximity
from ast_sim.scene import NodeType
from ast_sim.support.errors import ConfigError, nearest_name
from ast_sim.support.toml_settings import known

VECTOR: Columns = ("vector", 3)
SCALAR: Columns = ("scalar", 1)


def _states(names: tuple[str, ...], batch: Batch) -> list[Tensor]:
    """Displacement and velocity of the nodes, if they are among `names`."""
    values = []
    if "displacement" in names:
        values.append(batch.position - batch.graph.rest_position)
    if "velocity" in names:
        values.append(batch.position - known(batch.previous_position))
    return values


def node_features(config: ModelConfig, batch: Batch) -> Tensor:
    """[N, *]: node type (one-hot), displacement and velocity, material, proximity, forces out of balance, the
    displacement from the source and what is known there, and boundary motion, as far as they are inputs.
    docs/reference/model.md explains them."""
    graph = batch.graph
    inputs = known(config.node_inputs)
    values = [graph.one_hot, *_states(inputs, batch)]
    if "material" in inputs:
        values.append(known(graph.node_material))
    if "proximity" in inputs:
        ahead = batch.proximity
        values.append(_proximity(batch, known(config.proximity_radius)) if ahead is None else ahead)
    if "out_of_balance" in inputs:
        values.append(known(graph.elasticity).out_of_balance(batch.position, graph.rest_position))
    if "history" in inputs:
        values += [batch.position - known(batch.source), known(batch.history)]
    if config.boundary_motion:
        values.append(batch.boundary_motion)
    return torch.cat(values, dim=1)


def with_proximity(config: ModelConfig, batch: Batch) -> Batch:
    """The batch with its `proximity`, if that is an input."""
    if "proximity" not in known(config.node_inputs):
        return batch
    return replace(batch, proximity=_proximity(batch, known(config.proximity_radius)))


def _proximity(batch: Batch, radius: float) -> Tensor:
    """[N, 5]: `proximity` with the prescribed nodes at their next positions and the others at their current ones. So
    it tells whether contact begins in the next frame."""
    graph = batch.graph
    motion = batch.boundary_motion
    surface, surface_offsets = known(graph.surface), known(graph.surface_offsets)
    return proximity(batch.position, motion, graph.node_offsets, graph.body, surface, surface_offsets, radius)


def element_features(inputs: tuple[str, ...], batch: Batch) -> Tensor:
    """[E, *]: displacement and velocity (means of the element's nodes), material and stress, if they are `inputs`."""
    values = [batch.graph.element_mean(value) for value in _states(inputs, batch)]
    if "material" in inputs:
        values.append(known(batch.graph.material))
    if "stress" in inputs:
        values.append(known(batch.stress))
    return torch.cat(values, dim=1)


def edge_features(edges: EdgeSet, rest: Tensor, senders: Tensor, receivers: Tensor, strain: bool) -> Tensor:
    """[M, 8]: [dp0, |dp0|, dp, |dp|] from the edges at `rest` [M, 4] and the positions of senders and receivers now,
    d = sender - receiver. With `strain` dp and |dp| are relative to rest, and so have the scale of strains."""
    now = edge_vectors(edges, senders, receivers)
    return torch.cat([rest, now - rest if strain else now], dim=1)


def normalizer_of(config: ModelConfig, what: Literal["node", "edge", "world_edge"]) -> FeatureNormalizer:
    """The normalizer of the features of nodes, edges or world edges."""
    distances = {"edge": 2, "world_edge": 1}  # at rest and now, or now
    if what in distances:
        return FeatureNormalizer([VECTOR, SCALAR] * distances[what])
    if what != "node":
        raise ConfigError(f"there are no features of {what!r}{nearest_name(what, ('node', *distances))}")
    motion = [VECTOR] if config.boundary_motion else []
    return FeatureNormalizer([(None, len(NodeType)), *_columns(config, known(config.node_inputs)), *motion])


def element_normalizer(config: ModelConfig, inputs: tuple[str, ...]) -> FeatureNormalizer:
    """The normalizer of `element_features`."""
    return FeatureNormalizer(_columns(config, inputs))


def _columns(config: ModelConfig, inputs: tuple[str, ...]) -> list[Columns]:
    """The columns of these inputs, in the order of the features."""
    # Where metal yields, each column of the material has a scale of its own, or the yield stress would drown in Young's
    # modulus. The columns of elastic materials share one.
    width = config.data.material_width
    of_inputs: dict[str, list[Columns]] = {
        "displacement": [VECTOR],
        "velocity": [VECTOR],
        "material": [("scalar", width)] if config.history is None else [SCALAR] * width,
        "stress": [SCALAR],
        "proximity": [(None, PROXIMITY_WIDTH)],
        "out_of_balance": [(None, 3)],
        "history": [VECTOR, *[SCALAR] * sum(output.columns for output in config.history or ())],
    }
    return [one for name, columns in of_inputs.items() if name in inputs for one in columns]

"""The input features of nodes, elements and edges (paper, table "Input and output features").

Legend: N nodes, E elements, M edges, B scenes.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ast_sim.data.batch import Batch
from ast_sim.data.graph import edge_vectors
from ast_sim.data.scene import NodeType
from ast_sim.model.ast_config import ASTConfig
from ast_sim.model.config import ModelConfig
from ast_sim.model.normalizer import FeatureNormalizer, Kind
from ast_sim.model.proximity import WIDTH as PROXIMITY_WIDTH
from ast_sim.model.proximity import proximity

_STATES = ("displacement", "velocity")


def present(config: ModelConfig, batch: Batch) -> Tensor:
    """[N, 3] where a model takes the nodes to be: at p_t; time-conditioned, the prescribed ones where they will be in
    the frame to predict, the others still in the first."""
    return batch.position + batch.boundary_motion if config.time_conditioned else batch.position


def _state(config: ModelConfig, names: tuple[str, ...], batch: Batch) -> list[Tensor]:
    """Displacement and velocity of the nodes, those asked for."""
    values = []
    if "displacement" in names:
        values.append(present(config, batch) - batch.graph.rest_position)
    if "velocity" in names:
        values.append(batch.position - batch.previous_position)
    return values


def node_features(config: ModelConfig, batch: Batch) -> Tensor:
    """[N, *]: node type (one-hot), state, material, proximity and the boundary channels of model.md; time-conditioned,
    the number of the frame."""
    values = [batch.graph.one_hot, *_state(config, config.node_inputs, batch)]
    if "material" in config.node_inputs:
        values.append(batch.graph.node_material)
    if "proximity" in config.node_inputs:
        values.append(proximity(batch, config.proximity_radius))
    if config.boundary_motion:
        values.append(batch.boundary_motion)
    if config.time_conditioned:
        values.append(batch.frame.repeat_interleave(batch.graph.node_offsets.diff())[:, None])
    return torch.cat(values, dim=1)


def element_features(config: ASTConfig, batch: Batch) -> Tensor:
    """[E, *]: the mean state of the nodes of each element, material and stress."""
    values = [batch.graph.element_mean(value) for value in _state(config, config.element_inputs, batch)]
    if "material" in config.element_inputs:
        values.append(batch.graph.material)
    if "stress" in config.element_inputs:
        values.append(batch.stress)
    return torch.cat(values, dim=1)


def edge_features(config: ASTConfig, batch: Batch) -> Tensor:
    """[M, 8]: [dp0, |dp0|, dp, |dp|] with d = sender - receiver; with `edge_strain` dp and |dp| less those at rest."""
    graph, now = batch.graph, present(config, batch)
    senders = graph.element_mean(now) if graph.e2m is not None else now
    vectors = edge_vectors(graph.edges, senders, now)
    return beside_rest(graph.rest_edges, vectors, config.edge_strain)


def beside_rest(rest: Tensor, vectors: Tensor, strain: bool) -> Tensor:
    """[M, 8]: edges at rest [M, 4] and those of now [M, 4]; with `strain` their change, at the scale of strains."""
    return torch.cat([rest, vectors - rest if strain else vectors], dim=1)


def normalizer_of(config: ModelConfig, what: str) -> FeatureNormalizer:
    """For the "node", "element" or "edge" features."""
    if what == "edge":
        return FeatureNormalizer([("vector", 3), ("scalar", 1), ("vector", 3), ("scalar", 1)])
    inputs = config.node_inputs if what == "node" else config.element_inputs
    kinds: list[tuple[Kind | None, int]] = [(None, len(NodeType))] if what == "node" else []
    kinds += [("vector", 3) for name in _STATES if name in inputs]
    if "material" in inputs:
        kinds.append(("scalar", config.material_width))
    if "stress" in inputs:
        kinds.append(("scalar", 1))
    if "proximity" in inputs:
        kinds.append((None, PROXIMITY_WIDTH))
    if what == "node" and config.boundary_motion:
        kinds.append(("vector", 3))
    if what == "node" and config.time_conditioned:
        kinds.append(("scalar", 1))
    return FeatureNormalizer(kinds)

"""The input features of elements and edges (paper, table "Input and output features").

Legend: E elements, M edges.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ast_sim.batches.batch_builder import Batch
from ast_sim.batches.graph import edge_vectors
from ast_sim.models.ast.ast_config import ASTConfig
from ast_sim.models.node_inputs import beside_rest, states


def element_features(config: ASTConfig, batch: Batch) -> Tensor:
    """[E, *]: displacement and velocity (means of the element's nodes), material and stress, if they are inputs."""
    values = [batch.graph.element_mean(value) for value in states(config, config.element_inputs, batch)]
    if "material" in config.element_inputs:
        values.append(batch.graph.material)
    if "stress" in config.element_inputs:
        values.append(batch.stress)
    return torch.cat(values, dim=1)


def edge_features(config: ASTConfig, batch: Batch) -> Tensor:
    """[M, 8]: [dp0, |dp0|, dp, |dp|], d = sender - receiver. With `edge_strain` dp and |dp| are relative to rest."""
    graph, now = batch.graph, batch.position
    senders = graph.element_mean(now) if graph.e2m is not None else now
    vectors = edge_vectors(graph.edges, senders, now)
    return beside_rest(graph.rest_edges, vectors, config.edge_strain)

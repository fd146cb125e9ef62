"""The input features of nodes, elements and edges (paper, table "Input and output features").

Legend: N nodes, E elements, M edges, B scenes.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ast_sim.data.batch import Batch
from ast_sim.data.scene import NodeType
from ast_sim.model.config import ModelConfig
from ast_sim.model.normalizer import Kind, Normalizer
from ast_sim.ops.edges import EdgeSet


@dataclass(frozen=True)
class Feature:
    """One named input [rows, width] with the kind of statistics it is normalised by; None: as it is."""

    name: str
    kind: Kind | None
    value: Tensor


def _state(config: ModelConfig, names: tuple[str, ...], batch: Batch) -> list[Feature]:
    """Displacement and velocity of the nodes, in the order asked for."""
    features = []
    if "displacement" in names:
        features.append(Feature("displacement", "vector", batch.position - batch.graph.rest_position))
    if "velocity" in names:
        features.append(Feature("velocity", "vector", batch.position - batch.previous_position))
    return features


def _material_of_nodes(batch: Batch) -> Tensor:
    """[N, m]: the mean material of the elements at each node."""
    graph = batch.graph
    nodes, num = graph.elements.flatten(), len(graph.rest_position)
    share = graph.material.repeat_interleave(graph.elements.shape[1], dim=0)
    total = share.new_zeros(num, share.shape[1]).index_add_(0, nodes, share)
    return total / torch.bincount(nodes, minlength=num).clamp(min=1)[:, None]


def node_features(config: ModelConfig, batch: Batch) -> list[Feature]:
    """Node type (one-hot), state, material and the boundary channels of model.md."""
    kinds = torch.stack([batch.graph.node_type == kind for kind in NodeType], dim=1)
    features = [Feature("node_type", None, kinds.to(batch.position.dtype))]
    features += _state(config, config.node_inputs, batch)
    if "material" in config.node_inputs:
        features.append(Feature("material", "scalar", _material_of_nodes(batch)))
    if config.boundary_motion:
        features.append(Feature("boundary_motion", "vector", batch.boundary_motion))
    return features


def element_features(config: ModelConfig, batch: Batch) -> list[Feature]:
    """Features of the element nodes: the mean state of their nodes, material and stress."""
    mean = batch.graph.element_mean
    features = [Feature(f.name, f.kind, mean(f.value)) for f in _state(config, config.element_inputs, batch)]
    if "material" in config.element_inputs:
        features.append(Feature("material", "scalar", batch.graph.material))
    if "stress" in config.element_inputs:
        features.append(Feature("stress", "scalar", batch.stress))
    return features


def edge_features(
    config: ModelConfig, edges: EdgeSet, rest: tuple[Tensor, Tensor], now: tuple[Tensor, Tensor]
) -> list[Feature]:
    """[dp0, |dp0|, dp, |dp|] with d = sender - receiver, or with the second half as differences to the first.

    Args:
        config: `edge_strain` chooses the form.
        edges: M edges.
        rest: rest positions of senders [S, 3] and receivers [R, 3].
        now: the same at t.
    """
    d0 = rest[0][edges.senders] - rest[1][edges.receivers]
    dt = now[0][edges.senders] - now[1][edges.receivers]
    length0, length = (torch.linalg.vector_norm(d, dim=1, keepdim=True) for d in (d0, dt))
    if config.edge_strain:
        dt, length = dt - d0, length - length0
    return [
        Feature("rest", "vector", d0),
        Feature("rest_length", "scalar", length0),
        Feature("now", "vector", dt),
        Feature("now_length", "scalar", length),
    ]


class FeatureSet(nn.Module):
    """The normalizers of one set of features, and their concatenation."""

    def __init__(self, widths: dict[str, tuple[Kind | None, int]]):
        super().__init__()
        self.width = sum(width for _, width in widths.values())
        self.normalizers = nn.ModuleDict({name: Normalizer(kind) for name, (kind, _) in widths.items() if kind})

    def observe(self, features: list[Feature]) -> None:
        for f in features:
            if f.kind:
                self.normalizers[f.name].observe(f.value)

    def forward(self, features: list[Feature]) -> Tensor:
        """[rows, width]: all features, normalised."""
        return torch.cat([self.normalizers[f.name](f.value) if f.kind else f.value for f in features], dim=1)


def widths_of(config: ModelConfig, what: str) -> dict[str, tuple[Kind | None, int]]:
    """Name -> (kind, width) of the "node", "element" or "edge" features, in their order."""
    material: tuple[Kind, int] = ("scalar", config.material_width)
    if what == "edge":
        return {"rest": ("vector", 3), "rest_length": ("scalar", 1), "now": ("vector", 3), "now_length": ("scalar", 1)}
    inputs = config.node_inputs if what == "node" else config.element_inputs
    widths: dict[str, tuple[Kind | None, int]] = {"node_type": (None, len(NodeType))} if what == "node" else {}
    widths |= {name: ("vector", 3) for name in ("displacement", "velocity") if name in inputs}
    if "material" in inputs:
        widths["material"] = material
    if "stress" in inputs:
        widths["stress"] = ("scalar", 1)
    if what == "node" and config.boundary_motion:
        widths["boundary_motion"] = ("vector", 3)
    return widths

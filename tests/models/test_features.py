"""Input features by hand: two tetrahedra over the face 1, 2, 3, with their tips at the nodes 0 and 4."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from meshes import two_tetrahedra

from ast_sim.batches.batch_builder import Batch
from ast_sim.batches.graph import Graph
from ast_sim.models.ast.ast_config import ASTConfig
from ast_sim.models.data_facts import DataFacts
from ast_sim.models.node_inputs import (
    edge_features,
    element_features,
    element_normalizer,
    node_features,
    normalizer_of,
)
from ast_sim.models.normalizer import FeatureNormalizer
from ast_sim.support.errors import ConfigError


def batch_of(element_nodes: bool) -> Batch:
    """Every node has moved by (0.1, 0, 0) from rest, and by half of that in the last step; node 4 twice as far."""
    graph = Graph.from_scene(two_tetrahedra(material=np.array([[2.0], [6.0]], np.float32)), element_nodes)
    moved = torch.tensor([0.1, 0.1, 0.1, 0.1, 0.2])[:, None] * torch.tensor([1.0, 0.0, 0.0])
    now = graph.rest_position + moved
    stress = torch.tensor([[5.0], [7.0]])
    return Batch(graph, now, graph.rest_position + moved / 2, 3 * moved, stress, ["one"])


def test_node_features():
    inputs = ("displacement", "velocity", "material")
    config = ASTConfig(
        node_inputs=inputs, boundary_motion=True, data=DataFacts(columns=("stiffness",), integration="dynamic")
    )
    batch = batch_of(False)
    expected = []
    for node, kind in enumerate(batch.graph.node_type.tolist()):
        step = 0.2 if node == 4 else 0.1
        one_hot = [float(kind == 0), float(kind == 1), float(kind == 3)]
        material = {0: 2.0, 4: 6.0}.get(node, 4.0)
        expected.append([*one_hot, step, 0, 0, step / 2, 0, 0, material, 3 * step, 0, 0])
    torch.testing.assert_close(node_features(config, batch), torch.tensor(expected), rtol=0, atol=1e-6)
    assert normalizer_of(config, "node").width == 13


def test_element_features():
    inputs = ("displacement", "velocity", "material", "stress")
    config = ASTConfig(data=DataFacts(columns=("stiffness",), integration="dynamic", stress="element"))
    batch = batch_of(True)
    expected = torch.tensor([[0.1, 0, 0, 0.05, 0, 0, 2, 5], [0.125, 0, 0, 0.0625, 0, 0, 6, 7]])
    torch.testing.assert_close(element_features(inputs, batch), expected, rtol=0, atol=1e-6)
    assert element_normalizer(config, inputs).width == 8


@pytest.mark.parametrize("strain", [False, True])
@pytest.mark.parametrize("element_nodes", [False, True])
def test_edge_features(element_nodes, strain):
    config, batch = ASTConfig(), batch_of(element_nodes)
    graph, rest, now = batch.graph, batch.graph.rest_position, batch.position
    senders = graph.element_mean(now) if element_nodes else now
    found = edge_features(graph.edges, graph.rest_edges, senders, now, strain)
    assert found.shape == (len(graph.edges), 8) and normalizer_of(config, "edge").width == 8
    for row, s, r in zip(found, graph.edges.senders.tolist(), graph.edges.receivers.tolist(), strict=True):
        ends = [(x[graph.elements[s]].mean(dim=0) if element_nodes else x[s]) - x[r] for x in (rest, now)]
        first, second = (torch.cat([d, d.norm()[None]]) for d in ends)
        torch.testing.assert_close(row, torch.cat([first, second - first if strain else second]))


def test_settings_and_scenes_lack_nothing_that_is_an_input():
    config, batch = ASTConfig(node_inputs=("material",)), batch_of(False)
    without = replace(batch, graph=replace(batch.graph, node_material=None))
    for settings, scenes in ((replace(config, node_inputs=None), batch), (config, without)):
        with pytest.raises(AssertionError, match="the settings are not resolved, or do not fit the scene"):
            node_features(settings, scenes)
    with pytest.raises(ConfigError, match="there are no features of 'world edge'.*world_edge"):
        normalizer_of(config, "world edge")


def test_columns_are_normalised_by_their_kind():
    """A vector by the root mean square of its components, a scalar by mean and deviation, others not at all."""
    normalizer = FeatureNormalizer([(None, 2), ("vector", 3), ("scalar", 1)])
    rows = torch.tensor([[0.0, 1.0, 3.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 4.0, 0.0, 5.0]])
    normalizer.observe(rows[:1])
    normalizer.observe(rows[1:])
    normalizer.fix()
    scale = (25 / 6) ** 0.5
    expected = torch.tensor([[0.0, 1.0, 3 / scale, 0.0, 0.0, -1.0], [1.0, 0.0, 0.0, 4 / scale, 0.0, 1.0]])
    torch.testing.assert_close(normalizer(rows), expected)

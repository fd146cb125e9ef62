"""Graphs: the edges of a hand-checked mesh, and scenes within a batch."""

import dataclasses

import numpy as np
import pytest
import torch
from data_samples import block
from meshes import two_tetrahedra

from ast_sim.batches.graph import Graph
from ast_sim.batches.mirror_and_shift import Placement
from ast_sim.ops import EdgeSet


def pairs(edges: EdgeSet) -> list[tuple[int, int]]:
    return list(zip(edges.senders.tolist(), edges.receivers.tolist(), strict=True))


def test_node_edges_of_two_tetrahedra():
    graph = Graph.from_scene(two_tetrahedra(), element_nodes=False)
    # Nodes 0 and 4 are the two tips, joined to the shared face 1, 2, 3 only; by receiver, then sender.
    neighbours = {0: [1, 2, 3], 1: [0, 2, 3, 4], 2: [0, 1, 3, 4], 3: [0, 1, 2, 4], 4: [1, 2, 3]}
    assert pairs(graph.edges) == [(s, r) for r, senders in neighbours.items() for s in senders]
    assert graph.edges.receiver_offsets.tolist() == [0, 3, 7, 11, 15, 18]
    assert graph.m2e is None


def test_element_edges_of_two_tetrahedra():
    graph = Graph.from_scene(two_tetrahedra(), element_nodes=True)
    assert pairs(graph.edges) == [(0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (0, 3), (1, 3), (1, 4)]
    assert pairs(graph.m2e) == [(0, 0), (1, 0), (2, 0), (3, 0), (1, 1), (2, 1), (3, 1), (4, 1)]
    assert graph.m2e.receiver_offsets.tolist() == [0, 4, 8]


def test_masks_and_element_means():
    graph = Graph.from_scene(two_tetrahedra(), element_nodes=True)
    assert graph.prescribed.tolist() == [True, False, False, False, True]
    assert graph.normal_nodes.tolist() == [1, 2, 3]
    means = graph.element_mean(graph.rest_position)
    torch.testing.assert_close(means, torch.tensor([[0.25] * 3, [0.5] * 3]), rtol=0, atol=0)


def test_a_batch_is_its_scenes_with_shifted_numbers():
    material = np.arange(12, dtype=np.float32).reshape(6, 2)
    scenes = [block(1, 1, 1, material), two_tetrahedra(material=material[:2]), block(1, 1, 1, -material)]
    for element_nodes in (False, True):
        graphs = [Graph.from_scene(scene, element_nodes) for scene in scenes]
        batch = Graph.concatenate(graphs)
        assert batch.num_scenes == 3
        assert batch.node_offsets.tolist() == [0, 8, 13, 21] and batch.element_offsets.tolist() == [0, 6, 8, 14]
        for i, graph in enumerate(graphs):
            nodes = slice(int(batch.node_offsets[i]), int(batch.node_offsets[i + 1]))
            elements = slice(int(batch.element_offsets[i]), int(batch.element_offsets[i + 1]))
            assert torch.equal(batch.rest_position[nodes], graph.rest_position)
            assert torch.equal(batch.node_type[nodes], graph.node_type)
            assert torch.equal(batch.elements[elements] - nodes.start, graph.elements)
            assert torch.equal(batch.material[elements], graph.material)
            assert torch.equal(batch.deforming_nodes[nodes], graph.deforming_nodes)
            assert torch.equal(batch.deforming_elements[elements], graph.deforming_elements)
        assert (~batch.deforming_nodes).nonzero().tolist() == [[12]]  # the last node of the two tetrahedra
        assert (~batch.deforming_elements).nonzero().tolist() == [[7]]
        if element_nodes:
            shifted = [
                (s + a, r + b)
                for graph, a, b in zip(graphs, [0, 6, 8], [0, 8, 13], strict=True)
                for s, r in pairs(graph.edges)
            ]
            assert pairs(batch.edges) == shifted
            assert batch.m2e.num_senders == 21 and batch.m2e.num_receivers == 14
        else:
            shifted = [
                (s + a, r + a) for graph, a in zip(graphs, [0, 8, 13], strict=True) for s, r in pairs(graph.edges)
            ]
            assert pairs(batch.edges) == shifted


def test_batches_of_batches_are_batches():
    graphs = [Graph.from_scene(block(n, 1, 1), True) for n in (1, 2, 3)]
    nested = Graph.concatenate([Graph.concatenate(graphs[:2]), graphs[2]])
    flat = Graph.concatenate(graphs)
    for field in dataclasses.fields(Graph):
        one, other = getattr(nested, field.name), getattr(flat, field.name)
        if isinstance(one, EdgeSet):
            for name in ("senders", "receivers", "receiver_offsets"):
                assert torch.equal(getattr(one, name), getattr(other, name))
            assert one.num_senders == other.num_senders
        elif one is None:
            assert other is None
        else:
            assert torch.equal(one, other)


@pytest.mark.parametrize("element_nodes", [True, False])
@pytest.mark.parametrize("sign", [(-1, 1, 1), (-1, 1, -1), (-1, -1, -1), (1, 1, 1)])
def test_the_graph_of_a_mirror_image(sign, element_nodes):
    scene = block(2, 1, 1)
    mirror = Placement(np.float32(sign), np.float32([1, 0.5, 0.25]), np.zeros(3, np.float32))
    found = Graph.from_scene(scene, element_nodes, surface=True).placed(mirror)
    # The tetrahedra of an odd reflection are inside out, which the edges do not feel.
    rest = scene.rest_position.copy()
    for axis in range(3):
        if sign[axis] < 0:
            rest[:, axis] = 2 * mirror.center[axis] - rest[:, axis]
    expected = Graph.from_scene(dataclasses.replace(scene, rest_position=rest), element_nodes)
    assert torch.equal(found.rest_position, expected.rest_position)
    torch.testing.assert_close(found.rest_edges, expected.rest_edges, rtol=0, atol=1e-6)
    corners = found.rest_position.double()[found.surface]
    volume = torch.linalg.det(corners).sum() / 6  # by the divergence theorem, positive if seen from outside
    torch.testing.assert_close(volume, torch.tensor(2.0, dtype=torch.float64))


def test_the_graph_of_a_scene_that_was_moved():
    graph = Graph.from_scene(block(2, 1, 1), False, surface=True)
    shift = np.float32([0.5, -0.25, 1])
    found = graph.placed(Placement(np.ones(3, np.float32), np.zeros(3, np.float32), shift))
    assert torch.equal(found.rest_position, graph.rest_position + torch.from_numpy(shift))
    assert torch.equal(found.rest_edges, graph.rest_edges) and torch.equal(found.surface, graph.surface)

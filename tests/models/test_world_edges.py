"""World edges against all pairs, their cap, and scenes that do not see each other."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from graph_models import made, resolved
from meshes import box

from ast_sim.batches.batch_builder import Batch
from ast_sim.batches.graph import Graph
from ast_sim.models.bsms import BSMSConfig
from ast_sim.models.hcmt import HCMTConfig
from ast_sim.models.mgn import MGNConfig
from ast_sim.models.world_edges import world_edges
from ast_sim.scene import Scene


def block(*cells: int) -> Scene:
    """A block of unit cubes."""
    nodes, elements = box(cells, cells)
    zeros = np.zeros(len(nodes))
    return Scene(nodes.astype(np.float32), elements.astype(np.int32), zeros.astype(np.uint8), zeros.astype(np.int32))


def batch_of(*scenes, jitter: float = 0.0, seed: int = 0) -> Batch:
    graph = Graph.concatenate([Graph.from_scene(scene, element_nodes=False) for scene in scenes])
    noise = np.random.default_rng(seed).normal(0, jitter, graph.rest_position.shape).astype(np.float32)
    position = graph.rest_position + torch.from_numpy(noise)
    return Batch(graph, position, None, torch.zeros_like(position), None, [""] * len(scenes))


def pairs_of(edges) -> set[tuple[int, int]]:
    return set(zip(edges.senders.tolist(), edges.receivers.tolist(), strict=True))


def all_pairs(batch: Batch, radius: float) -> set[tuple[int, int]]:
    """By the definition: every ordered pair of a scene, measured in float64."""
    mesh, position, found = pairs_of(batch.graph.edges), batch.position.double(), set()
    for start, end in zip(batch.graph.node_offsets[:-1].tolist(), batch.graph.node_offsets[1:].tolist(), strict=True):
        for i in range(start, end):
            for j in range(start, end):
                close = float(torch.linalg.vector_norm(position[i] - position[j])) <= radius
                if i != j and close and (i, j) not in mesh:
                    found.add((i, j))
    return found


@pytest.mark.parametrize("radius", [0.5, 1.2, 1.6, 4.0])
def test_all_pairs_within_the_radius_that_are_no_mesh_edge(radius):
    batch = batch_of(block(2, 1, 1), block(1, 1, 1), jitter=0.2)
    edges = world_edges(batch, radius, None)
    assert pairs_of(edges) == all_pairs(batch, radius) and len(edges) == len(pairs_of(edges))
    assert torch.equal(edges.receivers, edges.receivers.sort().values) and edges.num_senders == 20


@pytest.mark.parametrize("radius", [0.0, 1e-6])
def test_there_may_be_none(radius):
    edges = world_edges(batch_of(block(1, 1, 1), block(1, 1, 1)), radius, None)
    assert len(edges) == 0 and edges.receiver_offsets.tolist() == [0] * 17


def test_coincident_nodes_are_neighbours():
    batch = batch_of(block(2, 1, 1))
    position = batch.position.clone()
    position[11] = position[0]  # the far corner, no neighbour of node 0
    assert (0, 11) in pairs_of(world_edges(replace(batch, position=position), 1e-9, None))


def test_the_shortest_are_kept_with_a_warning_in_every_scene():
    batch = batch_of(block(2, 1, 1), block(2, 2, 1), jitter=0.1)
    with pytest.warns(UserWarning, match="most_world_edges = 3: the shortest of a scene are kept"):
        edges = world_edges(batch, 2.0, 3)
    everything = [pair for pair in all_pairs(batch, 2.0) if pair[0] < pair[1]]
    length = {
        pair: float(torch.linalg.vector_norm(batch.position[pair[0]] - batch.position[pair[1]])) for pair in everything
    }
    expected = set()
    for members in ([p for p in everything if p[0] < 12], [p for p in everything if p[0] >= 12]):
        for i, j in sorted(members, key=length.get)[:3]:
            expected |= {(i, j), (j, i)}
    assert pairs_of(edges) == expected


def test_of_equally_long_edges_the_ones_of_the_lowest_nodes_are_kept():
    batch = batch_of(block(1, 1, 1))  # face diagonals that are no edges all have length sqrt 2
    lowest = sorted(pair for pair in all_pairs(batch, 1.5) if pair[0] < pair[1])[:2]
    with pytest.warns(UserWarning):
        edges = world_edges(batch, 1.5, 2)
    assert sorted(pair for pair in pairs_of(edges) if pair[0] < pair[1]) == lowest


def test_a_scene_has_the_same_edges_alone_and_in_a_batch():
    one, other = batch_of(block(2, 1, 1), jitter=0.2, seed=1), batch_of(block(1, 2, 1), jitter=0.2, seed=2)
    graph = Graph.concatenate([other.graph, one.graph])
    both = replace(one, graph=graph, position=torch.cat([other.position, one.position]))
    alone = {(i + 12, j + 12) for i, j in pairs_of(world_edges(one, 1.3, None))}
    assert {pair for pair in pairs_of(world_edges(both, 1.3, None)) if pair[0] >= 12} == alone


@pytest.mark.parametrize("small", [MGNConfig(blocks=1), BSMSConfig(levels=1), HCMTConfig(levels=1)])
def test_a_model_tells_how_many_a_scene_has_and_warns_of_none(small):
    model, batch = made(resolved(replace(small, hidden=16)), 0, 1)
    assert model.remarks() == [f"world edges {len(model.world(batch)) / 2:.3g} a scene, on average over 2 scenes"]
    blind, _ = made(resolved(replace(small, hidden=16), 0.0), 0)
    assert blind.remarks()[0].startswith("warning: no node has a world edge of at most 0 in 1 scenes")

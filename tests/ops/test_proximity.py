"""The gap to another body against closed forms and all triangles, one step ahead, and as an input of models."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import toy
from meshes import box

from ast_sim.batches.batch_builder import Batch
from ast_sim.batches.graph import Graph
from ast_sim.batches.mirror_and_shift import Placement
from ast_sim.models.node_inputs import _proximity as near
from ast_sim.models.node_inputs import node_features, normalizer_of, with_proximity
from ast_sim.ops import proximity
from ast_sim.ops._body_distance import FINE, _proximity, signed_gap
from ast_sim.scene import Scene
from ast_sim.training.configure import configure
from ast_sim.training.start import start_training


def surface_of(cells, size) -> tuple[np.ndarray, np.ndarray]:
    """Nodes [N, 3] and boundary triangles [F, 3] of a box."""
    nodes, elements = box(cells, size)
    zeros = np.zeros(len(nodes))
    scene = Scene(nodes.astype(np.float32), elements.astype(np.int32), zeros.astype(np.uint8), zeros.astype(np.int32))
    return nodes, scene.surface()


def gap_of_kernel(points: np.ndarray, nodes: np.ndarray, triangles: np.ndarray, radius: float):
    """What `signed_gap` returns, from the columns of the kernel; the points are a body without triangles."""
    position = torch.from_numpy(np.concatenate([nodes, points]).astype(np.float32))
    body = (torch.arange(len(position)) >= len(nodes)).long()
    ends = [torch.tensor([0, n]) for n in (len(position), len(triangles))]
    surface = torch.from_numpy(triangles.astype(np.int64))
    columns = proximity(position, torch.zeros_like(position), ends[0], body, surface, ends[1], radius)
    columns = columns[len(nodes) :].double().numpy()
    gap = columns[:, 3] * radius
    return gap, columns[:, :3] / np.where(np.abs(gap) < radius, 1 - np.abs(gap) / radius, 1)[:, None]


both_bodies = pytest.mark.parametrize(("gap_of", "close"), [(signed_gap, 1e-12), (gap_of_kernel, 2e-6)])


def single(*shape: int, seed: int) -> np.ndarray:
    """Numbers from -1 to 1 that float32 has, as float64."""
    return np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32).astype(np.float64)


def gap_to_box(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    """The signed distance from a box around the origin, in closed form."""
    q = np.abs(points) - half
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)


@both_bodies
@pytest.mark.parametrize("cells", [(1, 1, 1), (4, 2, 3)])
def test_the_gap_to_a_box_has_its_closed_form(cells, gap_of, close):
    half = np.array([0.5, 0.25, 0.125])
    points = single(4000, 3, seed=0)
    gap, normal = gap_of(points, *surface_of(cells, 2 * half), radius=10.0)
    np.testing.assert_allclose(gap, gap_to_box(points, half), atol=close)
    assert (gap < 0).sum() > 50
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=close)
    step = 1e-6  # the normal is the gradient of the gap
    risen = gap_to_box(points + step * normal, half)
    np.testing.assert_allclose((risen - gap_to_box(points, half)) / step, 1, atol=1e-5)


@both_bodies
def test_within_the_radius_alone(gap_of, close):
    half = np.array([0.5, 0.25, 0.125])
    points = single(2000, 3, seed=1)
    exact = gap_to_box(points, half)
    gap, normal = gap_of(points, *surface_of((3, 2, 1), 2 * half), radius=0.15)
    near = np.abs(exact) < 0.15
    np.testing.assert_allclose(gap[near], exact[near], atol=close)
    assert (gap[~near] == 0.15).all() and not normal[~near].any() and 100 < near.sum() < 1900


@both_bodies
def test_flat_triangles_of_a_surface_do_no_harm(gap_of, close):
    """A box whose faces are cut by nodes on an edge: triangles of no area."""
    half = np.array([0.5, 0.25, 0.125])
    nodes, triangles = surface_of((2, 2, 2), 2 * half)
    a, b, c = triangles[0]
    middle = len(nodes)
    nodes = np.vstack([nodes, (nodes[a] + nodes[b]) / 2])
    triangles = np.vstack([triangles, [[a, middle, b]]])
    points = single(4000, 3, seed=3)
    gap, normal = gap_of(points, nodes, triangles, radius=10.0)
    np.testing.assert_allclose(gap, gap_to_box(points, half), atol=close)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=close)


@both_bodies
def test_points_on_the_surface_have_its_normal(gap_of, close):
    half = np.array([0.5, 0.25, 0.125])
    nodes, triangles = surface_of((2, 2, 2), 2 * half)
    corners = nodes[triangles]
    inside = (2 * corners[:, 0] + corners[:, 1] + corners[:, 2]) / 4  # exact in float32
    gap, normal = gap_of(inside, nodes, triangles, radius=1.0)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    np.testing.assert_allclose(gap, 0, atol=1e-15)
    np.testing.assert_allclose(normal, cross / np.linalg.norm(cross, axis=1, keepdims=True), atol=1e-6)


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_the_kernel_is_the_composition(scale):
    """Bodies that overlap, and points that a hundred triangles are about as near to."""
    generator = np.random.default_rng(4)
    nodes, triangles = surface_of((3, 4, 2), np.array([0.5, 0.4, 0.3]))
    parts = [nodes + generator.uniform(-0.3, 0.3, 3) for _ in range(6)]
    position = scale * torch.from_numpy(np.concatenate(parts)).float()
    body = torch.arange(3).repeat_interleave(len(nodes)).repeat(2)
    surface = torch.cat([torch.from_numpy(triangles.astype(np.int64)) + part * len(nodes) for part in range(6)])
    motion = 0.01 * scale * torch.randn(position.shape, generator=torch.Generator().manual_seed(5))
    ends = [torch.tensor([0, 3, 6]) * n for n in (len(nodes), len(triangles))]
    arguments = (position, motion, ends[0], body, surface, ends[1], 0.2 * scale)
    ours, composed = proximity(*arguments), _proximity.composition(*arguments)
    assert ours.dtype == composed.dtype == torch.float32
    torch.testing.assert_close(ours, composed, atol=2e-7, rtol=0)
    assert (ours[:, 3] < 0).sum() > 20 and ((ours[:, 3] > 0) & (ours[:, 3] < 1)).sum() > 50


def test_a_radius_or_a_place_that_is_not_finite_is_refused():
    position, motion = torch.zeros(4, 3), torch.zeros(4, 3)
    ends = torch.tensor([0, 4]), torch.tensor([0, 1])
    rest = (ends[0], torch.tensor([0, 0, 0, 1]), torch.tensor([[0, 1, 2]]), ends[1])
    for radius in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(ValueError, match=f"proximity: radius must be positive and finite, not {radius}"):
            proximity(position, motion, *rest, radius)
    motion[2, 1] = np.nan
    with pytest.raises(ValueError, match=r"proximity: node 2 moves to \(0, nan, 0\), which is not finite"):
        proximity(position, motion, *rest, 1.0)


def batch_of(*seeds: int, down: float = 0.005) -> Batch:
    """Toy scenes at rest, whose block is about to go down."""
    scenes = [toy.plate(seed) for seed in seeds]
    graph = Graph.concatenate([Graph.from_scene(t.scene, element_nodes=False, surface=True) for t in scenes])
    motion = torch.where((graph.body == 1)[:, None], torch.tensor([0.0, 0.0, -down]), 0.0)
    return Batch(graph, graph.rest_position, None, motion, None, [""] * len(seeds))


@pytest.mark.parametrize("down", [0.0, 0.005, 0.012, -0.01])
def test_a_block_above_a_plate_by_hand(down):
    """The block's lower face is the nearest of what is under it: above it after the step, or below, in the plate."""
    batch, radius = batch_of(0, down=down), 0.1
    found, position, body = near(batch, radius).numpy(), batch.position.numpy(), batch.graph.body.numpy()
    block = position[body == 1]
    gap = block[:, 2].min() - down - position[:, 2]
    below = (np.abs(position[:, :2] - block[:, :2].mean(axis=0)) < 0.049).all(axis=1)
    under = np.flatnonzero((body == 0) & below & (position[:, 2] > 0.019))
    assert len(under)
    np.testing.assert_allclose(found[under, 3], gap[under] / radius, atol=1e-6)
    weight = 1 - np.abs(gap[under]) / radius
    np.testing.assert_allclose(found[under, :3], weight[:, None] * [0, 0, -1], atol=1e-6)
    np.testing.assert_allclose(found[under, 4], np.clip(gap[under] / radius / FINE, -1, 1), atol=1e-5)
    far = np.flatnonzero((body == 0) & (np.abs(position[:, 0] - block[:, 0].mean()) > 0.05 + radius))
    assert (found[far] == [0, 0, 0, 1, 1]).all() and len(far)


def test_a_scene_alone_equals_a_scene_in_a_batch():
    assert torch.equal(
        near(batch_of(0, 1), 0.1),
        torch.cat([near(batch_of(seed), 0.1) for seed in (0, 1)]),
    )


def test_it_is_an_input_of_any_model(tmp_path):
    data = toy.write(tmp_path / "toy.h5")
    for model in ("ast", "mgn"):
        small = ["model.hidden=16", "train.steps=2", "train.statistics_pairs=4", "model.node_inputs=proximity"]
        config = configure(data, "tiny", small, model)
        assert "proximity" in config.model.node_inputs
        start_training(tmp_path / model, config)
    batch = batch_of(0)
    config = replace(config.model, proximity_radius=0.1, boundary_motion=True)
    features = node_features(config, batch)
    assert features.shape[1] == normalizer_of(config, "node").width == 3 + 5 + 3
    assert torch.equal(features[:, 3:8], near(batch, 0.1))
    ahead = with_proximity(config, batch)
    assert torch.equal(ahead.proximity, near(batch, 0.1)) and torch.equal(node_features(config, ahead), features)
    placed = ahead.placed(Placement(np.float32([-1, 1, 1]), np.zeros(3, np.float32), np.zeros(3, np.float32)))
    assert placed.proximity is None  # it belongs to the positions before
    assert with_proximity(replace(config, node_inputs=("displacement",)), batch).proximity is None

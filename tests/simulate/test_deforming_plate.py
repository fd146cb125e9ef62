"""Scenes of the family: what is drawn, and one solved from end to end."""

import numpy as np
import pytest

from ast_sim.data.scene import NodeType
from ast_sim.simulate import deforming_plate
from ast_sim.simulate.contact import Contact
from ast_sim.simulate.deforming_plate import CONTACT, FRAMES, draw
from ast_sim.simulate.samples import make_sample

NODES = 150


@pytest.fixture(scope="module")
def trajectory():
    return make_sample("deforming_plate", seed=3, split="train", index=0, nodes=NODES)


@pytest.mark.parametrize("nodes", [80, 400, 1500])
def test_scenes_have_the_size_asked_for_and_are_valid(nodes):
    shapes, holes = set(), 0
    for index in range(20):
        case = draw(np.random.default_rng(index), nodes)
        scene = case.scene
        scene.check()
        assert 0.75 * nodes <= scene.num_nodes <= 1.5 * nodes
        assert np.abs(scene.rest_position).max() < 0.5 and np.abs(case.travel).max() < 0.1
        length = np.ptp(scene.rest_position[scene.body == 0], axis=0)
        assert (length > [0.419, 0.239, 0.0249]).all() and (length < [0.541, 0.401, 0.0451]).all()
        ends = np.isclose(np.abs(scene.rest_position[:, 0]), length[0] / 2, atol=1e-6) & (scene.body == 0)
        assert np.array_equal(scene.node_type == NodeType.HANDLE, ends)
        assert np.array_equal(scene.node_type == NodeType.OBSTACLE, scene.body == 1)
        shapes.add(case.shape)
        euler = scene.num_nodes - len(scene.edges()) + len(faces_of(scene.elements)) - scene.num_elements
        assert euler in (0, 1, 2)  # two solid bodies less one for every hole
        holes += 2 - euler
    assert shapes == {"ball", "cylinder", "block"} and 4 <= holes <= 18


def faces_of(elements: np.ndarray) -> np.ndarray:
    faces = elements[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3)
    return np.unique(np.sort(faces, axis=1), axis=0)


def test_the_obstacle_comes_down_and_returns():
    for index in range(20):
        case = draw(np.random.default_rng(index))
        height = case.travel[:, 2]
        lowest = int(np.argmin(height))
        assert len(height) == FRAMES and 22 <= lowest <= 29
        assert (np.diff(height[: lowest + 1]) < 0).all() and (np.diff(height[lowest:]) > 0).all()
        np.testing.assert_allclose(case.travel[[0, -1]], 0, atol=1e-12)
        scene = case.scene
        top = scene.rest_position[scene.body == 0, 2].max()
        gap = scene.rest_position[scene.body == 1, 2].min() - top
        assert 0.0039 < gap < 0.0151 and 0.019 < -height.min() - gap < 0.061
        obstacle = scene.rest_position[scene.body == 1][:, 0] + case.travel[:, None, 0]
        assert np.abs(obstacle).max() < scene.rest_position[scene.body == 0, 0].max()  # stays between the clamps


def test_a_scene_solved_end_to_end(trajectory):
    scene, attributes = trajectory.scene, trajectory.attributes
    trajectory.check("sample", "node")
    assert attributes["status"] == "complete" and trajectory.position.shape == (FRAMES, scene.num_nodes, 3)
    # Anew, by other means than the generator's own checks.
    rest, position = scene.rest_position.astype(float), trajectory.position.astype(float)
    contact = Contact(rest, scene.surface(), scene.body, CONTACT)
    corners = position[:, scene.elements]
    volume = np.linalg.det(corners[:, :, 1:] - corners[:, :, :1])
    jacobian = volume / volume[0]
    assert not any(contact.intersects(frame) for frame in position)
    gap = min(contact.gap(frame) for frame in position)
    assert 0 < gap < CONTACT.dhat and gap == pytest.approx(attributes["min_gap"])
    assert 0.5 < jacobian.min() < 1 and jacobian.min() == pytest.approx(attributes["min_jacobian"], rel=1e-5)
    assert attributes["max_imbalance"] < 1e-4 and attributes["max_residual"] <= 1 and attributes["work_balance"] < 0.01
    plate, deflection = scene.body == 0, position - position[0]
    assert -0.08 < deflection[:, plate, 2].min() < -0.015
    np.testing.assert_allclose(deflection[-1], 0, atol=1e-6)  # back at rest after the release
    assert (deflection[:, scene.node_type == NodeType.HANDLE] == 0).all()
    stress = trajectory.stress[..., 0]
    assert 2e4 < stress.max() < 6e5
    assert np.all(stress[:, ~plate] == 0)
    still = np.abs(deflection[:, plate]).max(axis=(1, 2)) < 1e-9
    assert still[0] and still.sum() >= 2 and stress[still].max() < 1e-3  # pascal: nothing before the first contact
    assert len(attributes["solve_seconds"]) == len(attributes["newton_iterations"]) == FRAMES
    assert sum(attributes["newton_iterations"]) > 40
    expected = {"seed": 3, "index": 0, "young": 1e6, "poisson": 0.4, "dhat": 1e-3, "kappa": 1e6}
    assert {key: attributes[key] for key in expected} == expected
    assert attributes["obstacle"] in deforming_plate.SHAPES

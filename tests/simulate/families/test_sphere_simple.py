"""Scenes of the family: what is drawn, and one solved from end to end."""

from dataclasses import replace

import numpy as np
import pytest

from ast_sim.mechanics.dynamics import BackwardEuler
from ast_sim.scene import NodeType
from ast_sim.simulate.families.sphere_simple import FRAMES, INFO, draw, icosphere, sheet, solve


@pytest.mark.parametrize("nodes", [200, 700, 2000])
def test_scenes_have_the_size_asked_for_and_are_valid(nodes):
    for seed in range(6):
        case = draw(np.random.default_rng(seed), nodes)
        scene = case.scene
        scene.check()
        assert 0.9 * nodes <= scene.num_nodes <= 1.1 * nodes
        held, obstacle = scene.node_type == NodeType.HANDLE, scene.node_type == NodeType.OBSTACLE
        np.testing.assert_array_equal(obstacle, scene.body == 1)
        left, right = held & (scene.rest_position[:, 0] < 0), held & (scene.rest_position[:, 0] > 0)
        assert 2 <= left.sum() <= 8 and 2 <= right.sum() <= 8
        assert np.ptp(scene.rest_position[~obstacle], axis=0)[0] > 0.85
        cloth_triangles = ~obstacle[scene.elements].all(axis=1)
        assert (scene.material[cloth_triangles] > 0).all() and (scene.material[~cloth_triangles] == 0).all()
        assert case.prescribed_position.shape == (FRAMES, scene.num_nodes, 3)
        np.testing.assert_array_equal(case.prescribed_position[0], scene.rest_position)
        assert (case.prescribed_position[:, held] == case.prescribed_position[0, held]).all()
        assert np.abs(case.prescribed_position).max() < INFO.domain_half_width
        path = case.prescribed_position[:, obstacle].mean(axis=1)
        speed = np.linalg.norm(np.diff(path, axis=0), axis=1) / INFO.time_step
        assert speed[0] < 0.05 and 0.4 < speed.max() < 2
        assert np.ptp(np.sign(path[:, 1])) == 2  # it passes through the plane in which the cloth hangs


@pytest.mark.parametrize("nodes", [200, 2000])
def test_no_contact_acts_at_the_start(nodes):
    for seed in range(3):
        case = draw(np.random.default_rng(seed), nodes)
        solver = BackwardEuler(case)
        assert solver.state.contact.is_empty
        assert solver.contact.gap(solver.position) > case.contact.dhat
        assert not solver.contact.intersects(solver.position)
        assert solver.elastic_energy() < 1e-9 * solver.cloth.unit_energy


def test_scenes_vary_and_share_their_contact_settings():
    cases = [draw(np.random.default_rng(seed), 200) for seed in range(20)]
    radii, tilts = (np.array([case.attributes[name] for case in cases]) for name in ("radius", "tilt"))
    assert 0.1 <= radii.min() < 0.12 and 0.18 < radii.max() <= 0.2
    assert 15 <= np.abs(tilts).min() < 30 and 60 < np.abs(tilts).max() <= 75 and 0 < (tilts > 0).sum() < 20
    assert len({case.contact for case in cases}) == 1
    stretches = [case.material.stretch for case in cases]
    assert 60 <= min(stretches) < 80 and 150 < max(stretches) <= 200


def test_a_scene_depends_on_its_generator_alone():
    one, same, other = (draw(np.random.default_rng(seed), 300) for seed in (5, 5, 6))
    assert one.prescribed_position.tobytes() == same.prescribed_position.tobytes() and one.material == same.material
    assert one.attributes != other.attributes


def test_the_sheet_is_covered_once_by_triangles_of_good_shape():
    flat, triangles = sheet((1.0, 0.9), 1000, np.random.default_rng(0))
    first, second = (flat[triangles[:, k]] - flat[triangles[:, 0]] for k in (1, 2))
    area = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2
    assert area.sum() == pytest.approx(0.9, rel=1e-12)
    assert area.min() > 0.3 * area.mean() > 0
    assert len(np.unique(triangles)) == len(flat)


@pytest.mark.parametrize("level", [0, 1, 2, 3])
def test_the_icosphere_is_closed_round_and_outward(level):
    position, triangles = icosphere(level)
    assert len(position) == 10 * 4**level + 2 and len(triangles) == 20 * 4**level
    np.testing.assert_allclose(np.linalg.norm(position, axis=1), 1, rtol=1e-12)
    directed = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    assert len(np.unique(directed, axis=0)) == len(directed)  # each edge once in each direction: closed, oriented
    np.testing.assert_array_equal(np.unique(directed, axis=0), np.unique(directed[:, ::-1], axis=0))
    assert (np.linalg.det(position[triangles]) > 0).all()


def test_a_scene_is_solved():
    case = draw(np.random.default_rng(0), 250)
    case = replace(case, prescribed_position=case.prescribed_position[:90])
    trajectory = solve(case)
    trajectory.check("trajectory", INFO.stress_location)
    attributes = trajectory.attributes
    assert attributes["status"] == "complete", attributes.get("stopped_by")
    assert trajectory.num_frames == 90
    assert attributes["min_gap"] > 0 and attributes["max_residual"] <= 1 and attributes["min_jacobian"] > 0.2
    assert max(attributes["contact_area"]) > 0.003  # the sphere was met
    assert np.abs(trajectory.position).max() < INFO.domain_half_width
    lists = ("newton_iterations", "gap", "elastic_energy", "kinetic_energy", "work", "solve_seconds")
    assert all(len(attributes[name]) == 90 for name in lists)
    assert attributes["dhat"] == case.contact.dhat and attributes["stretch"] == case.material.stretch

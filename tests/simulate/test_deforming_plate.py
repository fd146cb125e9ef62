"""Scenes of the family: what is drawn, and one solved from end to end."""

from dataclasses import replace

import numpy as np
import pytest

from ast_sim.data.scene import NodeType
from ast_sim.errors import SimulationError
from ast_sim.simulate import deforming_plate
from ast_sim.simulate.contact import Contact
from ast_sim.simulate.deforming_plate import DHAT, FRAMES, MATERIAL, draw
from ast_sim.simulate.elasticity import Elasticity
from ast_sim.simulate.samples import make_sample
from ast_sim.simulate.solver import NotConverged, QuasiStatic, SolverSettings
from ast_sim.simulate.trajectory import quasi_static

NODES = 150


@pytest.fixture(scope="module")
def trajectory():
    return make_sample("deforming_plate", seed=3, split="train", index=0, nodes=NODES)


def targets_of(case) -> np.ndarray:
    rest = case.scene.rest_position
    return np.where((case.scene.body == 1)[:, None], rest + case.travel[:, None, :], rest)


def start_solver(scene, settings=None) -> QuasiStatic:
    rest = scene.rest_position.astype(float)
    plate = scene.elements[scene.body[scene.elements[:, 0]] == 0]
    contact = Contact(rest, scene.surface(), scene.body, DHAT, MATERIAL.young)
    return QuasiStatic(Elasticity(rest, plate, MATERIAL), contact, scene.prescribed, rest, settings)


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
    contact = Contact(rest, scene.surface(), scene.body, DHAT, MATERIAL.young)
    corners = position[:, scene.elements]
    volume = np.linalg.det(corners[:, :, 1:] - corners[:, :, :1])
    jacobian = volume / volume[0]
    assert not any(contact.intersects(frame) for frame in position)
    gap = min(contact.gap(frame) for frame in position)
    assert 0 < gap < DHAT and gap == pytest.approx(attributes["min_gap"])
    assert 0.5 < jacobian.min() < 1 and jacobian.min() == pytest.approx(attributes["min_jacobian"], rel=1e-5)
    assert attributes["reaction_residual"] < 1e-4
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


def test_reactions_balance_and_support_the_obstacle():
    case = draw(np.random.default_rng(1), NODES)
    solver, targets = start_solver(case.scene), targets_of(case)
    for target in targets[1:15]:
        solver.advance(target)
    forces = solver.reactions()
    clamps, obstacle = (forces[case.scene.node_type == t].sum(axis=0) for t in (NodeType.HANDLE, NodeType.OBSTACLE))
    assert obstacle[2] < -1  # newton: the obstacle has to be pushed down
    np.testing.assert_allclose(clamps, -obstacle, atol=1e-5 * np.abs(obstacle).max())
    assert np.abs(forces[~case.scene.prescribed]).max() < 1e-4 * np.abs(obstacle).max()


def test_the_solution_does_not_depend_on_the_number_of_load_steps():
    case = draw(np.random.default_rng(1), NODES)
    target = targets_of(case)[14]
    fine, coarse = start_solver(case.scene), start_solver(case.scene)
    for share in (0.25, 0.5, 0.75, 1.0):
        fine.advance(case.scene.rest_position + share * (target - case.scene.rest_position))
    coarse.advance(target)
    assert np.abs(coarse.position - case.scene.rest_position).max() > 0.01
    np.testing.assert_allclose(coarse.position, fine.position, atol=1e-6)


def test_a_load_step_that_fails_is_halved():
    case = draw(np.random.default_rng(1), NODES)
    target = targets_of(case)[14]
    tight = replace(SolverSettings(), max_moves=3)
    with pytest.raises(NotConverged, match="not at its target after 3 moves, also after 0 halvings"):
        start_solver(case.scene, replace(tight, max_halvings=0)).advance(target)
    solver, expected = start_solver(case.scene, tight), start_solver(case.scene)
    solver.advance(target)
    expected.advance(target)
    np.testing.assert_allclose(solver.position, expected.position, atol=1e-6)


def test_a_trajectory_that_cannot_go_on_keeps_its_converged_frames(trajectory):
    harsh = SolverSettings(max_iterations=1, max_halvings=0)
    case = draw(np.random.default_rng(np.random.SeedSequence(3, spawn_key=(0, 0))), NODES)
    truncated = quasi_static(case.scene, targets_of(case), MATERIAL, DHAT, harsh)
    frames = len(truncated.position)
    assert truncated.attributes["status"] == "truncated" and 2 <= frames < FRAMES
    assert truncated.attributes["stopped_by"].startswith(f"frame {frames}: no equilibrium after 1 Newton iteration")
    assert len(truncated.stress) == len(truncated.attributes["solve_seconds"]) == frames
    np.testing.assert_array_equal(truncated.position, trajectory.position[:frames])
    truncated.check("truncated", "node")


def test_a_scene_that_starts_in_contact_is_refused():
    case = draw(np.random.default_rng(1), NODES)
    position = case.scene.rest_position.copy()
    position[case.scene.body == 1, 2] -= 0.02
    with pytest.raises(SimulationError, match="intersect"):
        quasi_static(replace(case.scene, rest_position=position), targets_of(case), MATERIAL, DHAT)

"""Scenes of the family: what is drawn, and one solved from end to end."""

import numpy as np
import pytest

from ast_sim.element_topology import MIDDLES, signed_volumes
from ast_sim.mechanics.contact_and_friction import Contact
from ast_sim.mechanics.driven import Driven
from ast_sim.mechanics.reaction import Reaction
from ast_sim.mechanics.solid_frames import solve_frame
from ast_sim.named_field import REACTION
from ast_sim.scene import NodeType
from ast_sim.simulate.families.deforming_plate import (
    CLAMP_MARGIN,
    CONTACT,
    DEFAULT_NODES,
    FRAMES,
    MATERIAL,
    MINIMUM_NODES,
    SETTINGS,
    draw,
    draw_drift,
    draw_geometry,
    draw_progress,
    solve,
)
from ast_sim.simulate.shapes.mesh_check import BadMesh
from ast_sim.simulate.shapes.obstacles import SHAPES
from ast_sim.simulate.shapes.plate_mesh import PlaneMesh, smallest_angle
from ast_sim.simulate.shapes.plate_outline_and_holes import OUTLINES
from ast_sim.support.errors import ConfigError

NODES, SHORT = 150, 41


@pytest.fixture(scope="module")
def trajectory():
    return solve(draw(np.random.default_rng(8), NODES, SHORT))


def faces_of(elements: np.ndarray) -> np.ndarray:
    faces = elements[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3)
    return np.unique(np.sort(faces, axis=1), axis=0)


def smallest_angle_between_faces(corners: np.ndarray) -> float:
    """Of tetrahedra [E,4,3], in degrees: pi minus the angle between the outward normals."""
    gradients = np.linalg.inv(corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)  # of barycentric coordinates 1 to 3
    normals = -np.concatenate([-gradients.sum(axis=1, keepdims=True), gradients], axis=1)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    pairs = np.triu_indices(4, 1)
    return float(180 - np.degrees(np.arccos(np.einsum("eai,ebi->eab", normals, normals)[:, *pairs].min())))


@pytest.mark.parametrize(("nodes", "count"), [(MINIMUM_NODES, 12), (400, 12), (DEFAULT_NODES, 16)])
def test_scenes_have_the_size_asked_for_and_are_valid(nodes, count):
    found, holes, drifts, sizes = {"obstacle": set(), "outline": set()}, 0, 0, []
    for index in range(count):
        case = draw(np.random.default_rng(index), nodes, 5)
        scene, attributes = case.scene, case.attributes
        scene.check()
        sizes.append(scene.num_nodes)
        assert 0.5 * nodes <= scene.num_nodes <= 1.7 * nodes
        assert np.abs(case.prescribed_position).max() < 0.5  # within the domain of the dataset
        plate = scene.body == 0
        rest = scene.rest_position
        length = np.ptp(rest[plate], axis=0)
        assert (length > [0.419, 0.17, 0.0249]).all() and (length < [0.62, 0.51, 0.053]).all()
        assert attributes["thickness"] == pytest.approx(length[2], rel=1e-5)
        assert np.array_equal(scene.node_type == NodeType.OBSTACLE, ~plate)
        clamps = rest[scene.node_type == NodeType.HANDLE]
        for clamp in (clamps[clamps[:, 0] < 0], clamps[clamps[:, 0] > 0]):  # each is a plane end, all of it
            values = np.linalg.svd(clamp[:, :2] - clamp[:, :2].mean(axis=0), compute_uv=False)
            assert values[1] < 1e-5 and values[0] > 0.1 and np.ptp(clamp[:, 2]) > 0.016
        surface = scene.surface()
        level = plate[surface[:, 0]] & (np.ptp(rest[surface, 2], axis=1) < 0.2 * length[2])  # top and bottom
        upwards = rest[surface[:, 0], 2] > 0
        top = PlaneMesh(rest[:, :2].astype(float), surface[level & upwards], [])
        assert np.degrees(smallest_angle(top)) > 21.9
        if nodes == DEFAULT_NODES:
            corners = rest[scene.elements[plate[scene.elements[:, 0]]]].astype(float)
            assert smallest_angle_between_faces(corners) > 10
        euler = scene.num_nodes - len(scene.edges()) + len(faces_of(scene.elements)) - scene.num_elements
        assert euler == 2 - len(attributes["holes"].split())  # two solid bodies less one for every hole
        holes += 2 - euler
        drifts += max(attributes["drift"]) > 0
        for name, values in found.items():
            values.add(attributes[name])
    assert all(len(values) >= 4 for values in found.values()) and 0.2 < drifts / count < 0.8
    assert found["obstacle"] <= set(SHAPES) and found["outline"] <= set(OUTLINES)
    assert holes >= (0 if nodes == MINIMUM_NODES else count / 3)
    if nodes == DEFAULT_NODES:
        assert min(sizes) < 1000 and max(sizes) > 1600 and 1000 < np.median(sizes) < 1600


def test_the_same_generator_draws_the_same_scene():
    one, two, other = (draw(np.random.default_rng(seed), NODES, SHORT) for seed in (5, 5, 6))
    np.testing.assert_array_equal(one.scene.rest_position, two.scene.rest_position)
    np.testing.assert_array_equal(one.scene.elements, two.scene.elements)
    np.testing.assert_array_equal(one.prescribed_position, two.prescribed_position)
    assert one.prescribed_position.shape != other.prescribed_position.shape or not np.array_equal(
        one.prescribed_position, other.prescribed_position
    )


def test_the_same_plate_on_coarser_meshes():
    for seed in range(8):
        drawn = draw_geometry(np.random.default_rng(seed), 400, 9)
        case = drawn.case
        again = drawn.remesh(1.0)
        np.testing.assert_array_equal(again.scene.rest_position, case.scene.rest_position)
        np.testing.assert_array_equal(again.prescribed_position, case.prescribed_position)
        for share in (0.5, 0.25):
            coarse = drawn.remesh_nearly(share)
            coarse.scene.check()
            plates = [c.scene.rest_position[c.scene.body == 0] for c in (case, coarse)]
            assert 0.7 * share <= len(plates[1]) / len(plates[0]) <= 1.5 * share
            np.testing.assert_allclose(np.ptp(plates[1], axis=0), np.ptp(plates[0], axis=0), rtol=0.06)
            obstacles = [c.prescribed_position[:, c.scene.body == 1] for c in (case, coarse)]
            np.testing.assert_array_equal(obstacles[1], obstacles[0])  # it keeps its mesh and its motion
            for end in (np.argmin, np.argmax):  # each clamp drifts as before
                moves = [
                    c.prescribed_position[:, k] - c.prescribed_position[0, k]
                    for c in (case, coarse)
                    for k in [_held(c, end)]
                ]
                np.testing.assert_allclose(moves[1], moves[0], atol=1e-12)


def test_plates_of_second_order_elements():
    sizes = []
    for seed in range(10):
        drawn = draw_geometry(np.random.default_rng(seed), DEFAULT_NODES, 9, order=2)
        case = drawn.case
        scene = case.scene
        scene.check()
        sizes.append(scene.num_nodes)
        rest = scene.rest_position.astype(float)
        plate = scene.elements[scene.body[scene.elements[:, 0]] == 0]
        assert plate.shape[1] == 10 and (signed_volumes(rest, plate) > 0).all()
        ends = plate[:, np.array(MIDDLES)]
        np.testing.assert_allclose(rest[plate[:, 4:]], rest[ends].mean(axis=2), atol=1e-7)
        _, across = np.unique(np.rint(1e6 * rest[scene.body == 0, :2]), axis=0, return_counts=True)
        assert set(across) == {3}  # as many nodes as in two layers of linear elements
        held = scene.node_type == NodeType.HANDLE
        for end in (held & (rest[:, 0] < 0), held & (rest[:, 0] > 0)):  # all of a plane end
            flat = rest[end][:, :2] - rest[end][:, :2].mean(axis=0)
            normal = np.linalg.svd(flat)[2][1]
            assert np.abs(flat @ normal).max() < 1e-6
            away = np.abs((rest[scene.body == 0, :2] - rest[end][:, :2].mean(axis=0)) @ normal)
            assert (away < 1e-6).sum() == end.sum()
        for share in (0.5, 8.0):
            other = drawn.remesh_nearly(share).scene
            assert other.elements.shape[1] == 10
            assert 0.7 * share <= (other.body == 0).sum() / (scene.body == 0).sum() <= 1.5 * share
    assert 1000 < np.median(sizes) < 1600


def test_the_force_of_second_order_plates_is_nearly_the_force_of_a_finer_mesh():
    drawn = draw_geometry(np.random.default_rng(7), DEFAULT_NODES, 9, order=2)
    forces = []
    for case in (drawn.case, drawn.remesh_nearly(4.0)):
        solved = solve_frame(case, 6, SETTINGS, first=0.5)
        driven = Driven.of(case.scene, case.prescribed_position)
        forces.append(Reaction(case.scene, driven, case.material).of(solved.position))
    size = np.linalg.norm(forces[1])
    assert size == pytest.approx(52.9, rel=0.01)  # newton
    assert np.linalg.norm(forces[0]) / size == pytest.approx(1.054, abs=0.01)  # a coarse mesh is too stiff
    assert np.linalg.norm(forces[0] - forces[1]) < 0.07 * size


def _held(case, end) -> int:
    """The number of the clamped node at the left end (argmin) or the right end (argmax)."""
    held = np.flatnonzero(case.scene.node_type == NodeType.HANDLE)
    return int(held[end(case.scene.rest_position[held, 0])])


def test_a_plate_that_cannot_be_meshed_with_so_few_nodes_says_so():
    with pytest.raises(BadMesh, match="a mesh with 0.001 of the nodes has triangles of poor shape"):
        draw_geometry(np.random.default_rng(1), 400, 9).remesh_nearly(0.001)


def test_the_obstacle_comes_down_and_returns():
    for index in range(12):
        case = draw(np.random.default_rng(index), NODES, FRAMES)
        scene, attributes = case.scene, case.attributes
        np.testing.assert_array_equal(case.prescribed_position[0], scene.rest_position)
        obstacle, plate = scene.body == 1, scene.body == 0
        travel = case.prescribed_position[:, obstacle] - case.prescribed_position[0, obstacle]
        np.testing.assert_allclose(travel, np.repeat(travel[:, :1], obstacle.sum(), axis=1), atol=1e-12)  # rigid
        gap = scene.rest_position[obstacle, 2].min() - scene.rest_position[plate, 2].max()
        assert 0.0039 < gap < 0.0151 and 0.02 <= attributes["depth"] <= 0.065
        if max(attributes["drift"]) == 0:
            np.testing.assert_allclose(travel[-1], 0, atol=1e-12)
            assert -travel[:, 0, 2].min() == pytest.approx(attributes["depth"] + gap, rel=1e-5)
        clamps = scene.rest_position[scene.node_type == NodeType.HANDLE, 0]
        inner = clamps[clamps < 0].max(), clamps[clamps > 0].min()
        lowest = case.prescribed_position[:, obstacle][:, np.argmin(scene.rest_position[obstacle, 2])]
        assert inner[0] + CLAMP_MARGIN <= lowest[0, 0] <= inner[1] - CLAMP_MARGIN  # stays between the clamps


def test_the_press_ends_late_and_is_let_go():
    held = linear = 0
    for index in range(40):
        progress = draw_progress(np.random.default_rng(index), FRAMES)
        assert len(progress) == FRAMES and progress[[0, -1]] == pytest.approx([0, 0]) and progress.max() == 1
        peak = int(np.argmax(progress))
        assert 0.63 * FRAMES < peak < 0.94 * FRAMES
        assert (np.diff(progress[: peak + 1]) > 0).all() and (np.diff(progress[peak:]) <= 0).all()
        held += progress[peak + 1] > progress[peak] - 1e-12
        linear += np.abs(np.diff(progress[: peak - 1], n=2)).max() < 1e-12
    assert 4 <= held <= 20 and 10 <= linear <= 30


@pytest.mark.parametrize("frames", [3, 5, 9])
def test_few_frames_hold_press_and_release(frames):
    for index in range(40):
        progress = draw_progress(np.random.default_rng(index), frames)
        assert len(progress) == frames and progress[[0, -1]] == pytest.approx([0, 0]) and progress.max() == 1
    with pytest.raises(ConfigError, match="frames is 2; a press and its release need at least 3"):
        draw(np.random.default_rng(0), NODES, 2)


def test_clamps_drift_outwards_smoothly():
    count = np.zeros(4)
    for index in range(60):
        rng = np.random.default_rng(index)
        progress = draw_progress(rng, FRAMES)
        drift = draw_drift(rng, progress)
        largest = np.linalg.norm(drift, axis=2).max(axis=1)
        moving = largest > 0
        count[moving[0] + 2 * moving[1]] += 1
        assert ((largest[moving] > 0.0195) & (largest[moving] < 0.0601)).all() and (drift[:, 0] == 0).all()
        assert (drift[0, :, 0] <= 0).all() and (drift[1, :, 0] >= 0).all()
        release = np.diff(progress).min()
        assert np.linalg.norm(np.diff(drift, axis=1), axis=2).max() <= 0.061 * max(-release, np.pi / 2 / (FRAMES - 1))
    assert (count > [15, 2, 2, 3]).all()


def test_a_scene_solved_end_to_end(trajectory):
    scene, attributes = trajectory.scene, trajectory.attributes
    trajectory.check("sample", "node")
    assert attributes["status"] == "complete" and trajectory.position.shape == (SHORT, scene.num_nodes, 3)
    # Computed again, by other means than the generator's own checks.
    rest, position = scene.rest_position.astype(float), trajectory.position.astype(float)
    contact = Contact(rest, scene.surface(), scene.body, CONTACT)
    corners = position[:, scene.elements]
    volume = np.linalg.det(corners[:, :, 1:] - corners[:, :, :1])
    jacobian = volume / volume[0]
    assert not any(contact.intersects(frame) for frame in position)
    gap = min(contact.gap(frame) for frame in position)
    assert 0 < gap < CONTACT.dhat and gap == pytest.approx(attributes["min_gap"])
    assert 0.5 < jacobian.min() < 1 and jacobian.min() == pytest.approx(attributes["min_jacobian"], rel=1e-5)
    assert attributes["max_imbalance"] < 1e-4 and attributes["max_residual"] <= 1 and attributes["work_balance"] < 0.03
    plate, deflection = scene.body == 0, position - position[0]
    assert -0.08 < deflection[:, plate, 2].min() < -0.015
    case = draw(np.random.default_rng(8), NODES, SHORT)
    prescribed = scene.prescribed
    np.testing.assert_array_equal(
        trajectory.position[:, prescribed], case.prescribed_position[:, prescribed].astype(np.float32)
    )
    stress = trajectory.stress[..., 0]
    assert 2e4 < stress.max() < 6e5
    assert np.all(stress[:, ~plate] == 0)
    still = np.abs(deflection[:, plate]).max(axis=(1, 2)) < 1e-9
    assert still[0] and stress[still].max() < 1e-3  # pascal: nothing before anything moves
    assert len(attributes["solve_seconds"]) == len(attributes["newton_iterations"]) == SHORT
    assert sum(attributes["newton_iterations"]) > 40
    reaction = trajectory.fields[REACTION]
    force = reaction.values.astype(float).sum(axis=1, where=(scene.body == 1)[:, None])  # of all nodes of the obstacle
    np.testing.assert_allclose(np.linalg.norm(force, axis=1), attributes["reaction"], rtol=1e-5, atol=1e-6)
    assert (reaction.location, reaction.unit) == ("node", "N") and not reaction.values[:, ~prescribed].any()
    assert np.abs(reaction.values.sum(axis=1)).max() < 1e-4 * np.abs(reaction.values).sum(axis=1).max() > 0
    expected = {"young": 1e6, "poisson": 0.4, "dhat": 1e-3, "kappa": MATERIAL.young, **case.attributes}
    assert {key: attributes[key] for key in expected} == expected


def test_a_plate_whose_clamps_return_springs_back(trajectory):
    """Without friction and with its clamps where they were, the plate is at rest again when the obstacle has left."""
    seed = next(s for s in range(8, 99) if max(draw(np.random.default_rng(s), NODES, SHORT).attributes["drift"]) == 0)
    found = trajectory if seed == 8 else solve(draw(np.random.default_rng(seed), NODES, SHORT))
    np.testing.assert_allclose(found.position[-1], found.position[0], atol=1e-6)

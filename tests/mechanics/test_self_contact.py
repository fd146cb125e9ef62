"""A body that touches itself: where, what it adds to Newton steps and forces, and how an answer is judged."""

from dataclasses import replace

import numpy as np
import pytest
from meshes import box_between
from solids import scene_of

from ast_sim.element_topology import node_areas, node_normals, surface_triangles
from ast_sim.material import Material
from ast_sim.mechanics.case import SolidCase
from ast_sim.mechanics.contact_and_friction import ContactSettings
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from ast_sim.mechanics.linearised.linearised_contact import CLEARANCE, NewtonSteps
from ast_sim.mechanics.linearised.near_pairs import NearSurfaces
from ast_sim.mechanics.physics_check import Law, check_physics
from ast_sim.mechanics.solid_frames import solve_frame
from ast_sim.scene import NodeType, Scene

RANGE = 5e-4


def clip() -> Scene:
    """A U of 80 x 20 x 50 mm that lies on its side: two legs of 20 mm, 10 mm apart, from x = 20 mm on. The lower face
    is held, and so is the upper one at the ends of the legs."""
    position, elements = box_between((8, 2, 5), (0, 0, 0), (0.08, 0.02, 0.05))
    x, _, z = position[elements].mean(axis=1).T
    elements = elements[~((x > 0.02) & (z > 0.02) & (z < 0.03))]
    kept, elements = np.unique(elements, return_inverse=True)
    position = position[kept]
    x, _, z = position.T
    held = np.isclose(z, 0) | (np.isclose(z, 0.05) & (x > 0.055))
    types = np.where(held, NodeType.HANDLE, NodeType.NORMAL)
    return scene_of(position, elements.reshape(-1, 4), np.zeros(len(position), int), types)


@pytest.fixture(scope="module")
def closed():
    """The upper leg is pressed down by 14 mm, so the legs touch: the case, and the solver's positions."""
    scene = clip()
    rest = scene.rest_position.astype(float)
    upper = scene.prescribed & (rest[:, 2] > 0.04)
    down = np.linspace(0, 0.014, 5)[:, None, None] * np.array([0, 0, -1.0]) * upper[:, None]
    law = NeoHookean(np.full(scene.num_elements, 1e6), np.full(scene.num_elements, 0.3))
    contact = ContactSettings(RANGE, 1e6, self_contact=True)
    case = SolidCase(scene, rest + down, law, contact, "element", attributes={"name": "clip"})
    solved = solve_frame(case, 4)
    assert solved.failure == ""
    return case, solved.position.astype(float)


def law_of(scene: Scene, contact_range: float = RANGE) -> tuple[Scene, Law]:
    columns = np.tile(np.float32([1e6, 0.3]), (scene.num_elements, 1))
    return replace(scene, material=columns), Law(Material(("young", "poisson"), {"friction": 0.0}), contact_range)


def pairs(scene: Scene, position: np.ndarray):
    return NearSurfaces(scene, np.arange(3 * scene.num_nodes)).pairs(position)


@pytest.mark.parametrize("gap", [2e-3, -1e-3])
def test_the_legs_of_a_clip_face_each_other_at_their_distance(gap):
    scene = clip()
    rest = scene.rest_position.astype(float)
    moved = rest - np.where((rest[:, 2] > 0.025)[:, None], [0, 0, 0.01 - gap], 0)
    near = pairs(scene, moved)
    assert len(near.gap) >= 2 * 18  # from each leg, the nodes right above or below the other one
    facing = np.abs(near.directions[: len(near.gap), 2::3].toarray()).sum(axis=1) > 1.99  # along z, from both sides
    np.testing.assert_allclose(near.gap[facing], gap, atol=1e-8)
    assert facing.sum() >= 2 * 18 and near.gap.min() > gap - 1e-8


def test_neighbours_and_the_two_sides_of_a_wall_do_not_touch():
    """A plate of one thin layer that is rolled up by a third of a circle, then to a third of its thickness."""
    position, elements = box_between((12, 2, 1), (0, 0, 0), (0.12, 0.02, 0.002))
    scene = scene_of(position, elements, np.zeros(len(position), int), np.zeros(len(position)))
    angle, radius = position[:, 0] / 0.12 * 2, 0.06 - position[:, 2]
    rolled = np.stack([radius * np.sin(angle), position[:, 1], -radius * np.cos(angle)], axis=1)
    for placed in (position, rolled, position * [1, 1, 1 / 3]):
        assert not len(pairs(scene, placed.astype(float)).gap)


def test_the_ends_of_a_strip_that_is_rolled_up_meet():
    position, elements = box_between((24, 2, 1), (0, 0, 0), (0.24, 0.02, 0.002))
    scene = scene_of(position, elements, np.zeros(len(position), int), np.zeros(len(position)))
    angle, radius = position[:, 0] / 0.24 * 6.4, 0.04 - position[:, 2] - 0.0012 * position[:, 0] / 0.01 / 8
    spiral = np.stack([radius * np.sin(angle), position[:, 1], -radius * np.cos(angle)], axis=1)
    near = pairs(scene, spiral)
    assert len(near.gap) and np.abs(near.gap).max() < 0.006


def test_newton_steps_keep_a_clip_from_passing_through_itself(closed):
    case, truth = closed
    scene, rest = case.scene, case.scene.rest_position.astype(float)
    steps = NewtonSteps(scene, case.material, CLEARANCE * RANGE)
    free = ~scene.prescribed
    position = np.where(free[:, None], rest + 0.9 * (truth - rest), truth)
    for step in range(6):
        position = steps.step(position, from_afar=step == 0)
    displacement = np.linalg.norm((truth - rest)[free])
    assert np.linalg.norm((position - truth)[free]) < 0.02 * displacement
    assert pairs(scene, position).gap.min() > -RANGE  # they would lie 4 mm inside each other


def test_forces_of_contact_explain_what_the_legs_press(closed):
    case, truth = closed
    scene, law = law_of(case.scene)
    check = check_physics(scene, truth.astype(np.float32)[None], [4], law, "m")
    assert check.residual.value < 100 and check.imbalance.value < 1e-4
    assert check.folded.value == 0 and check.folded.sentence == "none is"


def test_an_exact_answer_keeps_bodies_from_passing_through_themselves(closed):
    scene, law = law_of(closed[0].scene)
    assert law.contact(scene).self_contact == (0,)
    assert law_of(scene, 0.004)[1].contact(scene).self_contact == (0,)
    assert law_of(scene, 0.0101)[1].contact(scene).self_contact == ()  # the slit is thinner: it would push at rest


@pytest.mark.parametrize("inside_out", [False, True])
def test_elements_that_lie_in_another_part_of_their_body_are_counted(inside_out):
    """The upper leg comes down by 20 mm: its lower layer of elements lies in the upper layer of the lower leg."""
    scene, law = law_of(clip())
    if inside_out:
        scene = replace(scene, elements=scene.elements[:, [1, 0, 2, 3]])
    rest = scene.rest_position
    moved = rest - np.where((rest[:, 2] > 0.025)[:, None], np.float32([0, 0, 0.02]), 0)
    check = check_physics(scene, np.stack([rest, moved]), [0, 4], law, "m")
    x, _, z = rest[scene.elements].mean(axis=1).T
    inside = (x > 0.02) & (((z > 0.01) & (z < 0.02)) | ((z > 0.03) & (z < 0.04)))
    assert check.folded.value == pytest.approx(inside.sum(), rel=0.1) and check.folded.frame == 4
    assert "inside another part of their own body" in str(check)


def test_the_areas_of_nodes_add_up_and_their_normals_point_out():
    position, elements = box_between((3, 2, 4), (0, 0, 0), (0.3, 0.2, 0.5))
    faces = surface_triangles(position, elements)
    areas, normals = node_areas(position, faces), node_normals(position, faces)
    np.testing.assert_allclose(areas.sum(axis=0), 0, atol=1e-15)
    top = np.isclose(position[:, 2], 0.5)
    assert areas[top, 2].sum() == pytest.approx(0.3 * 0.2)
    edge = np.isclose(position[:, :2], [[0.3, 0.2]]).any(axis=1) | np.isclose(position[:, :2], 0).any(axis=1)
    np.testing.assert_allclose(normals[top & ~edge], [[0, 0, 1]] * (top & ~edge).sum())
    inner = np.setdiff1d(np.arange(len(position)), faces)
    assert len(inner) and not normals[inner].any()
    outer = np.unique(faces)
    np.testing.assert_allclose(np.linalg.norm(normals[outer], axis=1), 1)
    assert (np.einsum("ni,ni->n", normals, position - [0.15, 0.1, 0.25])[outer] > 0).all()

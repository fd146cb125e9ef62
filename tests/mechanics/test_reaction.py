"""The force that moves a body: against closed forms, against the solver, and on positions with errors."""

import sys
from dataclasses import replace

import meshio
import numpy as np
import pytest
from simulate.own_assembly.assemblies import SPEC, box, case_of, write_assembly, write_box

from ast_sim.material import Material
from ast_sim.mechanics.driven import Driven
from ast_sim.mechanics.elements.elasticity import Elasticity
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from ast_sim.mechanics.linearised.contact_forces import ContactForces
from ast_sim.mechanics.reaction import Reaction
from ast_sim.scene import NodeType, Scene
from ast_sim.simulate.families import assembly
from ast_sim.simulate.shapes.parts import rectilinear

YOUNG, POISSON = 1.5e6, 0.3


def solved(folder, spec=SPEC, **given):
    case = case_of(write_assembly(folder, spec), **given)
    return case.scene, assembly.solve(case)


def law_of(scene: Scene) -> NeoHookean:
    return NeoHookean.of_scene(scene, Material(("young", "poisson")))


def test_a_block_in_uniaxial_strain():
    """Between its ends, all nodes move in proportion: the force on 10 x 10 is area times P_zz = mu l + c / l."""
    position, elements = box((0, 0, 0), (10, 10, 5), (4, 4, 4))
    ends = (position[:, 2] == 0) | (position[:, 2] == 5)
    types = np.where(ends, NodeType.HANDLE, NodeType.NORMAL).astype(np.uint8)
    material = np.tile(np.float32([YOUNG, POISSON]), (len(elements), 1))
    scene = Scene(np.float32(position), np.int32(elements), types, np.zeros(len(position), np.int32), material)
    law = NeoHookean(*material[0].astype(float))
    for stretch in (0.8, 1.0, 1.3):
        moved = np.float32(position * [1, 1, stretch])
        force = Reaction(scene, Driven.of(scene, np.stack([np.float32(position), moved])), law).of(moved)
        expected = 100 * (law.mu * stretch + law.pressure_factor(np.array(stretch)) / stretch)
        assert force == pytest.approx([0, 0, expected], abs=1e-6 * YOUNG)


@pytest.mark.parametrize("who_moves", ["the rigid punch", "the block"])
def test_the_force_is_the_solvers(tmp_path, who_moves):
    spec = SPEC
    if who_moves == "the block":
        spec = spec.replace('fixed = "zmin"', 'move = {where="zmin", translation=[0.2, 0, "travel"]}')
        spec = spec.replace("move = { translation = [0, 0, '-travel'] }", "")
        spec = spec.replace("frames = 3", "frames = 3\nfriction = 0.3")
    scene, truth = solved(tmp_path, spec, travel=1.2)
    force = Reaction(scene, Driven.of(scene, truth.position), law_of(scene))
    found = np.array([force.of(position) for position in truth.position])
    recorded = np.array(truth.attributes["reaction"])
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), recorded, rtol=1e-3, atol=1e-3)
    # The punch is pushed down, the block up.
    assert recorded[-1] > 1e6 and (found[-1, 2] > 0) == (who_moves == "the block")


ENDS = """
unit = "mm"
frames = 3
order = {order}
[parameters]
young = [1e6, 2e6]
[parts.bush]
file = "block.vtu"
young = "young"
poisson = 0.3
fixed = "{held}"
[[parts.bush.move]]
where = "{moved}"
{motion}
[parts.far]
file = "punch.vtu"
rigid = true
offset = [12, 0, 0]
"""


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize(
    ("held", "moved", "motion"),
    [
        ("zmin", "zmax", "translation = [0, 0, -0.5]"),
        ("xmin", "xmax", "translation = [0.3, 0.4, 0.1]"),
        ("xmin", "xmax", "rotation = 20\naxis = [1, 0, 0]\npoint = [0, 5, 2.5]"),
        ("xmin", "xmax", "rotation = 8\naxis = [0, 1, 0]\npoint = [10, 0, 2.5]"),
    ],
    ids=["pressed", "pulled aside", "twisted", "bent"],
)
def test_a_part_that_is_held_at_one_end_and_moved_at_the_other(tmp_path, order, held, moved, motion):
    """The work of force and torque is the energy: force times way, or torque times angle, over two where it is linear.

    The same figures follow from the positions alone.
    """
    scene, truth = solved(tmp_path, ENDS.format(order=order, held=held, moved=moved, motion=motion))
    driven = Driven.of(scene, truth.position)
    axis = {"x": 0, "y": 1, "z": 2}[moved[0]]
    rest = scene.rest_position
    np.testing.assert_array_equal(
        driven.nodes, (scene.body == 0) & np.isclose(rest[:, axis], rest[scene.body == 0, axis].max())
    )
    found, recorded = Reaction(scene, driven, law_of(scene)), truth.attributes
    forces = np.array([np.linalg.norm(found.of(position)) for position in truth.position])
    np.testing.assert_allclose(forces, recorded["reaction"], rtol=2e-3, atol=1e-3 * max(recorded["reaction"]))
    energy = recorded["elastic_energy"]
    if "rotation" in motion:
        torques = [found.torque(position) for position in truth.position]
        np.testing.assert_allclose(torques, recorded["torque"], rtol=2e-3, atol=1e-3 * max(recorded["torque"]))
        angle = np.radians(float(motion.split()[2]))
        assert recorded["torque"][-1] * angle / 2 == pytest.approx(energy[-1], rel=0.03)
        assert min(recorded["torque"][1:]) > 0
    else:
        way = (truth.position[-1] - rest)[driven.nodes][0]
        assert found.of(truth.position[-1]) @ way / 2 == pytest.approx(energy[-1], rel=0.15)
        assert "torque" not in recorded


def straight_into_a_clamp(folder, friction, motion):
    """The punch stands on faces of which one corner is held: three fifths of its force strain no element."""
    spec = SPEC.replace('fixed = "zmin"', 'fixed = "xmin"').replace("frames = 3", f"frames = 3\nfriction = {friction}")
    spec = spec.replace("rigid = true", "rigid = true\noffset = [-2, 0, 0]").replace("[0, 0, '-travel']", motion)
    return solved(folder, spec, travel=0.5)


@pytest.mark.parametrize(
    ("friction", "motion", "tolerance"),
    [
        (0.0, "[0, 0, '-travel']", 1e-4),
        (0.3, "[0, 0, '-travel']", 0.01),
        (0.3, "['0.6 * travel', '0.6 * travel', '-travel']", 0.01),
    ],
    ids=["smooth", "rough", "across the axes"],
)
def test_what_goes_straight_into_held_nodes_counts(tmp_path, friction, motion, tolerance):
    """With four rays of Coulomb's cone alone, the force of the last case is 5 % off. (The solver takes the sizes of
    friction from the iteration before: this is what is left.)"""
    scene, truth = straight_into_a_clamp(tmp_path, friction, motion)
    contact, nodal = ContactForces(scene, 0.05, friction), truth.fields["reaction"].values
    punch, block = (scene.prescribed & (scene.body == body) for body in (1, 0))
    for body, nodes in ((1, punch), (0, block)):
        driven = Driven(body, nodes, truth.position[:, nodes].astype(float))
        force, strains = Reaction(scene, driven, law_of(scene), contact), Reaction(scene, driven, law_of(scene))
        for position, stored in zip(truth.position[1:], nodal[1:, nodes].sum(axis=1), strict=True):
            away = np.linalg.norm(force.of(position) - stored)
            assert away < tolerance * np.linalg.norm(stored)
            assert np.linalg.norm(strains.of(position) - stored) > 0.5 * np.linalg.norm(stored)
        assert not force.rough
    shaken = truth.position[-1] + np.random.default_rng(0).normal(0, 0.05, truth.position[-1].shape)
    shaken[scene.prescribed] = truth.position[-1][scene.prescribed]
    np.testing.assert_array_equal(force.shares(shaken), strains.shares(shaken))  # forces of no equilibrium show nothing


def test_without_ipctk_pairs_of_edges_are_missing(tmp_path, monkeypatch):
    """They carry 0.4 % of this force."""
    scene, truth = straight_into_a_clamp(tmp_path, 0.0, "[0, 0, '-travel']")
    monkeypatch.setitem(sys.modules, "ipctk", None)
    force = Reaction(scene, Driven.of(scene, truth.position), law_of(scene), ContactForces(scene, 0.05, 0.0))
    stored = truth.fields["reaction"].values[-1, scene.body == 1].sum(axis=0)
    away = np.linalg.norm(force.of(truth.position[-1]) - stored) / np.linalg.norm(stored)
    assert 1e-3 < away < 5e-3 and force.rough


def test_edges_that_cross_beside_held_nodes(tmp_path):
    """A rigid bar across a bar that is held at one end: no node of either is near a face of the other."""
    spec = write_assembly(tmp_path, SPEC.replace('fixed = "zmin"', 'fixed = "xmin"'))
    write_box(tmp_path / "block.vtu", (0, 4, 0), (10, 6, 2), (4, 1, 1))
    write_box(tmp_path / "punch.vtu", (0.5, 0, 2.2), (2, 10, 4), (1, 4, 1))
    case = case_of(spec, travel=0.5)
    scene, truth = case.scene, assembly.solve(case)
    driven = Driven.of(scene, truth.position)
    force, strains = (Reaction(scene, driven, law_of(scene), one) for one in (case.contact_forces(), None))
    for position, nodal in zip(truth.position[1:], truth.fields["reaction"].values[1:], strict=True):
        stored = nodal[driven.nodes].sum(axis=0)
        np.testing.assert_allclose(force.of(position), stored, atol=1e-3 * np.linalg.norm(stored))
        assert np.linalg.norm(strains.of(position) - stored) > 0.3 * np.linalg.norm(stored)


def test_a_face_whose_nodes_are_all_held_shows_no_force(tmp_path):
    """The punch comes within the range of contact of the held face: the solver stores a force, positions have none."""
    scene, truth = solved(tmp_path, SPEC.replace('fixed = "zmin"', 'fixed = "zmax"'), travel=0.17)
    force = Reaction(scene, Driven.of(scene, truth.position), law_of(scene), ContactForces(scene, 0.05, 0.0))
    assert not force.of(truth.position[1]).any() and not force.unseen
    assert not force.of(truth.position[-1]).any() and force.unseen
    assert truth.attributes["reaction"][-1] > 1


@pytest.mark.parametrize("known", [True, False])
def test_a_fine_tool_on_a_coarse_part(tmp_path, known):
    """The tool stands within one face, whose corners are many of its own edges away: what is near is a matter of the
    part's edges. With the mean edge of both, this force was 0."""
    spec = write_assembly(tmp_path, SPEC)
    write_box(tmp_path / "block.vtu", (0, 0, 0), (10, 10, 5), (2, 2, 1))
    write_box(tmp_path / "punch.vtu", (1.5, 1, 5.2), (4, 3, 8), (8, 8, 6))
    case = case_of(spec, travel=0.6)
    scene, truth = case.scene, assembly.solve(case)
    driven = Driven.of(scene, truth.position)
    force = Reaction(scene, driven, law_of(scene), case.contact_forces() if known else None)
    for position, nodal in zip(truth.position[1:], truth.fields["reaction"].values[1:], strict=True):
        stored = nodal[driven.nodes].sum(axis=0)
        np.testing.assert_allclose(force.of(position), stored, atol=1e-3 * np.linalg.norm(stored))


def test_it_is_the_force_on_the_body_that_moves_farthest_in_all_frames(tmp_path):
    """The punch that goes farther comes back; then the other one is farther away."""
    whole, punch = SPEC.replace("frames = 3", "frames = 5").split("[parts.punch]")
    there_and_back = punch.replace("[0, 0, '-travel']", "[[0, 0, '-travel'], [0, 0, 0]]")
    shorter = punch.replace("'-travel'", "'-0.8 * travel'")
    spec = f"{whole}[parts.left]\noffset = [-2.4, 0, 0]{there_and_back}[parts.right]\noffset = [2.4, 0, 0]{shorter}"
    scene, truth = solved(tmp_path, spec, travel=1.2)
    force, recorded = Reaction(scene, Driven.of(scene, truth.position), law_of(scene)), truth.attributes["reaction"]
    found = [np.linalg.norm(force.of(position)) for position in truth.position]
    np.testing.assert_allclose(found, recorded, rtol=1e-2, atol=1e-6 * max(recorded))
    other = Reaction(scene, replace(Driven.of(scene, truth.position), body=2), law_of(scene)).of(truth.position[-1])
    assert np.linalg.norm(other) > 1e6 > recorded[-1]


def test_a_part_that_touches_itself(tmp_path):
    """The punch closes a slit. The forces between its lips are no force on the punch, however large they are."""
    lines = [np.linspace(0, 10, 11), np.linspace(0, 4, 5), np.array([0, 0.9, 1.8, 2.2, 3.1, 4])]
    solid = np.ones((10, 4, 5), bool)
    solid[:8, :, 2] = False
    position, elements = rectilinear(lines, solid)
    meshio.Mesh(position, {"tetra": elements}).write(tmp_path / "clip.vtu")
    spec = SPEC.replace('"block.vtu"', '"clip.vtu"\nself_contact = true')
    spec = spec.replace("rigid = true", "rigid = true\noffset = [-3, -3, -1]")
    scene, truth = solved(tmp_path, spec, travel=1.4)
    force = Reaction(scene, Driven.of(scene, truth.position), law_of(scene))
    recorded = np.array(truth.attributes["reaction"])
    found = [np.linalg.norm(force.of(position)) for position in truth.position]
    np.testing.assert_allclose(found, recorded, rtol=0.02, atol=1e-3)
    assert all(len(force._folds(position.astype(float))[0]) > 5 for position in truth.position[1:])


def test_where_nothing_touches_no_force_is_needed(tmp_path):
    scene, truth = solved(tmp_path, travel=0.1)
    force = Reaction(scene, Driven.of(scene, truth.position), law_of(scene))
    assert np.abs([force.of(position) for position in truth.position]).max() < 1e-3


def test_errors_of_positions_average_out(tmp_path):
    """The forces at the clamp alone err more, because they come from one layer of elements."""
    scene, truth = solved(tmp_path, travel=1.2)
    law = NeoHookean(*scene.material[0].astype(float))
    soft = scene.deforming_nodes[scene.elements].any(axis=1)
    elastic = Elasticity(scene.rest_position.astype(float), scene.elements[soft], law)
    held, force, rng = (
        scene.node_type == NodeType.HANDLE,
        Reaction(scene, Driven.of(scene, truth.position), law_of(scene)),
        np.random.default_rng(0),
    )
    size = 0.03 * np.linalg.norm(truth.position[-1] - truth.position[0], axis=1).max()
    exact, errors = force.of(truth.position[-1]), []
    for _ in range(20):
        noise = np.where(scene.prescribed[:, None], 0, size * rng.standard_normal(truth.position[-1].shape))
        guess = truth.position[-1] + noise
        at_clamp = -elastic.gradient(elastic.evaluate(guess))[0][held].sum(axis=0)
        errors.append([np.linalg.norm(force.of(guess) - exact), np.linalg.norm(at_clamp - exact)])
    smooth, plain = np.sqrt(np.square(errors).mean(axis=0))
    assert smooth < 0.8 * plain

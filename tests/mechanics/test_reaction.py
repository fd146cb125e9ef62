"""The force that moves a body: against closed forms, against the solver, and on positions with errors."""

import meshio
import numpy as np
import pytest
from simulate.own_assembly.assemblies import SPEC, box, write_assembly

from ast_sim.mechanics.case import driven_body
from ast_sim.mechanics.elements.elasticity import Elasticity
from ast_sim.mechanics.elements.material import NeoHookean
from ast_sim.mechanics.reaction import Reaction
from ast_sim.scene import NodeType, Scene
from ast_sim.simulate.families import assembly
from ast_sim.simulate.own_assembly.parameters import completed
from ast_sim.simulate.own_assembly.spec_reader import read_spec
from ast_sim.simulate.shapes.parts import rectilinear

YOUNG, POISSON = 1.5e6, 0.3


def solved(folder, spec=SPEC, **given):
    read = read_spec(write_assembly(folder, spec))
    drawn = assembly.scene_of(read, completed(read.parameters, given), None, read.frames)
    return drawn.case.scene, assembly.solve(drawn.case)


def test_a_block_in_uniaxial_strain():
    """Between its ends, all nodes move in proportion: the force on 10 x 10 is area times P_zz = mu l + c / l."""
    position, elements = box((0, 0, 0), (10, 10, 5), (4, 4, 4))
    ends = (position[:, 2] == 0) | (position[:, 2] == 5)
    types = np.where(ends, NodeType.HANDLE, NodeType.NORMAL).astype(np.uint8)
    material = np.tile(np.float32([YOUNG, POISSON]), (len(elements), 1))
    scene = Scene(np.float32(position), np.int32(elements), types, np.zeros(len(position), np.int32), material)
    law = NeoHookean(*material[0].astype(float))
    for stretch in (0.8, 1.0, 1.3):
        force = Reaction(scene, 0).of(position * [1, 1, stretch])
        expected = 100 * (law.mu * stretch + law.pressure_factor(np.array(stretch)) / stretch)
        assert force == pytest.approx([0, 0, expected], abs=1e-6 * YOUNG)


@pytest.mark.parametrize("who_moves", ["the rigid punch", "the block"])
def test_the_force_is_that_of_the_solver(tmp_path, who_moves):
    spec = SPEC
    if who_moves == "the block":
        spec = spec.replace('fixed = "zmin"', 'move = {where="zmin", translation=[0.2, 0, "travel"]}')
        spec = spec.replace("move = { translation = [0, 0, '-travel'] }", "")
        spec = spec.replace("frames = 3", "frames = 3\nfriction = 0.3")
    scene, truth = solved(tmp_path, spec, travel=1.2)
    force = Reaction(scene, driven_body(scene, truth.position))
    found = np.array([force.of(position) for position in truth.position])
    recorded = np.array(truth.attributes["reaction"])
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), recorded, rtol=1e-3, atol=1e-3)
    # The punch is pushed down, the block up.
    assert recorded[-1] > 1e6 and (found[-1, 2] > 0) == (who_moves == "the block")


def test_it_is_the_force_on_the_body_that_moves_farthest_in_all_frames(tmp_path):
    """The punch that goes farther comes back; then the other one is farther away."""
    whole, punch = SPEC.replace("frames = 3", "frames = 5").split("[parts.punch]")
    there_and_back = punch.replace("[0, 0, '-travel']", "[[0, 0, '-travel'], [0, 0, 0]]")
    shorter = punch.replace("'-travel'", "'-0.8 * travel'")
    spec = f"{whole}[parts.left]\noffset = [-2.4, 0, 0]{there_and_back}[parts.right]\noffset = [2.4, 0, 0]{shorter}"
    scene, truth = solved(tmp_path, spec, travel=1.2)
    force, recorded = Reaction(scene, driven_body(scene, truth.position)), truth.attributes["reaction"]
    found = [np.linalg.norm(force.of(position)) for position in truth.position]
    np.testing.assert_allclose(found, recorded, rtol=1e-2, atol=1e-6 * max(recorded))
    other = Reaction(scene, 2).of(truth.position[-1])
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
    force, recorded = Reaction(scene, driven_body(scene, truth.position)), np.array(truth.attributes["reaction"])
    found = [np.linalg.norm(force.of(position)) for position in truth.position]
    np.testing.assert_allclose(found, recorded, rtol=0.02, atol=1e-3)
    assert all(len(force._folds(position.astype(float))[0]) > 10 for position in truth.position[1:])


def test_where_nothing_touches_no_force_is_needed(tmp_path):
    scene, truth = solved(tmp_path, travel=0.1)
    assert (
        np.abs([Reaction(scene, driven_body(scene, truth.position)).of(position) for position in truth.position]).max()
        < 1e-3
    )


def test_errors_of_positions_average_out(tmp_path):
    """The forces at the clamp alone err more, because they come from one layer of elements."""
    scene, truth = solved(tmp_path, travel=1.2)
    law = NeoHookean(*scene.material[0].astype(float))
    soft = scene.deforming_nodes[scene.elements].any(axis=1)
    elastic = Elasticity(scene.rest_position.astype(float), scene.elements[soft], law)
    held, force, rng = (
        scene.node_type == NodeType.HANDLE,
        Reaction(scene, driven_body(scene, truth.position)),
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

"""Newton steps and load steps: two free bodies, friction, halving, damping, restarts."""

from dataclasses import replace

import numpy as np
import pytest
from meshes import two_tetrahedra
from solids import blocks, pressed

from ast_sim.mechanics.contact_and_friction import Contact, ContactSettings
from ast_sim.mechanics.elements.elasticity import Elasticity
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from ast_sim.mechanics.load_halving import QuasiStatic
from ast_sim.mechanics.solid_frames import quasi_static
from ast_sim.mechanics.solver import Newton, NotConverged, SolverSettings
from ast_sim.mechanics.unfinished import Checkpoint
from ast_sim.simulate.shapes import mesh
from ast_sim.support.errors import SimulationError


def solver_of(case, settings=None) -> QuasiStatic:
    rest = case.scene.rest_position.astype(float)
    contact = Contact(rest, case.scene.surface(), case.scene.body, case.contact)
    elasticity = Elasticity(rest, case.scene.elements, case.material)
    return QuasiStatic(elasticity, contact, case.scene.prescribed, rest, settings)


@pytest.fixture(scope="module")
def two_blocks():
    case = pressed(*blocks(), depth=0.02)
    return case, quasi_static(case)


def test_two_free_bodies_carry_the_same_load(two_blocks):
    case, trajectory = two_blocks
    trajectory.check("blocks", "element")
    attributes, scene = trajectory.attributes, case.scene
    assert attributes["status"] == "complete" and trajectory.num_frames == 6
    assert 0 < attributes["min_gap"] < 1e-3 and 0.5 < attributes["min_jacobian"] < 1
    assert attributes["max_residual"] <= 1 and attributes["max_imbalance"] < 1e-3 and attributes["work_balance"] < 0.02
    assert attributes["young"] == [1e6, 2e6] and attributes["poisson"] == 0.3
    assert attributes["contact_area"][0] == 0 and 1 < attributes["contact_area"][-1] / 0.14**2 < 2.5
    solver = solver_of(case)
    for target in case.prescribed_position[1:]:
        solver.advance(target)
    np.testing.assert_array_equal(solver.newton.position.astype(np.float32), trajectory.position[-1])
    forces = solver.newton.reactions()
    held = [forces[(scene.body == b) & scene.prescribed].sum(axis=0) for b in (0, 1)]
    np.testing.assert_allclose(held[0], -held[1], atol=1e-3 * np.abs(held[1]).max())
    assert np.linalg.norm(held[1]) == pytest.approx(attributes["reaction"][-1]) and held[1][2] < -100
    # The mean vertical stress of each body, weighted by volume, times its height is the moment of that force.
    corners = trajectory.position[-1][scene.elements].astype(float)
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    for body, height in ((0, 0.12), (1, 0.12)):
        chosen = scene.body[scene.elements[:, 0]] == body
        moment = (trajectory.cauchy_stress[-1, chosen, 2] * volume[chosen]).sum()
        assert moment == pytest.approx(held[1][2] * height, rel=0.15)


def test_von_mises_follows_from_the_tensor(two_blocks):
    _, trajectory = two_blocks
    xx, yy, zz, xy, yz, zx = np.moveaxis(trajectory.cauchy_stress.astype(float), 2, 0)
    mises = np.sqrt(0.5 * ((xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2) + 3 * (xy**2 + yz**2 + zx**2))
    np.testing.assert_allclose(mises, trajectory.stress[..., 0], rtol=1e-4, atol=1e-2)


def test_the_solution_does_not_depend_on_the_number_of_load_steps(two_blocks):
    case, trajectory = two_blocks
    coarse = solver_of(case)
    coarse.advance(case.prescribed_position[-1])
    # Two solutions that both stop at a residual of the tolerance differ by about that share of the displacement.
    np.testing.assert_allclose(coarse.newton.position, trajectory.position[-1], atol=3e-4 * 0.02)


def test_a_load_step_that_fails_is_halved():
    case = pressed(*blocks(), depth=0.02)
    with pytest.raises(NotConverged, match="not at its target after 1 moves, also after 0 halvings and 60 damped"):
        solver_of(case, SolverSettings(max_moves=1, max_halvings=0)).advance(case.prescribed_position[-1])
    solver, expected = solver_of(case, SolverSettings(max_moves=2)), solver_of(case)
    solver.advance(case.prescribed_position[-1])
    expected.advance(case.prescribed_position[-1])
    assert solver.halvings > 0
    np.testing.assert_allclose(solver.newton.position, expected.newton.position, atol=3e-4 * 0.02)


def test_what_halving_does_not_help_is_damped():
    """A slender column that is pressed snaps aside in eleven iterations: with eight it needs inertia to get there."""
    column = mesh.plate((0.6, 0.03, 0.02), (24, 2, 1), np.zeros((0, 3)))
    rest, elements = column
    rest = rest + np.cos(np.pi * rest[:, :1] / 0.6) * [0, 0, 5e-4]  # an imperfection decides the side
    ends = np.isclose(np.abs(rest[:, 0]), 0.3)
    target = rest * [0.85, 1, 1]
    surface = np.array([[0, 1, 2]])
    contact = Contact(rest, surface, np.zeros(len(rest), int), ContactSettings(1e-4, 1e6))

    def solver(settings: SolverSettings) -> QuasiStatic:
        return QuasiStatic(Elasticity(rest, elements, NeoHookean(1e6, 0.3)), contact, ends, rest, settings)

    hasty = solver(SolverSettings(max_iterations=8, max_halvings=0))
    hasty.advance(target)
    assert hasty._damped is not None and hasty.newton.residual() <= 1
    assert np.ptp(hasty.newton.position[:, 2]) > 0.03  # it did buckle
    forces = hasty.newton.reactions()
    np.testing.assert_allclose(forces[~ends], 0, atol=1e-4 * np.abs(forces).max())  # and rests without inertia


def test_friction_holds_what_slides_without_it():
    """Pushed aside, a pressed block goes along without friction and shears the other with it, up to mu times N."""
    ratio = {}
    for friction in (0.0, 0.2, 2.0):
        case = pressed(*blocks(), depth=0.01, shift=0.03, friction=friction)
        solver = solver_of(case)
        for target in case.prescribed_position[1:]:
            solver.advance(target)
        assert (solver.dissipation > 0) == (friction > 0)
        state, upper = solver.newton.state.contact, case.scene.body[solver.newton.contact.nodes] == 1
        normal, tangential = (g[upper].sum(axis=0) for g in (state.barrier_gradient(), state.friction_gradient()))
        ratio[friction] = np.linalg.norm(tangential) / np.linalg.norm(normal)
    assert ratio[0.0] == 0
    assert ratio[0.2] == pytest.approx(0.2, rel=0.02)  # it slides: Coulomb's cap
    assert 0.2 < ratio[2.0] < 2.0  # it sticks: as much as the shear takes


def test_a_resumed_solve_gives_the_same_bits(two_blocks, tmp_path, monkeypatch):
    case, whole = two_blocks
    monkeypatch.setattr("ast_sim.mechanics.unfinished.SECONDS_BETWEEN_WRITES", 0.0)
    checkpoint, frames = Checkpoint(tmp_path / "a.npz"), []

    class Killed(Exception):
        pass

    def kill(done: int, of: int, iterations: int) -> None:
        frames.append(done)
        assert of == 6
        if done == 4:
            raise Killed

    with pytest.raises(Killed):
        quasi_static(case, checkpoint=Checkpoint(tmp_path / "a.npz", kill))
    assert checkpoint.load()["position"].shape[0] == 4
    resumed = quasi_static(case, checkpoint=checkpoint)
    for name in ("position", "stress", "cauchy_stress"):
        np.testing.assert_array_equal(getattr(resumed, name), getattr(whole, name))
    for key, value in whole.attributes.items():
        if key != "solve_seconds":
            assert resumed.attributes[key] == value, key
    checkpoint.remove()
    assert checkpoint.load() is None and list(tmp_path.iterdir()) == []


def test_a_trajectory_that_cannot_go_on_keeps_its_converged_frames(two_blocks):
    case, whole = two_blocks
    harsh = SolverSettings(max_moves=1, max_halvings=0)
    truncated = quasi_static(case, harsh)
    frames = truncated.num_frames
    assert truncated.attributes["status"] == "truncated" and 1 <= frames < 6
    assert truncated.attributes["stopped_by"].startswith(f"frame {frames}: ")
    assert len(truncated.stress) == len(truncated.attributes["solve_seconds"]) == frames
    truncated.check("truncated", "element")
    np.testing.assert_array_equal(truncated.position, whole.position[:frames])


def test_a_frame_that_takes_too_many_newton_iterations_is_given_up(two_blocks, monkeypatch):
    case, whole = two_blocks
    needed = whole.attributes["newton_iterations"]
    limit = max(needed) - 1
    last = next(frame for frame, steps in enumerate(needed) if steps > limit)
    monkeypatch.setattr("ast_sim.mechanics.frames.MAX_FRAME_ITERATIONS", limit)
    given_up, patient = quasi_static(case), quasi_static(case, patient=True)
    assert given_up.attributes["status"] == "truncated" and given_up.num_frames == last
    assert given_up.attributes["stopped_by"].startswith(f"frame {last}: more than {limit} Newton iterations")
    np.testing.assert_array_equal(given_up.position, whole.position[:last])
    monkeypatch.setattr("ast_sim.mechanics.frames.MAX_FRAME_ITERATIONS", max(needed))
    for same in (patient, quasi_static(case)):  # a frame that needs exactly the limit is kept
        assert same.attributes["status"] == "complete"
        np.testing.assert_array_equal(same.position, whole.position)


def test_a_scene_that_starts_in_contact_is_refused():
    case = pressed(*blocks(), depth=0.02)
    position = case.scene.rest_position.copy()
    position[case.scene.body == 1, 2] -= 0.02
    with pytest.raises(SimulationError, match="intersect"):
        quasi_static(replace(case, scene=replace(case.scene, rest_position=position)))


def test_a_body_that_touches_itself_is_held_apart_if_asked():
    """The two arms of a U are pressed together."""
    rest, elements = mesh.hexahedral_grid((6, 2, 5), keep=_u_shape())
    rest = rest * [0.02, 0.02, 0.02]
    held = np.isclose(rest[:, 2], 0)
    pushed = np.isclose(rest[:, 2], 0.1) & np.isclose(rest[:, 0], 0.12)
    target = rest - np.where(pushed[:, None], [0.1, 0, 0], 0)
    faces = _surface(elements)
    gaps = {}
    for self_contact in (False, True):
        contact = Contact(rest, faces, np.zeros(len(rest), int), ContactSettings(1e-3, 1e6, 0.0, self_contact))
        newton = Newton(Elasticity(rest, elements, NeoHookean(1e6, 0.3)), contact, held | pushed, rest)
        for share in np.linspace(0, 1, 11)[1:]:
            newton.step(rest + share * (target - rest))
        gaps[self_contact] = contact.intersects(newton.position)
    assert gaps == {False: True, True: False}


def _u_shape() -> np.ndarray:
    keep = np.ones((6, 2, 5), bool)
    keep[2:4, :, 1:] = False
    return keep


def _surface(elements: np.ndarray) -> np.ndarray:
    faces = elements[:, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[np.sort(first[count == 1])]


def test_an_element_that_an_obstacle_holds_at_one_node_is_strained_by_the_others():
    """The solver gives it forces, although it has no stress."""
    scene = two_tetrahedra()
    assert (scene.rigid_elements.tolist(), scene.deforming_elements.tolist()) == ([False, False], [True, False])
    rigid = replace(scene, node_type=np.array([0, 1, 1, 1, 1], np.uint8))
    assert rigid.rigid_elements.tolist() == [False, True]

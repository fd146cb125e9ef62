"""Contact through ipctk: derivatives by central differences, candidate pairs, gaps, intersections."""

import numpy as np
import pytest

from ast_sim.mechanics import contact_and_friction as contact_module
from ast_sim.mechanics.contact_and_friction import Contact, ContactSettings
from ast_sim.simulate.shapes import mesh
from ast_sim.support.errors import MissingExtra, SimulationError

DHAT = 1e-3


def two_bodies(gap: float, obstacle=None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A plate and a ball (or `obstacle`) whose lowest node is `gap` above it: positions, faces, bodies."""
    plate, plate_elements = mesh.plate((0.4, 0.3, 0.03), (8, 6, 2), np.zeros((0, 3)))
    ball, ball_elements = mesh.ball(0.05, 3) if obstacle is None else obstacle
    ball = ball @ np.array([[0.995, 0.0, 0.0998], [0, 1, 0], [-0.0998, 0, 0.995]]) + [0.013, 0.021, 0]
    ball[:, 2] += 0.015 + gap - ball[:, 2].min()
    elements = np.concatenate([plate_elements, ball_elements + len(plate)])
    faces = elements[:, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return np.concatenate([plate, ball]), faces[first[count == 1]], np.repeat([0, 1], [len(plate), len(ball)])


def state_at(contact: Contact, position: np.ndarray):
    contact.collision_free_fraction(position, position)
    return contact.at(position)


# Face-vertex, edge-edge and vertex contacts: gaps and obstacles that bring different pairs into reach.
CASES = {
    "ball": (0.4e-3, None),
    "block": (0.2e-3, lambda: mesh.block((0.05, 0.06, 0.04), 3)),
    "cylinder": (0.6e-3, lambda: mesh.cylinder(0.05, 0.07, 4)),
}


@pytest.mark.parametrize("name", CASES)
def test_derivatives_match_central_differences(name):
    gap, make = CASES[name]
    rest, faces, body = two_bodies(gap, make and make())
    contact = Contact(rest, faces, body, ContactSettings(DHAT, 1e6))
    state = state_at(contact, rest)
    assert state.energy() > 0
    gradient = state.gradient()
    touched = np.flatnonzero(np.abs(gradient).sum(axis=1))
    assert {0, 1} == set(body[touched])
    rows, columns, values = state.hessian()
    hessian = np.zeros((rest.size, rest.size))
    np.add.at(hessian, (rows, columns), values)
    step = 1e-9
    for node in touched:
        for i in range(3):
            shift = np.zeros_like(rest)
            shift[node, i] = step
            up, down = state_at(contact, rest + shift), state_at(contact, rest - shift)
            difference = (up.energy() - down.energy()) / (2 * step)
            assert difference == pytest.approx(gradient[node, i], abs=2e-6 * np.abs(gradient).max())
            difference = (up.gradient() - down.gradient()).ravel() / (2 * step)
            np.testing.assert_allclose(difference, hessian[:, 3 * node + i], atol=2e-6 * np.abs(hessian).max())


def test_contact_forces_are_opposite_and_push_apart():
    rest, faces, body = two_bodies(0.4e-3)
    gradient = state_at(Contact(rest, faces, body, ContactSettings(DHAT, 1e6)), rest).gradient()
    on_plate, on_ball = (-gradient[body == b].sum(axis=0) for b in (0, 1))
    np.testing.assert_allclose(on_plate, -on_ball, atol=1e-9 * np.abs(on_ball).max())
    assert on_ball[2] > 0


@pytest.mark.parametrize("size", [1e-4, 1e-7])
def test_contact_does_not_depend_on_the_unit_of_length(size):
    """Parts of a few micrometres in metres: squares of their gaps are below what ipctk tells from zero."""
    rest, faces, body = two_bodies(0.4e-3)
    slid = rest + np.where(body == 1, 2e-4, 0)[:, None] * [1, 0, 0]
    found = []
    for scale in (1, size):
        contact = Contact(scale * rest, faces, body, ContactSettings(scale * DHAT, 1e6, friction=0.3))
        contact.lag_friction(state_at(contact, scale * rest), scale * rest)
        state = state_at(contact, scale * slid)
        hessian = np.abs(state.hessian()[2]).max()
        powers = {"energy": 3, "barrier_energy": 3, "dissipation": 3, "gradient": 2, "friction_gradient": 2}
        lines = [np.max(getattr(state, name)()) / scale**power for name, power in powers.items()]
        gap, step = contact.gap(scale * slid), -0.01 * np.where(body == 1, scale, 0)[:, None] * [0, 0, 1]
        fraction = contact.collision_free_fraction(scale * slid, scale * slid + step)
        found.append([*lines, hessian / scale, gap / scale, contact.area(state) / scale**2, fraction])
    assert min(np.abs(found[0])) > 0 and found[0][-1] < 0.1
    np.testing.assert_allclose(found[1], found[0], rtol=1e-6)


def test_projected_hessian_is_positive_semi_definite():
    rest, faces, body = two_bodies(0.4e-3)
    rows, columns, values = state_at(Contact(rest, faces, body, ContactSettings(DHAT, 1e6)), rest).hessian(project=True)
    touched, numbers = np.unique([rows, columns], return_inverse=True)
    hessian = np.zeros((len(touched), len(touched)))
    np.add.at(hessian, tuple(numbers.reshape(2, -1)), values)
    eigenvalues = np.linalg.eigvalsh(hessian)
    assert eigenvalues.min() > -1e-9 * eigenvalues.max()


def test_steps_stop_before_surfaces_meet():
    rest, faces, body = two_bodies(5e-3)
    contact = Contact(rest, faces, body, ContactSettings(DHAT, 1e6))
    end = rest - np.where(body == 1, 0.02, 0)[:, None] * [0, 0, 1]
    fraction = contact.collision_free_fraction(rest, end)
    assert 0.6 * 0.25 < fraction < 0.25  # surfaces would meet after 5 of 20 mm
    state = contact.at(rest + fraction * (end - rest))
    assert not state.is_empty and np.isfinite(state.energy())
    assert contact.collision_free_fraction(rest, rest + [0.0, 0.0, 1.0]) == 1  # both move


def test_kept_candidates_find_the_same_pairs_as_a_new_search():
    rest, faces, body = two_bodies(0.8e-3)
    kept = Contact(rest, faces, body, ContactSettings(DHAT, 1e6))
    kept.collision_free_fraction(rest, rest)
    generator = np.random.default_rng(0)
    for _ in range(20):
        shift = generator.uniform(-1, 1, rest.shape)
        shift *= 0.99 * DHAT / np.linalg.norm(shift, axis=1, keepdims=True)
        position = rest + 0.3 * shift - np.where(body == 1, 0.3e-3, 0)[:, None] * [0, 0, 1]
        kept.collision_free_fraction(rest, position)
        fresh = Contact(rest, faces, body, ContactSettings(DHAT, 1e6))
        expected = state_at(fresh, position)
        assert kept.at(position).energy() == pytest.approx(expected.energy(), rel=1e-12)
        assert expected.energy() > 0


def test_gap_is_a_distance():
    for gap in (0.3e-3, 4e-3, 0.08):
        rest, faces, body = two_bodies(gap)
        for dhat in (1e-5, DHAT, 10.0):
            assert Contact(rest, faces, body, ContactSettings(dhat, 1e6)).gap(rest) == pytest.approx(gap, rel=1e-9)
        assert Contact(rest, faces, 0 * body, ContactSettings(DHAT, 1e6)).gap(rest) == np.inf


def test_intersections_are_found_between_bodies_and_within_one():
    rest, faces, body = two_bodies(1e-4)
    contact = Contact(rest, faces, body, ContactSettings(DHAT, 1e6))
    assert not contact.intersects(rest)
    assert contact.intersects(rest - np.where(body == 1, 2e-4, 0)[:, None] * [0, 0, 1])
    folded = rest.copy()
    corner = np.argmax(np.where(body == 0, rest @ [1, 1, 1], -np.inf))
    folded[corner] = [0.0, 0.0, -0.1]
    assert contact.intersects(folded)


def test_the_self_test_passes_and_notices_a_wrong_stiffness_or_distance(monkeypatch):
    contact_module.self_test()
    monkeypatch.setattr(Contact, "gap", lambda self, position: 0.05**2)  # as if ipctk's square were taken as it is
    with pytest.raises(SimulationError, match=r"distance 0\.0025 where 0\.05 is right"):
        contact_module.self_test()
    monkeypatch.undo()
    energy = contact_module.ContactState.energy
    monkeypatch.setattr(contact_module.ContactState, "energy", lambda self: 1.1 * energy(self))
    with pytest.raises(SimulationError, match="gradient"):
        contact_module.self_test()


def test_another_version_of_ipctk_is_refused(monkeypatch):
    monkeypatch.setattr("ipctk.__version__", "1.6.0")
    with pytest.raises(MissingExtra, match=r'ipctk 1\.5\.x is needed .*pip install "ast_sim\[simulate\]"'):
        contact_module.load_ipctk()


def test_a_missing_ipctk_names_the_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ipctk", None)
    with pytest.raises(MissingExtra, match=r'pip install "ast_sim\[simulate\]"'):
        contact_module.load_ipctk()

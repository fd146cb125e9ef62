"""The sparse system of a Newton step: against dense algebra, with contact that comes and goes, both factorizations."""

import numpy as np
import pytest

from ast_sim.simulate import linear_system, mesh
from ast_sim.simulate.elasticity import Elasticity
from ast_sim.simulate.linear_system import Cholmod, LinearSystem, Pardiso
from ast_sim.simulate.material import NeoHookean

NO_CONTACT = (np.zeros(0, int), np.zeros(0, int), np.zeros(0))


@pytest.fixture(params=[Pardiso, Cholmod])
def problem(request, monkeypatch):
    """A plate with fixed ends: system, values of its entries, dense matrix, fixed nodes."""
    monkeypatch.setattr(linear_system, "factorization", request.param)
    rest, elements = mesh.plate((0.5, 0.3, 0.03), (5, 4, 2), np.array([[0.0, 0.0, 0.06]]))
    elasticity, fixed = Elasticity(rest, elements, NeoHookean(1e6, 0.4)), np.abs(rest[:, 0]) > 0.25 - 1e-9
    rows, columns = elasticity.entry_dofs()
    values = elasticity.hessian(elasticity.evaluate(rest * [1.02, 1.0, 1.01]))
    dense = np.zeros((rest.size, rest.size))
    np.add.at(dense, (rows, columns), values)
    np.add.at(dense, (columns[rows != columns], rows[rows != columns]), values[rows != columns])
    return LinearSystem(rows, columns, fixed), values, dense, fixed


def contact_between(nodes: np.ndarray, size: int, seed: int) -> tuple:
    """A symmetric positive definite matrix over all dofs of some nodes, as a contact's entries."""
    dofs = (3 * nodes[:, None] + np.arange(3)).ravel()
    root = np.random.default_rng(seed).normal(size=(len(dofs), len(dofs)))
    return np.repeat(dofs, len(dofs)), np.tile(dofs, len(dofs)), 1e4 * (root @ root.T).ravel()


def assert_solves(system: LinearSystem, values, contact, dense, fixed) -> None:
    matrix, free = dense.copy(), np.flatnonzero(np.repeat(~fixed, 3))
    np.add.at(matrix, contact[:2], contact[2])
    assert system.factorise(values, contact)
    right = np.random.default_rng(5).normal(size=(len(fixed), 3))
    expected = np.zeros(right.size)
    expected[free] = np.linalg.solve(matrix[np.ix_(free, free)], right.ravel()[free])
    np.testing.assert_allclose(system.solve(right).ravel(), expected, atol=1e-9 * np.abs(expected).max())


def test_it_solves_what_the_dense_matrix_does_with_contact_that_changes(problem):
    system, values, dense, fixed = problem
    free, held = np.flatnonzero(~fixed), np.flatnonzero(fixed)
    far = contact_between(free[[0, len(free) // 2, -1]], len(fixed), 1)
    mixed = contact_between(np.array([free[3], held[0]]), len(fixed), 2)  # half of it belongs to a fixed node
    for contact in (NO_CONTACT, far, NO_CONTACT, mixed, far):
        assert_solves(system, values, contact, dense, fixed)
    system.restart()
    assert_solves(system, values, NO_CONTACT, dense, fixed)
    assert system.factorizations == 6


def test_a_matrix_that_is_not_positive_definite_is_told_and_does_no_harm(problem):
    system, values, dense, fixed = problem
    assert not system.factorise(-values, NO_CONTACT)
    assert_solves(system, values, NO_CONTACT, dense, fixed)


def test_increments_of_fixed_nodes_couple_as_in_the_dense_matrix(problem):
    system, values, dense, fixed = problem
    increment = np.where(fixed[:, None], np.random.default_rng(3).normal(size=(len(fixed), 3)), 0)
    contact = contact_between(np.array([np.flatnonzero(~fixed)[0], np.flatnonzero(fixed)[0]]), len(fixed), 4)
    matrix = dense.copy()
    np.add.at(matrix, contact[:2], contact[2])
    free = np.repeat(~fixed, 3)
    expected = (matrix @ increment.ravel())[free]
    found = system.coupling(values, contact, increment).ravel()[free]
    np.testing.assert_allclose(found, expected, atol=1e-10 * np.abs(expected).max())


def test_the_pattern_is_analysed_anew_only_when_contact_adds_to_it(problem, monkeypatch):
    system, values, _, fixed = problem
    news, factorise = [], system._factorization.factorise
    monkeypatch.setattr(
        system._factorization, "factorise", lambda matrix, is_new: news.append(is_new) or factorise(matrix, is_new)
    )
    free = np.flatnonzero(~fixed)
    far, near = contact_between(free[[0, -1]], len(fixed), 1), contact_between(free[[0, 1]], len(fixed), 1)
    for contact in (NO_CONTACT, near, far, NO_CONTACT, near, far):
        system.factorise(values, contact)
    assert news == [True, False, True, False, False, False]
    system.restart()
    system.factorise(values, NO_CONTACT)
    assert news[-1]

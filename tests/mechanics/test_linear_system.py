"""The sparse system of a Newton step: against dense algebra, with contact that comes and goes, both factorizations."""

import sys

import numpy as np
import pytest
import scipy.sparse

from ast_sim.mechanics.elements.elasticity import Elasticity
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from ast_sim.mechanics.linear_algebra import compliance, factorization, linear_system
from ast_sim.mechanics.linear_algebra.factorization import Cholmod, Pardiso
from ast_sim.mechanics.linear_algebra.linear_system import NO_CONTACT, LinearSystem
from ast_sim.mechanics.linear_algebra.sparsity import Entries, Sparsity, entry_dofs
from ast_sim.simulate.shapes import mesh

REST, ELEMENTS = mesh.plate((0.5, 0.3, 0.03), (5, 4, 2), np.array([[0.0, 0.0, 0.06]]))


@pytest.fixture(params=[Pardiso, Cholmod])
def problem(request, monkeypatch):
    """A plate with fixed ends: system, values of its entries, dense matrix, fixed nodes."""
    monkeypatch.setattr(linear_system, "factorization", request.param)
    monkeypatch.setattr(linear_system, "ITERATE_FROM", 0)
    elasticity, fixed = Elasticity(REST, ELEMENTS, NeoHookean(1e6, 0.4)), np.abs(REST[:, 0]) > 0.25 - 1e-9
    rows, columns = entry_dofs(elasticity.entries())
    values = elasticity.hessian(elasticity.evaluate(REST * [1.02, 1.0, 1.01]))
    dense = np.zeros((REST.size, REST.size))
    np.add.at(dense, (rows, columns), values)
    np.add.at(dense, (columns[rows != columns], rows[rows != columns]), values[rows != columns])
    return LinearSystem(elasticity.entries(), fixed), values, dense, fixed


def contact_between(nodes: np.ndarray, size: int, seed: int) -> tuple:
    """A symmetric positive definite matrix over all dofs of some nodes, as a contact's entries."""
    dofs = (3 * nodes[:, None] + np.arange(3)).ravel()
    root = np.random.default_rng(seed).normal(size=(len(dofs), len(dofs)))
    return np.repeat(dofs, len(dofs)), np.tile(dofs, len(dofs)), 1e4 * (root @ root.T).ravel()


def assert_solves(system: LinearSystem, values, contact, dense, fixed, residual: float) -> None:
    """The solution leaves at most this residual, relative to the right side."""
    matrix, free = dense.copy(), np.flatnonzero(np.repeat(~fixed, 3))
    np.add.at(matrix, contact[:2], contact[2])
    right = np.random.default_rng(5).normal(size=(len(fixed), 3))
    solution = system.solve(values, contact, right)
    assert (solution[fixed] == 0).all()
    left = matrix[np.ix_(free, free)] @ solution.ravel()[free] - right.ravel()[free]
    assert np.linalg.norm(left) <= residual * np.linalg.norm(right.ravel()[free])


def test_where_there_is_no_mkl_cholmod_factorises(monkeypatch):
    assert isinstance(factorization.factorization(), Pardiso)
    monkeypatch.setitem(sys.modules, "pypardiso", None)
    factorization._pypardiso.cache_clear()
    assert isinstance(factorization.factorization(), Cholmod)


def test_it_solves_what_the_dense_matrix_does_with_contact_that_changes(problem):
    system, values, dense, fixed = problem
    free, held = np.flatnonzero(~fixed), np.flatnonzero(fixed)
    far = contact_between(free[[0, len(free) // 2, -1]], len(fixed), 1)
    mixed = contact_between(np.array([free[3], held[0]]), len(fixed), 2)  # half of it belongs to a fixed node
    assert_solves(system, values, NO_CONTACT, dense, fixed, 1e-11)
    for contact in (far, NO_CONTACT, mixed, far):  # by iteration
        assert_solves(system, values, contact, dense, fixed, 1.01e-3)
    assert system.factorizations == 1
    for contact in (far, NO_CONTACT, mixed):
        system.restart()
        assert_solves(system, values, contact, dense, fixed, 1e-11)
    assert system.factorizations == 4


def test_the_halves_of_solutions_make_the_dense_inverse(problem):
    system, values, dense, fixed = problem
    free, random = np.flatnonzero(np.repeat(~fixed, 3)), np.random.default_rng(7)
    inverse = np.linalg.inv(dense[np.ix_(free, free)])
    loads, forces, factor = random.normal(size=(4, len(free))), random.normal(size=4), system.factorise(values)
    left, right = factor.halves(loads)
    np.testing.assert_allclose(left @ right.T, loads @ inverse @ loads.T, rtol=1e-8)
    displacement = inverse @ loads.T @ forces
    np.testing.assert_allclose(factor.other_half(forces @ right), displacement, atol=1e-9 * abs(displacement).max())
    assert system.factorise(-values) is None


@pytest.mark.parametrize("condensed", [True, False])
def test_compliances_are_those_of_the_dense_inverse(problem, monkeypatch, condensed):
    """Of some directions, then of others, by columns and by condensation, with a whole factorization between."""
    monkeypatch.setattr(compliance, "condensation_pays", lambda *_: condensed)
    system, values, dense, fixed = problem
    free, random = np.flatnonzero(np.repeat(~fixed, 3)), np.random.default_rng(7)
    inverse, told = np.linalg.inv(dense[np.ix_(free, free)]), []
    for first in (20, 90):
        directions = np.zeros((6, len(free)))
        directions[:, first : first + 15] = random.normal(size=(6, 15))
        made = compliance.compliance_of(system, values, scipy.sparse.csr_array(directions), told.append)
        assert made.is_whole == (condensed and system.condenses)
        for wanted in ([4, 1], [5, 0, 2]):
            made.want(np.array(wanted))
        between, forces = inverse @ directions.T, random.normal(size=5)
        products = (directions @ between)[np.ix_([4, 1, 5, 0, 2], [4, 1, 5, 0, 2])]
        regular = products + 1e-10 * products.trace() / 5 * np.eye(5)
        displacement = between[:, [4, 1, 5, 0, 2]] @ forces
        assert np.array_equal(made.matrix, made.matrix.T)
        np.testing.assert_allclose(made.matrix, regular, atol=1e-12 * abs(regular).max())
        np.testing.assert_allclose(made.displacement(forces), displacement, atol=1e-10 * abs(displacement).max())
        np.testing.assert_allclose(made.along(forces), directions @ displacement, rtol=1e-8)
        load = random.normal(size=len(free))
        np.testing.assert_allclose(made.solution(load), inverse @ load, atol=1e-10 * abs(inverse @ load).max())
        assert compliance.compliance_of(system, -values, scipy.sparse.csr_array(directions), told.append) is None
        assert_solves(system, values, NO_CONTACT, dense, fixed, 1e-11)
    assert told == [0, 2, 0, 2]


@pytest.mark.parametrize(
    ("directions", "touched", "unknowns", "pays"),
    [
        (54, 141, 3_519, False),  # a plate that a box presses
        (2_610, 7_812, 461_748, False),
        (486, 564, 3_888, True),  # two blocks
        (2_910, 3_030, 76_176, True),
        (900, 300, 300, False),  # PARDISO does not eliminate nothing
    ],
)
def test_condensation_is_chosen_where_it_was_measured_to_be_faster(directions, touched, unknowns, pays):
    assert compliance.condensation_pays(directions, touched, unknowns) == pays


def test_a_schur_complement_that_is_not_positive_definite_is_told(problem, monkeypatch):
    """One node is eliminated, whose own part of the matrix is positive definite; with all others it is not."""
    monkeypatch.setattr(compliance, "condensation_pays", lambda *_: True)
    system, values, _, fixed = problem
    rows, columns = entry_dofs(Elasticity(REST, ELEMENTS, NeoHookean(1e6, 0.4)).entries())
    coupled = np.where(rows // 3 == columns // 3, values, 2 * values)
    directions = scipy.sparse.csr_array((np.arange(3 * np.count_nonzero(~fixed)) >= 3)[None].astype(float))
    assert compliance.compliance_of(system, values, directions, lambda _: None) is not None
    assert compliance.compliance_of(system, coupled, directions, lambda _: None) is None


def test_the_inverse_of_bodies_that_are_not_coupled_is_that_of_each():
    matrix = np.zeros((4, 4))
    matrix[np.ix_([0, 2], [0, 2])] = [[2.0, 1.0], [1.0, 3.0]]
    matrix[np.ix_([1, 3], [1, 3])] = [[1.0, 2.0], [2.0, 5.0]]
    np.testing.assert_allclose(compliance._inverse(matrix), np.linalg.inv(matrix), rtol=1e-14, atol=1e-15)


def test_a_factor_that_serves_no_more_is_replaced(problem):
    system, values, dense, fixed = problem
    assert_solves(system, values, NO_CONTACT, dense, fixed, 1e-11)
    everywhere = contact_between(np.flatnonzero(~fixed), len(fixed), 1)  # far from what was factorised
    assert_solves(system, values, everywhere, dense, fixed, 1e-9)
    assert system.factorizations == 2


def test_a_matrix_that_is_not_positive_definite_is_told_and_does_no_harm(problem):
    system, values, dense, fixed = problem
    right = np.ones((len(fixed), 3))
    assert system.solve(-values, NO_CONTACT, right) is None  # by the factorization
    assert_solves(system, values, NO_CONTACT, dense, fixed, 1e-11)
    assert system.solve(-values, NO_CONTACT, right) is None  # by the iteration
    assert system.factorizations == 2
    assert_solves(system, values, NO_CONTACT, dense, fixed, 1.01e-3)


def test_nothing_comes_of_nothing(problem):
    system, values, _, fixed = problem
    for _ in range(2):
        assert (system.solve(values, NO_CONTACT, np.zeros((len(fixed), 3))) == 0).all()


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


def test_the_pattern_is_analysed_again_only_when_contact_adds_to_it(problem, monkeypatch):
    system, values, _, fixed = problem
    news, factorise = [], system._factorization.factorise
    monkeypatch.setattr(
        system._factorization, "factorise", lambda matrix, is_new: news.append(is_new) or factorise(matrix, is_new)
    )
    monkeypatch.setattr(linear_system, "ITERATE_FROM", 1_000_000)  # factorise each time
    free, right = np.flatnonzero(~fixed), np.ones((len(fixed), 3))
    far, near = contact_between(free[[0, -1]], len(fixed), 1), contact_between(free[[0, 1]], len(fixed), 1)
    for contact in (NO_CONTACT, near, far, NO_CONTACT, near, far):
        system.solve(values, contact, right)
    assert news == [True, False, True, False, False, False]
    system.restart()
    system.solve(values, NO_CONTACT, right)
    assert news[-1]


def test_every_value_has_its_place_in_the_upper_triangle():
    """Elements of three nodes in any order, links of two nodes that may be the same, a free node that is alone."""
    random, nodes = np.random.default_rng(3), 12
    triangles = np.array([random.permutation(nodes - 1)[:3] for _ in range(9)]).T
    links = random.integers(0, nodes - 1, (2, 7))
    links[:, 0] = 4
    entries = (
        Entries(triangles, *np.triu_indices(9)),
        Entries(links, np.array([0, 1, 2]), np.array([3, 4, 5])),
    )
    number = np.where(np.arange(nodes) % 4 == 3, -1, 0)
    number[number == 0] = np.arange((number == 0).sum())
    made = Sparsity(entries, number)
    rows, columns = (3 * number[dofs // 3] + dofs % 3 for dofs in entry_dofs(entries))
    inside = (rows >= 0) & (columns >= 0)
    count = 3 * (number.max() + 1)
    places = np.repeat(np.arange(count), np.diff(made.starts)) * count + made.columns
    assert (np.diff(places) > 0).all()
    assert np.isin(np.arange(count) * (count + 1), places).all()
    expected = np.minimum(rows, columns) * count + np.maximum(rows, columns)
    assert np.array_equal(places[made.slot[inside]], expected[inside])
    assert (made.slot[~inside] == len(places)).all()
    assert 0 < inside.sum() < len(inside)

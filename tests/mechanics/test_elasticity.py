"""Tetrahedra of both orders: derivatives by central differences, rigid motions, the patch test."""

import numpy as np
import pytest

from ast_sim import _C
from ast_sim.mechanics.elements.elasticity import Elasticity, stiffness
from ast_sim.mechanics.elements.neo_hookean import NeoHookean, cofactor, determinant, von_mises
from ast_sim.mechanics.elements.second_order import LARGEST, elastic_body, shape_functions
from ast_sim.mechanics.linear_algebra.linear_system import LinearSystem
from ast_sim.mechanics.linear_algebra.sparsity import entry_dofs
from ast_sim.simulate.shapes import mesh
from ast_sim.support.errors import SimulationError
from benchmarks.kernels.elastic_stiffness import by_numpy

MATERIAL = NeoHookean(young=1e6, poisson=0.4)
RUBBER = NeoHookean(young=1e6, poisson=0.499)  # in second-order elements, part of it acts on the mean dilatation
ORDERS = pytest.mark.parametrize(
    ("order", "material"), [(1, MATERIAL), (2, MATERIAL), (2, RUBBER)], ids=["linear", "second order", "rubber"]
)


def box(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A small box whose inner nodes are moved at random."""
    position, elements = mesh.block((1.0, 0.8, 0.6), 3)
    inner = (np.abs(position) < np.array([1.0, 0.8, 0.6]) - 1e-9).all(axis=1)
    shift = np.random.default_rng(seed).uniform(-0.1, 0.1, position.shape)
    return position + np.where(inner[:, None], shift, 0), elements


def body(order: int, material: NeoHookean, curved: float = 0.03) -> tuple[np.ndarray, np.ndarray, Elasticity]:
    """The box, of coarser elements with curved edges if they are of second order: positions, elements, body."""
    rest, elements = box()
    if order == 2:
        rest, elements = mesh.second_order(*mesh.block((1.0, 0.8, 0.6), 2))
        inner = (np.abs(rest) < np.array([1.0, 0.8, 0.6]) - 1e-9).all(axis=1)
        rest = rest + np.where(inner[:, None], np.random.default_rng(0).uniform(-curved, curved, rest.shape), 0)
    return rest, elements, elastic_body(rest, elements, material)


def deformed(position: np.ndarray, seed: int = 1) -> np.ndarray:
    return position + np.random.default_rng(seed).uniform(-0.05, 0.05, position.shape)


def gradient(elasticity: Elasticity, position: np.ndarray) -> np.ndarray:
    return elasticity.gradient(elasticity.evaluate(position))[0]


def dense_stiffness(elasticity: Elasticity, position: np.ndarray, project: bool = False) -> np.ndarray:
    entries = elasticity.hessian(elasticity.evaluate(position), project)
    rows, columns = entry_dofs(elasticity.entries())
    matrix = np.zeros((position.size, position.size))
    np.add.at(matrix, (rows, columns), entries)
    off_diagonal = rows != columns
    np.add.at(matrix, (columns[off_diagonal], rows[off_diagonal]), entries[off_diagonal])
    return matrix


@ORDERS
def test_gradient_is_the_derivative_of_the_energy(order, material):
    rest, _, elasticity = body(order, material)
    position = deformed(rest)
    expected, step = gradient(elasticity, position), 1e-6
    difference = np.empty_like(expected)
    for index in np.ndindex(position.shape):
        shift = np.zeros_like(position)
        shift[index] = step
        up, down = (elasticity.evaluate(position + s * shift).energy for s in (1, -1))
        difference[index] = (up - down) / (2 * step)
    np.testing.assert_allclose(difference, expected, atol=1e-6 * np.abs(expected).max())


@ORDERS
def test_stiffness_is_the_derivative_of_the_gradient(order, material):
    rest, _, elasticity = body(order, material)
    position = deformed(rest)
    expected, step = dense_stiffness(elasticity, position), 1e-6
    for column in range(0, position.size, 7):
        shift = np.zeros(position.size)
        shift[column] = step
        shift = shift.reshape(-1, 3)
        difference = (gradient(elasticity, position + shift) - gradient(elasticity, position - shift)) / (2 * step)
        np.testing.assert_allclose(difference.ravel(), expected[:, column], atol=1e-6 * np.abs(expected).max())


@ORDERS
def test_projected_stiffness_is_positive_semi_definite_and_otherwise_the_same(order, material):
    rest, _, elasticity = body(order, material)
    squeezed = deformed(rest) * [0.6, 1.0, 1.0]
    exact = np.linalg.eigvalsh(dense_stiffness(elasticity, squeezed))
    projected = np.linalg.eigvalsh(dense_stiffness(elasticity, squeezed, project=True))
    assert exact.min() < -1e-3 * exact.max()  # the case needs the projection
    assert projected.min() > -1e-9 * projected.max()
    at_rest = dense_stiffness(elasticity, rest)  # nothing to project here: rotations cost nothing, all else energy
    np.testing.assert_allclose(
        dense_stiffness(elasticity, rest, project=True), at_rest, atol=1e-10 * np.abs(at_rest).max()
    )


@pytest.mark.parametrize(
    "stretches", [(0.5, 0.9, 1.1), (0.97, 1.0, 1.02), (1.0, 1.0, 1.0), (1.4, 1.7, 2.5), (0.1, 3.0, 5.0)]
)
def test_the_projection_makes_the_negative_eigenvalues_of_the_second_derivative_zero(stretches):
    """Beside the eigenvalues of the whole 9 x 9 matrix, which is made of differences of P."""
    rng = np.random.default_rng(3)
    left, right = (np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(2))
    left *= np.sign(np.linalg.det(left @ right))
    F = left @ np.diag(stretches) @ right
    rest, material = np.array([[0.0, 0, 0], [1, 0.1, 0], [0.2, 1, 0], [0.1, 0.3, 0.8]]), NeoHookean(1e6, 0.4)
    elasticity = Elasticity(rest, np.array([[0, 1, 2, 3]]), material)

    def piola(F: np.ndarray) -> np.ndarray:
        F = F.reshape(3, 3, 1)
        cofactors = cofactor(F)
        J = determinant(F, cofactors)
        return material.first_piola(F, J, cofactors / J).ravel()

    step = 1e-6
    second = np.stack([(piola(F.ravel() + e) - piola(F.ravel() - e)) / (2 * step) for e in step * np.eye(9)])
    values, vectors = np.linalg.eigh((second + second.T) / 2)
    kept = (vectors * np.maximum(values, 0)) @ vectors.T
    by_nodes = np.einsum("ik,aj->akij", np.eye(3), elasticity.gradients[:, :, 0]).reshape(12, 9)  # dF by the nodes
    expected = elasticity.volume[0] * by_nodes @ kept @ by_nodes.T
    found = dense_stiffness(elasticity, rest @ F.T, project=True)
    np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(expected).max())


@ORDERS
def test_rigid_motion_gives_no_force_and_rotates_forces(order, material):
    rest, _, elasticity = body(order, material)
    q, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    q *= np.sign(np.linalg.det(q))
    scale = elasticity.unit_force * max(1, material.lam / material.young)
    assert np.abs(gradient(elasticity, rest @ q.T + [1.0, -2.0, 3.0])).max() < 1e-12 * scale
    position = deformed(rest)
    np.testing.assert_allclose(
        gradient(elasticity, position @ q.T + 5.0), gradient(elasticity, position) @ q.T, atol=1e-10 * scale
    )


@ORDERS
def test_forces_sum_to_zero_and_have_no_moment(order, material):
    rest, _, elasticity = body(order, material)
    position = deformed(rest)
    forces = gradient(elasticity, position)
    np.testing.assert_allclose(forces.sum(axis=0), 0, atol=1e-9 * np.abs(forces).max())
    np.testing.assert_allclose(np.cross(position, forces).sum(axis=0), 0, atol=1e-9 * np.abs(forces).max())


@ORDERS
def test_patch_test(order, material):
    """With an affine motion of the boundary the equilibrium of the interior is the same affine motion."""
    rest, _, elasticity = body(order, material, curved=0)
    boundary = (np.abs(rest) > np.array([1.0, 0.8, 0.6]) - 1e-9).any(axis=1)
    assert 0 < (~boundary).sum() < len(rest)
    affine = np.eye(3) + np.array([[0.1, 0.05, 0.0], [-0.04, -0.08, 0.1], [0.02, 0.0, 0.06]])
    expected = rest @ affine.T
    start = 0.02 if material is MATERIAL else 0.002  # rubber is stable near the solution only
    position = np.where(boundary[:, None], expected, expected + start * np.sin(17 * rest))
    system = LinearSystem(elasticity.entries(), boundary)
    no_contact = (np.zeros(0, int), np.zeros(0, int), np.zeros(0))
    for _ in range(8):
        system.restart()
        values = elasticity.hessian(elasticity.evaluate(position))
        position = position + system.solve(values, no_contact, -gradient(elasticity, position))
    np.testing.assert_allclose(position, expected, atol=1e-10)
    deformation = elasticity.evaluate(position)
    stress = elasticity.cauchy(deformation)
    expected = material.cauchy(deformation.F, deformation.J)[:, :, :1]
    np.testing.assert_allclose(
        stress, np.broadcast_to(expected, stress.shape), atol=1e-10 * material.young / (0.5 - 0.499)
    )
    at_nodes = elasticity.von_mises(deformation, "node")
    np.testing.assert_allclose(at_nodes, von_mises(expected)[0], rtol=1e-6)


def test_second_order_elements_are_quadratic():
    """A field of degree two is exact between the nodes, and its F at the points; shape functions add up to one."""
    rest, elements, elasticity = body(2, MATERIAL, curved=0)
    factors = 0.05 * np.random.default_rng(4).normal(size=(3, 3, 3))
    moved = rest + np.einsum("ijk,nj,nk->ni", factors, rest, rest)
    weights = np.random.default_rng(5).dirichlet(np.ones(4), 20)
    shapes = shape_functions(weights)
    np.testing.assert_allclose(shapes.sum(axis=1), 1)
    points, found = (np.einsum("na,eai->eni", shapes, x[elements]).reshape(-1, 3) for x in (rest, moved))
    np.testing.assert_allclose(found, points + np.einsum("ijk,nj,nk->ni", factors, points, points), atol=1e-12)
    # The mean of a gradient that is linear is that in the middle of the element.
    F = elasticity.evaluate(moved).F.reshape(3, 3, 4, -1).mean(axis=2)
    middle = rest[elements[:, :4]].mean(axis=1)
    expected = np.eye(3)[:, :, None] + np.einsum("ijk,ej->ike", factors + factors.swapaxes(1, 2), middle)
    np.testing.assert_allclose(F, expected, atol=1e-12)


def test_the_mean_takes_what_is_left_of_the_bulk_modulus():
    """A dilatation that is zero in the mean costs lambda' only; a uniform one costs the whole of lambda."""
    rest, elements, elasticity = body(2, RUBBER, curved=0)
    material, size = RUBBER, 1e-3
    uniform = elasticity.evaluate((1 + size) * rest).energy
    volume = 1.0 * 0.8 * 0.6 * 8
    assert uniform == pytest.approx(volume * (4.5 * material.lam + 3 * material.mu) * size**2, rel=0.01)
    lam, mu = elasticity.material.lam, elasticity.material.mu
    np.testing.assert_allclose(lam, LARGEST * mu)
    stiff = elastic_body(rest, elements, NeoHookean.of_lame(LARGEST * material.mu, material.mu))
    one = elements[:1]
    # tr(grad u) is linear in the element and zero in its middle.
    offset = rest - rest[one[0, :4]].mean(axis=0)
    bent = rest + size * np.stack([offset[:, 0] ** 2, np.zeros(len(rest)), np.zeros(len(rest))], axis=1)
    alone, plain = (
        elastic_body(rest, one, each).evaluate(bent).energy for each in (RUBBER, stiff.material.of(one[:, 0] * 0))
    )
    assert alone == pytest.approx(plain, rel=0.02)


def test_nodal_mean_is_weighted_by_volume():
    rest = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -3.0], [9, 9, 9]])
    elements = np.array([[0, 1, 2, 3], [0, 2, 1, 4]])
    mean = Elasticity(rest, elements, MATERIAL).nodal_mean(np.array([10.0, 2.0]))
    np.testing.assert_allclose(mean, [4, 4, 4, 10, 2, 0])  # volumes 1/6 and 1/2
    rest, elements = mesh.second_order(rest, elements)
    mean = elastic_body(rest, elements, MATERIAL).nodal_mean(np.array([10.0, 2.0]))
    np.testing.assert_allclose(mean[:6], [4, 4, 4, 10, 2, 0])
    assert sorted(mean[6:].round(9)) == [2, 2, 2, 4, 4, 4, 10, 10, 10]  # three edges in one element, three in both


def test_an_inverted_element_has_infinite_energy_and_no_place_at_rest():
    rest, elements = box()
    elasticity = Elasticity(rest, elements, MATERIAL)
    assert elasticity.evaluate(rest * [1, 1, -1]).energy == np.inf
    with pytest.raises(SimulationError, match="element 2 .*positive"):
        flipped = elements.copy()
        flipped[2, [0, 1]] = flipped[2, [1, 0]]
        Elasticity(rest, flipped, MATERIAL)
    rest, elements = mesh.second_order(rest, elements)
    rest[elements[2, 4]] += 2 * (rest[elements[2, 3]] - rest[elements[2, 0]])
    with pytest.raises(SimulationError, match="is turned over at rest: a quarter of it has the volume -"):
        elastic_body(rest, elements, MATERIAL)


@pytest.mark.parametrize("project", [False, True])
@pytest.mark.parametrize("nodes", [4, 10])
def test_stiffness_follows_from_the_second_derivative_by_F(nodes, project):
    """Also where stretches are equal, where an element is mirrored, and for numbers of any size."""
    rng = np.random.default_rng(2)
    count = 4 * 50
    turns = np.linalg.qr(rng.normal(size=(2, count, 3, 3)))[0]
    stretches = rng.choice([0.2, 0.9, 1.0, 1.0, 3.0], (count, 3))
    F = np.einsum("pij,pj,pjk->ikp", turns[0], stretches, turns[1])  # no contiguous array
    size = 10.0 ** rng.integers(-12, 12, count)
    mu, c, spread = size * rng.uniform([0.1, -3, -1], [1, 3, 3], (count, 3)).T
    volume, gradients = rng.uniform(0.1, 1, count), rng.normal(size=(nodes, 3, count))
    found = stiffness(F, gradients, volume, mu, c, spread, project)
    exact = by_numpy(F, gradients, volume, mu, c, spread, project)
    assert (np.abs(found - exact).max(axis=0) <= 1e-12 * np.abs(exact).max(axis=0)).all()
    some = stiffness(F[:, :, :4], gradients[:, :, :4], volume[:4], 2.0, c[:4], spread[:4], project)
    np.testing.assert_array_equal(
        some, stiffness(F[:, :, :4], gradients[:, :, :4], volume[:4], np.full(4, 2.0), c[:4], spread[:4], project)
    )
    assert stiffness(F[:, :, :0], gradients[:, :, :0], *4 * [np.zeros(0)], project).shape[1] == 0


@pytest.mark.parametrize("first", [0.0, 1e-9, np.nan, np.inf])
def test_a_lost_stretch_cannot_be_projected(first):
    F = np.repeat(np.diag([1.0, 1.0, 1.0])[:, :, None], 20, axis=2)
    F[0, 0, 17] = first
    ones = np.ones(20)
    arguments = F, np.ones((4, 3, 20)), ones, 1.0, ones, ones
    stiffness(*arguments, False)
    with pytest.raises(np.linalg.LinAlgError, match="7e7 times another"):
        stiffness(*arguments, True)


def test_the_core_refuses_arrays_that_do_not_fit_together():
    F = np.repeat(np.eye(3)[:, :, None], 2, axis=2)
    valid = [np.empty((78, 2)), F, np.ones((4, 3, 2)), *4 * [np.ones(2)], True]
    assert _C.elastic_stiffness(*valid)
    read_only = np.empty((78, 2))
    read_only.flags.writeable = False
    wrong = [
        (0, read_only), (0, np.empty((77, 2))), (0, np.empty((78, 3))), (0, np.empty((465, 2))), (0, np.empty(156)),
        (1, np.ones((3, 3, 2), np.float32)), (1, np.ones((3, 2, 2))), (1, np.ones((2, 3, 3)).T), (1, np.ones((9, 2))),
        (2, np.ones((5, 3, 2))), (2, np.ones((10, 3, 2))), (2, np.ones((4, 2, 2))), (2, np.ones((4, 3, 0))),
        (3, np.ones(1)), (4, np.ones(4)[::2]), (5, np.ones(2, ">f8")), (6, np.ones((2, 1))), (6, 1.0), (6, None),
    ]  # fmt: skip
    for place, value in wrong:
        with pytest.raises((TypeError, ValueError, BufferError)):
            _C.elastic_stiffness(*valid[:place], value, *valid[place + 1 :])
    for count in (0, 7, 9):
        with pytest.raises(TypeError, match="takes 8 arguments"):
            _C.elastic_stiffness(*(2 * valid)[:count])

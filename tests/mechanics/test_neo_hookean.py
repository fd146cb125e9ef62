"""The neo-Hookean material against finite differences, invariances and closed forms."""

import numpy as np
import pytest

from ast_sim.mechanics.elements.neo_hookean import NeoHookean, cofactor, determinant, von_mises
from ast_sim.support.errors import SimulationError

MATERIAL = NeoHookean(young=1e6, poisson=0.4)


def random_deformations(count: int = 50, seed: int = 0) -> np.ndarray:
    F = np.eye(3)[:, :, None] + 0.3 * np.random.default_rng(seed).uniform(-1, 1, (3, 3, count))
    assert determinant(F, cofactor(F)).min() > 0.1
    return F


def energy(F: np.ndarray) -> np.ndarray:
    return MATERIAL.energy_density(F, determinant(F, cofactor(F)))


def cauchy(F: np.ndarray) -> np.ndarray:
    F = np.asarray(F, float)[:, :, None]
    return MATERIAL.cauchy(F, determinant(F, cofactor(F)))[:, :, 0]


def rotation(seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def test_cofactor_and_determinant_match_numpy():
    F = random_deformations()
    matrices = F.transpose(2, 0, 1)
    np.testing.assert_allclose(determinant(F, cofactor(F)), np.linalg.det(matrices), rtol=1e-12)
    expected = np.linalg.det(matrices)[:, None, None] * np.linalg.inv(matrices).transpose(0, 2, 1)
    np.testing.assert_allclose(cofactor(F).transpose(2, 0, 1), expected, rtol=1e-10, atol=1e-12)


def test_stress_is_the_derivative_of_the_energy():
    F = random_deformations()
    J = determinant(F, cofactor(F))
    P = MATERIAL.first_piola(F, J, cofactor(F) / J)
    step = 1e-6
    for i in range(3):
        for j in range(3):
            shift = np.zeros((3, 3, 1))
            shift[i, j] = step
            difference = (energy(F + shift) - energy(F - shift)) / (2 * step)
            np.testing.assert_allclose(difference, P[i, j], rtol=1e-6, atol=1e-6 * np.abs(P).max())


def test_cauchy_and_first_piola_are_the_same_stress():
    F = random_deformations()
    J = determinant(F, cofactor(F))
    P = MATERIAL.first_piola(F, J, cofactor(F) / J)
    np.testing.assert_allclose(np.einsum("ike,jke->ije", P, F) / J, MATERIAL.cauchy(F, J), rtol=1e-9, atol=1e-4)


def test_rotations_cost_nothing_and_change_nothing():
    Q = rotation(1)
    assert abs(energy(Q[:, :, None])[0]) < 1e-9
    np.testing.assert_allclose(cauchy(Q), 0, atol=1e-9)
    F = random_deformations()
    np.testing.assert_allclose(energy(np.einsum("ik,kje->ije", Q, F)), energy(F), rtol=1e-10)


@pytest.mark.parametrize("stretch", [0.5, 0.9, 1.0, 1.3, 2.0])
def test_uniaxial_stretch_has_the_closed_form(stretch):
    mu, lam = MATERIAL.mu, MATERIAL.lam
    lateral = (-mu + np.sqrt(mu**2 + lam * stretch**2 * (2 * mu + lam))) / (lam * stretch**2)  # lateral stretch squared
    stress = cauchy(np.diag([np.sqrt(lateral), np.sqrt(lateral), stretch]))
    assert stress[2, 2] == pytest.approx(mu * (stretch**2 - lateral) / (stretch * lateral), rel=1e-12, abs=1e-9)
    np.testing.assert_allclose(stress - np.diag([0, 0, stress[2, 2]]), 0, atol=1e-9 * MATERIAL.young)


def test_simple_shear_has_the_closed_form():
    gamma = 0.37
    expected = MATERIAL.mu * np.array([[gamma**2, gamma, 0], [gamma, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(cauchy([[1, gamma, 0], [0, 1, 0], [0, 0, 1]]), expected, atol=1e-9 * MATERIAL.young)


@pytest.mark.parametrize("a", [0.7, 1.0, 1.4])
def test_hydrostatic_stretch_has_the_closed_form(a):
    expected = (MATERIAL.mu * (a**2 - 1) + MATERIAL.lam / 2 * (a**6 - 1)) / a**3
    np.testing.assert_allclose(cauchy(a * np.eye(3)), expected * np.eye(3), rtol=1e-12, atol=1e-9)


def test_von_mises_of_known_states():
    uniaxial, shear = np.zeros((3, 3, 1)), np.zeros((3, 3, 1))
    uniaxial[0, 0] = -5.0
    shear[0, 1] = shear[1, 0] = 2.0
    assert von_mises(uniaxial)[0] == pytest.approx(5)
    assert von_mises(shear)[0] == pytest.approx(2 * np.sqrt(3))
    assert von_mises(7 * np.eye(3)[:, :, None])[0] == pytest.approx(0, abs=1e-12)


def test_small_strain_gives_young_and_poisson():
    strain = 1e-6
    stress = cauchy(np.diag([1 + strain, 1 - 0.4 * strain, 1 - 0.4 * strain]))
    assert stress[0, 0] == pytest.approx(1e6 * strain, rel=1e-5)
    assert abs(stress[1, 1]) < 1e-5 * stress[0, 0]


@pytest.mark.parametrize(("young", "poisson"), [(0, 0.3), (-1, 0.3), (1, 0.5), (1, -0.1)])
def test_impossible_constants_are_refused(young, poisson):
    with pytest.raises(SimulationError, match="Poisson"):
        NeoHookean(young, poisson)

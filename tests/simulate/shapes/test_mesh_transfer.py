"""Displacements carried from one mesh of a body to another."""

import numpy as np
from meshes import box

from ast_sim.simulate.shapes import mesh_transfer
from ast_sim.simulate.shapes.mesh_transfer import transferred

RANDOM = np.random.default_rng(0)
REST, ELEMENTS = box((3, 4, 2), (1.0, 0.8, 0.5))
INSIDE = REST.min(axis=0) + np.ptp(REST, axis=0) * RANDOM.uniform(0, 1, (200, 3))


def test_an_affine_displacement_is_carried_exactly_also_outside():
    matrix, shift = RANDOM.normal(size=(3, 3)), RANDOM.normal(size=3)
    points = np.concatenate([INSIDE, REST, INSIDE + [0.3, -0.9, 0.1]])
    found = transferred(REST, ELEMENTS, REST @ matrix + shift, points)
    np.testing.assert_allclose(found, points @ matrix + shift, atol=1e-12)


def test_nodes_get_their_own_and_points_a_mean_of_their_elements_corners(monkeypatch):
    displacement = RANDOM.normal(size=REST.shape)
    np.testing.assert_allclose(transferred(REST, ELEMENTS, displacement, REST), displacement, atol=1e-12)
    weights = RANDOM.dirichlet(np.ones(4), len(ELEMENTS))
    points, wanted = (np.einsum("ek,ekd->ed", weights, x[ELEMENTS]) for x in (REST, displacement))
    np.testing.assert_allclose(transferred(REST, ELEMENTS, displacement, points), wanted, atol=1e-10)
    monkeypatch.setattr(mesh_transfer, "_NUMBERS_AT_ONCE", 7 * 4 * len(ELEMENTS))  # seven points at a time
    np.testing.assert_allclose(transferred(REST, ELEMENTS, displacement, points), wanted, atol=1e-10)


def test_a_point_outside_follows_the_nearest_element():
    above = np.append(REST[:, :2].mean(axis=0) + [0.01, 0.02], REST[:, 2].max() + 0.01)[None]
    below = above - [0, 0, 0.01 + 1e-9]
    displacement = RANDOM.normal(size=REST.shape)
    found, near = (transferred(REST, ELEMENTS, displacement, points) for points in (above, below))
    assert np.abs(found - near).max() < 0.01 * 10 * np.abs(displacement).max() / 0.125  # it goes on linearly

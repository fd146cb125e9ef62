"""Displacements transferred from one mesh of a body to another."""

from time import process_time

import numpy as np
from meshes import box

from ast_sim.simulate.shapes.mesh import ball, second_order
from ast_sim.simulate.shapes.mesh_transfer import transferred

RANDOM = np.random.default_rng(0)
REST, ELEMENTS = box((3, 4, 2), (1.0, 0.8, 0.5))
INSIDE = REST.min(axis=0) + np.ptp(REST, axis=0) * RANDOM.uniform(0, 1, (200, 3))


def test_an_affine_displacement_is_carried_exactly_also_outside():
    matrix, shift = RANDOM.normal(size=(3, 3)), RANDOM.normal(size=3)
    points = np.concatenate([INSIDE, REST, INSIDE + [0.3, -0.9, 0.1]])
    found = transferred(REST, ELEMENTS, REST @ matrix + shift, points)
    np.testing.assert_allclose(found, points @ matrix + shift, atol=1e-12)


def test_nodes_get_their_own_and_points_a_mean_of_their_elements_corners():
    displacement = RANDOM.normal(size=REST.shape)
    np.testing.assert_allclose(transferred(REST, ELEMENTS, displacement, REST), displacement, atol=1e-12)
    weights = RANDOM.dirichlet(np.ones(4), len(ELEMENTS))
    points, wanted = (np.einsum("ek,ekd->ed", weights, x[ELEMENTS]) for x in (REST, displacement))
    np.testing.assert_allclose(transferred(REST, ELEMENTS, displacement, points), wanted, atol=1e-10)


def test_a_point_outside_follows_the_nearest_element():
    above = np.append(REST[:, :2].mean(axis=0) + [0.01, 0.02], REST[:, 2].max() + 0.01)[None]
    below = above - [0, 0, 0.01 + 1e-9]
    displacement = RANDOM.normal(size=REST.shape)
    found, near = (transferred(REST, ELEMENTS, displacement, points) for points in (above, below))
    assert np.abs(found - near).max() < 0.01 * 10 * np.abs(displacement).max() / 0.125  # it goes on linearly


def test_a_quadratic_displacement_is_carried_exactly_by_second_order_tetrahedra():
    rest, elements = second_order(REST, ELEMENTS)
    factors = RANDOM.normal(size=(3, 3, 3))
    points = np.concatenate([INSIDE, INSIDE * [1, 1, 1.02]])  # some of them are outside
    found, wanted = (np.einsum("ijk,nj,nk->ni", factors, x, x) for x in (rest, points))
    np.testing.assert_allclose(transferred(rest, elements, found, points), wanted, atol=1e-12)


def test_every_point_finds_its_element_where_sizes_differ_by_a_factor_of_thirty():
    """A large element far from its centre holds points that are nearer to the centres of many small ones."""
    small, tetrahedra = box((8, 8, 8), (0.1, 0.1, 0.1))
    large, around = box((1, 1, 1), (3.0, 3.0, 3.0))
    rest = np.concatenate([small, large + [0.1 - large.min(), 0, 0]])
    elements = np.concatenate([tetrahedra, around + len(small)])
    displacement = rest**2
    weights = RANDOM.dirichlet(np.ones(4), (len(elements), 3))
    points, wanted = (np.einsum("epk,ekd->epd", weights, x[elements]).reshape(-1, 3) for x in (rest, displacement))
    np.testing.assert_allclose(transferred(rest, elements, displacement, points), wanted, atol=1e-10)


def test_27000_points_of_a_ball_take_less_than_two_seconds():
    coarse, elements = ball(1.0, 23)
    fine, _ = ball(1.0, 29)
    began = process_time()
    found = transferred(coarse, elements, np.sin(coarse), fine)
    assert process_time() - began < 2  # 0.3 on an idle core; comparing all with all takes 50
    assert np.abs(found - np.sin(fine)).max() < 0.02

"""The shapes of obstacles: solid, of good elements, of their known volumes, with their narrow end down."""

import numpy as np
import pytest
from test_mesh import as_scene, volumes

from ast_sim.simulate.shapes.obstacles import SHAPES, draw_obstacle

SIZE = np.array([0.05, 0.06, 0.04])
VOLUMES = {  # as drawn from SIZE; meshes of round shapes approach them from below
    "ball": 4 / 3 * np.pi * 0.05**3,
    "cylinder": np.pi * 0.05**2 * 0.12,
    "block": 8 * 0.05 * 0.06 * 0.04,
    "ellipsoid": 4 / 3 * np.pi * 0.05 * 0.06 * 0.04,
    "cone": np.pi * 0.12 / 3 * 0.05**2 * (1 + 0.4 + 0.4**2),
    "wedge": 8 * 0.05 * 0.06 * 0.04 * (1 + 0.3) / 2,
    "punch": np.pi * 0.05**2 * 0.06 + 2 / 3 * np.pi * 0.05**2 * 0.06,
}


def smallest_dihedral(position, elements) -> float:
    """Smallest angle in degrees between two faces of a tetrahedron."""
    x, smallest = position[elements], 180.0
    for i, j, k, m in ((0, 1, 2, 3), (0, 2, 1, 3), (0, 3, 1, 2), (1, 2, 0, 3), (1, 3, 0, 2), (2, 3, 0, 1)):
        along = x[:, j] - x[:, i]
        a, b = np.cross(along, x[:, k] - x[:, i]), np.cross(along, x[:, m] - x[:, i])
        cosine = (a * b).sum(axis=1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
        smallest = min(smallest, float(np.degrees(np.arccos(cosine.max()))))
    return smallest


@pytest.mark.parametrize("shape", SHAPES)
def test_shapes_are_solid_and_of_good_elements(shape):
    position, elements = SHAPES[shape](SIZE, 5)
    assert volumes(position, elements).min() > 0 and smallest_dihedral(position, elements) > 9
    assert np.array_equal(np.unique(elements), np.arange(len(position)))
    faces = as_scene(position, elements).surface()
    _, count = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0, return_counts=True)
    assert set(count) == {2}
    assert volumes(*SHAPES[shape](SIZE, 16)).sum() == pytest.approx(VOLUMES[shape], rel=0.02)


@pytest.mark.parametrize("shape", ["cone", "wedge", "punch"])
def test_tools_point_down(shape):
    position, _ = SHAPES[shape](SIZE, 6)
    z = position[:, 2]
    lower, upper = (np.ptp(position[mask, 0]) for mask in (z < 0.7 * z.min(), z > 0.99 * z.max()))
    assert lower < 0.75 * upper


def test_drawn_obstacles_are_turned_without_changing_their_size():
    shapes = set()
    for seed in range(40):
        rng, again = np.random.default_rng(seed), np.random.default_rng(seed)
        shape, position, elements = draw_obstacle(rng, 4)
        again.integers(len(SHAPES))
        plain, _ = SHAPES[shape](again.uniform(0.035, 0.075, 3), 4)
        gram = position @ position.T - plain @ plain.T
        np.testing.assert_allclose(gram, 0, atol=1e-15)  # a rotation about the origin
        assert volumes(position, elements).min() > 0
        shapes.add(shape)
    assert shapes == set(SHAPES)


@pytest.mark.parametrize("cells", [2, 4, 6])
def test_obstacles_of_second_order_elements_have_the_nodes_and_the_surface_of_the_linear_ones(cells):
    for seed in range(8):
        _, position, linear = draw_obstacle(np.random.default_rng(seed), cells)
        _, same, elements = draw_obstacle(np.random.default_rng(seed), cells, order=2)
        np.testing.assert_array_equal(same, position)
        assert elements.shape == (6 * (cells // 2) ** 3, 10)
        assert np.array_equal(np.unique(elements), np.arange(len(position)))
        one, two = (as_scene(position, e).surface() for e in (linear, elements))
        assert len(two) == len(one) == 12 * cells**2
        assert np.array_equal(np.unique(two), np.unique(one))

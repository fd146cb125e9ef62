"""The nearest points of a cube: beside a face, an edge and a corner, inside, on the surface, far away."""

import numpy as np
import pytest
from meshes import box

from ast_sim.scene import NodeType, Scene
from ast_sim.support.nearest_surface import nearest_surface


@pytest.fixture
def cube():
    """The nodes and the surface of the cube from -1 to 1."""
    position, elements = box((2, 2, 2), (2.0, 2.0, 2.0))
    position = position - (position.min(axis=0) + position.max(axis=0)) / 2
    types, body = np.full(len(position), NodeType.NORMAL, np.uint8), np.zeros(len(position), np.int32)
    return position, Scene(position.astype(np.float32), elements.astype(np.int32), types, body).surface()


def test_gaps_normals_and_places(cube):
    diagonal = np.sqrt([1 / 2, 1 / 3])
    points = np.array([
        [0.3, 0.2, 1.25],  # beside a face
        [0.3, 1.1, 1.1],  # an edge
        [1.1, 1.1, 1.1],  # a corner
        [0.3, 0.2, 0.9],  # inside
        [0.3, 0.2, 1.0],  # on the surface
        [0.3, 0.2, 1.6],  # too far
        [0.3, 0.2, 0.3],  # too deep
    ])  # fmt: skip
    found = nearest_surface(points, *cube, inside=0.3, outside=0.5)
    assert found.rows.tolist() == [0, 1, 2, 3, 4]
    assert found.gap == pytest.approx([0.25, 0.1 * 2**0.5, 0.1 * 3**0.5, -0.1, 0], abs=1e-12)
    up, edge, corner = [0, 0, 1], [0, diagonal[0], diagonal[0]], [diagonal[1]] * 3
    assert found.normal == pytest.approx(np.array([up, edge, corner, up, up]), abs=1e-9)
    assert found.place == pytest.approx(points[:5] - found.gap[:, None] * found.normal, abs=1e-12)
    corners = cube[0][found.triangles]
    assert np.isclose(corners.max(axis=1), 1).any(axis=1).all()


def test_where_nothing_is_near_nothing_is_found(cube):
    found = nearest_surface(np.full((4, 3), 3.0), *cube, inside=0.3, outside=0.5)
    assert [len(part) for part in found] == [0] * 5

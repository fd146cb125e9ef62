"""The structured meshes: volume, orientation, closed surfaces."""

import numpy as np
import pytest

from ast_sim.scene import Scene
from ast_sim.simulate.shapes import mesh


def as_scene(position, elements) -> Scene:
    n = len(position)
    return Scene(position.astype(np.float32), elements.astype(np.int32), np.zeros(n, np.uint8), np.zeros(n, np.int32))


def volumes(position, elements) -> np.ndarray:
    return np.linalg.det(position[elements[:, 1:]] - position[elements[:, :1]]) / 6


MESHES = {
    "plate": lambda: mesh.plate((0.5, 0.3, 0.03), (12, 8, 2), np.zeros((0, 3))),
    "plate with holes": lambda: mesh.plate((0.5, 0.3, 0.03), (12, 8, 2), np.array([[-0.1, 0, 0.06], [0.12, 0, 0.05]])),
    "block": lambda: mesh.block((0.05, 0.06, 0.04), 3),
    "ball": lambda: mesh.ball(0.05, 3),
    "fine ball": lambda: mesh.ball(0.05, 8),
    "cylinder": lambda: mesh.cylinder(0.05, 0.07, 3),
    "fine cylinder": lambda: mesh.cylinder(0.05, 0.07, 6),
    "coarsest ball": lambda: mesh.ball(0.05, 2),
}


@pytest.mark.parametrize("name", MESHES)
def test_elements_are_positive_and_the_surface_closes(name):
    position, elements = MESHES[name]()
    assert volumes(position, elements).min() > 0
    assert np.array_equal(np.unique(elements), np.arange(len(position)))
    faces = as_scene(position, elements).surface()
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert set(count) == {2}
    a, b, c = position[faces].transpose(1, 0, 2)
    enclosed = np.einsum("fi,fi->", np.cross(b - a, c - a), a) / 6  # divergence theorem: needs outward normals
    assert enclosed == pytest.approx(volumes(position, elements).sum(), rel=1e-6)


def test_volumes_have_their_known_values():
    position, elements = MESHES["plate"]()
    assert volumes(position, elements).sum() == pytest.approx(0.5 * 0.3 * 0.03)
    assert len(position) == 13 * 9 * 3
    assert volumes(*MESHES["block"]()).sum() == pytest.approx(0.1 * 0.12 * 0.08)
    # The inscribed polyhedra approach ball and cylinder.
    assert volumes(*mesh.ball(1.0, 16)).sum() == pytest.approx(4 / 3 * np.pi, rel=0.02)
    assert volumes(*mesh.cylinder(1.0, 2.0, 16)).sum() == pytest.approx(4 * np.pi, rel=0.02)


def test_holes_leave_no_node_inside_and_reduce_the_volume():
    position, elements = mesh.plate((0.5, 0.3, 0.03), (24, 16, 2), np.array([[0.05, 0.02, 0.06]]))
    assert np.hypot(position[:, 0] - 0.05, position[:, 1] - 0.02).min() > 0.06 - 0.02
    missing = 0.5 * 0.3 * 0.03 - volumes(position, elements).sum()
    assert missing == pytest.approx(np.pi * 0.06**2 * 0.03, rel=0.15)


def test_numbering_along_the_plate_keeps_edges_within_one_layer():
    position, elements = MESHES["plate"]()
    assert (elements.max(axis=1) - elements.min(axis=1)).max() == 9 * 3
    assert (np.diff(position[:, 0]) >= 0).all()

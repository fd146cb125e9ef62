"""Second-order tetrahedra in scenes: edges, surfaces, and what else knows their ten nodes."""

from dataclasses import replace

import numpy as np
import pytest
from data_samples import block, raised, trajectory, write

from ast_sim.batches.carry import Carrier
from ast_sim.dataset.reader import Dataset
from ast_sim.element_topology import LOCAL_EDGES, MIDDLES, linear_elements
from ast_sim.scene import NodeType, Scene
from ast_sim.view.fields import surface_owners


def enclosed(scene: Scene) -> float:
    """The volume inside the surface, by the divergence theorem."""
    a, b, c = (scene.rest_position[scene.surface()[:, i]].astype(np.float64) for i in range(3))
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)


def test_the_edges_of_an_element_join_corners_with_middles_and_the_middles_of_a_face():
    """12 halves of the six edges, and three edges in each of the four faces; none through the inside."""
    edges = LOCAL_EDGES[10]
    assert len(edges) == len(set(edges)) == 24
    assert [pair for pair in edges if pair[0] < 4] == sorted(
        (corner, 4 + number) for number, ends in enumerate(MIDDLES) for corner in ends
    )
    opposite = {(4, 9), (5, 7), (6, 8)}  # their ends share no corner
    assert {pair for pair in edges if pair[0] >= 4} == {
        (a, b) for a in range(4, 10) for b in range(a + 1, 10)
    } - opposite


@pytest.mark.parametrize("mirrored", [False, True])
def test_each_outer_face_is_cut_in_four_that_point_outward(mirrored):
    scene = raised(block(3, 2, 1))
    if mirrored:
        elements = scene.elements.copy()
        elements[::2] = elements[::2][:, [1, 0, 2, 3, 4, 6, 5, 8, 7, 9]]
        scene = replace(scene, elements=elements)
    scene.check()
    assert len(scene.surface()) == 4 * len(block(3, 2, 1).surface())
    assert enclosed(scene) == pytest.approx(6.0, abs=1e-6)
    x = scene.rest_position[scene.surface()]
    area = np.linalg.norm(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]), axis=1) / 2
    assert area == pytest.approx(1 / 8)  # each is a quarter of half a square


def test_the_elements_cut_in_eight_fill_them():
    scene = raised(block(2, 1, 1))
    small, whole = (
        scene.rest_position[rows].astype(float) for rows in (linear_elements(scene.elements), scene.elements[:, :4])
    )
    volume, of_element = (np.linalg.det(x[:, 1:] - x[:, :1]) / 6 for x in (small, whole))
    assert volume == pytest.approx(np.repeat(of_element, 8) / 8)
    assert linear_elements(block(1, 1, 1).elements).shape == (6, 4)
    assert len(np.unique(np.sort(linear_elements(scene.elements), axis=1), axis=0)) == 8 * scene.num_elements


def test_the_owner_of_a_triangle_has_its_nodes():
    scene = raised(block(2, 2, 1))
    owners = surface_owners(scene, scene.surface())
    inside = [
        set(triangle) <= set(scene.elements[owner]) for triangle, owner in zip(scene.surface(), owners, strict=True)
    ]
    assert all(inside) and len(owners) == len(scene.surface())


def test_a_file_keeps_all_ten_nodes(tmp_path):
    scene = raised(block(2, 1, 1))
    path = write(tmp_path / "d.h5", {"train": [trajectory(scene, 3)]})
    with Dataset(path) as data:
        np.testing.assert_array_equal(data.scene("train", 0).elements, scene.elements)


def test_handles_that_stretch_a_bar_of_second_order_stretch_it_evenly():
    scene = raised(block(4, 1, 1))
    ends = np.isin(scene.rest_position[:, 0], (0, 4))
    scene = replace(scene, node_type=np.where(ends, NodeType.HANDLE, NodeType.NORMAL).astype(np.uint8))
    rest = scene.rest_position
    pulled = rest + np.where(rest[:, :1] == 4, [1.0, 0.0, 0.5], 0.0).astype(np.float32)
    found = Carrier(scene)(rest, pulled)
    np.testing.assert_allclose(found - rest, (rest[:, :1] / 4) * [1.0, 0.0, 0.5], rtol=0, atol=1e-6)

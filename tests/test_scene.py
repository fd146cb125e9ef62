"""Scenes and trajectories: geometry by hand, and checks that name what is wrong."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
from data_samples import block, trajectory
from meshes import two_tetrahedra

from ast_sim import number_arrays
from ast_sim.number_arrays import connected_parts
from ast_sim.scene import NodeType, Scene, Trajectory
from ast_sim.support.errors import DatasetError


def test_edges_of_two_tetrahedra():
    expected = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [1, 4], [2, 3], [2, 4], [3, 4]]
    assert two_tetrahedra().edges().tolist() == expected


def test_edges_of_a_pair_of_triangles():
    scene = triangles()
    assert scene.edges().tolist() == [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]
    assert scene.surface().tolist() == scene.elements.tolist()


@pytest.mark.parametrize("at_once", [1, 3, 1 << 13])
def test_connected_parts_are_counted_by_their_lowest_nodes(monkeypatch, at_once):
    """However many elements are looked at in one go; a node of no element is a part of its own."""
    monkeypatch.setattr(number_arrays, "_ELEMENTS_AT_ONCE", at_once)
    chain = [[6, 8, 9], [9, 10, 11], [1, 3, 5], [0, 2, 6], [5, 7, 12]]
    assert connected_parts(np.array(chain, np.int32), 14).tolist() == [0, 1, 0, 1, 2, 1, 0, 1, 0, 0, 0, 0, 1, 3]


def triangles() -> Scene:
    return Scene(
        rest_position=np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float32),
        elements=np.array([[0, 1, 2], [3, 2, 1]], np.int32),
        node_type=np.zeros(4, np.uint8),
        body=np.zeros(4, np.int32),
    )


def test_the_surface_is_closed_and_points_outward():
    faces = two_tetrahedra().surface()
    assert sorted(map(sorted, faces.tolist())) == [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 4], [1, 3, 4], [2, 3, 4]]


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_surface_encloses_the_volume(mirrored):
    """By the divergence theorem the outward faces enclose sum a . (b x c) / 6, whatever the elements' orientation."""
    scene = block(3, 2, 1)
    if mirrored:
        elements = scene.elements.copy()
        elements[::2] = elements[::2][:, [1, 0, 2, 3]]
        scene = Scene(scene.rest_position, elements, scene.node_type, scene.body)
    a, b, c = (scene.rest_position[scene.surface()[:, i]].astype(np.float64) for i in range(3))
    assert np.einsum("fi,fi->", a, np.cross(b, c)) / 6 == pytest.approx(6.0, abs=1e-12)
    assert len(scene.surface()) == 2 * 2 * (3 * 2 + 2 * 1 + 3 * 1)


def test_prescribed_nodes_are_obstacles_and_handles():
    scene = two_tetrahedra()
    assert scene.prescribed.tolist() == [True, False, False, False, True]
    assert (scene.num_nodes, scene.num_elements) == (5, 2)


def test_an_element_deforms_unless_one_of_its_nodes_is_an_obstacles():
    scene = two_tetrahedra()
    nodes, elements = [True, True, True, True, False], [True, False]
    assert (scene.deforming_nodes.tolist(), scene.deforming_elements.tolist()) == (nodes, elements)
    assert (scene.deforming("node").tolist(), scene.deforming("element").tolist()) == (nodes, elements)


def test_stress_that_may_be_at_nodes_or_in_elements_needs_its_location():
    for location in ("none", "node", "element"):
        assert trajectory(block(1, 1, 1), 3, stress=location).stress_at == location
    found = trajectory(block(2, 1, 1), 3, stress="element")
    assert found.scene.num_nodes == found.scene.num_elements == 12
    with pytest.raises(DatasetError, match="at the 12 nodes or in the 12 elements: give the trajectory its stress_loc"):
        _ = found.stress_at
    known = replace(found, stress_location="element")
    known.check("t")
    assert known.stress_at == "element"
    with pytest.raises(DatasetError, match="t: has stress at each element, but stress_location is 'node'"):
        known.check("t", "node")


def test_a_good_scene_and_trajectory_pass():
    two_tetrahedra().check()
    triangles().check()
    block(2, 2, 2, np.ones((48, 2), np.float32)).check()
    for location in ("none", "node", "element"):
        trajectory(block(2, 1, 1), 3, stress=location).check("t", location)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rest_position": np.zeros((5, 2), np.float32)}, r"rest_position has the shape \[5, 2\], must be \[any, 3\]"),
        ({"rest_position": np.zeros((5, 3))}, "rest_position must be float32, not float64"),
        ({"elements": np.zeros((2, 4), np.int64)}, "elements must be int32, not int64"),
        ({"elements": np.array([[0, 1, 2, 3, 4]], np.int32)}, r"3 nodes \(triangle\), 4 or 10 \(tetrahedron\), not 5"),
        ({"elements": np.array([[0, 1, 2, 5]], np.int32)}, "element 0 refers to node 5, but the nodes are 0 to 4"),
        ({"elements": np.array([[0, 1, 2, 3], [0, 1, -1, 2]], np.int32)}, "element 1 refers to node -1"),
        ({"elements": np.array([[0, 1, 2, 1]], np.int32)}, r"element 0 refers to a node twice: \[0, 1, 2, 1\]"),
        ({"elements": np.zeros((0, 4), np.int32)}, "needs nodes and elements, this one has 5 and 0"),
        ({"node_type": np.array([0, 0, 2, 0, 0], np.uint8)}, "node 2 has the type 2; known are 0 NORMAL"),
        ({"node_type": np.zeros(4, np.uint8)}, r"node_type has the shape \[4\], must be \[5\]"),
        ({"body": np.zeros(5, np.int64)}, "body must be int32"),
        ({"material": np.zeros((3, 1), np.float32)}, r"material has the shape \[3, 1\], must be \[2, any\]"),
        ({"material": np.zeros((2, 0), np.float32)}, "material has no columns"),
        ({"material": np.array([[1], [np.inf]], np.float32)}, r"material of element 1 is not finite: \[inf\]"),
        (
            {"rest_position": np.array([[0, 0, 0], [0, np.nan, 0], *[[1, 1, 1]] * 3], np.float32)},
            r"rest_position of node 1 is not finite: \[0.0, nan, 0.0\]",
        ),
    ],
)
def test_a_wrong_scene_is_named(changes, message):
    with pytest.raises(DatasetError, match="plate: .*" + message):
        two_tetrahedra(**changes).check("plate")


def test_a_wrong_trajectory_is_named():
    good = trajectory(block(1, 1, 1), 4, stress="node")
    position = good.position.copy()
    position[2, 5, 1] = np.inf
    tensor = trajectory(good.scene, 4, tensor=True)
    tensor.check("x", "none")
    cases = [
        (Trajectory(good.scene, position), "none", "position in frame 2 at node 5 is not finite"),
        (Trajectory(good.scene, good.position[:0]), "none", "at least one frame"),
        (Trajectory(good.scene, good.position[:, :-1]), "none", r"position has the shape \[4, 7, 3\]"),
        (Trajectory(good.scene, good.position), "node", "has no stress, but stress_location is 'node'"),
        (good, "none", "has stress, but stress_location is 'none'"),
        (good, "element", "stress has 8 rows; needs 6"),
        (Trajectory(good.scene, good.position, good.stress[:3]), "node", r"stress has the shape \[3, 8, 1\]"),
        (
            Trajectory(good.scene, good.position, good.stress * np.float32(np.nan)),
            "node",
            "stress in frame 0 at node 0",
        ),
        (replace(tensor, cauchy_stress=tensor.cauchy_stress[:, :5]), "none", r"cauchy_stress has .* \[4, 5, 6\], must"),
        (replace(tensor, cauchy_stress=tensor.cauchy_stress * np.float32("nan")), "none", "cauchy_stress in frame 0"),
    ]
    for value, location, message in cases:
        with pytest.raises(DatasetError, match="x: .*" + message):
            value.check("x", location)


def test_node_types_have_the_numbers_of_meshgraphnets():
    assert {kind.name: kind.value for kind in NodeType} == {"NORMAL": 0, "OBSTACLE": 1, "HANDLE": 3}


def test_a_body_is_rigid_if_all_its_nodes_are_obstacles():
    """Body 0 is free, body 1 an obstacle, body 2 has nodes of both kinds, body 3 handles alone."""
    points = np.concatenate([two_tetrahedra().rest_position[:4] + 10 * number for number in range(4)])
    cells = np.arange(16).reshape(4, 4)
    node_type = np.repeat([0, 1, 1, 3], 4)
    node_type[8] = 0
    scene = Scene.of(points, cells, node_type=node_type)
    assert scene.rigid_bodies == {1}
    assert scene.rigid_elements.tolist() == [False, True, False, False]
    assert scene.deforming_elements.tolist() == [True, False, False, True]


POINTS = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
ARRAYS = ("rest_position", "elements", "node_type", "body", "material")


def test_nobody_writes_to_the_arrays_from_which_edges_and_surface_follow():
    given = [np.array(POINTS, np.float32), np.array([[0, 1, 2, 3]], np.int32), np.zeros(4, np.uint8)]
    given += [np.zeros(4, np.int32), np.ones((1, 2), np.float32)]
    scene = Scene(*given)
    edges, surface, kept = scene.edges(), scene.surface(), [getattr(scene, name).copy() for name in ARRAYS]
    for array in given:
        array[:] = array[::-1] + 1  # the caller's own array is not the scene's
    for made in (scene, copy.copy(scene), copy.deepcopy(scene), pickle.loads(pickle.dumps(scene))):
        for name, before in zip(ARRAYS, kept, strict=True):
            np.testing.assert_array_equal(getattr(made, name), before)
            with pytest.raises(ValueError, match="read-only"):
                getattr(made, name)[:] = 0
        np.testing.assert_array_equal(made.edges(), edges)
        np.testing.assert_array_equal(made.surface(), surface)
    with pytest.raises(ValueError, match="read-only"):
        scene.rest_volumes[:] = 0
    flat = Scene.of([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
    with pytest.raises(ValueError, match="read-only"):
        flat.surface()[:] = 0
    mesh = scene.to_meshio()
    mesh.points[:] = 7
    mesh.cells[0].data[:] = 0
    np.testing.assert_array_equal(scene.rest_position, kept[0])


def test_a_scene_is_not_copied_again():
    scene = Scene.of(POINTS, [[0, 1, 2, 3]])
    assert all(getattr(copy.copy(scene), name) is getattr(scene, name) for name in ARRAYS)
    assert replace(scene, material=None).elements is scene.elements

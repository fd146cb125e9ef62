"""Scenes from arrays of any type, from and to meshio, joined, and the bodies to start from."""

import meshio
import numpy as np
import pytest
from data_samples import block
from meshes import two_tetrahedra

import ast_sim
from ast_sim import NodeType, Scene
from ast_sim.simulate.shapes.mesh import second_order
from ast_sim.support.errors import ConfigError, DatasetError

POINTS = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [5, 0, 0], [6, 0, 0], [5, 1, 0], [5, 0, 1]]
CELLS = [[0, 1, 2, 3], [4, 5, 6, 7]]
ARRAYS = ("rest_position", "elements", "node_type", "body", "material")


def require_equal(one: Scene, other: Scene) -> None:
    for key in ARRAYS:
        mine, theirs = getattr(one, key), getattr(other, key)
        assert (mine is None) == (theirs is None), key
        if mine is not None:
            assert mine.dtype == theirs.dtype and np.array_equal(mine, theirs), key


def volumes(scene: Scene) -> np.ndarray:
    corners = scene.rest_position[scene.elements[:, :4]].astype(np.float64)
    return np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6


@pytest.mark.parametrize("dtype", [list, np.float64, np.int64, np.float32])
def test_a_scene_of_any_numbers(dtype):
    points, cells = (POINTS, CELLS) if dtype is list else (np.array(POINTS, dtype), np.array(CELLS, dtype))
    types = np.zeros(8, np.int64)
    scene = Scene.of(points, cells, node_type=types, material=[2e5, 0.3], obstacles=[1], handles=[0, 2])
    assert scene.rest_position.tolist() == POINTS and scene.elements.tolist() == CELLS
    assert scene.body.tolist() == [0] * 4 + [1] * 4
    assert scene.node_type.tolist() == [3, 0, 3, 0, 1, 1, 1, 1] and not types.any()
    assert np.array_equal(scene.material, np.float32([[2e5, 0.3]] * 2))
    assert [getattr(scene, key).dtype for key in ARRAYS] == [np.float32, np.int32, np.uint8, np.int32, np.float32]
    masked = Scene.of(points, cells, handles=np.arange(8) == 2)
    assert masked.node_type.tolist() == [0, 0, NodeType.HANDLE, 0, 0, 0, 0, 0]


def test_points_in_the_plane_get_a_third_coordinate():
    scene = Scene.of([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
    assert scene.rest_position.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"points": POINTS[:7]}, "cell 1 refers to node 7, but the nodes are 0 to 6"),
        ({"points": [[0, 0, np.nan], *POINTS[1:]]}, r"rest_position of node 0 is not finite: \[0.0, 0.0, nan\]"),
        ({"points": [[0, 0, 1e300], *POINTS[1:]]}, r"points holds 1e\+300, which is too large for float32"),
        ({"points": [0, 1, 2]}, r"points has the shape \[3\], must be \[any, 3\]"),
        ({"points": [["a", "b", "c"]]}, "points must be numbers, not <U1"),
        ({"points": [[0, 0, 0], [1, 0]]}, "points must be an array"),
        ({"cells": [[0, 1, 2, 3.5]]}, r"cells holds 3.5 at \[0, 3\]; must be whole numbers of int32"),
        ({"cells": [[0, 1, 2, 1 << 40]]}, r"cells holds 1099511627776 at \[0, 3\]"),
        ({"cells": [[0, 1, 2, 2]]}, r"element 0 refers to a node twice: \[0, 1, 2, 2\]"),
        ({"cells": [[0, 1, 2, 3, 4]]}, r"elements must have 3 nodes \(triangle\), 4 or 10 \(tetrahedron\), not 5"),
        ({"node_type": [0] * 7 + [2]}, "node 7 has the type 2; known are 0 NORMAL, 1 OBSTACLE, 3 HANDLE"),
        ({"node_type": [-1] * 8}, r"node_type holds -1 at \[0\]; must be whole numbers of uint8"),
        ({"body": [0, 1]}, r"body has the shape \[2\], must be \[8\]"),
        ({"material": [[1.0]] * 3}, r"material has the shape \[3, 1\], must be \[2, any\]"),
        ({"handles": [9]}, "handle 0 refers to node 9, but the nodes are 0 to 7"),
        ({"handles": np.ones(3, bool)}, r"handles has the shape \[3\], must be \[8\]"),
        ({"handles": np.ma.masked_array([True] * 8, [False] * 7 + [True])}, "handles has masked numbers"),
        ({"handles": np.ma.masked_array([0, 1], [True, False])}, "handles has masked numbers"),
        ({"body": [0] * 7 + [-1]}, "node 7 is of the body -1, but bodies are numbered from 0"),
    ],
)
def test_what_is_wrong_is_named(changes, text):
    arguments = {"points": POINTS, "cells": CELLS, **changes}
    with pytest.raises(DatasetError, match=f"^block: {text}"):
        Scene.of(arguments.pop("points"), arguments.pop("cells"), name="block", **arguments)


def test_an_obstacle_is_a_body():
    with pytest.raises(ConfigError, match=r"there is no body 2; there are: 0 \(4 nodes\), 1 \(4 nodes\)"):
        Scene.of(POINTS, CELLS, obstacles=[2])


def scenes() -> dict[str, Scene]:
    material = np.float32([[1e6, 0.3], [2e6, 0.4]])
    curved = second_order(*(block(1, 1, 1).rest_position, block(1, 1, 1).elements))
    return {
        "tetrahedra": two_tetrahedra(material=material),
        "one column": two_tetrahedra(material=material[:, :1]),
        "second order": Scene.of(*curved),
        "triangles": Scene.of([[0, 0], [1, 0], [0, 1], [1 / 3, 1]], [[0, 1, 2], [1, 3, 2]], handles=[0]),
        "bodies that touch": Scene.of(POINTS, [[0, 1, 2, 3], [4, 5, 6, 7]], body=[7] * 4 + [3] * 4),
    }


@pytest.mark.parametrize("name", scenes())
def test_meshio_and_back_is_exact(name, tmp_path):
    scene = scenes()[name]
    mesh = scene.to_meshio()
    require_equal(Scene.from_meshio(mesh), scene)
    mesh.write(tmp_path / "scene.vtu")
    require_equal(Scene.from_meshio(meshio.read(tmp_path / "scene.vtu")), scene)


def test_a_mesh_of_several_blocks_and_other_arguments():
    mesh = meshio.Mesh(np.float64(POINTS), [("tetra", CELLS[:1]), ("tetra", CELLS[1:])])
    mesh.cell_data["material"] = [np.float64([1.0]), np.float64([2.0])]
    scene = Scene.from_meshio(mesh, obstacles=[0])
    assert scene.elements.tolist() == CELLS and scene.material.tolist() == [[1], [2]]
    assert scene.node_type.tolist() == [1, 1, 1, 1, 0, 0, 0, 0]
    assert Scene.from_meshio(mesh, material=[5]).material.tolist() == [[5], [5]]
    mesh.cells.append(meshio.CellBlock("triangle", np.array([[0, 1, 2]])))
    with pytest.raises(DatasetError, match=r"this mesh has: tetra, triangle. Use ast_sim.read_scene for it"):
        Scene.from_meshio(mesh)
    with pytest.raises(DatasetError, match="this mesh has: hexahedron"):
        Scene.from_meshio(meshio.Mesh(np.zeros((8, 3)), {"hexahedron": [list(range(8))]}))


def test_joined_scenes_count_on():
    one, two = two_tetrahedra(), Scene.of(POINTS, CELLS, obstacles=[1])
    scene = Scene.join(one, two, one)
    assert scene.elements.tolist() == [
        *one.elements.tolist(),
        [5, 6, 7, 8],
        [9, 10, 11, 12],
        [13, 14, 15, 16],
        [14, 15, 16, 17],
    ]
    assert scene.body.tolist() == [0, 0, 0, 0, 1, *[2] * 4, *[3] * 4, 4, 4, 4, 4, 5]
    assert scene.node_type.tolist() == [*one.node_type, *two.node_type, *one.node_type]
    scene.check()
    with pytest.raises(DatasetError, match="agree in the nodes of an element and the columns of the material"):
        Scene.join(one, two_tetrahedra(material=np.ones((2, 1), np.float32)))
    with pytest.raises(ConfigError, match="there is no scene to join: name at least one"):
        Scene.join()
    last = Scene.of(POINTS, CELLS, body=[2**31 - 1] * 8)
    assert Scene.join(last).body.tolist() == [2**31 - 1] * 8
    with pytest.raises(DatasetError, match="would have a body 4294967295, which is too large: number them from 0"):
        Scene.join(last, last)


def test_bodies_to_start_from_have_their_sizes():
    box = ast_sim.box((1, 2, 3), (2, 4, 6), cells=(2, 3, 4), handles=[0])
    assert (box.num_nodes, box.num_elements) == (3 * 4 * 5, 6 * 2 * 3 * 4)
    assert box.rest_position.min(axis=0).tolist() == [1, 2, 3] and box.rest_position.max(axis=0).tolist() == [2, 4, 6]
    assert box.node_type.tolist() == [3] + [0] * 59
    plate = ast_sim.plate((4, 2, 0.5), cells=(16, 8, 1), holes=[(0, 0, 0.6)])
    pierced = 16 * 8 - plate.num_elements // 6
    assert pierced == 16  # cells of 0.25 whose centres are nearer than 0.6: by hand, four of each quarter
    assert volumes(plate).sum() == pytest.approx(0.5 * (8 - pierced / 16), rel=1e-6)
    ball = ast_sim.ball((0, 0, 5), 2.0, cells=12)
    assert np.linalg.norm(ball.rest_position - [0, 0, 5], axis=1).max() == pytest.approx(2, rel=1e-6)
    assert volumes(ball).sum() == pytest.approx(4 / 3 * np.pi * 8, rel=0.03)
    for axis in "xyz":
        rod = ast_sim.cylinder((1, 1, 1), 0.5, 3.0, cells=8, axis=axis)
        extent = [3.0 if axis == one else 1.0 for one in "xyz"]
        assert np.ptp(rod.rest_position, axis=0) == pytest.approx(extent, rel=1e-6)
        assert rod.rest_position.mean(axis=0) == pytest.approx([1, 1, 1], abs=1e-6)
    for scene in (box, plate, ball, rod):
        assert (volumes(scene) > 0).all() and scene.body.max() == 0


def test_sizes_and_cells_must_be_above_zero():
    with pytest.raises(ConfigError, match=r"the box has the size \[1, 0, 1\]; every size must be above 0"):
        ast_sim.box((0, 0, 0), (1, 0, 1), (1, 1, 1))
    with pytest.raises(ConfigError, match=r"the plate has \[2, 0, 1\] cells; must be three whole numbers above 0"):
        ast_sim.plate((1, 1, 1), (2, 0, 1))
    with pytest.raises(ConfigError, match=r"the ball has \[3\] cells; must be an even whole number above 0"):
        ast_sim.ball((0, 0, 0), 1, 3)
    with pytest.raises(ConfigError, match="the axis of the cylinder is 'w'; must be x, y or z"):
        ast_sim.cylinder((0, 0, 0), 1, 1, 4, axis="w")


@pytest.mark.parametrize(
    "make", [lambda: ast_sim.ball((0, 0, 0), 1, 2000), lambda: ast_sim.cylinder((0, 0, 0), 1, 1, 2000)]
)
def test_bodies_of_too_many_cells_are_refused(make):
    with pytest.raises(
        ConfigError, match="has 2000 x 2000 x 2000 cells; more than 10,000,000 are too many for one scene"
    ):
        make()


def test_holes_that_leave_no_plate_or_two_are_told():
    with pytest.raises(ConfigError, match="the holes leave no cell of the plate: make them smaller, or move them"):
        ast_sim.plate((1, 1, 0.1), (4, 4, 1), holes=[(0, 0, 5)])
    with pytest.warns(UserWarning, match="the holes cut the plate into 2 pieces, each a body of its own"):
        cut = ast_sim.plate((1, 0.2, 0.1), (10, 2, 1), holes=[(0, 0, 0.15)])
    assert len(np.unique(cut.body)) == 2


@pytest.mark.parametrize("given", [{"obstacles": [0]}, {"node_type": [1] * 27}])
def test_obstacles_stay_obstacles_where_handles_are_named(given):
    with pytest.warns(
        UserWarning, match="scene: handles: 1 of 1 nodes stay obstacles, the first is node 0 of body 0: an"
    ):
        scene = ast_sim.box((0, 0, 0), (1, 1, 1), (2, 2, 2), handles=[0], **given)
    assert (scene.node_type == 1).all()


@pytest.mark.parametrize("material", [ast_sim.Material(("young",)), {"young": 1.0}])
def test_a_material_of_a_scene_is_numbers(material):
    with pytest.raises(
        ConfigError, match=r"material is of the type .*; it must be numbers, \[E, m\] or \[m\], such as"
    ):
        ast_sim.box((0, 0, 0), (1, 1, 1), (1, 1, 1), material=material)

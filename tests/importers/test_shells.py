"""Rigid shells beside tetrahedra: tools of triangles or quadrilaterals."""

import meshio
import numpy as np
import pytest
from data_samples import block
from meshes import box_between

from ast_sim.dataset.reader import Dataset
from ast_sim.importers.convert import convert
from ast_sim.importers.scene_mesh import read_scene
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.scene import NodeType, Scene
from ast_sim.support.errors import DatasetError

BLOCK = block(2, 2, 1)
N = BLOCK.num_nodes


def plate(kind="triangle", height=1.5):
    """A square of 4 x 4 cells above the block; every second triangle is turned over."""
    x, y = np.meshgrid(np.linspace(0, 2, 5), np.linspace(0, 2, 5), indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), np.full(25, height)], axis=1)
    node = np.arange(25).reshape(5, 5)
    a, b, c, d = (part.ravel() for part in (node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]))
    if kind == "quad":
        return points, np.stack([a, b, c, d], axis=1)
    cells = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    cells[::2] = cells[::2, ::-1]
    return points, cells


def mesh(shell, kind, moved=None, cell_data=None, extra=()):
    points, cells = shell
    all_points = np.concatenate([BLOCK.rest_position.astype(float), points if moved is None else moved])
    blocks = [("tetra", BLOCK.elements), (kind, cells + N), *extra]
    return meshio.Mesh(all_points, blocks, cell_data=cell_data or {})


def rotated(points, angle, down):
    c, s = np.cos(angle), np.sin(angle)
    middle = points.mean(axis=0)
    return (points - middle) @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]]) + middle - [0, 0, down]


def volumes(scene: Scene, points=None):
    corners = (scene.rest_position if points is None else points)[scene.elements].astype(float)
    return np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6


def is_closed(faces):
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there, back = (set(map(tuple, pairs)) for pairs in (edges, edges[:, ::-1]))
    return there == back and len(there) == len(edges)


def write(folder, shell, kind, frames, **options):
    folder.mkdir(parents=True)
    for index, moved in enumerate(frames):
        meshio.write(folder / f"{index}.vtu", mesh(shell, kind, moved, **options), file_format="vtu")
    return folder


@pytest.mark.parametrize("kind", ["triangle", "quad"])
@pytest.mark.parametrize("height", [1.5, -0.5])
def test_a_shell_becomes_a_layer_behind_its_surface(kind, height):
    shell = plate(kind, height)
    found = read_scene(mesh(shell, kind), clamps=["0:zmin"])
    scene = found.scene
    tool = scene.body == 1
    assert tool.sum() == 50 and (scene.node_type[tool] == NodeType.OBSTACLE).all()
    assert (scene.node_type[~tool] != NodeType.OBSTACLE).all()
    assert np.array_equal(scene.rest_position[N : N + 25], shell[0].astype(np.float32))
    behind = scene.rest_position[N + 25 :] - scene.rest_position[N : N + 25]
    away = 1 if height > 0 else -1
    assert not behind[:, :2].any() and (away * behind[:, 2] > 0.2).all() and np.ptp(behind[:, 2]) == 0
    assert (volumes(scene) > 0).all()
    assert volumes(scene)[len(BLOCK.elements) :].sum() == pytest.approx(4 * abs(behind[0, 2]), rel=1e-5)
    faces = scene.surface()
    assert is_closed(faces[tool[faces[:, 0]]])
    count = len(shell[1])
    assert found.notes == [f"{count} cells of the kind {kind} are shells and become obstacles"]


def test_the_layer_of_a_closed_shell_lies_inside():
    points, tetrahedra = box_between((3, 3, 3), (0.5, 0.5, 1.2), (1.5, 1.5, 2.2))
    hull = Scene(points.astype(np.float32), tetrahedra, np.zeros(len(points), np.uint8), np.zeros(len(points), int))
    used, cells = np.unique(hull.surface(), return_inverse=True)
    shell = points[used], cells.reshape(-1, 3)
    scene = read_scene(mesh(shell, "triangle"), clamps=["0:zmin"]).scene
    behind = scene.rest_position[N + len(used) :]
    assert len(behind) == len(used)
    assert ((behind > [0.5, 0.5, 1.2]) & (behind < [1.5, 1.5, 2.2])).all()
    assert (volumes(scene) > 0).all()


def test_the_layer_turns_with_its_shell(tmp_path):
    shell = plate()
    frames = [rotated(shell[0], 0.3 * i, 0.1 * i) for i in range(4)]
    own = {"E": [np.arange(len(BLOCK.elements)) + 1.0, np.arange(32) + 100.0]}
    folder = write(tmp_path / "r" / "a", shell, "triangle", frames, cell_data=own)
    found = read_series(folder, FieldNames(material=("E",)))
    front, back = found.position[:, N : N + 25], found.position[:, N + 25 :]
    np.testing.assert_allclose(front, frames, rtol=0, atol=1e-6)
    thickness = back[0, 0, 2] - front[0, 0, 2]
    for index in range(4):
        normal = np.cross(front[index, 5] - front[index, 0], front[index, 1] - front[index, 0])
        normal /= np.linalg.norm(normal)
        np.testing.assert_allclose(back[index] - front[index], np.tile(thickness * normal, (25, 1)), atol=2e-6)
        np.testing.assert_allclose(volumes(found.scene, found.position[index]), volumes(found.scene), atol=1e-5)
    assert found.scene.node_type.tolist() == [0] * N + [1] * 50
    material = found.scene.material[:, 0]
    assert material[: len(BLOCK.elements)].tolist() == own["E"][0].tolist()
    assert sorted(material[len(BLOCK.elements) :]) == sorted([*own["E"][1]] * 3)
    told = []
    convert(
        tmp_path / "r",
        tmp_path / "d.h5",
        splits={"test": 1},
        incomplete=True,
        progress=lambda done, total, line: told.append(line),
    )
    assert told == [
        f"test: a, 4 frames of {N + 50} nodes; 32 cells of the kind triangle are shells and become obstacles;"
        " no times tell the 4 frames apart: they count 0, 1, 2, ..."
    ]
    with Dataset(tmp_path / "d.h5") as dataset:
        assert np.array_equal(dataset.load("test", 0).position, found.position)


def test_a_shell_moved_by_a_displacement_field(tmp_path):
    shell = plate()
    for index in range(3):
        one = mesh(shell, "triangle")
        moved = np.concatenate([np.zeros((N, 3)), rotated(shell[0], 0.2 * index, 0) - shell[0]])
        one.point_data = {"displacement": moved}
        meshio.write(tmp_path / f"{index}.vtu", one, file_format="vtu")
    found = read_series(tmp_path, FieldNames())
    distance = np.linalg.norm(found.position[:, N + 25 :] - found.position[:, N : N + 25], axis=2)
    np.testing.assert_allclose(distance, distance[0, 0], atol=1e-6)
    np.testing.assert_allclose(found.position[2, N : N + 25], rotated(shell[0], 0.4, 0), atol=1e-6)


def test_a_shell_that_deforms_is_refused(tmp_path):
    shell = plate()
    bent = shell[0] + np.where(np.arange(25)[:, None] == 12, [0, 0, -0.4], 0)
    folder = write(tmp_path / "a", shell, "triangle", [shell[0], bent])
    with pytest.raises(
        DatasetError, match="a: the shell at .1.0, 1.0, 1.5. is not rigid: in frame 1 an edge changes by 0"
    ):
        read_series(folder, FieldNames())


def test_triangles_on_tetrahedra_are_no_shell_and_their_loss_is_told(tmp_path):
    faces = BLOCK.surface()[:6].astype(int)
    shell = plate()
    folder = write(tmp_path / "a", shell, "triangle", [shell[0]], extra=[("triangle", faces), ("line", faces[:2, :2])])
    found = read_series(folder, FieldNames())
    assert found.scene.num_nodes == N + 50
    assert found.attributes["notes"] == (
        "6 cells of the kind triangle are left out; 2 cells of the kind line are left out;"
        " 32 cells of the kind triangle are shells and become obstacles"
    )


def test_a_shell_that_names_a_missing_point_is_an_error():
    points, cells = plate()
    with pytest.raises(DatasetError, match="triangle [0-9]+ refers to node 43, but the nodes are 0 to 42"):
        read_scene(mesh((points, cells + 7), "triangle"))


def test_a_point_that_is_not_finite_is_named():
    points, cells = plate()
    points[3, 1] = np.nan
    with pytest.raises(DatasetError, match=f"mesh: point {N + 3} is not finite"):
        read_scene(mesh((points, cells), "triangle"))

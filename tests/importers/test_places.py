"""Places select the nodes that they say."""

import meshio
import numpy as np
import pytest
from meshes import plate_and_punch

from ast_sim.importers.places import parse_places
from ast_sim.importers.scene_mesh import read_scene
from ast_sim.scene import NodeType
from ast_sim.support.errors import ConfigError, DatasetError

GRID = np.stack(np.meshgrid(*[np.arange(5.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
X, Y, Z = GRID.T


def selected(text: str) -> np.ndarray:
    marks = {"odd": (X % 2 == 1), "end": (X == 4)}
    places = [place.inside(GRID, marks.__getitem__, marks.__getitem__) for place in parse_places(text)]
    return np.any(places, axis=0)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("all", X >= 0),
        ("xmin", X == 0),
        ("zmax", Z == 4),
        ("x>3", X > 3),
        ("x >= 3", X >= 3),
        ("y=2", Y == 2),
        ("y<-1e-3,y<=0", Y == 0),
        ("1<x<3", X == 2),
        ("1 <= x < 3", (X == 1) | (X == 2)),
        ("1<x<3 and y=2 and z<=1", (X == 2) & (Y == 2) & (Z <= 1)),
        ("xmin and ymin,z>3", ((X == 0) & (Y == 0)) | (Z > 3)),
        ("field=odd and z>3", (X % 2 == 1) & (Z > 3)),
        ("group=end", X == 4),
    ],
)
def test_a_place_holds_these_nodes(text, expected):
    assert np.array_equal(selected(text), expected)


@pytest.mark.parametrize("text", ["", "top", "w>3", "x>", "x>nan", "x>1e999", "3<x", "x<3<y", "3<x>2", "x>1 or y>1"])
def test_other_texts_are_refused(text):
    with pytest.raises(ValueError):
        parse_places(text)


def test_a_box_and_a_group_of_a_mesh_file(tmp_path):
    mesh = plate_and_punch()
    left = np.flatnonzero(mesh.points[:, 0] == -0.2)
    meshio.Mesh(mesh.points, mesh.cells, point_sets={"left": left}).write(tmp_path / "a.inp")
    inside = (np.abs(mesh.points[:, 0]) < 0.06) & (mesh.points[:, 2] == 0)
    for clamp, expected in (("0:group=left", left), ("0:-0.06<x<0.06 and zmin", np.flatnonzero(inside))):
        scene = read_scene(tmp_path / "a.inp", obstacles=[1], clamps=[clamp]).scene
        assert np.array_equal(np.flatnonzero(scene.node_type == NodeType.HANDLE), expected)
    with pytest.raises(DatasetError, match="there is no group of nodes 'right'; there are: left"):
        read_scene(tmp_path / "a.inp", obstacles=[1], clamps=["0:group=right"])
    with pytest.raises(ConfigError, match="no node of body 0 lies in 'x>9 and zmin'"):
        read_scene(tmp_path / "a.inp", obstacles=[1], clamps=["0:x>9 and zmin"])


def test_an_end_is_flat_to_a_hundredth_of_the_shortest_edge(tmp_path):
    """Coordinates that were written with few digits. The noise differs from node to node, so one node alone is the
    lowest; nodes that stand in by more are not at the end."""
    mesh = plate_and_punch()
    lowest = np.flatnonzero(mesh.points[:, 0] == mesh.points[:, 0].min())
    ends = mesh.points[mesh.cells[0].data]
    shortest = np.linalg.norm(ends - np.roll(ends, 1, axis=1), axis=2).min()
    for share, at_end in ((0.005, len(lowest)), (0.05, 1)):
        noisy = mesh.points.copy()
        noisy[lowest, 0] += share * shortest * (np.arange(len(lowest)) > 0)
        meshio.Mesh(noisy, mesh.cells).write(tmp_path / "a.vtu")
        scene = read_scene(tmp_path / "a.vtu", obstacles=[1], clamps=["0:xmin"]).scene
        held = np.flatnonzero(scene.node_type == NodeType.HANDLE)
        assert np.array_equal(held, lowest[:at_end])

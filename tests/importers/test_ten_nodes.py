"""Second-order tetrahedra in files: their ten nodes are kept, and elements beside them get ten, too."""

from itertools import product

import meshio
import numpy as np
import pytest
from data_samples import block

from ast_sim.element_topology import MIDDLES, linear_elements, signed_volumes
from ast_sim.importers.mesh_file import read_mesh
from ast_sim.importers.scene_mesh import read_scene
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.plausibility.topology import at_rest
from ast_sim.scene import NodeType
from ast_sim.simulate.shapes.mesh import second_order
from ast_sim.support.errors import DatasetError


def raised(x=2, y=1, z=1, shift=(0.0, 0.0, 0.0)):
    """The nodes [N, 3] and elements [E, 10] of a block."""
    plain = block(x, y, z)
    return second_order(plain.rest_position.astype(float) + shift, plain.elements)


def require_whole(scene):
    """All elements have ten nodes, each middle halfway, and each edge has one."""
    assert scene.elements.shape[1] == 10
    ends = scene.rest_position[scene.elements[:, np.array(MIDDLES)]]
    np.testing.assert_allclose(scene.rest_position[scene.elements[:, 4:]], ends.mean(axis=2), atol=1e-6)
    edges = np.sort(scene.elements[:, np.array(MIDDLES)], axis=2).reshape(-1, 2)
    edges = np.column_stack([edges, scene.elements[:, 4:].ravel()])
    assert len(np.unique(edges, axis=0)) == len(np.unique(edges[:, :2], axis=0)) == len(np.unique(edges[:, 2]))
    assert (signed_volumes(scene.rest_position, linear_elements(scene.elements)) > 0).all()


def test_linear_elements_and_shells_beside_them_get_middles():
    nodes, elements = raised()
    cube = block(1, 1, 1)
    above = cube.rest_position + (0.5, 0, 1.5)
    sheet = np.array([[0, 0, 3.0], [2, 0, 3], [2, 1, 3], [0, 1, 3]])
    points = np.concatenate([nodes, above, sheet])
    start = len(nodes)
    cells = [
        ("tetra10", elements),
        ("tetra", cube.elements + start),
        ("quad", np.arange(4)[None] + start + len(above)),
    ]
    held = (points[:, 0] == 0).astype(float)
    mesh = meshio.Mesh(points, cells, {"held": held}, point_sets={"bottom": np.flatnonzero(points[:, 2] == 0)})
    read = read_scene(mesh, clamps=["0:group=bottom"], obstacles=[1])
    scene = read.scene
    require_whole(scene)
    assert np.array_equal(scene.elements[: len(elements)], elements)
    # The cube has 8 corners and 12 + 6 + 1 edges, and so has the layer behind the quadrilateral.
    assert np.bincount(scene.body).tolist() == [len(nodes), 27, 27]
    assert (scene.node_type[scene.body > 0] == NodeType.OBSTACLE).all()
    assert np.array_equal(scene.node_type == NodeType.HANDLE, scene.rest_position[:, 2] == 0)
    assert any("edges of elements that have corners only get a node in their middle" in note for note in read.notes)
    plain = read_mesh(mesh, corners=True)
    assert plain.elements.shape[1] == 4


def test_linear_elements_that_touch_second_order_ones_share_their_middles():
    nodes, elements = raised(2, 1, 1)
    left = nodes[elements[:, :4]].mean(axis=1)[:, 0] < 1
    cells = [("tetra10", elements[left]), ("tetra", elements[~left, :4])]
    marks = (nodes[:, 0] >= 1).astype(float)  # the middles at x = 1.5 are in no element of the file
    scene = read_scene(meshio.Mesh(nodes, cells, {"held": marks}), clamps=["0:field=held"]).scene
    require_whole(scene)
    assert scene.num_nodes == len(nodes) and len(np.unique(scene.body)) == 1
    assert np.array_equal(scene.node_type == NodeType.HANDLE, scene.rest_position[:, 0] >= 1)


def test_elements_inside_out_keep_the_middles_of_their_edges():
    nodes, elements = raised()
    wrong = elements.copy()
    wrong[:3] = wrong[:3][:, [0, 1, 3, 2, 4, 8, 7, 6, 5, 9]]
    read = read_scene(meshio.Mesh(nodes, [("tetra10", wrong)]), clamps=["0:xmin"])
    assert np.array_equal(read.scene.elements, elements)
    assert "3 tetrahedra that were inside out are turned over" in read.notes


def test_another_order_of_the_middles_is_refused_unless_corners_are_asked_for():
    nodes, elements = raised()
    other = meshio.Mesh(nodes, [("tetra10", elements[:, [0, 1, 2, 3, 4, 5, 6, 8, 7, 9]])])
    with pytest.raises(DatasetError, match="element 0 has its node .* far from the middle of the edge .* corners=True"):
        read_scene(other, clamps=["0:xmin"])
    assert read_scene(other, clamps=["0:xmin"], corners=True).scene.elements.shape[1] == 4


def test_an_edge_that_is_bent_through_its_element_looks_wrong():
    nodes, elements = raised(2, 2, 2)
    ends = nodes[elements[0, np.array(MIDDLES)]]
    edge = int(np.argmax(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)))
    middle = elements[0, 4 + edge]
    opposite = elements[0, (set(range(4)) - set(MIDDLES[edge])).pop()]
    straight = nodes[middle].copy()
    inside = "elements inside out"
    part = "elements of which a part is inside out"
    for share, told in ((0.45, []), (0.55, [part]), (0.72, [inside, part])):  # a bend of 0.69 has no volume at a point
        nodes[middle] = straight + share * (nodes[opposite] - straight)
        read = read_scene(meshio.Mesh(nodes, [("tetra10", elements)]), clamps=["0:xmin"])
        assert [one.what for one in at_rest(read.scene)] == told


@pytest.mark.parametrize("cut", ["elements", "patches"])
def test_points_that_stand_several_times_are_joined_with_their_middles(cut):
    if cut == "elements":
        nodes, elements = raised(2, 2, 1)
        points, cells = nodes[elements].reshape(-1, 3), np.arange(elements.size).reshape(-1, 10)
    else:
        patches = [raised(1, 1, 1, (x, y, 0)) for x, y in product(range(2), range(2))]
        starts = np.cumsum([0, *(len(points) for points, _ in patches)])
        points = np.concatenate([points for points, _ in patches])
        cells = np.concatenate([cells + start for (_, cells), start in zip(patches, starts, strict=False)])
    read = read_scene(meshio.Mesh(points, [("tetra10", cells)]), clamps=["0:xmin"])
    assert read.scene.num_nodes == len(np.unique(points, axis=0)) and len(np.unique(read.scene.body)) == 1


def test_made_middles_are_halfway_in_every_frame_and_have_the_mean_stress(tmp_path):
    nodes, elements = raised()
    cube = block(1, 1, 1)
    points = np.concatenate([nodes, cube.rest_position + (0.5, 0, 1.5)])
    cells = [("tetra10", elements), ("tetra", cube.elements + len(nodes))]
    tool = (np.arange(len(points)) >= len(nodes)).astype(float)
    rng = np.random.default_rng(0)
    stress = rng.uniform(1, 2, len(points))
    moved = np.where(tool[:, None] > 0, (0, 0, -0.25), rng.uniform(-0.1, 0.1, points.shape))
    for frame in range(2):
        fields = {"displacement": frame * moved, "von_mises": stress, "tool": tool}
        meshio.write(tmp_path / f"f_{frame}.vtu", meshio.Mesh(points, cells, fields))
    read = read_series(tmp_path, FieldNames(obstacle="tool"))
    require_whole(read.scene)
    new = np.flatnonzero(read.scene.body == 1)[8:]
    assert len(new) == 19 and (read.scene.node_type[read.scene.body == 1] == NodeType.OBSTACLE).all()
    rows = read.scene.body[read.scene.elements[:, 0]] == 1
    ends = read.scene.elements[rows][:, np.array(MIDDLES)]
    middles = read.scene.elements[rows][:, 4:]
    np.testing.assert_allclose(read.position[:, middles], read.position[:, ends].mean(axis=3), atol=1e-6)
    np.testing.assert_allclose(read.stress[:, middles, 0], read.stress[:, ends, 0].mean(axis=3), rtol=1e-6)
    np.testing.assert_allclose(read.position[1, : len(nodes)], nodes + moved[: len(nodes)], atol=1e-6)

"""Cells with a volume cut into tetrahedra that fit, stress from components, elements in another order in each frame."""

from itertools import product

import meshio
import numpy as np
import pytest
from data_samples import block

from ast_sim.element_topology import signed_volumes
from ast_sim.importers.scene_mesh import read_scene
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.plausibility.topology import at_rest

GRID = {place: row for row, place in enumerate(product(range(3), range(3), range(2)))}


def cube(x, y):
    """The corners of a cube of the grid, in the order of a hexahedron."""
    square = [(x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1)]
    return [GRID[(*corner, z)] for z in (0, 1) for corner in square]


def of_all_shapes(seed):
    """Four cubes: two hexahedra, two prisms, six pyramids around a point; their points in a random order."""
    points = np.array([*GRID, (0.5, 1.5, 0.5)], float)
    prisms, pyramids = np.array(cube(1, 0)), np.array(cube(0, 1))
    faces = [(0, 1, 2, 3), (4, 7, 6, 5), (0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0)]
    blocks = [
        ("hexahedron", np.array([cube(0, 0), cube(1, 1)])),
        ("wedge", prisms[[(0, 1, 2, 4, 5, 6), (0, 2, 3, 4, 6, 7)]]),
        ("pyramid", np.array([[*pyramids[list(face)], len(GRID)] for face in faces])),
    ]
    order = np.random.default_rng(seed).permutation(len(points))
    place = np.argsort(order)
    return meshio.Mesh(points[order], [(kind, place[cells]) for kind, cells in blocks])


@pytest.mark.parametrize("seed", range(12))
def test_hexahedra_prisms_and_pyramids_are_cut_so_that_neighbours_fit(seed):
    read = read_scene(of_all_shapes(seed), clamps=["0:xmin"])
    scene = read.scene
    volumes = signed_volumes(scene.rest_position, scene.elements)
    assert volumes.min() > 0 and volumes.sum() == pytest.approx(4) and len(np.unique(scene.body)) == 1
    a, b, c = np.moveaxis(scene.rest_position[scene.surface()].astype(float), 1, 0)
    # Diagonals that do not fit leave faces within the body: then the surface is larger than the box's.
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(2 * 4 + 4 * 2)
    assert not at_rest(scene)
    kinds = {"hexahedron": 2, "wedge": 2, "pyramid": 6}
    for kind, count in kinds.items():
        assert any(note.startswith(f"{count} cells of the kind {kind} are cut into ") for note in read.notes)


def sheet(kinds):
    """A square of 2 x 2 cells in the plane z = 0 with the numbers 0 to 3, of quadrilaterals, curved ones and triangles:
    one cell names a node twice, as codes do that have quadrilaterals alone."""
    corners = np.array([(x, y, 0.0) for x in range(3) for y in range(3)])
    cells = np.array([(x, x + 3, x + 4, x + 1) for x in (0, 1, 3, 4)])
    if kinds == "curved":
        ends = np.stack([cells, np.roll(cells, -1, axis=1)], axis=2).reshape(-1, 2)
        cells = np.column_stack([cells, 9 + np.arange(16).reshape(4, 4)])
        return np.concatenate([corners, corners[ends].mean(axis=1)]), [("quad8", cells)], [np.arange(4.0)]
    if kinds == "plain":
        return corners, [("quad", cells)], [np.arange(4.0)]
    first, last = cells[0], cells[3]
    halves = [last[[0, 1, 2]], last[[0, 2, 3]]] if kinds == "triangles" else []
    degenerate = np.array([[*first[:3], first[2]], first[[0, 2, 3, 3]], *cells[1:3], *([] if halves else [last])])
    blocks, numbers = [("quad", degenerate)], [np.array([0.0, 0, 1, 2, 3])[: len(degenerate)]]
    if halves:
        blocks, numbers = [("triangle", np.array(halves)), *blocks], [np.array([3.0, 3]), *numbers]
    return corners, blocks, numbers


@pytest.mark.parametrize(("kinds", "cut"), [("plain", 8), ("curved", 8), ("degenerate", 8), ("triangles", 6)])
def test_flat_meshes_of_quadrilaterals_are_cut_into_triangles(tmp_path, kinds, cut):
    points, blocks, numbers = sheet(kinds)
    for frame in range(2):
        moved = np.zeros_like(points)
        moved[:, 2] = 0.1 * frame * points[:, 0]
        fields = {"displacement": moved, "body": np.zeros(len(points), np.int64)}
        meshio.Mesh(points, blocks, fields, {"E": numbers}).write(tmp_path / f"f{frame}.vtu")
    trajectory = read_series(tmp_path, FieldNames(material=("E",)))
    scene = trajectory.scene
    assert scene.num_nodes == 9 and scene.elements.shape == (8, 3)
    a, b, c = np.moveaxis(scene.rest_position[scene.elements].astype(float), 1, 0)
    normals = np.cross(b - a, c - a)
    assert normals[:, 2] == pytest.approx(1) and not at_rest(scene)  # as the cells look; twice the area of each
    centre = (a + b + c) / 3
    assert scene.material is not None and (scene.material[:, 0] == 2 * (centre[:, 0] > 1) + (centre[:, 1] > 1)).all()
    assert trajectory.position[1, :, 2] == pytest.approx(0.1 * scene.rest_position[:, 0])
    kind, count = ("quad", {"plain": 4, "curved": 4, "degenerate": 5, "triangles": 4}[kinds])
    assert f"{count} cells of the kind {kind} are cut into {cut} triangles" in str(trajectory.attributes["notes"])


TENSOR = np.array([3.0, -1.0, 0.5, 0.7, -0.2, 0.4])  # xx, yy, zz, xy, yz, zx
MISES = np.sqrt(0.5 * (4.0**2 + 1.5**2 + 2.5**2) + 3 * (0.7**2 + 0.2**2 + 0.4**2))
ORDERS = {
    (): (0, 1, 2, 3, 4, 5),
    ("xx", "xy", "xz", "yy", "yz", "zz"): (0, 3, 5, 1, 4, 2),
    ("xx", "yy", "zz", "yz", "xz", "xy"): (0, 1, 2, 4, 5, 3),
}


def write_frames(folder, fields, order_of_frame=lambda frame: slice(None)):
    """Two frames of a block that moves; `fields` gives the point and the cell fields of a frame."""
    scene = block(2, 1, 1)
    for frame in range(2):
        rows = order_of_frame(frame)
        at_points, at_cells = fields(frame)
        moved = np.full((scene.num_nodes, 3), 0.1 * frame)
        cells = {name: [values[rows]] for name, values in at_cells.items()}
        points = {"displacement": moved, **at_points}
        mesh = meshio.Mesh(scene.rest_position, [("tetra", scene.elements[rows])], points, cells)
        meshio.write(folder / f"f{frame}.vtu", mesh)
    return scene


@pytest.mark.parametrize("place", ["node", "element"])
@pytest.mark.parametrize("order", ORDERS)
def test_six_components_give_the_von_mises_stress(tmp_path, place, order):
    columns = TENSOR[list(ORDERS[order])]
    rows = block(2, 1, 1).num_nodes if place == "node" else block(2, 1, 1).num_elements
    tensor = np.outer(1 + np.arange(rows), columns)

    def fields(frame):
        field = {"S": (1 + frame) * tensor}
        return (field, {}) if place == "node" else ({}, field)

    write_frames(tmp_path, fields)
    read = read_series(tmp_path, FieldNames(stress="S", handle="0:xmin", stress_order=order, stress_unit="MPa"))
    assert read.stress_location == place
    wanted = np.outer([1, 2], 1 + np.arange(rows)) * 1e6 * MISES
    np.testing.assert_allclose(read.stress[:, :, 0], wanted, rtol=1e-6)


def test_elements_in_another_order_from_frame_to_frame(tmp_path):
    """Their stress and their fields go with them."""
    count = block(2, 1, 1).num_elements
    numbers = 1.0 + np.arange(count)
    order = np.random.default_rng(0).permutation(count)
    scene = write_frames(
        tmp_path,
        lambda frame: ({}, {"von_mises": numbers + frame, "PEEQ": 0.1 * numbers}),
        lambda frame: order if frame else slice(None),
    )
    read = read_series(tmp_path, FieldNames(handle="0:xmin", fields=("PEEQ",)))
    assert np.array_equal(read.scene.elements, scene.elements)
    np.testing.assert_allclose(read.stress[:, :, 0], [numbers, numbers + 1])
    np.testing.assert_allclose(read.fields["PEEQ"].values[:, :, 0], [0.1 * numbers] * 2, rtol=1e-6)
    assert read.fields["PEEQ"].location == "element"
    assert "the elements of f1.vtu stand in another order" in read.attributes["notes"]

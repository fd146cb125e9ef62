"""Cells with a volume cut into tetrahedra that fit, stress from components, elements in another order in each frame."""

from itertools import product

import meshio
import numpy as np
import pytest
from blocks import block

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

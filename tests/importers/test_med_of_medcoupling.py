"""MED files as SALOME's own library writes them."""

from pathlib import Path

import h5py
import medcoupling
import numpy as np
import pytest

from ast_sim.importers.mesh_file import read_mesh
from ast_sim.support.errors import DatasetError

LEFT, LOW = [0, 9, 18], [0, 1, 2]  # nodes of the grid


def grid():
    """2 x 2 x 2 hexahedra with edges of 1."""
    ticks = medcoupling.DataArrayDouble([0.0, 1.0, 2.0])
    cells = medcoupling.MEDCouplingCMesh()
    cells.setCoords(ticks, ticks, ticks)
    return cells.buildUnstructured()


def tetrahedra(kind=medcoupling.PLANAR_FACE_5):
    cells = grid()
    cells.simplexize(kind)
    return cells


def second_order(cells):
    cells.convertLinearCellsToQuadratic(0)
    return cells


def pyramids():
    """A cube of edges of 1, each face the base of a pyramid."""
    corners = [[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)]
    cells = medcoupling.MEDCouplingUMesh("pyramids", 3)
    cells.setCoords(medcoupling.DataArrayDouble(np.array([*corners, [0.5, 0.5, 0.5]], float)))
    cells.allocateCells(6)
    for base in ([0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [1, 5, 7, 3], [3, 7, 6, 2], [2, 6, 4, 0]):
        cells.insertNextCell(medcoupling.NORM_PYRA5, [*base, 8])
    return cells


def prisms():
    triangles = medcoupling.MEDCouplingCMesh()
    ticks = medcoupling.DataArrayDouble([0.0, 1.0, 2.0])
    triangles.setCoords(ticks, ticks)
    flat = triangles.buildUnstructured()
    flat.simplexize(0)
    flat.changeSpaceDimension(3, 0.0)
    height = medcoupling.MEDCouplingUMesh("height", 1)
    height.setCoords(medcoupling.DataArrayDouble(np.array([[0, 0, 0], [0, 0, 1], [0, 0, 2]], float)))
    height.allocateCells(2)
    height.insertNextCell(medcoupling.NORM_SEG2, [0, 1])
    height.insertNextCell(medcoupling.NORM_SEG2, [1, 2])
    return flat.buildExtrudedMesh(height, 0)


def write(path: Path, *meshes, groups=None, cell_groups=None) -> Path:
    content = medcoupling.MEDFileMeshes()
    for number, cells in enumerate(meshes):
        cells.setName(f"mesh {number}")
        file = medcoupling.MEDFileUMesh()
        file.setMeshAtLevel(0, cells)
        for level, named in ((1, groups), (0, cell_groups)):
            arrays = [medcoupling.DataArrayInt64(list(members)) for members in (named or {}).values()]
            for array, name in zip(arrays, named or {}, strict=True):
                array.setName(name)
            if arrays:
                file.setGroupsAtLevel(level, arrays)
        content.pushMesh(file)
    content.write(str(path), 2)
    return path


@pytest.mark.parametrize(
    ("cells", "nodes", "elements", "volume"),
    [
        (tetrahedra, 27, (40, 4), 8),
        (lambda: second_order(tetrahedra(medcoupling.PLANAR_FACE_6)), 125, (48, 10), 8),
        (grid, 27, (48, 4), 8),
        (lambda: second_order(grid()), 81, (48, 4), 8),
        (prisms, 27, (48, 4), 8),
        (pyramids, 9, (12, 4), 1),
    ],
)
def test_cells_keep_their_nodes_and_their_volume(tmp_path, cells, nodes, elements, volume):
    """The file counts the nodes of a cell the other way around than VTK, and nothing is told of that."""
    mesh = read_mesh(write(tmp_path / "a.med", cells()))
    assert not any("inside out" in note for note in mesh.notes)
    assert (len(mesh.points), mesh.elements.shape) == (nodes, elements)
    corners = mesh.points[mesh.elements[:, :4]].astype(np.float64)
    volumes = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    assert volumes.min() > 0.05 and volumes.sum() == pytest.approx(volume)
    for middle, (one, other) in enumerate([(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)][: 6 * (elements[1] == 10)]):
        halfway = (corners[:, one] + corners[:, other]) / 2
        np.testing.assert_allclose(mesh.points[mesh.elements[:, 4 + middle]], halfway, atol=1e-6)


def test_a_cell_unlike_all_others_is_told(tmp_path):
    path = write(tmp_path / "a.med", tetrahedra())
    with h5py.File(path, "r+") as file:
        numbers = []
        file.visititems(lambda name, item: numbers.append(item) if name.endswith("TE4/NOD") else None)
        nodes = numbers[0][()].reshape(4, -1)
        nodes[:2, 0] = nodes[1::-1, 0]
        numbers[0][()] = nodes.ravel()
    assert read_mesh(path).notes == ["39 tetrahedra that were inside out are turned over"]


def test_groups_may_overlap_and_have_any_letters(tmp_path):
    names = {"Encastré à gauche": LEFT, "низ": LOW, "x" * 80: [5]}
    path = write(tmp_path / "a.med", tetrahedra(), groups=names, cell_groups={"première": [0], "both": [0, 1]})
    groups = {name: sorted(map(int, nodes)) for name, nodes in read_mesh(path).groups.items()}
    assert {name: groups[name] for name in names} == {name: sorted(nodes) for name, nodes in names.items()}
    assert len(groups["première"]) == 4 and set(groups["première"]) < set(groups["both"]) and len(groups) == 5


def test_two_meshes_in_a_file_are_refused(tmp_path):
    other = tetrahedra()
    other.translate([9.0, 0.0, 0.0])
    with pytest.raises(
        DatasetError, match=r"a.med: cannot be read as a mesh: Must only contain exactly 1 mesh, found 2"
    ):
        read_mesh(write(tmp_path / "a.med", tetrahedra(), other))


def test_names_of_groups_may_be_of_latin_1(tmp_path):
    """As old programs wrote them."""
    path = write(tmp_path / "a.med", tetrahedra(), groups={"tenu": LEFT})
    with h5py.File(path, "r+") as file:
        (families,) = file["FAS"].values()
        (family,) = (one for one in families["NOEUD"].values() if "GRO" in one)
        family["GRO/NOM"][0] = np.frombuffer("tenu à gauche".encode("latin-1").ljust(80, b"\0"), np.int8)
    assert list(read_mesh(path).groups) == ["tenu à gauche"]


def write_with_fields(path: Path, on_nodes=None, on_cells=None, several=False) -> Path:
    """Hexahedra, the squares around them, and fields: of all hexahedra (young), of some nodes or hexahedra, whose
    numbers are given (mark, part: 10 times the number), at the nodes of each hexahedron (inner)."""
    cells = grid()
    cells.setName("mesh 0")
    around = cells.computeSkin()
    file = medcoupling.MEDFileUMesh()
    file.setMeshAtLevel(0, cells)
    file.setMeshAtLevel(-1, around)
    meshes = medcoupling.MEDFileMeshes()
    meshes.pushMesh(file)
    fields = medcoupling.MEDFileFields()

    def put(name, where, values, chosen=None):
        field = medcoupling.MEDCouplingFieldDouble(where, medcoupling.ONE_TIME)
        field.setName(name)
        field.setTime(0.0, 0, 0)
        field.setArray(medcoupling.DataArrayDouble([float(value) for value in values]))
        step = medcoupling.MEDFileField1TS()
        if chosen is None:
            field.setMesh(cells)
            step.setFieldNoProfileSBT(field)
        else:
            numbers = medcoupling.DataArrayInt64(list(chosen))
            numbers.setName(f"places of {name}")
            step.setFieldProfile(field, file, 0, numbers)
        steps = medcoupling.MEDFileFieldMultiTS()
        steps.pushBackTimeStep(step)
        fields.pushField(steps)

    put("young", medcoupling.ON_CELLS, range(1, 9))
    if on_nodes:
        put("mark", medcoupling.ON_NODES, [10 * number for number in on_nodes], on_nodes)
    if on_cells:
        put("part", medcoupling.ON_CELLS, [10 * number for number in on_cells], on_cells)
    if several:
        put("inner", medcoupling.ON_GAUSS_NE, range(64))
    data = medcoupling.MEDFileData()
    data.setMeshes(meshes)
    data.setFields(fields)
    data.write(str(path), 2)
    return path


@pytest.mark.parametrize("nodes", [None, LEFT, [20, 3, 1]])
@pytest.mark.parametrize("cells", [None, [5, 0, 2]])
def test_fields_may_be_on_a_part_of_the_mesh(tmp_path, nodes, cells):
    """Here on one kind of cells, on some nodes or on some cells; elsewhere they are NaN."""
    mesh = read_mesh(write_with_fields(tmp_path / "a.med", nodes, cells))
    hexahedron = np.repeat(np.arange(8), 6)
    np.testing.assert_array_equal(mesh.numbers("cell", "young"), 1 + hexahedron)
    for name, given, read in (("mark", nodes, np.arange(27)), ("part", cells, hexahedron)):
        fields = mesh.fields["point" if name == "mark" else "cell"]
        assert (name in fields) == (given is not None)
        if given is not None:
            np.testing.assert_array_equal(fields[name], np.where(np.isin(read, given), 10.0 * read, np.nan))
    assert not any("field" in note for note in mesh.notes)


def test_fields_with_several_values_in_a_cell_are_left_out(tmp_path):
    mesh = read_mesh(write_with_fields(tmp_path / "a.med", several=True))
    assert "1 field with several values in a cell is left out: 'inner'" in mesh.notes
    assert "inner" not in mesh.fields["cell"] and "young" in mesh.fields["cell"]

"""Pieces of an XML file of VTK that list other arrays than the first one, or the same in another order. VTK takes the
arrays of a piece by their places in the list of the first."""

import re
from pathlib import Path

import numpy as np
import pytest
import pyvista
from data_samples import block
from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

from ast_sim.importers.formats.source_mesh import CellBlock, SourceMesh
from ast_sim.importers.formats.together import together
from ast_sim.importers.mesh_file import read_mesh
from ast_sim.importers.stress import stress_place
from ast_sim.support.errors import DatasetError

SCENES = block(1, 1, 1), block(2, 2, 1)
PLACE = {"a": 10.0, "b": 20.0, "c": 30.0}


def grid(scene, height, names, base):
    """A mesh with the fields of these names; the ones in cells are larger by 1."""
    cells = np.column_stack([np.full(scene.num_elements, 4), scene.elements])
    mesh = pyvista.UnstructuredGrid(cells, np.full(scene.num_elements, 10), scene.rest_position + (0.0, 0, height))
    for name in names:
        kind = np.float32 if name == "b" else np.float64
        mesh.point_data[name] = np.full(scene.num_nodes, base + PLACE[name], kind)
        mesh.cell_data[f"{name} in cells"] = np.full(scene.num_elements, base + PLACE[name] + 1, kind)
    return mesh


def write(path, meshes, mode="Ascii"):
    texts = []
    for mesh in meshes:
        writer = vtkXMLUnstructuredGridWriter()
        writer.SetInputData(mesh)
        getattr(writer, f"SetDataModeTo{mode}")()
        writer.SetWriteToOutputString(True)
        writer.Write()
        texts.append(re.fullmatch(r"(.*)(<Piece.*</Piece>)(.*)", writer.GetOutputString(), re.DOTALL))
    path.write_text(texts[0][1] + "".join(text[2] for text in texts) + texts[0][3])


def declared(names):
    """A .pvtu file of two pieces."""
    listed = [
        "".join(f'<PDataArray type="Float{32 if name == "b" else 64}" Name="{name}{place}"/>' for name in names)
        for place in ("", " in cells")
    ]
    return (
        '<VTKFile type="PUnstructuredGrid" version="1.0" byte_order="LittleEndian"><PUnstructuredGrid GhostLevel="0">'
        f"<PPointData>{listed[0]}</PPointData><PCellData>{listed[1]}</PCellData><PPoints>"
        '<PDataArray type="Float64" Name="Points" NumberOfComponents="3"/></PPoints>'
        '<Piece Source="left.vtu"/><Piece Source="right.vtu"/></PUnstructuredGrid></VTKFile>'
    )


def require_fields(mesh, names, first, second):
    """The fields of both pieces have their values where a piece has them, and are NaN elsewhere."""
    for name in names:
        value = np.array([PLACE[name] if name in first else np.nan, 100 + PLACE[name] if name in second else np.nan])
        of_points = np.repeat(value, [one.num_nodes for one in SCENES])
        np.testing.assert_array_equal(mesh.fields["point"][name], of_points)
        of_cells = np.repeat(value + 1, [one.num_elements for one in SCENES])
        np.testing.assert_array_equal(mesh.fields["cell"][f"{name} in cells"], of_cells)


@pytest.mark.parametrize(("first", "second"), [("abc", "ab"), ("ab", "abc"), ("", "b"), ("ab", "bc"), ("abc", "cba")])
def test_files_of_pieces_may_lack_a_field(tmp_path, first, second):
    for name, *args in zip(("left", "right"), SCENES, (0, 3), (first, second), (0, 100), strict=True):
        grid(*args).save(tmp_path / f"{name}.vtu")
    names = sorted({*first, *second})
    (tmp_path / "f.pvtu").write_text(declared(names))
    mesh = read_mesh(tmp_path / "f.pvtu")
    assert mesh.path == tmp_path / "f.pvtu" and mesh.source.piece_names == ("left.vtu", "right.vtu")
    require_fields(mesh, names, first, second)
    for name in names:
        lacks = name not in first or name not in second
        assert any(f"the field {name!r} is missing" in note for note in mesh.notes) == lacks


@pytest.mark.parametrize("mode", ["Ascii", "Binary"])
@pytest.mark.parametrize(
    ("first", "second"),
    [("abc", "ab"), ("ab", "abc"), ("bc", "abc"), ("abc", "cba"), ("ab", "bc"), ("", "b")],
    ids=["no last one", "one more", "one more in front", "another order", "each lacks one", "none in the first"],
)
def test_each_piece_has_the_fields_that_it_names(tmp_path, mode, first, second):
    pieces = [grid(*args) for args in zip(SCENES, (0, 3), (first, second), (0, 100), strict=True)]
    write(tmp_path / "f.vtu", pieces, mode)
    mesh = read_mesh(tmp_path / "f.vtu")
    names = sorted({*first, *second})
    assert sorted(mesh.fields["point"]) == names and len(mesh.elements) == sum(one.num_elements for one in SCENES)
    require_fields(mesh, names, first, second)
    for name in names:
        rows = sum(one.num_nodes for one, lists in zip(SCENES, (first, second), strict=True) if name not in lists)
        note = f"the field {name!r} is missing in some blocks: it is NaN in {rows} rows"
        assert (note in mesh.notes) == (rows > 0)


def test_points_of_two_types_stand_in_their_places(tmp_path):
    pieces = [grid(*args) for args in zip(SCENES, (0, 3), ("a", "a"), (0, 100), strict=True)]
    pieces[1].points = pieces[1].points.astype(np.float32)
    pieces[0].points = pieces[0].points.astype(np.float64)
    write(tmp_path / "f.vtu", pieces, "Binary")
    expected = np.concatenate([pieces[0].points, pieces[1].points])
    np.testing.assert_array_equal(read_mesh(tmp_path / "f.vtu").points, expected)


def test_unlike_pieces_of_files_that_other_files_list_are_refused(tmp_path):
    write(tmp_path / "f_0.vtu", [grid(SCENES[0], 0, "ab", 0), grid(SCENES[0], 3, "b", 0)])
    grids = '<PUnstructuredGrid><Piece Source="f_0.vtu"/></PUnstructuredGrid>'
    (tmp_path / "f.pvtu").write_text(f'<VTKFile type="PUnstructuredGrid">{grids}</VTKFile>')
    with pytest.raises(DatasetError, match=r"f_0\.vtu: its pieces have different fields, or the same in another order"):
        read_mesh(tmp_path / "f.pvtu")


@pytest.mark.parametrize("name", ['Name=""', ""])
@pytest.mark.parametrize("place", ["PointData", "CellData"])
def test_a_field_without_a_name_is_refused(tmp_path, name, place):
    write(tmp_path / "f.vtu", [grid(SCENES[0], 0, "a", 0)])
    text = (tmp_path / "f.vtu").read_text()
    old = 'Name="a"' if place == "PointData" else 'Name="a in cells"'
    assert old in text
    (tmp_path / "f.vtu").write_text(text.replace(old, name))
    with pytest.raises(DatasetError, match=rf"f\.vtu: .* an array of its {place} has no name: name it"):
        read_mesh(tmp_path / "f.vtu")


NORMAL_FIRST = ("XX", "YY", "ZZ", "XY", "YZ", "XZ")
BY_ROWS = ("XX", "XY", "XZ", "YY", "YZ", "ZZ")


def called(names, place, columns=6):
    """A mesh of one tetrahedron whose tensor has columns of these names; "XX" is 1, "YY" is 2 and so on."""
    values = [1.0 + NORMAL_FIRST.index(name) if name in NORMAL_FIRST else 9.0 for name in names or NORMAL_FIRST]
    at = np.tile(values[:columns], (4 if place == "point" else 1, 1))
    fields = {"point_fields": {"S": at}} if place == "point" else {"cell_fields": {"S": [at]}}
    blocks = [CellBlock("tetra", np.array([[0, 1, 2, 3]]), "tetra")]
    named = {"S": tuple(names[:columns])} if names else {}
    return SourceMesh(Path("a.vtu"), np.eye(4, 3), blocks, columns=named, **fields)


@pytest.mark.parametrize("place", ["point", "cell"])
@pytest.mark.parametrize("orders", [(NORMAL_FIRST, BY_ROWS), (BY_ROWS, NORMAL_FIRST), (BY_ROWS, BY_ROWS)])
def test_columns_of_parts_are_put_in_the_order_of_their_names(place, orders):
    mesh = together([called(names, place) for names in orders])
    held = mesh.point_fields["S"] if place == "point" else np.concatenate(mesh.cell_fields["S"])
    right = [1.0 + NORMAL_FIRST.index(name) for name in mesh.columns["S"]]
    assert mesh.columns["S"] == orders[0] and mesh.notes == []
    np.testing.assert_array_equal(held, np.tile(right, (len(held), 1)))


@pytest.mark.parametrize("orders", [(BY_ROWS, ()), ((), BY_ROWS), (BY_ROWS, ("A", *BY_ROWS[1:]))])
@pytest.mark.parametrize("place", ["point", "cell"])
def test_tensors_of_parts_whose_columns_have_other_names_are_left_out(orders, place):
    mesh = together([called(names, place) for names in orders])
    assert not mesh.point_fields and not mesh.cell_fields and "S" not in mesh.columns
    assert re.match("the columns of the field 'S' are called .* in different blocks: it is left out", mesh.notes[0])
    with pytest.raises(DatasetError, match="there is no field 'S': the columns of the field 'S' are called"):
        stress_place(mesh, "S", ())


@pytest.mark.parametrize("orders", [((), ()), (BY_ROWS, None), (NORMAL_FIRST[:3], ())])
def test_vectors_and_fields_of_one_part_are_kept(orders):
    columns = 3 if len(orders[0]) == 3 else 6
    meshes = [called(names or (), "point", columns) for names in orders]
    if orders[1] is None:
        del meshes[1].point_fields["S"]
    assert "S" in together(meshes).point_fields

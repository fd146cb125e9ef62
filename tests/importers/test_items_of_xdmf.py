"""Numbers of XDMF that are made of others: parts of larger arrays, chosen places, joined columns."""

import h5py
import numpy as np
import pytest
from test_series_of_xdmf import CUBE, FRAMES, POINTS, displacement, geometry, item, require_right, series, topology

from ast_sim.importers.convert import convert
from ast_sim.importers.mesh_file import read_mesh
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.support.errors import DatasetError

COUNT = len(POINTS)
MOVED = np.stack([POINTS * (0, 0, -0.05 * frame) for frame in FRAMES])


def attribute(inner, name="displacement", kind="Vector"):
    return f'<Attribute Name="{name}" AttributeType="{kind}" Center="Node">{inner}</Attribute>'


def made(kind, inner, size=f"{COUNT} 3", facts=""):
    return f'<DataItem ItemType="{kind}" Dimensions="{size}" {facts}>{inner}</DataItem>'


def hdf(name, values):
    size = " ".join(map(str, values.shape))
    return f'<DataItem Format="HDF" NumberType="Float" Precision="8" Dimensions="{size}">all.h5:/{name}</DataItem>'


def with_fields(path, fields):
    return series(path, [topology() + geometry() + one for one in fields])


@pytest.mark.parametrize("kind", ["HyperSlab", "Hyperslab"])
@pytest.mark.parametrize("form", ["XML", "HDF", "Binary"])
def test_slabs_of_one_array_of_all_frames(tmp_path, form, kind):
    (tmp_path / "far").mkdir()
    whole = item(MOVED)
    if form == "HDF":
        whole = hdf("u", MOVED)
        with h5py.File(tmp_path / "far" / "all.h5", "w") as file:
            file["u"] = MOVED
    if form == "Binary":
        MOVED.tofile(tmp_path / "far" / "u.bin")
        whole = f'<DataItem Format="Binary" Precision="8" Dimensions="3 {COUNT} 3">u.bin</DataItem>'
    slabs = [np.array([(frame, 0, 0), (1, 1, 1), (1, COUNT, 3)]) for frame in FRAMES]
    require_right(with_fields(tmp_path / "far" / "a.xdmf", [attribute(made(kind, item(one) + whole)) for one in slabs]))


def test_slabs_have_strides_and_stand_for_points_and_cells(tmp_path):
    """Each second row of an array, whose other rows are wrong."""
    points, cells = np.zeros((2 * COUNT, 3)), np.zeros((12, 4), np.int64)
    points[1::2], cells[::2] = POINTS, CUBE.elements
    of_points = made("HyperSlab", item(np.array([1, 0, 2, 1, COUNT, 3])) + item(points))
    of_cells = made("HyperSlab", item(np.array([[0, 0], [2, 1], [6, 4]])) + item(cells), "6 4")
    mesh = f'<Topology TopologyType="Tetrahedron" NumberOfElements="6">{of_cells}</Topology>'
    mesh += f'<Geometry GeometryType="XYZ">{of_points}</Geometry>'
    require_right(series(tmp_path / "a.xdmf", [mesh + displacement(frame) for frame in FRAMES]))
    (tmp_path / "b.xdmf").write_text(f'<Xdmf Version="3.0"><Domain><Grid>{mesh}</Grid></Domain></Xdmf>')
    np.testing.assert_array_equal(read_mesh(tmp_path / "b.xdmf").points, POINTS)


def test_chosen_places_and_joined_columns(tmp_path):
    rows = np.stack(np.meshgrid(np.arange(COUNT), np.arange(3), indexing="ij"), axis=-1).reshape(-1, 2)

    def fields(frame):
        columns = "".join(item(MOVED[frame, :, axis]) for axis in (2, 0, 1))
        slabs = "".join(
            made("HyperSlab", item(np.array([0, axis, 1, 1, COUNT, 1])) + item(MOVED[frame]), f"{COUNT}")
            for axis in range(3)
        )
        yield made("Coordinates", item(rows) + item(MOVED[frame]))
        yield made("Function", columns, facts='Function="JOIN($1 , $2, $0)"')
        yield made("Function", slabs, facts='Function="join($0;$1;$2)"')

    for number, of_frames in enumerate(zip(*map(fields, FRAMES), strict=True)):
        require_right(with_fields(tmp_path / f"{number}.xdmf", map(attribute, of_frames)))


@pytest.mark.parametrize("key", ["GeometryType", "Type"])
def test_coordinates_with_an_array_for_each_axis(tmp_path, key):
    apart = "".join(item(POINTS[:, axis]) for axis in range(3))
    mesh = f'{topology()}<Geometry {key}="X_Y_Z">{apart}</Geometry>'
    require_right(series(tmp_path / "a.xdmf", [mesh + displacement(frame) for frame in FRAMES]))


@pytest.mark.parametrize("stem", ["displacement", "U"])
@pytest.mark.parametrize("ends", [("_x", "_y", "_z"), ("1", "2", "3"), (" Z", " X", " Y"), ("[1]", "[2]", "[3]")])
def test_a_displacement_in_fields_of_its_components(tmp_path, stem, ends):
    axes = ["xyz123".index(end.strip(" _[]").lower()) % 3 for end in ends]
    columns = [*zip(axes, ends, strict=True)]
    fields = [
        "".join(attribute(item(MOVED[frame, :, axis]), stem + end, "Scalar") for axis, end in columns)
        for frame in FRAMES
    ]
    path = with_fields(tmp_path / "a.xdmf", fields)
    names = FieldNames(displacement=None if stem == "displacement" else stem, handle="0:zmin")
    if stem == "displacement" and any(end.strip("[]").isdigit() for end in ends):
        names = FieldNames(displacement="displacement", handle="0:zmin")
        with pytest.raises(DatasetError, match="moves"):  # they may be load cases: nobody has named them
            convert(path, tmp_path / "d.h5", names=FieldNames(handle="0:zmin"), splits={"train": 1})
    result = read_series(path, names)
    np.testing.assert_allclose(result.position, POINTS + MOVED, rtol=1e-6, atol=1e-7)
    assert f"the displacement is put together from {stem}" in result.attributes["notes"]


@pytest.mark.parametrize(
    ("ends", "told"),
    [
        (("_x", "_z"), "there is no point field 'U'; there are: U_x, U_z"),
        (("_x", "_y", "_z", "1"), "there is no point field 'U'"),
        (("_x", "_y"), "the displacement of a body with a volume has 2 components"),
    ],
)
def test_components_that_are_missing_or_stand_twice_are_refused(tmp_path, ends, told):
    fields = ["".join(attribute(item(MOVED[f, :, 2]), "U" + end, "Scalar") for end in ends) for f in FRAMES]
    with pytest.raises(DatasetError, match=told):
        read_series(with_fields(tmp_path / "a.xdmf", fields), FieldNames(displacement="U", handle="0:zmin"))


WRONG = {
    "beyond the array": (
        made("HyperSlab", item(np.array([1, 0, 1, 1, COUNT, 3])) + item(MOVED[1])),
        rf"a HyperSlab begins at \[1, 0\] and has \[{COUNT}, 3\] places",
    ),
    "steps of none": (made("HyperSlab", item(np.array([0, 0, 0, 1, COUNT, 3])) + item(MOVED[1])), "in steps of"),
    "numbers of another array": (
        made("HyperSlab", item(np.array([0, 1, COUNT])) + item(MOVED[1])),
        rf"a HyperSlab has 3 numbers for an array of the shape \({COUNT}, 3\)",
    ),
    "another size": (
        made("HyperSlab", item(np.array([0, 0, 1, 1, 4, 3])) + item(MOVED[1])),
        f"have the Dimensions {COUNT} 3, but 12 are chosen",
    ),
    "nothing chosen from": (made("HyperSlab", item(np.array([0, 0, 1, 1, 4, 3]))), "HyperSlab of 1 item"),
    "an index too many": (
        made("Coordinates", item(np.full(6 * COUNT, COUNT)) + item(MOVED[1])),
        "Coordinates must be, for each number, an index for each axis",
    ),
    "arithmetic": (
        made("Function", item(MOVED[1]) + item(MOVED[1]), facts='Function="$0 + $1"'),
        r"has numbers by the function '\$0 \+ \$1'",
    ),
    "two columns": (
        made("Function", 2 * item(MOVED[1][:, 0]), facts='Function="JOIN($0, $1)"'),
        r"by the function 'JOIN\(\$0, \$1\)' with the Dimensions 8 3",
    ),
    "columns of two lengths": (
        made("Function", 2 * item(MOVED[1][:, 0]) + item(MOVED[1]), facts='Function="JOIN($0, $1, $2)"'),
        "joins columns of equal length",
    ),
    "no such item": (
        made("Function", 3 * item(MOVED[1][:, 0]), facts='Function="JOIN($0, $1, $3)"'),
        r"by the function 'JOIN\(\$0, \$1, \$3\)'",
    ),
    "a tree": (made("Tree", item(MOVED[1])), "numbers of the type Tree of 1 item; must be plain ones"),
    "a file that is missing": (
        made("HyperSlab", item(np.array([0, 0, 1, 1, COUNT, 3])) + hdf("u", MOVED[1])),
        "the numbers 'all.h5:/u' cannot be read",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_numbers_whose_meaning_is_not_clear_are_refused_by_name(tmp_path, case):
    inner, told = WRONG[case]
    with pytest.raises(DatasetError, match=f"a.xdmf: .*{told}"):
        read_series(with_fields(tmp_path / "a.xdmf", 3 * [attribute(inner)]), FieldNames(handle="0:zmin"))


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (' Name="displacement"', "", r"a field \(Attribute\) without a Name"),
        ('GeometryType="XYZ"', 'Type="ORIGIN_DXDYDZ"', "a Geometry of the type ORIGIN_DXDYDZ; must be one of XYZ, XY"),
        ('GeometryType="XYZ"', 'GeometryType="VXVYVZ"', "a Geometry of the type VXVYVZ"),
        (geometry(), 2 * geometry(), "a grid has 2 entries Geometry; must have one"),
        (topology(), 2 * topology(), "a grid has 2 entries Topology; must have one"),
    ],
)
def test_what_a_grid_may_say_once_and_of_points_alone(tmp_path, old, new, told):
    """meshio takes one of two, and the numbers of a regular grid for points."""
    path = series(tmp_path / "a.xdmf", [topology() + geometry() + displacement(frame) for frame in FRAMES])
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(DatasetError, match=f"a.xdmf: .*{told}"):
        read_series(path, FieldNames(handle="0:zmin"))

"""Series of XDMF as programs write them: references, defaults that are not written out, arrays in one row."""

import re

import numpy as np
import pytest
from data_samples import block

from ast_sim.importers.frames_in_file import holds_frames
from ast_sim.importers.mesh_file import read_mesh
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.support.errors import DatasetError

CUBE = block(1, 1, 1)
POINTS = CUBE.rest_position.astype(float)
FRAMES = range(3)


def item(values, facts=""):
    kind = "Int" if values.dtype.kind == "i" else "Float"
    size = " ".join(map(str, values.shape))
    numbers = " ".join(map(str, values.ravel().tolist()))
    return f'<DataItem Dimensions="{size}" NumberType="{kind}" Precision="8" Format="XML" {facts}>{numbers}</DataItem>'


def topology(nodes=CUBE.elements, count=6):
    return f'<Topology TopologyType="Tetrahedron" NumberOfElements="{count}">{item(nodes)}</Topology>'


def geometry():
    return f'<Geometry GeometryType="XYZ">{item(POINTS)}</Geometry>'


def displacement(frame, facts='Center="Node"'):
    values = item(POINTS * (0, 0, -0.05 * frame))
    return f'<Attribute Name="displacement" AttributeType="Vector" {facts}>{values}</Attribute>'


def series(path, frames, beside=""):
    """A series of frames, each the inner text of a grid."""
    grids = "".join(f'<Grid><Time Value="{frame}"/>{inner}</Grid>' for frame, inner in enumerate(frames))
    head = '<Grid GridType="Collection" CollectionType="Temporal">'
    path.write_text(f'<Xdmf Version="3.0"><Domain>{beside}{head}{grids}</Grid></Domain></Xdmf>')
    return path


def require_right(path):
    result = read_series(path, FieldNames(handle="0:zmin"))
    assert result.times == (0, 1, 2) and len(result.scene.elements) == len(CUBE.elements)
    for frame in FRAMES:
        np.testing.assert_allclose(result.position[frame], POINTS * (1, 1, 1 - 0.05 * frame), rtol=1e-6)


FIRST = "/Xdmf/Domain/Grid[@GridType='Collection']/Grid[1]"


@pytest.mark.parametrize(
    ("cells", "points"),
    [
        (f'<Topology Reference="XML">{FIRST}/Topology</Topology>', f'<Geometry Reference="{FIRST}/Geometry"/>'),
        ('<Topology Reference="//Topology"/>', '<Geometry Reference="XML"> //Geometry </Geometry>'),
        (
            '<Topology TopologyType="Tetrahedron"><DataItem Reference="//DataItem[@Name=\'cells\']"/></Topology>',
            f'<Geometry><DataItem Reference="XML">{FIRST}/Geometry/DataItem</DataItem></Geometry>',
        ),
    ],
)
def test_references_stand_for_what_they_refer_to(tmp_path, cells, points):
    named = topology().replace("<DataItem", '<DataItem Name="cells"')
    frames = [named + geometry() + displacement(0), *(cells + points + displacement(frame) for frame in (1, 2))]
    require_right(series(tmp_path / "a.xdmf", frames))


@pytest.mark.parametrize(
    "to", ["//Topology[@Name='x']", "/Xdmf/Domain/Grid/Time", "//Topology[[", "//Geometry", "//Topology[2]"]
)
def test_references_to_nothing_are_refused(tmp_path, to):
    lost = f'<Topology Reference="{to}"/>'
    frames = [(topology() if frame == 0 else lost) + geometry() + displacement(frame) for frame in FRAMES]
    with pytest.raises(DatasetError, match=f"a.xdmf: refers to '?\"?{re.escape(to)}.*, which it does not hold"):
        read_series(series(tmp_path / "a.xdmf", frames), FieldNames(handle="0:zmin"))


def test_cells_in_one_row_and_fields_that_say_no_place(tmp_path):
    flat = topology(CUBE.elements.ravel())
    require_right(series(tmp_path / "a.xdmf", [flat + geometry() + displacement(frame, "") for frame in FRAMES]))


def test_cells_that_are_no_rows_are_refused(tmp_path):
    flat = topology(CUBE.elements.ravel()[:-1])
    frames = [flat + geometry() + displacement(frame) for frame in FRAMES]
    with pytest.raises(DatasetError, match=r"a.xdmf: the nodes of its tetra cells have the shape \(23,\)"):
        read_series(series(tmp_path / "a.xdmf", frames), FieldNames(handle="0:zmin"))


@pytest.mark.parametrize("own", [True, False])
def test_a_number_of_cells_that_is_not_the_one_of_the_array_is_refused(tmp_path, own):
    """XDMF's own readers take as many as the topology says."""
    mesh = topology(count=4) + geometry()
    later = [(mesh if own else "") + displacement(frame) for frame in (1, 2)]
    path = series(tmp_path / "a.xdmf", [mesh + displacement(0), *later])
    with pytest.raises(DatasetError, match="a.xdmf: says that it holds 4 cells, but their array has 6"):
        read_series(path, FieldNames(handle="0:zmin"))
    path.write_text(f'<Xdmf Version="3.0"><Domain><Grid>{mesh}</Grid></Domain></Xdmf>')
    with pytest.raises(DatasetError, match="a.xdmf: says that it holds 4 cells, but their array has 6"):
        read_mesh(path)


def test_functions_of_finite_elements_are_refused_by_name(tmp_path):
    facts = 'Center="Other" ItemType="FiniteElementFunction" ElementFamily="CG"'
    frames = [topology() + geometry() + displacement(frame, facts) for frame in FRAMES]
    with pytest.raises(DatasetError, match="'displacement' has its values at the place 'Other': .*not by write_check"):
        read_series(series(tmp_path / "a.xdmf", frames), FieldNames(handle="0:zmin"))


@pytest.mark.parametrize(
    "word",
    ["Collection", "Temporal", "Tetrahedron", "XYZ", "Int", "Float", "XML", "Node"],
)
@pytest.mark.parametrize("case", [str.upper, str.lower])
def test_words_may_be_in_capital_or_small_letters(tmp_path, word, case):
    """As XDMF takes them; meshio knows one spelling."""
    frames = [topology() + geometry() + displacement(frame) for frame in FRAMES]
    path = series(tmp_path / "a.xdmf", frames)
    text = path.read_text()
    assert f'"{word}"' in text
    path.write_text(text.replace(f'"{word}"', f'"{case(word)}"'))
    require_right(path)
    assert holds_frames(path)


def test_remarks_and_fields_of_whole_grids_are_left_out(tmp_path):
    remark = '<Information Name="made by" Value="hand"/>'
    step = f'<Attribute Name="dt" Center="Grid" AttributeType="Scalar">{item(np.array([0.1]))}</Attribute>'
    frames = [remark + topology() + geometry() + displacement(frame) + step for frame in FRAMES]
    path = series(tmp_path / "a.xdmf", frames)
    path.write_text(path.read_text().replace('"Temporal">', f'"Temporal">{remark}'))
    require_right(path)
    notes = read_series(path, FieldNames(handle="0:zmin")).attributes["notes"]
    assert "1 field with one value for the whole grid is left out: 'dt'" in notes


SHARED = (
    "<xi:include xpointer=\"xpointer(/Xdmf/Domain/Grid[@GridType='Uniform'][1]/*[self::Topology or self::Geometry])\"/>"
)


def of_functions(path, functions, grid=""):
    """A mesh and a series for each function: the attribute of each frame by its time."""
    text = f'<Grid Name="mesh" GridType="Uniform">{topology()}{geometry()}</Grid>'
    for frames in functions:
        grids = "".join(
            f'<Grid GridType="Uniform">{grid or SHARED}<Time Value="{time}"/>{inner}</Grid>' for time, inner in frames
        )
        text += f'<Grid GridType="Collection" CollectionType="Temporal">{grids}</Grid>'
    include = 'xmlns:xi="http://www.w3.org/2001/XInclude"'
    path.write_text(f'<Xdmf Version="3.0" {include}><Domain>{text}</Domain></Xdmf>')
    return path


MOTION = [(frame, displacement(frame)) for frame in FRAMES]
STRESS = [
    (frame, f'<Attribute Name="von_mises" Center="Cell">{item(100.0 * frame + np.arange(6.0))}</Attribute>')
    for frame in FRAMES
]


@pytest.mark.parametrize("functions", [(MOTION, STRESS), (STRESS, MOTION)])
def test_fenics_writes_a_series_for_each_function(tmp_path, functions):
    path = of_functions(tmp_path / "a.xdmf", functions)
    require_right(path)
    stress = read_series(path, FieldNames(handle="0:zmin")).stress
    assert stress[:, :, 0].tolist() == [(100.0 * frame + np.arange(6)).tolist() for frame in FRAMES]


@pytest.mark.parametrize(
    ("functions", "grid"),
    [
        ((MOTION, STRESS[:2]), ""),
        ((MOTION, [(time + 0.5, inner) for time, inner in STRESS]), ""),
        ((MOTION, STRESS), topology() + geometry()),
    ],
)
def test_series_of_other_times_or_meshes_are_refused(tmp_path, functions, grid):
    path = of_functions(tmp_path / "a.xdmf", functions, grid)
    with pytest.raises(DatasetError, match="a.xdmf: holds 2 series of frames, and one can be read"):
        read_series(path, FieldNames(handle="0:zmin"))


def test_two_series_must_not_have_a_field_of_one_name(tmp_path):
    path = of_functions(tmp_path / "a.xdmf", (MOTION, MOTION))
    with pytest.raises(DatasetError, match="a.xdmf: a grid has the field 'displacement' twice"):
        read_series(path, FieldNames(handle="0:zmin"))

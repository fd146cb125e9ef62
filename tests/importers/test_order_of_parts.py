"""Bodies, points and frames that a file lists in another order than the frame before: names, numbers and times tell
which is which."""

import json

import numpy as np
import pytest
import pyvista
from data_samples import block
from vtkmodules.vtkCommonCore import vtkIdTypeArray

from ast_sim.importers.convert import find_series
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.support.errors import DatasetError

CUBE = block(1, 1, 1)
NAMES = FieldNames(handle="0:zmin")
TWO = np.concatenate([CUBE.elements, CUBE.elements + 8])


def places(frame):
    """[16, 3]: a cube that is pressed, and an equal one that comes down on it."""
    return np.concatenate(
        [CUBE.rest_position * (1, 1, 1 - 0.05 * frame), CUBE.rest_position + (0, 0, 1.5 - 0.1 * frame)]
    )


def grid(elements, points):
    cells = np.column_stack([np.full(len(elements), 4), elements])
    return pyvista.UnstructuredGrid(cells, np.full(len(elements), 10), np.asarray(points, float))


def write_blocks(path, frame, turned=False, depth=0, time=None, names=("low", "high")):
    parts = [(name, grid(CUBE.elements, places(frame)[8 * row :][:8])) for row, name in enumerate(names)]
    blocks = pyvista.MultiBlock()
    for name, part in parts[::-1] if turned else parts:
        if time is not None:
            part.field_data["TimeValue"] = [time]
        blocks.append(part, name)
    for _ in range(depth):
        blocks = pyvista.MultiBlock({"parts": blocks})
    blocks.save(path)


def require_motion(read, frames=3):
    assert len(read.position) == frames
    for frame in range(frames):
        np.testing.assert_allclose(read.position[frame], places(frame), atol=1e-6)


@pytest.mark.parametrize("ending", [".vtm", ".vtmb"])
@pytest.mark.parametrize("depth", [0, 2])
def test_blocks_of_one_name_are_one_body(tmp_path, ending, depth):
    for frame in range(3):
        write_blocks(tmp_path / f"f{frame}{ending}", frame, turned=frame == 1, depth=depth)
    read = read_series(tmp_path, NAMES)
    require_motion(read)
    note = f"the blocks of f1{ending} stand in another order: they are reordered as in the first"
    assert read.attributes["notes"] == f"{note}; no times tell the 3 frames apart: they count 0, 1, 2, ..."


def test_blocks_of_other_names_keep_their_order(tmp_path):
    for frame in range(3):
        write_blocks(tmp_path / f"f{frame}.vtm", frame, names=(f"low {frame}", f"high {frame}"))
    require_motion(read_series(tmp_path, NAMES))


def test_a_file_of_blocks_may_have_letters_that_xml_writes_otherwise(tmp_path):
    for frame in range(3):
        write_blocks(tmp_path / f"a & b{frame}.vtm", frame)
    require_motion(read_series(tmp_path, NAMES))


def test_the_time_of_all_blocks_is_the_time_of_the_frame(tmp_path):
    for frame, name in enumerate("bca"):
        write_blocks(tmp_path / f"{name}.vtm", frame, time=0.5 * frame)
    read = read_series(tmp_path, NAMES)
    require_motion(read)
    assert read.times == (0, 0.5, 1)


def write_numbered(path, frame, order, declared):
    """A frame whose points stand in this order and have numbers, which the file declares or has as a field."""
    mesh = grid(np.argsort(order)[TWO], places(frame)[order])
    numbers = vtkIdTypeArray()
    numbers.SetName("GlobalNodeId")
    for number in order:
        numbers.InsertNextValue(100 + int(number))
    add = mesh.GetPointData().SetGlobalIds if declared else mesh.GetPointData().AddArray
    add(numbers)
    mesh.save(path)


@pytest.mark.parametrize("order", [np.r_[8:16, 0:8], np.random.default_rng(0).permutation(16)])
def test_points_of_one_number_are_one_point(tmp_path, order):
    for frame in range(3):
        write_numbered(tmp_path / f"f{frame}.vtu", frame, order if frame == 1 else np.arange(16), declared=True)
    read = read_series(tmp_path, NAMES)
    require_motion(read)
    assert "the points of f1.vtu stand in another order" in read.attributes["notes"]


def test_a_field_that_numbers_moved_points_otherwise_is_refused(tmp_path):
    """A program may write such a field for its own use; nothing says that the frames are to be put in its order."""
    for frame in range(3):
        order = np.r_[8:16, 0:8] if frame == 1 else np.arange(16)
        write_numbered(tmp_path / f"f{frame}.vtu", frame, order, declared=False)
    with pytest.raises(DatasetError, match=r"f1.vtu: the field 'GlobalNodeId' numbers the points in another order"):
        read_series(tmp_path, NAMES)


@pytest.mark.parametrize("tell", ['name="{}"', ""])
def test_parts_of_a_pvd_file_have_names(tmp_path, tell):
    listed = []
    for frame in range(3):
        for row, name in enumerate(("low", "high")):
            grid(CUBE.elements, places(frame)[8 * row :][:8]).save(tmp_path / f"{name}_{frame}.vtu")
            listed.append(f'<DataSet timestep="{frame}" {tell.format(name)} file="{name}_{frame}.vtu"/>')
    listed[2:4] = listed[3], listed[2]
    text = f'<VTKFile type="Collection"><Collection>{"".join(listed)}</Collection></VTKFile>'
    (tmp_path / "all.pvd").write_text(text)
    read = read_series(tmp_path / "all.pvd", FieldNames(handle="1:zmin"))  # "high" comes first
    for frame in range(3):
        np.testing.assert_allclose(read.position[frame], np.roll(places(frame), 8, axis=0), atol=1e-6)


def test_a_series_file_of_paraview_says_the_times(tmp_path):
    files = [{"name": f"r{name}.vtu", "time": 0.5 * frame} for frame, name in enumerate((2, 0, 1))]
    for frame, one in enumerate(files):
        grid(TWO, places(frame)).save(tmp_path / one["name"])
    path = tmp_path / "r.vtu.series"
    path.write_text(json.dumps({"file-series-version": "1.0", "files": files[::-1]}))
    assert find_series(tmp_path) == {"r.vtu": path}
    read = read_series(path, NAMES)
    require_motion(read)
    assert read.times == (0, 0.5, 1)


@pytest.mark.parametrize("text", ["{", "[]", '{"files": []}', '{"files": [{"name": "r0.vtu"}]}'])
def test_a_damaged_series_file_is_refused(tmp_path, text):
    (tmp_path / "r.vtu.series").write_text(text)
    with pytest.raises(DatasetError, match=r"r.vtu.series: (is damaged or no|must list files)"):
        read_series(tmp_path / "r.vtu.series", NAMES)


def test_a_series_file_has_a_time_for_each_frame(tmp_path):
    (tmp_path / "r.vtu.series").write_text('{"files": [{"name": "a.vtu", "time": 1}, {"name": "b.vtu", "time": 1}]}')
    with pytest.raises(DatasetError, match=r"each with a time of its own; it has \[1.0, 1.0\]"):
        read_series(tmp_path / "r.vtu.series", NAMES)


@pytest.mark.parametrize("numbers", [("_0_1", "_0_2", "_0_10"), ("1", "2")])
def test_two_series_in_one_folder_are_refused(tmp_path, numbers):
    """Kratos writes the parts of a model beside the whole: the frames of one series came after the other series."""
    for name in ("Structure", "Parts"):
        for frame, number in enumerate(numbers):
            grid(TWO, places(frame)).save(tmp_path / f"{name}{number}.vtu")
    told = "the files Parts.* and Structure.* have the same numbers and no times: give each series a folder"
    with pytest.raises(DatasetError, match=told):
        read_series(tmp_path, NAMES)


def test_names_of_files_may_be_words(tmp_path):
    for frame, name in enumerate(("at_rest", "loaded_1", "loaded_2")):
        grid(TWO, places(frame)).save(tmp_path / f"{name}.vtu")
    require_motion(read_series(tmp_path, NAMES))

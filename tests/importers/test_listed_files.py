"""PVD and .series files that list a file of another time or of another run are refused, or a note tells it."""

import json
import shutil

import meshio
import numpy as np
import pytest
import pyvista
from data_samples import block
from vtkmodules.vtkIOHDF import vtkHDFWriter

from ast_sim.importers.convert import find_series
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.support.errors import DatasetError

CUBE = block(1, 1, 1)
NAMES = FieldNames(handle="0:zmin")
A = [(frame, "", f"a_{frame}.vtu") for frame in range(4)]


@pytest.fixture
def folder(tmp_path):
    """Four frames of a cube (a), of the same cube in another run (b), of a cube above it (c); t and u are a and c with
    their times inside."""
    (tmp_path / "sub").mkdir()
    for frame in range(4):
        pressed = CUBE.rest_position * (1, 1, 1 - 0.1 * frame)
        above = CUBE.rest_position + (0, 0, 1.5 - 0.1 * frame)
        less = CUBE.rest_position * (1, 1, 1 - 0.05 * frame)
        for name, points in (("a", pressed), ("b", less), ("c", above), ("t", pressed), ("u", above), ("sub/a", less)):
            grid = pyvista.from_meshio(meshio.Mesh(points, [("tetra", CUBE.elements)]))
            if name in "tu":
                grid.field_data["TimeValue"] = [0.1 * frame]
            grid.save(tmp_path / f"{name}_{frame}.vtu")
    return tmp_path


def pvd(folder, entries):
    listed = "".join(f'<DataSet timestep="{time!r}" {part} file="{name}"/>' for time, part, name in entries)
    text = f'<VTKFile type="Collection"><Collection>{listed}</Collection></VTKFile>'
    (folder / "all.pvd").write_text(text)
    return folder / "all.pvd"


def notes(source):
    return read_series(source, NAMES).attributes.get("notes", "")


@pytest.mark.parametrize(
    "entries",
    [
        A,
        [(time * 1000.0, "", name.replace("a", "t")) for time, _, name in A],
        [(time, "", f"sub/{name}") for time, _, name in A],
        [(time, part, name) for time, _, name in A for part, name in (('part="0"', name), ('part="1"', "c_0.vtu"))],
    ],
)
def test_files_of_one_run_have_no_note(folder, entries):
    """Also with times in another unit, and with a part that is one file in all frames."""
    assert notes(pvd(folder, entries)) == ""


@pytest.mark.parametrize(
    ("entries", "told"),
    [
        ([*A[:2], (2, "", "b_2.vtu"), A[3]], r"differ in more than a number (a_1.vtu, b_2.vtu): are they of one run?"),
        ([*A, (4, "", "sub/a_1.vtu")], "differ in more than a number (a_3.vtu, sub/a_1.vtu): are they of one run?"),
        ([*A[:2], (2, "", "a_1.vtu"), A[3]], "all.pvd lists a_1.vtu after a_1.vtu: are their times right?"),
        ([A[0], (1, "", "a_2.vtu"), (2, "", "a_1.vtu")], "all.pvd lists a_1.vtu after a_2.vtu: are their times right?"),
        ([(0, "", "t_0.vtu"), (1, "", "t_2.vtu"), (2, "", "t_1.vtu")], "the time 2 for frame 2, whose file says 0.1"),
        (
            [(0.0, "", "t_0.vtu"), (0.1, "", "t_1.vtu"), (0.15, "", "t_2.vtu"), (0.3, "", "t_3.vtu")],
            "the time 0.15 for frame 2, whose file says 0.2: is it the right file?",
        ),
        (
            [(time, "", file) for time, _, name in A for file in (name, name.replace("a", "b"))],
            "the 2 files of each time are read as parts of one frame: a_0.vtu, b_0.vtu",
        ),
        (
            [
                (time, part, file)
                for time, _, name in A
                for part, file in (('part="0"', name), ('part="1"', f"c_{max(time, 2)}.vtu"))
            ],
            "all.pvd lists c_2.vtu after c_2.vtu: are their times right?",
        ),
    ],
)
def test_a_file_of_another_time_or_run_is_told(folder, entries, told):
    assert told in notes(pvd(folder, entries))


@pytest.mark.parametrize(
    ("entries", "cause"),
    [
        (A + A, r"lists a_0.vtu twice for the time 0"),
        ([*A, (2.000000001, "", "b_2.vtu")], r"lists a_2.vtu and b_2.vtu for times that differ by rounding alone"),
        (
            [(time, part, name) for time, _, name in A[:3] for part, name in (('part="0"', f"t_{time}.vtu"),)]
            + [(0, 'part="1"', "u_0.vtu"), (1, 'part="1"', "u_1.vtu"), (2, 'part="1"', "u_3.vtu")],
            r"u_3.vtu: is a part of a frame at the time 0.3, t_2.vtu at 0.2: list parts of one time together",
        ),
    ],
)
def test_what_cannot_be_one_run_is_refused(folder, entries, cause):
    with pytest.raises(DatasetError, match=cause):
        notes(pvd(folder, entries))


@pytest.mark.parametrize("other", ['<Dataset timestep="3" {}/>', '<Group><DataSet timestep="3" {}/></Group>'])
def test_an_entry_of_another_kind_is_not_passed_over(folder, other):
    source = pvd(folder, A)
    last = '<DataSet timestep="3"  file="a_3.vtu"/>'
    source.write_text(source.read_text().replace(last, other.format('file="a_3.vtu"')))
    with pytest.raises(DatasetError, match="all.pvd: 1 entry with a file is no DataSet right in a Collection"):
        notes(source)


def test_a_series_file_is_looked_at_as_well(folder):
    def series(*files):
        listed = [{"name": name, "time": time} for time, name in files]
        (folder / "all.vtu.series").write_text(json.dumps({"files": listed}))
        return folder / "all.vtu.series"

    assert "all.vtu.series lists a_1.vtu after a_2.vtu" in notes(series((0, "a_0.vtu"), (1, "a_2.vtu"), (2, "a_1.vtu")))
    with pytest.raises(DatasetError, match="for times that differ by rounding alone"):
        notes(series((0, "a_0.vtu"), (1, "a_1.vtu"), (1 + 1e-9, "b_1.vtu"), (2, "a_2.vtu")))


def test_blocks_of_a_frame_have_one_time(folder):
    for frame in range(3):
        blocks = pyvista.MultiBlock([pyvista.read(folder / f"{name}.vtu") for name in (f"t_{frame}", f"u_{frame}")])
        blocks.save(folder / f"m_{frame}.vtm")
    listed = [(frame, "", f"m_{frame}.vtm") for frame in range(3)]
    assert len(read_series(pvd(folder, listed), NAMES).position) == 3
    blocks[1].field_data["TimeValue"] = [0.7]
    blocks.save(folder / "m_2.vtm")
    with pytest.raises(DatasetError, match=r"its blocks are of different times \(0.2, 0.7\)"):
        read_series(pvd(folder, listed), NAMES)


def test_times_in_a_folder_that_are_not_used_are_told(folder, tmp_path_factory):
    files = tmp_path_factory.mktemp("files")
    for frame, name in enumerate(("t_0", "t_1", "t_2", "t_1")):
        shutil.copy(folder / f"{name}.vtu", files / f"f_{frame}.vtu")
    count = "no times tell the 4 frames apart: they count 0, 1, 2, ..."
    assert notes(files) == f"f_1.vtu and f_3.vtu say the same time 0.1: the times inside are not used; {count}"
    shutil.copy(folder / "a_3.vtu", files / "f_3.vtu")
    assert notes(files) == f"f_3.vtu says no time, other files do: the times inside are not used; {count}"


def test_vtkhdf_files_of_one_frame_each_may_be_listed(tmp_path):
    """As ParaView writes a series of them."""
    entries = []
    for frame in range(3):
        points = CUBE.rest_position * (1, 1, 1 - 0.1 * frame)
        grid = pyvista.from_meshio(meshio.Mesh(points, [("tetra", CUBE.elements)]))
        writer = vtkHDFWriter()
        writer.SetFileName(str(tmp_path / f"a_{frame}.vtkhdf"))
        writer.SetInputData(grid)
        writer.Write()
        entries.append((0.5 * frame, "", f"a_{frame}.vtkhdf"))
    series = [{"name": name, "time": time} for time, _, name in entries]
    (tmp_path / "a.vtkhdf.series").write_text(json.dumps({"file-series-version": "1.0", "files": series}))
    for source in (pvd(tmp_path, entries), tmp_path / "a.vtkhdf.series"):
        read = read_series(source, NAMES)
        assert read.times == (0.0, 0.5, 1.0)
        assert read.position[:, :, 2].max(axis=1) == pytest.approx([1, 0.9, 0.8])


def test_a_list_that_is_written_on_windows_names_files_in_folders(folder):
    """With backslashes; the other folder holds other results."""
    source = pvd(folder, [(time, "", f"sub\\{name}") for time, _, name in A])
    pressed_less = [1, 0.95, 0.9, 0.85]
    np.testing.assert_allclose(read_series(source, NAMES).position[:, :, 2].max(axis=1), pressed_less, rtol=1e-6)


@pytest.mark.parametrize("kind", ["list", "folder", "one of several"])
def test_endings_have_no_case(folder, tmp_path_factory, kind):
    files = tmp_path_factory.mktemp("files")
    for frame in range(4):
        shutil.copy(folder / f"a_{frame}.vtu", files / f"A_{frame}.VTU")
    source = files
    if kind != "folder":
        source = pvd(files, [(time, "", name.upper()) for time, _, name in A]).rename(files / "ALL.PVD")
    source = find_series(files)["ALL"] if kind == "one of several" else source
    read = read_series(source, NAMES)
    np.testing.assert_allclose(read.position[:, :, 2].max(axis=1), (1, 0.9, 0.8, 0.7), rtol=1e-6)


def listed_in(kind, folder, names):
    """A PVD or .series file that lists these files."""
    if kind == "pvd":
        return pvd(folder, [(time, "", name) for time, name in enumerate(names)])
    files = [{"name": name, "time": time} for time, name in enumerate(names)]
    (folder / "all.vtu.series").write_text(json.dumps({"files": files}))
    return folder / "all.vtu.series"


@pytest.mark.parametrize("kind", ["pvd", "series"])
@pytest.mark.parametrize(("real", "listed"), [("two words", "two%20words"), ("größe", "gr%C3%B6%C3%9Fe"), ("a", "%61")])
def test_names_with_percent_signs_are_taken_as_they_stand(folder, kind, real, listed):
    """As by ParaView: a browser's name of a file is another file, and is there no file of the name, it is refused."""
    shutil.copytree(folder / "sub", folder / real)
    source = listed_in(kind, folder, [f"{listed}/a_{frame}.vtu" for frame in range(4)])
    with pytest.raises(DatasetError, match=f"lists .*/{listed}/a_0.vtu, which does not exist"):
        read_series(source, NAMES)
    (folder / listed).mkdir()
    for frame in range(4):
        shutil.copy(folder / f"a_{frame}.vtu", folder / listed)
    np.testing.assert_allclose(read_series(source, NAMES).position[:, :, 2].max(axis=1), (1, 0.9, 0.8, 0.7), rtol=1e-6)
    plain = listed_in(kind, folder, [f"{real}/a_{frame}.vtu" for frame in range(4)])
    np.testing.assert_allclose(read_series(plain, NAMES).position[:, :, 2].max(axis=1), (1, 0.95, 0.9, 0.85), rtol=1e-6)

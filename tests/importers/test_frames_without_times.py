"""Frames of which no file says the time are told with their count, in each format; others are not."""

import meshio
import numpy as np
import pytest
import pyvista
from data_samples import block
from exodus_made import exodus, nodal

from ast_sim.dataset.reader import Dataset
from ast_sim.importers.convert import convert
from ast_sim.importers.formats.exodus.exodus_files import exodus_facts
from ast_sim.importers.mesh_file import read_mesh
from ast_sim.importers.series import FieldNames, read_series

CUBE = block(1, 1, 1)
NAMES = FieldNames("disp", handle="low", obstacle="punch")
SPLITS = {"train": 1, "valid": 0, "test": 0}


def told(count):
    return f"no times tell the {count} frames apart: they count 0, 1, 2, ..."


def write(path, kind, timed, times=(0.0, 0.5, 1.0), values=None):
    made = exodus(times=times, values=values)
    if not timed:
        del made.variables["time_whole"]
    made.write_hdf(path) if kind == "hdf" else made.write(path, kind)


@pytest.mark.parametrize("kind", [1, 2, 5, "hdf"])
def test_an_exodus_file_without_times_is_told(tmp_path, kind):
    """VTK counts 0, 1, 2."""
    path = tmp_path / "a.e"
    write(path, kind, timed=False)
    read = read_series(path, NAMES)
    assert read.times is None and read.attributes["notes"] == told(3)
    facts = exodus_facts(path)
    assert facts.steps == 3 and not facts.timed
    write(path, kind, timed=True, times=(0.0, 1.0, 2.0))
    read = read_series(path, NAMES)
    assert read.times == (0.0, 1.0, 2.0) and "notes" not in read.attributes
    assert exodus_facts(path).timed


def test_convert_tells_it_and_keeps_it(tmp_path):
    (tmp_path / "runs").mkdir()
    for name, timed, last in (("one", False, 3), ("other", True, 4)):
        times = 0.5 * np.arange(1 + last)
        write(tmp_path / "runs" / f"{name}.g", "hdf", timed, times)  # .g: only if it has frames
    lines = []
    shown = {"progress": lambda done, total, line: lines.append(line)}
    counts = convert(tmp_path / "runs", tmp_path / "d.h5", splits=SPLITS, names=NAMES, **shown)
    assert counts["train"] == 2
    assert [told(4) in line for line in lines] == [True, False]
    with Dataset(tmp_path / "d.h5") as data:
        assert [data["train"][row].attributes.get("notes") for row in range(2)] == [told(4), None]


def test_one_frame_needs_no_time(tmp_path):
    pressed = {name: rows[1:] for name, rows in nodal(2).items()}
    for timed in (True, False):
        write(tmp_path / "a.e", 2, timed, times=(7.0,), values=pressed)
        read = read_series(tmp_path / "a.e", NAMES)
        assert read.num_frames == 1 and "notes" not in read.attributes
        assert np.abs(read.position - read.scene.rest_position).max() == pytest.approx(0.1, rel=1e-6)
        assert read_mesh(tmp_path / "a.e").source.time == (7.0 if timed else None)


def write_frames(folder, ending, times):
    folder.mkdir()
    for frame, time in enumerate(times):
        points = CUBE.rest_position * (1, 1, 1 - 0.1 * frame)
        mesh = meshio.Mesh(points, [("tetra", CUBE.elements)])
        path = folder / f"f_{frame}.{ending}"
        if ending == "xdmf":
            meshio.write(path, mesh, data_format="XML")
            if time is not None:
                path.write_text(path.read_text().replace("<Geometry", f'<Time Value="{time}"/><Geometry'))
        else:
            grid = pyvista.from_meshio(mesh)
            if time is not None:
                grid.field_data["TimeValue"] = [time]
            grid.save(path)


@pytest.mark.parametrize("ending", ["vtu", "vtk", "xdmf"])
@pytest.mark.parametrize(
    ("times", "notes"),
    [
        ((None, None, None, None), [told(4)]),
        ((2.0, 2.0), [told(2)]),
        ((0.0, 0.5, 1.0), []),
        ((0.0, None, 1.0), ["f_1.{} says no time, other files do: the times inside are not used", told(3)]),
    ],
    ids=["none", "one for all", "each its own", "one has none"],
)
def test_a_folder_of_frames_without_times_is_told(tmp_path, ending, times, notes):
    write_frames(tmp_path / "run", ending, times)
    read = read_series(tmp_path / "run", FieldNames(handle="0:zmin"))
    assert read.attributes.get("notes", "") == "; ".join(notes).format(ending)
    assert read.times == (None if notes else times)
    np.testing.assert_allclose(
        read.position[:, :, 2].max(axis=1), 1 - 0.1 * np.arange(len(times)), rtol=1e-6, err_msg="in order"
    )


def test_a_list_of_files_says_their_times(tmp_path):
    write_frames(tmp_path / "run", "vtu", (None, None))
    entries = "".join(f'<DataSet timestep="{n}" file="run/f_{n}.vtu"/>' for n in range(2))
    (tmp_path / "run.pvd").write_text(f'<VTKFile type="Collection"><Collection>{entries}</Collection></VTKFile>')
    read = read_series(tmp_path / "run.pvd", FieldNames(handle="0:zmin"))
    assert read.times == (0.0, 1.0) and "notes" not in read.attributes

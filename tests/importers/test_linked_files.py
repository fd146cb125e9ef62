"""HDF5 files that take their arrays from other files: VTK's files of one step each, and virtual arrays of XDMF."""

import h5py
import meshio
import numpy as np
import pytest
from data_samples import block

from ast_sim.importers.convert import find_series
from ast_sim.importers.mesh_file import read_mesh
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.support.errors import DatasetError

CUBE = block(1, 1, 1)
POINTS = CUBE.rest_position.astype(float)
COUNT = len(CUBE.elements)
NAMES = FieldNames(handle="0:zmin")


def moved(frame):
    return POINTS * (0, 0, -0.1 * frame)


def write_step(path, frame):
    """An unstructured grid of VTKHDF with the displacement of a frame."""
    with h5py.File(path, "w") as file:
        root = file.create_group("VTKHDF")
        root.attrs.update(Version=(2, 0), Type=np.bytes_("UnstructuredGrid"))
        root["NumberOfPoints"], root["NumberOfCells"], root["NumberOfConnectivityIds"] = [8], [COUNT], [4 * COUNT]
        root["Points"], root["Connectivity"] = POINTS, CUBE.elements.ravel().astype(np.int64)
        root["Offsets"], root["Types"] = 4 * np.arange(COUNT + 1), np.full(COUNT, 10, np.uint8)
        root["PointData/displacement"] = moved(frame)


def write_run(folder, frames=3):
    """A file of all frames, on the mesh of its own and with the displacements of a file for each frame, and these."""
    for frame in range(frames):
        write_step(folder / f"run_{frame}.vtkhdf", frame)
    layout = h5py.VirtualLayout((frames * 8, 3), "f8")
    for frame in range(frames):
        source = h5py.VirtualSource(f"run_{frame}.vtkhdf", "VTKHDF/PointData/displacement", shape=(8, 3))
        layout[8 * frame : 8 * frame + 8] = source
    write_step(folder / "run.vtkhdf", 0)
    with h5py.File(folder / "run.vtkhdf", "r+") as file:
        root = file["VTKHDF"]
        del root["PointData/displacement"]
        root["PointData"].create_virtual_dataset("displacement", layout)
        steps = root.create_group("Steps")
        steps.attrs["NSteps"] = frames
        steps["Values"] = np.arange(frames, dtype=float)
        for name in ("PartOffsets", "PointOffsets", "CellOffsets", "ConnectivityIdOffsets"):
            steps[name] = np.zeros(frames, np.int64)
        steps["NumberOfParts"] = np.ones(frames, np.int64)
        steps["PointDataOffsets/displacement"] = 8 * np.arange(frames)
    return folder / "run.vtkhdf"


def test_steps_in_files_of_their_own_are_read(tmp_path):
    read = read_series(write_run(tmp_path), NAMES)
    for frame in range(3):
        np.testing.assert_allclose(read.position[frame], POINTS + moved(frame), atol=1e-7)
    assert find_series(tmp_path) == {"run": tmp_path / "run.vtkhdf"}


@pytest.mark.parametrize("frame", [1, 2])
def test_a_missing_step_is_refused(tmp_path, frame):
    """HDF5 takes zeros for it: the body would be back at rest."""
    path = write_run(tmp_path)
    (tmp_path / f"run_{frame}.vtkhdf").unlink()
    with pytest.raises(DatasetError, match=rf"run.vtkhdf: takes numbers from run_{frame}.vtkhdf, which is not there"):
        read_series(path, NAMES)


def test_a_mesh_by_an_external_link_is_refused_without_its_file(tmp_path, monkeypatch):
    """HDF5 would take a file of this name in the folder where the process runs."""
    write_step(tmp_path / "mesh.vtkhdf", 1)
    folder = tmp_path / "inner"
    folder.mkdir()
    with h5py.File(folder / "run.vtkhdf", "w") as file:
        file["VTKHDF"] = h5py.ExternalLink("mesh.vtkhdf", "VTKHDF")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DatasetError, match=r"run.vtkhdf: takes numbers from mesh.vtkhdf, which is not there"):
        read_mesh(folder / "run.vtkhdf")


def test_virtual_arrays_of_xdmf_need_their_files(tmp_path):
    mesh = meshio.Mesh(POINTS, [("tetra", CUBE.elements)], {"displacement": moved(2)})
    mesh.write(tmp_path / "a.xdmf", data_format="HDF")
    with h5py.File(tmp_path / "a.h5", "r+") as file, h5py.File(tmp_path / "values.h5", "w") as values:
        name = next(name for name, array in file.items() if np.array_equal(array[()], moved(2)))
        values["u"] = moved(2)
        layout = h5py.VirtualLayout((8, 3), "f8")
        layout[:] = h5py.VirtualSource("values.h5", "u", shape=(8, 3))
        del file[name]
        file.create_virtual_dataset(name, layout)
    np.testing.assert_array_equal(read_mesh(tmp_path / "a.xdmf").fields["point"]["displacement"], moved(2))
    (tmp_path / "values.h5").unlink()
    with pytest.raises(DatasetError, match=r"a.h5: takes numbers from values.h5, which is not there"):
        read_mesh(tmp_path / "a.xdmf")


def test_files_that_a_pvd_file_lists_are_no_simulations(tmp_path):
    frames = [f'<DataSet timestep="{frame}" file="run_{frame}.vtkhdf"/>' for frame in range(3)]
    for frame in range(3):
        write_step(tmp_path / f"run_{frame}.vtkhdf", frame)
    text = f'<VTKFile type="Collection"><Collection>{"".join(frames)}</Collection></VTKFile>'
    (tmp_path / "run.pvd").write_text(text)
    assert find_series(tmp_path) == {"run": tmp_path / "run.pvd"}
    assert len(read_series(tmp_path / "run.pvd", NAMES).position) == 3

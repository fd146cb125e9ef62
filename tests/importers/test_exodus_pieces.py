"""Pieces and blocks of Exodus files: which file a message names, which nodes are points, files of other programs."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from exodus_made import ELEMENTS, PAD, POINTS, Netcdf, exodus, nodal
from test_exodus_files import HALVES, NAMES, require_right, write_pieces

from ast_sim.importers.mesh_file import read_mesh
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.support.errors import DatasetError

SECOND = "job.e.2.1"


def test_a_piece_of_a_number_that_is_not_there_is_refused(tmp_path):
    write_pieces(tmp_path, HALVES)
    (tmp_path / "job.e.2.2").write_bytes((tmp_path / SECOND).read_bytes())
    with pytest.raises(DatasetError, match=r"job.e.2.2: is a piece of a parallel run, but there is no piece of this"):
        read_series(tmp_path / "job.e.2.2", NAMES)


def test_pieces_are_found_by_a_relative_path(tmp_path, monkeypatch):
    write_pieces(tmp_path, HALVES)
    monkeypatch.chdir(tmp_path)
    require_right(read_series(Path(SECOND), NAMES))


def test_a_message_names_the_piece_that_it_is_about(tmp_path):
    write_pieces(tmp_path, HALVES)
    file = exodus(numbers=np.arange(1, len(POINTS) + 1))
    del file.variables["vals_nod_var3"]
    file.write(tmp_path / SECOND)
    with pytest.raises(DatasetError, match=f"^{tmp_path / SECOND}: lacks vals_nod_var3"):
        read_series(tmp_path / "job.e.2.0", NAMES)


def test_pieces_of_other_times_are_named(tmp_path):
    write_pieces(tmp_path, HALVES)
    kept = (tmp_path / SECOND).read_bytes()
    write_pieces(tmp_path, HALVES, times=(0.0, 0.25, 0.5))
    (tmp_path / SECOND).write_bytes(kept)
    told = f"^{tmp_path / SECOND}: is a part of a frame at the time 0.5, job.e.2.0 at 0.25"
    with pytest.raises(DatasetError, match=told):
        read_series(tmp_path / "job.e.2.0", NAMES)


@pytest.mark.parametrize("name", ["job.e.2.0", SECOND])
def test_a_message_about_the_whole_names_the_file_that_was_given(tmp_path, name):
    write_pieces(tmp_path, HALVES)
    with pytest.raises(DatasetError, match=f"^{tmp_path / name}: .*'nothing'"):
        read_series(tmp_path / name, FieldNames("nothing", handle="low", obstacle="punch"))


def test_a_piece_without_nodes_is_refused(tmp_path):
    """A process that got no elements may write one."""
    write_pieces(tmp_path, [*HALVES, (slice(0, 1), slice(0, 0))])
    empty = Netcdf({"time_step": 0, "len_string": 33, "num_dim": 3})
    empty.put("time_whole", ("time_step",), np.array([0.0, 0.5, 1.0]))
    empty.write(tmp_path / "job.e.3.2")
    with pytest.raises(DatasetError, match=r"job.e.3.2: gives its nodes no numbers \(node_num_map\)"):
        read_series(tmp_path / "job.e.3.0", NAMES)


def test_blocks_that_share_nodes_are_one_mesh(tmp_path):
    """VTK gives each block points of its own."""
    upper, lower = PAD.elements[:20], PAD.elements[20:]
    blocks = [("TETRA4", 1, "upper", upper), ("TETRA4", 2, "lower", lower), ("TETRA4", 3, "tool", ELEMENTS[1])]
    exodus(blocks=blocks).write(tmp_path / "a.e")
    require_right(read_series(tmp_path / "a.e", NAMES))


def test_points_of_no_element_are_left_out_and_told(tmp_path):
    values = {name: np.concatenate([rows, rows[:, :2]], axis=1) for name, rows in nodal().items()}
    points = np.concatenate([POINTS, [(5, 5, 5), (6, 5, 5)]])
    exodus(points, values=values).write(tmp_path / "a.e")
    read = read_series(tmp_path / "a.e", NAMES)
    require_right(read)
    assert "2 points of no element are left out" in read.attributes["notes"]


def test_other_files_of_netcdf_are_no_exodus_files(tmp_path):
    """Such as the weather of a day, and any file of HDF5."""
    file = Netcdf({"time_step": 0, "place": 3})
    file.put("temperature", ("time_step", "place"), np.ones((2, 3)))
    file.write(tmp_path / "a.e")
    with pytest.raises(DatasetError, match=r"a\.e: holds no points"):
        read_mesh(tmp_path / "a.e")
    with h5py.File(tmp_path / "b.e", "w") as other:
        other["temperature"] = np.ones(3)
    with pytest.raises(DatasetError, match=r"b\.e: cannot be read as a mesh: is no Exodus file"):
        read_mesh(tmp_path / "b.e")

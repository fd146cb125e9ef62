"""What comes out of a file is counted against what the file says it holds."""

import re
import subprocess
from pathlib import Path

import h5py
import numpy as np
import pytest
import pyvista
from data_samples import block
from scipy.io import netcdf_file
from vtkmodules.vtkCommonDataModel import vtkUnstructuredGrid
from vtkmodules.vtkIOExodus import vtkExodusIIWriter

from ast_sim.importers.formats import vtk_files
from ast_sim.importers.mesh_file import read_mesh
from ast_sim.support.errors import DatasetError

DECK = """*NODE
1, 0, 0, 0
2, 1, 0, 0
3, 0, 1, 0
4, 0, 0, 1
5, 1, 1, 1
*ELEMENT, TYPE=C3D4, ELSET=ALL
1, 1, 2, 3, 4
2, 2, 3, 4, 5
*SOLID SECTION, ELSET=ALL, MATERIAL=M
*MATERIAL, NAME=M
*ELASTIC
1000., 0.3
*BOUNDARY
1, 1, 3
2, 1, 3
3, 1, 3
*STEP
*STATIC
*BOUNDARY
5, 3, 3, 0.1
*NODE {}
U
*END STEP
"""


@pytest.mark.parametrize("output", ["FILE", "OUTPUT"])  # as text, and binary
def test_results_of_calculix_that_say_another_number_are_refused(tmp_path, output):
    (tmp_path / "job.inp").write_text(DECK.format(output))
    subprocess.run(["ccx", "job"], cwd=tmp_path, check=True, capture_output=True)
    result = tmp_path / "job.frd"
    assert read_mesh(result).elements.shape == (2, 4)
    content = result.read_bytes()
    for key, said, more in ((b"2C", b"5", b"6"), (b"3C", b"2", b"3")):
        wrong, count = re.subn(rb"( {4}" + key + rb" +)" + said + rb" ", rb"\g<1>" + more + rb" ", content, count=1)
        assert count == 1
        result.write_bytes(wrong)
        refusal = (
            "the header declares 3 elements" if output == "OUTPUT" and key == b"3C" else "says that it holds . points"
        )
        with pytest.raises(DatasetError, match=refusal):
            read_mesh(result)


def test_results_with_exponents_of_three_digits_are_read(tmp_path):
    """CalculiX for Windows writes them, and negative numbers are a column wider then."""
    (tmp_path / "job.inp").write_text(DECK.format("FILE").replace("1, 0, 0, 0\n", "1, -12, 0, 0\n"))
    subprocess.run(["ccx", "job"], cwd=tmp_path, check=True, capture_output=True)
    (before,) = vtk_files.vtk_frames(tmp_path / "job.frd")
    number = re.compile(r"[ ](\d\.\d{5}E[+-])(\d\d)|(-\d\.\d{5}E[+-])(\d\d)")
    text, changed = number.subn(lambda m: f"{m[1] or m[3]}0{m[2] or m[4]}", (tmp_path / "job.frd").read_text())
    assert changed > 20
    (tmp_path / "job.frd").write_text(text)
    (after,) = vtk_files.vtk_frames(tmp_path / "job.frd")
    np.testing.assert_array_equal(after.points, before.points)
    assert after.points.min() == -12
    for name, values in before.point_fields.items():
        np.testing.assert_array_equal(after.point_fields[name], values)


def exodus(path: Path) -> pyvista.UnstructuredGrid:
    """A block of two bodies and two points of no element."""
    scene = block(2, 1, 1)
    points = np.concatenate([scene.rest_position, [[9, 9, 9], [8, 8, 8]]])
    cells = np.hstack([np.full((scene.num_elements, 1), 4), scene.elements]).ravel()
    grid = pyvista.UnstructuredGrid(cells, np.full(scene.num_elements, 10, np.uint8), points)
    writer = vtkExodusIIWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(vtkUnstructuredGrid.SafeDownCast(grid))
    assert writer.Write() == 1
    return grid


def test_points_of_no_element_in_an_exodus_file_are_told(tmp_path):
    grid = exodus(tmp_path / "a.exo")
    mesh = read_mesh(tmp_path / "a.exo")
    assert len(mesh.elements) == grid.n_cells and len(np.unique(mesh.elements)) == grid.n_points - 2
    assert "2 points of no element are left out" in mesh.notes


@pytest.mark.parametrize(("points", "cells"), [(-1, 0), (0, -1), (0, 1)])
def test_an_exodus_file_of_which_vtk_reads_another_part_is_refused(tmp_path, monkeypatch, points, cells):
    grid = exodus(tmp_path / "a.exo")
    ask = vtk_files._worker.ask

    def answer(*args):
        head, parts = ask(*args)
        declared = head["declared"]
        assert declared == [grid.n_points, grid.n_cells]
        used = grid.n_points - 2  # fewer than are read: the file lacks some
        head["declared"] = [used + points if points else declared[0], declared[1] + cells]
        return head, parts

    monkeypatch.setattr(vtk_files._worker, "ask", answer)
    with pytest.raises(DatasetError, match=r"a.exo: says that it holds \d+ points and \d+ cells, but VTK reads"):
        read_mesh(tmp_path / "a.exo")


def exodus_of(path: Path, kind: str, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Three elements of a kind, each of its own points. The points, and the nodes of the elements."""
    rng = np.random.default_rng(nodes)
    points, cells = rng.random((3 * nodes, 3)), rng.permutation(3 * nodes).reshape(3, nodes)
    sizes = {"time_step": None, "len_string": 33, "len_line": 81, "four": 4, "num_dim": 3, "num_nodes": len(points)}
    sizes |= {"num_elem": 3, "num_el_blk": 1, "num_el_in_blk1": 3, "num_nod_per_el1": nodes}
    with netcdf_file(path, "w") as file:
        file.api_version = file.version = np.float32(5.1)
        file.floating_point_word_size, file.file_size, file.title = np.int32(8), np.int32(1), b"a"
        for name, size in sizes.items():
            file.createDimension(name, size)
        file.createVariable("time_whole", "d", ("time_step",))
        file.createVariable("eb_status", "i", ("num_el_blk",))[:] = 1
        numbers = file.createVariable("eb_prop1", "i", ("num_el_blk",))
        numbers[:], numbers.name = 1, b"ID"
        for axis, values in zip("xyz", points.T, strict=True):
            file.createVariable(f"coord{axis}", "d", ("num_nodes",))[:] = values
        rows = file.createVariable("connect1", "i", ("num_el_in_blk1", "num_nod_per_el1"))
        rows[:], rows.elem_type = cells + 1, kind.encode()
    return points, cells


KINDS = [
    ("TRI", 3, (3, 6), (4, 7)),
    ("QUAD", 4, (4, 8, 9), (5,)),
    ("SHELL", 4, (4, 8), (6, 9)),
    ("SHELL", 3, (3,), ()),
    ("TETRA", 4, (4, 10, 15), (5, 8, 11, 14)),
    ("PYRAMID", 5, (5, 13), (14, 18, 19)),
    ("wedge", 6, (6, 15, 18, 21), (7, 12, 16, 20)),
    ("HEX", 8, (8, 20, 27), (9, 12, 21, 26, 64)),
]


@pytest.mark.parametrize(("kind", "corners", "known", "mistaken"), KINDS)
def test_elements_of_exodus_have_the_nodes_of_the_file_or_are_refused(tmp_path, kind, corners, known, mistaken):
    """VTK takes rows of other lengths where it does not know how many nodes such an element may have."""
    path = tmp_path / "a.e"
    for nodes in known:
        points, cells = exodus_of(path, kind, nodes)
        (mesh,) = vtk_files.vtk_frames(path)
        assert (mesh.points[mesh.blocks[0].nodes[:, :corners]] == points[cells[:, :corners]]).all()
    for nodes in mistaken:
        exodus_of(path, kind, nodes)
        with pytest.raises(DatasetError, match=f"a.e: holds {kind} elements of {nodes} nodes, and VTK mistakes"):
            read_mesh(path)


def test_elements_that_vtk_mistakes_are_refused_in_netcdf_4_as_well(tmp_path):
    with h5py.File(tmp_path / "a.e", "w") as file:
        file["connect1"] = np.ones((2, 14), np.int32)
        file["connect1"].attrs["elem_type"] = np.bytes_("TETRA14")
    with pytest.raises(DatasetError, match=r"a.e: holds TETRA14 elements of 14 nodes, .* with 4, 10 or 15 nodes$"):
        read_mesh(tmp_path / "a.e")


def test_elements_of_exodus_that_vtk_does_not_know_are_named(tmp_path):
    exodus_of(tmp_path / "a.e", "BEX_HEX", 8)
    with pytest.raises(DatasetError, match="a.e: .*: VTK does not know its elements of the kind 'BEX_HEX'"):
        read_mesh(tmp_path / "a.e")

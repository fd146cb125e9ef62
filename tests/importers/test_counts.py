"""What comes out of a file is counted against what the file says it holds."""

import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
import pyvista
from blocks import block
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

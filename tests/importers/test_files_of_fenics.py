"""Files that both generations of FEniCS wrote: dolfin 2019.2 and dolfinx 0.5.2, as Debian has them.

`/usr/bin/python3 benchmarks/robustness/dialects/fenics_files.py WRITER FOLDER 1 0` made them, and `truth.npz` beside
them: what the program was told to write.
"""

from pathlib import Path

import numpy as np
import pytest

from ast_sim.importers.mesh_file import read_mesh
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.mechanics.case import NOTES

FOLDER = Path(__file__).with_name("fenics")
TURNED = "36 tetrahedra that were inside out are turned over"
TWICE = (
    "72 points at 36 places are joined: pieces of the file meet there;"
    " 72 elements that stand in the file twice are taken once"
)


def truth_of(writer):
    return np.load(FOLDER / writer / "truth.npz")


def require_the_mesh(truth, points, elements):
    """The same tetrahedra at the same places, none inside out, each node once."""
    true_points = truth["points"]
    distance = np.linalg.norm(points[:, None] - true_points, axis=2)
    node = distance.argmin(axis=1)
    assert distance.min(axis=1).max() < 1e-6 and sorted(node) == list(range(len(true_points)))
    assert set(map(frozenset, node[elements])) == set(map(frozenset, truth["cells"]))
    corners = points[elements]
    assert (np.linalg.det(corners[:, 1:] - corners[:, :1]) > 0).all()
    return node


@pytest.mark.parametrize(
    ("writer", "name", "notes"),
    [
        ("dolfin", "all.pvd", TURNED),
        ("dolfin", "all.xdmf", TURNED),
        ("dolfinx", "all.pvd", TWICE),
    ],
)
def test_a_series_is_what_fenics_was_told_to_write(writer, name, notes):
    truth = truth_of(writer)
    result = read_series(FOLDER / writer / name, FieldNames("U", handle="0:xmin"))
    assert result.attributes[NOTES] == notes
    assert result.times == pytest.approx(truth["times"])
    scene = result.scene
    node = require_the_mesh(truth, scene.rest_position, scene.elements)
    np.testing.assert_array_equal(scene.prescribed, truth["points"][node, 0] < 1e-9)
    np.testing.assert_allclose(result.position - scene.rest_position, truth["displacement"][:, node], atol=1e-6)


def test_a_mesh_of_dolfinx_is_read():
    mesh = read_mesh(FOLDER / "dolfinx" / "mesh.xdmf")
    require_the_mesh(truth_of("dolfinx"), mesh.points, mesh.elements)

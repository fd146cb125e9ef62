"""Meshes as programs write them whose files bear the endings of other formats, or older formats."""

import re
import subprocess
import sys

import numpy as np
import pytest

from ast_sim.importers.mesh_file import read_mesh
from ast_sim.support.errors import DatasetError

BOX = """
import gmsh
gmsh.initialize()
gmsh.option.setNumber("General.Verbosity", 0)
box = gmsh.model.occ.addBox(0, 0, 0, 1, 2, 3)
gmsh.model.occ.synchronize()
gmsh.model.addPhysicalGroup(3, [box], 5, "body")
gmsh.model.addPhysicalGroup(2, [1], 7, "end")
gmsh.option.setNumber("Mesh.MeshSizeMin", 1)
gmsh.option.setNumber("Mesh.ElementOrder", {order})
gmsh.model.mesh.generate(3)
gmsh.option.setNumber("Mesh.MshFileVersion", {version})
gmsh.write("{name}")
"""


def of_gmsh(folder, version, order=1, name="a.msh"):
    """A box with the groups 5, of its body, and 7, of its face at x = 0, as Gmsh writes it."""
    pytest.importorskip("gmsh")
    script = BOX.format(version=version, order=order, name=name)
    subprocess.run([sys.executable, "-c", script], cwd=folder, check=True)
    return folder / name


@pytest.mark.parametrize("order", [1, 2])
def test_the_first_format_of_gmsh_is_read_as_the_second(tmp_path, order):
    (tmp_path / "2").mkdir()
    path = of_gmsh(tmp_path, 1, order)
    assert path.read_bytes().startswith(b"$NOD")
    first, second = read_mesh(path), read_mesh(of_gmsh(tmp_path / "2", 2.2, order))
    assert first.elements.shape[1] == {1: 4, 2: 10}[order]
    np.testing.assert_array_equal(first.points, second.points)
    np.testing.assert_array_equal(first.elements, second.elements)
    for number, name in (("5", "body"), ("7", "end")):
        np.testing.assert_array_equal(first.groups[number], second.groups[name])
    assert (first.points[first.groups["7"], 0] == 0).all()


@pytest.mark.parametrize(
    ("old", "new", "cause"),
    [
        (r"\$ENDNOD", "", "the section NOD has no end"),
        (r"\$ENDELM", "", "the section ELM has no end"),
        (r"(\d+ 4 5 1 4 \d+ \d+ \d+) \d+\n", r"\1\n", "element [0-9]+ has 3 nodes"),
        (r"\$ELM\n", "$ELM\n1", "it says that it holds 1[0-9]+ elements, but there are"),
    ],
)
def test_damaged_files_of_the_first_format_are_refused(tmp_path, old, new, cause):
    path = of_gmsh(tmp_path, 1)
    text, changed = re.subn(old, new, path.read_text(), count=1)
    assert changed
    path.write_text(text)
    with pytest.raises(DatasetError, match=f"a.msh: cannot be read as a mesh: it is damaged: {cause}"):
        read_mesh(path)


def test_comments_may_stand_before_the_format(tmp_path):
    path = of_gmsh(tmp_path, 2.2)
    before = read_mesh(path)
    comments = "$Comments\n" + 9 * "exported by a program\n" + "$EndComments\n"
    path.write_text(comments + path.read_text())
    np.testing.assert_array_equal(read_mesh(path).points, before.points)


@pytest.mark.parametrize("first", ["*NODE, NSET=Nall", "** made by cgx\n*node, nset=Nall"])
def test_a_mesh_of_cgx_is_a_deck(tmp_path, first):
    """cgx, which makes meshes for CalculiX, calls them all.msh."""
    nodes = "1, 0, 0, 0\n2, 1, 0, 0\n3, 0, 1, 0\n4, 0, 0, 1\n"
    (tmp_path / "all.msh").write_text(f"{first}\n{nodes}*ELEMENT, TYPE=C3D4, ELSET=Eall\n1, 1, 2, 3, 4\n")
    mesh = read_mesh(tmp_path / "all.msh")
    assert mesh.elements.tolist() == [[0, 1, 2, 3]] and sorted(mesh.groups) == ["Eall", "Nall"]

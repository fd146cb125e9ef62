"""Every mistake in a specification gives one line that says what is wrong, and where."""

import re

import meshio
import numpy as np
import pytest
from simulate.own_assembly.assemblies import SPEC, box, write_assembly, write_box

from ast_sim.cli import main

MOVE = "move = { translation = [0, 0, '-travel'] }"
SCRIPT = """
def broken(gmsh, height):
    raise ValueError(f"no height {height:g}")

def tangled(gmsh):
    gmsh.model.occ.addBox(0, 0, 0, 1, 1, 1)

    def generate(dimension):
        raise Exception("tangled")

    gmsh.model.mesh.generate = generate

def two(gmsh):
    gmsh.model.occ.addBox(0, 0, 0, 1, 1, 1)
    gmsh.model.occ.addBox(5, 0, 0, 1, 1, 1)
"""


def scripted(call: str) -> tuple[str, str]:
    return 'file = "block.vtu"', f"file = 'made.py:{call}'\nsize = 2"


# What is replaced in the good specification, by what, and what the line then says.
WRONG = {
    "no TOML": ('unit = "mm"', "unit = mm", "SPEC.toml: the specification cannot be read: Invalid value"),
    "unknown key": ("frames = 3", "frame = 3", "there is no key frame; did you mean 'frames'?"),
    "unknown key of a part": ('fixed = "', 'fixd = "', "there is no key parts.block.fixd; did you mean 'fixed'?"),
    "no unit": ('unit = "mm"', "", "unit is missing; say in which unit lengths are: m, cm, mm, um, in"),
    "unknown unit": ('"mm"', '"km"', "unit is 'km'; say in which unit lengths are"),
    "one frame": ("frames = 3", "frames = 1", "frames is 1; must be a whole number of at least 2"),
    "one part": (SPEC[SPEC.index("[parts.punch]") :], "", "an assembly has two parts or more, .* here 1"),
    "missing file": ('"block.vtu"', '"blok.vtu"', "parts.block.file: there is no file .*blok.vtu"),
    "unknown kind of file": ('"block.vtu"', '"block.doc"', "block.doc is no STEP, IGES, BREP, STL, mesh, .geo or .py"),
    "size of a mesh": ("poisson", "size = 2\npoisson", "parts.block.size: block.vtu is a mesh already"),
    "no size": (*scripted("two")[:1], "file = 'made.py:two'", "parts.block.size is missing; made.py:two"),
    "unknown parameter": ("'-travel'", "'-travl'", "there is no parameter 'travl'; did you mean 'travel'?"),
    "idle parameter": ("[parameters]", "[parameters]\nwidth = 3", "nothing depends on the parameter 'width'"),
    "descending range": ("[0.5, 1.5]", "[1.5, 0.5]", "the range of travel is 1.5 to 0.5; must be finite and ascend"),
    "logarithm of 0": ("[0.5, 1.5]", "{low=0, high=1, log=true}", "the range of travel starts at 0; a logarithm"),
    "no arithmetic": ("'-travel'", "'travel.real'", "no arithmetic of numbers and parameters: 'travel.real' is not"),
    "no number": ("'-travel'", "true", r"move.translation\[2\] is True; must be a number or an expression"),
    "division by 0": ("'-travel'", "'1 / (travel - 1)'", "'1 / .travel - 1.' cannot be computed: .*division by zero"),
    "incompressible": ("poisson = 0.3", "poisson = 0.5", "block.poisson is 0.5 to 0.5; must be at least 0 and"),
    "negative modulus": ("[1e6, 2e6]", "[-1e6, 2e6]", r"block.young is -1e\+06 to 2e\+06; must be above 0"),
    "no material": ("young = [1e6, 2e6]", "", "parts.block.young is missing; say what block is made of"),
    "material of a rigid part": ("rigid = true", "rigid = true\nyoung = 1e6", "parts.punch.young: a rigid part has no"),
    "friction of nobody": ("[parts.block]", "[[contact]]\nparts = ['block', 'punsh']\nfriction = 1\n[parts.block]",
                           "contact.parts: there is no part 'punsh'; did you mean 'punch'?"),
    "negative friction": ("frames", "friction = -0.1\nframes", "friction is -0.1; must be at least 0"),
    "empty region": ('"zmin"', '"z>50"', "parts.block.fixed: no node of block .* lies in 'z>50'; .*z from 0 to 5"),
    "unreadable region": ('"zmin"', '"zmn"', "parts.block.fixed = 'zmn' cannot be read at 'zmn'; write for example"),
    "unknown field": ('"zmin"', '"field=rib"', "block .* has no field 'rib'; did you mean 'rim'?"),
    "unknown group": ('"zmin"', '"group=rib"', "parts.block.fixed: block .* has no group 'rib'"),
    "held by nothing": ('fixed = "zmin"', "", "nothing holds block: give parts.block a region"),
    "held on a line": ('"zmin"', '"z=0 and x=0"', "block is held at 5 nodes, on one line, around which"),
    "held everywhere": ('"zmin"', '"all"', "all nodes are fixed or moved, so nothing deforms"),
    "fixed and moved": ('fixed = "zmin"', "fixed = 'zmin'\nmove = {where = 'xmin', translation = [0, 0, 1]}",
                        r"parts.block.move: 5 of its nodes are also in parts.block.fixed, the first at \(0, 0, 0\)"),
    "overlap": ("rigid", "offset = [0, 0, -1.2]\nrigid", r"block and punch overlap at rest by 1 mm at \(.*, 4\)"),
    "crossing": ('"punch.vtu"', '"bar.vtu"', r"block and punch cut each other at rest near \(.*\): move one of them"),
    "swallowed": ("rigid", "offset = [0, 0, -2]\nscale=0.5\nrigid", "block and punch overlap at rest by 2 mm"),
    "force": (MOVE, "force = [0, 0, -5]", "parts.punch.force: forces cannot be prescribed, only motions: give a move"),
    "pressure in a move": ("translation", "pressure = 3, translation", "parts.punch.move.pressure: forces cannot be"),
    "loads beside the parts": ("[parts.block]", "[[load]]\non = 'block'\n[parts.block]", "load: forces cannot be"),
    "gravity": ("frames", "gravity = [0, 0, -9.81]\nframes", "gravity: scenes are quasi-static, without weight"),
    "density": ("poisson", "density = 1100\npoisson", "parts.block.density: scenes are quasi-static, without weight"),
    "tie": ("[parts.block]", "[[tie]]\nparts = ['block', 'punch']\n[parts.block]", "tie: parts cannot be glued to"),
    "glued": ("poisson", "glued_to = 'punch'\npoisson", "parts.block.glued_to: parts cannot be glued .* make the stif"),
    "symmetry": ("poisson", "symmetry = 'xmin'\npoisson", "parts.block.symmetry: .* simulate the whole part"),
    "heat": ("frames", "temperature = 80\nframes", "temperature: there is no heat in these scenes"),
    "thin wall": ("poisson", "self_contact = true\npoisson", "block: a wall, slit or element is thinner than"),
    "whole part moves": (MOVE, "move = { where = 'zmax', translation = [0, 0, 1] }", "a rigid part moves as a whole"),
    "where": ("fixed", "move = { translation = [0, 0, 1] }\nfixed", "parts.block.move.where is missing"),
    "no motion": (MOVE, "move = { axis = [0, 0, 1] }", "parts.punch.move needs a translation, a rotation or both"),
    "two numbers": (MOVE, "move = { translation = ['travel', 0] }", "must be three numbers, such as"),
    "no axis": (MOVE, "move = { rotation = 'travel', axis = [0, 0, 0] }", "parts.punch.move: axis of a motion must be"),
    "turned over": ('fixed = "zmin"', "fixed = 'x<9 and z<3'\nmove = {where='z>3', translation=[0, 0, '-2 * travel']}",
                    "with travel=1.5.*: block: its prescribed nodes turn .* elements over between rest and frame 2"),
    "nothing deforms": (SPEC[SPEC.index("young") : SPEC.index("[parts.punch]")], "rigid = true\n", "parts are rigid"),
    "script fails": (*scripted("broken"), "TypeError: broken.. missing 1 required positional argument: 'height'"),
    "script has no such function": (*scripted("brokn"), "block .made.py:brokn.: the script has no function brokn"),
    "two solids": (*scripted("two"), "it holds 2 solids: 1 of 1 x 1 x 1 around .0.5, 0.5, 0.5.; 2 of .*: solid = 1"),
    "no mesh": (*scripted("tangled"), "with elements of the size 2: tangled; nor do sizes from 1.2 to 2.6"),
    "two pieces": ('"block.vtu"', '"pieces.vtu"', "block .pieces.vtu.: it has 2 pieces not joined by a common face"),
    "triangles": ('"block.vtu"', '"tool.stl"', "parts.block.size is missing; tool.stl must be meshed"),
    "scale": ("poisson", "scale = 0\npoisson", "parts.block.scale is 0; must be a number above 0"),
}  # fmt: skip


@pytest.mark.parametrize("mistake", WRONG)
def test_a_mistake_gives_one_clear_line(mistake, tmp_path, capsys):
    old, new, line = WRONG[mistake]
    spec = SPEC
    if mistake == "thin wall":
        spec = spec.replace("0.05", "2.6")
        spec = spec.replace("rigid = true", "rigid = true\noffset = [0, 0, 5]")
    assert spec.count(old) >= 1
    path = write_assembly(tmp_path, spec.replace(old, new, 1))
    (tmp_path / "made.py").write_text(SCRIPT)
    write_pieces(tmp_path / "pieces.vtu")
    write_box(tmp_path / "block.doc.vtu", (0, 0, 0), (1, 1, 1), (1, 1, 1))
    write_box(tmp_path / "bar.vtu", (-5, 4.2, 3), (15, 4.8, 3.5), (1, 1, 1))  # no node of either lies in the other
    position, _ = box((0, 0, 0), (1, 1, 1), (1, 1, 1))
    meshio.Mesh(position, {"triangle": np.array([[0, 1, 2]])}).write(tmp_path / "tool.stl")
    capsys.readouterr()
    out = tmp_path / "study.h5"
    assert main(["generate", "assembly", str(path), "--out", str(out), "--count", "1", "--workers", "1"]) == 2
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 1 and re.search(line, told[0]), told
    assert not out.exists()


def write_pieces(path) -> None:
    first, elements = box((0, 0, 0), (10, 10, 5), (2, 2, 1))
    points = np.concatenate([first, first + [20, 0, 0]])
    meshio.Mesh(points, {"tetra": np.concatenate([elements, elements + len(first)])}).write(path)


def test_an_assembly_needs_a_specification_and_only_it_has_one(tmp_path, capsys):
    out = ["--out", str(tmp_path / "a.h5"), "--count", "1"]
    assert main(["generate", "assembly", *out]) == 2
    assert "assembly needs a specification" in capsys.readouterr().err
    assert main(["generate", "abcd", "SPEC.toml", *out]) == 2
    assert "abcd has no option spec; these families have it: assembly" in capsys.readouterr().err


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("part", ["block", "punch"])
def test_a_mesh_that_folds_over_itself_is_no_part(tmp_path, capsys, part, order):
    """An inner node lies beyond a face of its star. Readers turn elements over, so that all have a volume; the surface
    is whole. A rigid part is refused, too."""
    path = write_assembly(tmp_path, SPEC.replace("order = 1", f"order = {order}"))
    low, high = {"block": ((0, 0, 0), (10, 10, 5)), "punch": ((3, 3, 5.2), (7, 7, 8))}[part]
    points, elements = box(low, high, (4, 4, 4))
    inner = np.argmin(np.linalg.norm(points - (np.array(low) + high) / 2, axis=1))
    points[inner, :2] += 0.3 * (np.array(high) - low)[:2]
    corners = points[elements]
    assert 0 < (np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0).sum() <= 12
    meshio.Mesh(points, {"tetra": elements}).write(tmp_path / f"{part}.vtu")
    out = tmp_path / "study.h5"
    assert main(["generate", "assembly", str(path), "--out", str(out), "--count", "1", "--workers", "1"]) == 2
    told = capsys.readouterr().err.splitlines()
    line = rf"{part} \({part}.vtu\): \d+ tetrahedra in a fold of the mesh, .*: element \d+ .*; mesh it again"
    assert re.search(line, told[-1]) and not out.exists(), told

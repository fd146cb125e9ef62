"""Parts as CAD programs write them: fillets smaller than the elements, several solids, other formats, hollow parts."""

import re
import subprocess
import sys

import pytest
from simulate.own_assembly.assemblies import case_of, write_box

from ast_sim.cli import main
from ast_sim.simulate.shapes.cad import gmsh_process
from ast_sim.simulate.shapes.parts import volumes
from ast_sim.support.errors import SimulationError

SPEC = """
unit = "mm"
frames = 2
[parts.part]
file = "FILE"
size = 8
young = 1e9
poisson = 0.3
fixed = "zmin"
[parts.block]
file = "block.vtu"
offset = [0, 0, 34]
rigid = true
"""
CAD = """
import sys, gmsh
gmsh.initialize(interruptible=False)
gmsh.option.setNumber("General.Terminal", 0)
occ, (path, kind) = gmsh.model.occ, sys.argv[1:]
plate = occ.addBox(0, 0, 0, 80, 50, 10)
if kind == "fillet":
    occ.synchronize()
    occ.fillet([plate], [tag for _, tag in gmsh.model.getEntities(1)], [0.5])
elif kind == "hollow":
    occ.cut([(3, plate)], [(3, occ.addBox(30, 15, 3, 20, 20, 4))])
elif kind == "two":
    occ.addBox(40, 25, 12, 6, 6, 20)
occ.synchronize()
if path.endswith(".stl"):
    gmsh.option.setNumber("Mesh.MeshSizeMax", 8)
    gmsh.model.mesh.generate(2)
gmsh.write(path)
"""


def write(path, kind: str, text: str = SPEC):
    """A specification with a part that Gmsh has written."""
    subprocess.run([sys.executable, "-c", CAD, str(path), kind], check=True, capture_output=True)
    if path.suffix == ".step":  # Gmsh does not write the names of solids
        names = re.compile(r"'Open CASCADE STEP translator [0-9.]+ 1\.([12])'")
        path.write_text(names.sub(lambda found: ("'Base plate'", "'Pin'")[int(found[1]) - 1], path.read_text()))
    write_box(path.parent / "block.vtu", (0, 0, 0), (10, 10, 10), (2, 2, 2))
    spec = path.with_name("SPEC.toml")
    spec.write_text(text.replace("FILE", path.name))
    return spec


def part(path):
    """The volume of the part, and the notes."""
    case = case_of(path)
    rows = case.scene.elements[case.scene.body[case.scene.elements[:, 0]] == 0]
    return volumes(case.scene.rest_position.astype(float), rows).sum(), case.notes()


@pytest.mark.parametrize("size", [4, 5, 15])
def test_fillets_smaller_than_the_elements_are_meshed(size, tmp_path):
    """Gmsh alone gives flat elements at 4 and 15."""
    volume, notes = part(write(tmp_path / "plate.step", "fillet", SPEC.replace("size = 8", f"size = {size}")))
    assert volume == pytest.approx(39_935, rel=1e-3)
    assert all(note.startswith("part (plate.step): ") for note in notes)


def test_a_size_near_the_wanted_one_is_taken_and_told(tmp_path, capsys):
    """A mesher that fails for elements below 4.2."""
    (tmp_path / "picky.py").write_text("""
def make(gmsh):
    gmsh.model.occ.addBox(0, 0, 0, 20, 20, 10)
    generate = gmsh.model.mesh.generate

    def picky(dimension):
        gmsh.model.mesh.generate = generate
        if gmsh.option.getNumber("Mesh.MeshSizeMax") < 4.2:
            raise Exception("tangled; badly")
        generate(dimension)

    gmsh.model.mesh.generate = picky
""")
    write_box(tmp_path / "block.vtu", (0, 0, 0), (10, 10, 10), (2, 2, 2))
    path = tmp_path / "SPEC.toml"
    path.write_text(SPEC.replace("FILE", "picky.py").replace("size = 8", "size = 4"))
    note = (
        "part (picky.py): elements of the size 4.28 instead of 4, with which Gmsh gives no good mesh (tangled; badly)"
    )
    volume, notes = part(path)
    assert volume == pytest.approx(4000) and notes == [note]
    assert main(["generate", "assembly", str(path), "--out", str(tmp_path / "d.h5"), "--count", "1"]) == 0
    assert note in capsys.readouterr().err


def test_gmsh_that_crashes_in_an_attempt_goes_on_with_the_next(tmp_path):
    (tmp_path / "crash.py").write_text("""
import os

def make(gmsh):
    gmsh.model.occ.addBox(0, 0, 0, 20, 20, 10)
    if gmsh.option.getNumber("Mesh.Algorithm") == 6 and not os.path.exists(os.path.dirname(__file__) + "/crashed"):
        open(os.path.dirname(__file__) + "/crashed", "w").close()
        os.abort()
""")
    one = {"name": "it", "script": str(tmp_path / "crash.py"), "function": "make", "arguments": {}}
    (mesh,) = gmsh_process.mesh_own_scale([{**one, "size": 5, "finer": [], "order": 1}])
    assert (tmp_path / "crashed").exists() and volumes(mesh["position"], mesh["elements"]).sum() == pytest.approx(4000)
    (tmp_path / "crash.py").write_text("import os\n\ndef make(gmsh):\n    os.abort()\n")
    with pytest.raises(gmsh_process.MeshingFailed, match="^it: with elements of the size 5: gmsh crashed in every"):
        gmsh_process.mesh_own_scale([{**one, "size": 5, "finer": [], "order": 1, "first": 16}])  # the last two attempts


@pytest.mark.parametrize("ending", ["step", "stp", "iges", "brep", "stl"])
def test_formats_of_cad_programs(ending, tmp_path):
    volume, notes = part(write(tmp_path / f"plate.{ending}", "hollow"))
    assert volume == pytest.approx(40_000 - 1_600, rel=1e-6) and not notes


@pytest.mark.parametrize("ending", ["step", "iges"])
def test_files_that_know_their_unit_are_taken_in_the_unit_of_the_specification(ending, tmp_path):
    inches = SPEC.replace('"mm"', '"in"').replace("size = 8", "size = 0.32").replace("34]", "1.4]")
    volume, _ = part(write(tmp_path / f"plate.{ending}", "hollow", inches))
    assert volume == pytest.approx((40_000 - 1_600) / 25.4**3, rel=1e-6)


@pytest.mark.parametrize("ending", ["step", "stl"])
def test_one_solid_of_several_is_chosen(ending, tmp_path):
    path = write(tmp_path / f"both.{ending}", "two")
    with pytest.raises(SimulationError) as caught:
        part(path)
    text = str(caught.value)
    first, second = (" 'Base plate'", " 'Pin'") if ending == "step" else ("", "")
    assert f"holds 2 solids: 1{first} of 80 x 50 x 10 around (40, 25, 5); 2{second} of 6 x 6 x 20 around (43," in text
    assert text.startswith("part (both.") or ": part (both." in text
    assert text.endswith("solid = 1" + (" or 'Base plate'" if ending == "step" else ""))
    chosen = {1: 40_000, 2: 720} | ({"Base plate": 40_000, "pin": 720} if ending == "step" else {})
    for name, volume in chosen.items():
        path.write_text(SPEC.replace("FILE", f"both.{ending}").replace("size = 8", f"size = 8\nsolid = {name!r}"))
        assert part(path)[0] == pytest.approx(volume)
    path.write_text(path.read_text().replace("solid = ", "solid = 3 # "))
    with pytest.raises(SimulationError, match="solid 3; it holds 2"):
        part(path)


@pytest.mark.parametrize("share", [0.5, 0.0])
def test_a_cad_file_that_is_cut_off_is_told(share, tmp_path):
    path = write(tmp_path / "plate.step", "hollow")
    file = tmp_path / "plate.step"
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    with pytest.raises(SimulationError, match=r"part \(plate.step\): gmsh cannot read the file: it is damaged"):
        part(path)

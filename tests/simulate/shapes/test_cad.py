"""Solids of the grammar and CAD files, with the real gmsh; broken files, a crash and a hang are told in words."""

import sys

import gmsh
import meshio
import numpy as np
import pytest

from ast_sim.simulate.shapes.cad import gmsh_process, grammar
from ast_sim.simulate.shapes.mesh import second_order
from ast_sim.simulate.shapes.mesh_check import BadMesh, check_mesh
from ast_sim.simulate.shapes.part_source import GrammarParts, StructuredParts, meshed_part, part_source
from ast_sim.simulate.shapes.parts import rectilinear, volumes
from ast_sim.support.errors import ConfigError, MissingExtra, SimulationError

HOLED = {"solid": [
    {"do": "add", "shape": "box", "at": [0, 0, 0], "size": [1, 0.8, 0.5]},
    {"do": "cut", "shape": "cylinder", "at": [0.5, 0.4, -0.1], "axis": [0, 0, 0.7], "radius": 0.2},
]}  # fmt: skip
WRITE = """
import sys, gmsh
gmsh.initialize(interruptible=False)
gmsh.option.setNumber("General.Terminal", 0)
occ = gmsh.model.occ
block = occ.addBox(0, 0, 0, 50, 30, 20)
if sys.argv[2] == "holed":
    occ.cut([(3, block)], [(3, occ.addCylinder(20, 15, -1, 0, 0, 30, 6))])
elif sys.argv[2] == "two":
    occ.addBox(70, 0, 0, 10, 10, 10)
occ.synchronize()
if sys.argv[2] in ("open", "faces"):
    occ.remove(gmsh.model.getEntities(3))
    if sys.argv[2] == "open":
        occ.remove([gmsh.model.getEntities(2)[0]])
    occ.synchronize()
gmsh.option.setNumber("Mesh.MeshSizeMax", 8)
if not sys.argv[1].endswith(".step"):
    gmsh.model.mesh.generate(2 if sys.argv[1].endswith(".stl") else 3)
gmsh.write(sys.argv[1])
"""


def write(path, kind: str = "holed"):
    """A CAD file as gmsh writes it: a block of 50 x 30 x 20 mm."""
    import subprocess

    subprocess.run([sys.executable, "-c", WRITE, str(path), kind], check=True, capture_output=True)
    return path


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    return {ending: write(folder / f"holed.{ending}") for ending in ("step", "stl", "msh")}


def refusal(path) -> str:
    with pytest.raises(SimulationError) as caught:
        part_source(path).check()
    text = str(caught.value)
    assert text.startswith(path.name) and "\n" not in text
    return text


def test_a_solid_has_its_volume_and_its_number_of_nodes():
    for nodes in (400, 2000):
        a, b = gmsh_process.mesh_parts([HOLED, HOLED], ["a", "b"], nodes)
        check_mesh(a.position, a.elements, "a")
        assert len(a.position) + len(b.position) == pytest.approx(nodes, rel=0.2)
        assert volumes(a.position, a.elements).sum() == pytest.approx(0.4 - np.pi * 0.04 * 0.5, rel=0.02)
        assert np.allclose([a.position.min(axis=0), a.position.max(axis=0)], [[0, 0, 0], [1, 0.8, 0.5]], atol=1e-6)


def test_the_same_request_gives_the_same_mesh():
    first, second = (gmsh_process.mesh_parts([HOLED], ["holed"], 500)[0] for _ in range(2))
    assert np.array_equal(first.position, second.position) and np.array_equal(first.elements, second.elements)


def test_a_part_does_not_depend_on_the_parts_before_it(tmp_path):
    """Neither on the options that their scripts set nor on constants of the same name."""
    (tmp_path / "ball.py").write_text("""
def make(gmsh):
    gmsh.option.setNumber("Mesh.MeshSizeFactor", 0.5)
    gmsh.model.occ.addSphere(0, 0, 0, 1)
""")
    (tmp_path / "bar.geo").write_text("""
SetFactory("OpenCASCADE");
DefineConstant[ height = 2 ];
Box(1) = {0, 0, 0, 1, 1, height};
""")
    part = {"size": 0.5, "finer": [], "order": 1, "arguments": {}}
    ball = {**part, "name": "ball", "script": str(tmp_path / "ball.py"), "function": "make"}
    bar = {**part, "name": "bar", "geo": str(tmp_path / "bar.geo")}
    *_, after = gmsh_process.mesh_own_scale([ball, {**bar, "name": "low", "arguments": {"height": 0.7}}, bar])
    (alone,) = gmsh_process.mesh_own_scale([bar])
    assert np.ptp(alone["position"], axis=0) == pytest.approx([1, 1, 2])
    assert np.array_equal(after["position"], alone["position"]) and np.array_equal(after["elements"], alone["elements"])


def test_the_settings_of_the_user_of_gmsh_do_not_matter(tmp_path, monkeypatch):
    """Whoever saves options in the window of Gmsh has a file of them at home."""
    (before,) = gmsh_process.mesh_parts([HOLED], ["holed"], 300)
    (tmp_path / ".gmsh-options").write_text("Mesh.ElementOrder = 2;\nMesh.Algorithm3D = 10;\n")
    monkeypatch.setenv("HOME", str(tmp_path))
    (after,) = gmsh_process.mesh_parts([HOLED], ["holed"], 300)
    assert np.array_equal(before.position, after.position) and np.array_equal(before.elements, after.elements)


def test_every_solid_of_the_grammar_can_be_meshed():
    rng, names, steps = np.random.default_rng(5), [], []
    while set(names) != set(grammar._SOLIDS) or len(names) < 18:
        name, solid = grammar.draw_solid(rng)
        names.append(name)
        steps.append({"solid": solid})
    parts = gmsh_process.mesh_parts(steps, names, 500 * len(names))
    assert sum(len(part.position) for part in parts) == pytest.approx(500 * len(names), rel=0.2)
    for part in parts:
        check_mesh(part.position, part.elements, part.name)
        assert 0.5 < np.linalg.norm(np.ptp(part.position, axis=0)) < 2


def test_the_grammar_draws_the_same_from_the_same_seed():
    drawn = [grammar.draw_solid(np.random.default_rng(seed)) for seed in (1, 1, 2)]
    assert drawn[0] == drawn[1] != drawn[2]


def test_pairs_come_from_the_grammar_if_gmsh_is_there_and_from_structured_parts_if_not(monkeypatch):
    source = part_source()
    assert isinstance(source, GrammarParts) and source.describe() == {"mesher": f"gmsh {gmsh.__version__}"}
    pair = source.draw(np.random.default_rng(0))(600)
    again = source.draw(np.random.default_rng(0))(600)
    assert sum(len(part.position) for part in pair) == pytest.approx(600, rel=0.2)
    assert all(np.array_equal(x.position, y.position) for x, y in zip(pair, again, strict=True))
    monkeypatch.setattr(gmsh_process, "gmsh_version", lambda: None)
    source = part_source()
    assert isinstance(source, StructuredParts) and source.describe() == {"mesher": "structured"}
    assert all(part.name.startswith("structured") for part in source.draw(np.random.default_rng(0))(600))


@pytest.mark.parametrize("ending", ["step", "stl", "msh"])
def test_a_file_of_the_user_becomes_a_pair(files, ending):
    source = part_source(files[ending])
    source.check()
    a, b = source.draw(np.random.default_rng(0))(800)
    assert a.name == b.name == f"holed.{ending}"
    assert np.linalg.norm(np.ptp(a.position, axis=0)) == pytest.approx(1, rel=1e-3)
    diagonal = np.sqrt(50**2 + 30**2 + 20**2)
    true = (50 * 30 * 20 - np.pi * 36 * 20) / diagonal**3
    assert volumes(a.position, a.elements).sum() == pytest.approx(true, rel=0.02)
    if ending != "msh":
        assert len(a.position) + len(b.position) == pytest.approx(800, rel=0.2)
    described = source.describe()
    assert list(described["parts"]) == [f"holed.{ending}"] and len(described["parts"][f"holed.{ending}"]) == 64
    assert described["mesher"].startswith("none" if ending == "msh" else "gmsh")


def test_a_folder_gives_pairs_of_different_files(files, tmp_path):
    for ending in ("step", "msh"):
        (tmp_path / files[ending].name).symlink_to(files[ending])
    (tmp_path / "notes.txt").write_text("where they are from")
    source = part_source(tmp_path)
    names = {tuple(part.name for part in source.draw(np.random.default_rng(seed))(1200)) for seed in range(4)}
    assert names == {("holed.msh", "holed.step"), ("holed.step", "holed.msh")}


@pytest.mark.parametrize("ending", ["vtu", "inp"])
def test_mesh_files_of_other_programs(files, tmp_path, ending):
    source = meshio.read(files["msh"])
    points, elements = source.points * 1000, source.cells_dict["tetra"]
    path = tmp_path / f"part.{ending}"
    meshio.write(path, meshio.Mesh(np.concatenate([points, [[0, 0, 9.0]]]), [("tetra", elements[:, [0, 2, 1, 3]])]))
    part = meshed_part(path)  # numbered the other way round, with a node that nothing uses
    assert len(part.elements) == len(elements)
    assert volumes(part.position, part.elements).min() > 0


def test_quadratic_tetrahedra_keep_their_corners(tmp_path):
    position, elements = rectilinear([np.linspace(0, 1, 3)] * 3)
    pairs = [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]
    middle = np.stack([(position[elements[:, a]] + position[elements[:, b]]) / 2 for a, b in pairs], axis=1)
    extra = len(position) + np.arange(6 * len(elements)).reshape(-1, 6)
    mesh = meshio.Mesh(np.concatenate([position, middle.reshape(-1, 3)]), [("tetra10", np.hstack([elements, extra]))])
    meshio.write(tmp_path / "quadratic.vtu", mesh)
    part = meshed_part(tmp_path / "quadratic.vtu")
    assert len(part.position) == 27 and np.allclose(part.position * np.sqrt(3), position)


@pytest.mark.parametrize("second", [False, True])
def test_a_mesh_file_that_folds_over_itself_is_no_part(tmp_path, second):
    position, elements = rectilinear([np.linspace(0, 1, 4)] * 3)
    position[np.argmin(np.linalg.norm(position - 1 / 3, axis=1))] += [0.5, 0.05, 0.1]
    mesh = {"tetra10" if second else "tetra": elements}
    if second:
        position, mesh["tetra10"] = second_order(position, elements)
    meshio.write(tmp_path / "folded.vtu", meshio.Mesh(position, mesh))
    with pytest.raises(BadMesh, match=r"folded.vtu: \d+ tetrahedra in a fold of the mesh, .* element .*mesh it again"):
        part_source(tmp_path / "folded.vtu").check()


def test_loose_faces_that_close_are_sewn_to_a_solid(tmp_path):
    source = part_source(write(tmp_path / "faces.step", "faces"))
    source.check()
    part, _ = source.draw(np.random.default_rng(0))(400)
    assert volumes(part.position, part.elements).sum() == pytest.approx(30000 / 3800**1.5, rel=1e-3)


def test_a_binary_stl_and_one_in_metres_far_from_the_origin(tmp_path, files):
    surface = meshio.read(files["stl"])
    moved = meshio.Mesh(surface.points / 1000 + [0.5, 0.25, 1], surface.cells)
    meshio.write(tmp_path / "binary.stl", moved, binary=True)
    a, _ = part_source(tmp_path / "binary.stl").draw(np.random.default_rng(0))(800)
    assert np.linalg.norm(np.ptp(a.position, axis=0)) == pytest.approx(1, rel=1e-3)


def test_an_open_shell_is_refused(tmp_path, files):
    text = refusal(write(tmp_path / "open.step", "open"))
    assert "shell is open, 4 edges bound only one face, the first at (" in text
    surface = meshio.read(files["stl"])
    path = tmp_path / "open.stl"
    meshio.write(path, meshio.Mesh(surface.points, [("triangle", surface.cells_dict["triangle"][1:])]))
    assert "its surface is open: 3 edges with a triangle on one side only, the first from (" in refusal(path)


def test_several_solids_are_refused(tmp_path):
    text = refusal(write(tmp_path / "two.step", "two"))
    assert "2 separate solids (the first two around (25, 15, 10) and (75, 5, 5))" in text


def test_a_surface_that_cuts_itself_is_refused(tmp_path, files):
    surface = meshio.read(files["stl"])
    points = surface.points.copy()
    corner = np.abs(points - [50, 30, 20]).sum(axis=1).argmin()
    points[np.abs(points - points[corner]).sum(axis=1) < 1e-6] = [-20, 15, 10]  # pulled through the far side
    path = tmp_path / "cut.stl"
    meshio.write(path, meshio.Mesh(points, surface.cells))
    assert "its surface cuts itself: the triangles [" in refusal(path)


def test_broken_mesh_files_are_refused(tmp_path, files):
    mesh = meshio.read(files["msh"])
    elements = mesh.cells_dict["tetra"].copy()
    elements[7] = elements[7, [1, 0, 2, 3]]
    meshio.write(tmp_path / "inverted.vtu", meshio.Mesh(mesh.points, [("tetra", elements)]))
    part_source(tmp_path / "inverted.vtu").check()  # turned over, as in every other scene
    meshio.write(tmp_path / "surface.vtu", meshio.Mesh(mesh.points, [("triangle", elements[:, :3])]))
    assert "holds no tetrahedra, but triangle" in refusal(tmp_path / "surface.vtu")
    (tmp_path / "cut.msh").write_bytes(files["msh"].read_bytes()[:500])
    assert "cannot be read" in refusal(tmp_path / "cut.msh")
    meshio.write(tmp_path / "plain.bdf", mesh, file_format="nastran")
    text = (tmp_path / "plain.bdf").read_text()
    (tmp_path / "system.bdf").write_text(text.replace("BEGIN BULK", "BEGIN BULK\nGRDSET,,5"))
    assert "line 4 stands in the coordinate system 5, which there is not" in refusal(tmp_path / "system.bdf")
    with pytest.raises(ConfigError, match="zones.tec is no STEP, STL or mesh file: files of the kind .tec are not"):
        (tmp_path / "zones.tec").write_text("")
        part_source(tmp_path / "zones.tec")
    (tmp_path / "empty.step").write_text("ISO-10303-21;\n")
    assert refusal(tmp_path / "empty.step")


def test_a_folder_counts_no_pieces_as_parts(files, tmp_path):
    mesh = meshio.read(files["msh"])
    tetrahedra = [("tetra", mesh.cells_dict["tetra"])]
    meshio.write(tmp_path / "one.node", meshio.Mesh(mesh.points, tetrahedra))  # and one.ele
    meshio.write(tmp_path / "two_0.vtu", meshio.Mesh(mesh.points, tetrahedra))
    points = '<PPoints><PDataArray type="Float64" NumberOfComponents="3"/></PPoints>'
    whole = f'<PUnstructuredGrid>{points}<Piece Source="two_0.vtu"/></PUnstructuredGrid>'
    (tmp_path / "two.pvtu").write_text(f'<VTKFile type="PUnstructuredGrid" version="0.1">{whole}</VTKFile>')
    assert list(part_source(tmp_path).describe()["parts"]) == ["one.node", "two.pvtu"]
    part_source(tmp_path).check()


def test_paths_that_hold_no_parts(tmp_path):
    for path, words in ((tmp_path / "absent.step", "does not exist"), (tmp_path, "holds no files")):
        with pytest.raises(ConfigError, match=words):
            part_source(path)
    (tmp_path / "drawing.pdf").write_text("")
    with pytest.raises(ConfigError, match="drawing.pdf is no STEP, STL or mesh file"):
        part_source(tmp_path)


def test_without_gmsh_cad_files_name_the_extra_and_mesh_files_work(files, monkeypatch):
    monkeypatch.setattr(gmsh_process, "gmsh_version", lambda: None)
    with pytest.raises(MissingExtra, match=r"holed.step .* pip install \"ast_sim\[cad\]\""):
        part_source(files["step"])
    part_source(files["msh"]).check()


def test_a_crash_and_a_hang_of_gmsh_are_told(monkeypatch):
    def failure(code: str, seconds: int = 60, again: bool = True) -> str:
        monkeypatch.setattr(gmsh_process, "WORKER", [sys.executable, "-c", code])
        with pytest.raises(SimulationError) as caught:
            gmsh_process.mesh_parts([HOLED], ["holed"], 500, seconds)
        # Only what would happen again needs another draw.
        assert isinstance(caught.value, gmsh_process.MeshingFailed) == again
        return str(caught.value)

    assert failure("import os; os.kill(os.getpid(), 11)") == "gmsh crashed (SIGSEGV): no message"
    spin = "import ast_sim.simulate.shapes.cad.cad_worker as w; w._load = lambda *_: exec('while True: pass'); w.main()"
    assert failure(spin, 2) == "gmsh did not finish within 2 s of processor time and was stopped"
    killed = failure("import os; os.kill(os.getpid(), 9)", again=False)
    assert killed == "gmsh was killed by SIGKILL, perhaps because memory ran out: use fewer workers or nodes"
    monkeypatch.setattr(gmsh_process, "PATIENCE", 1)
    assert failure("import time; time.sleep(60)", 1, again=False) == "gmsh did not answer within 1 s and was stopped"
    assert failure("import sys; sys.exit('Invalid boundary mesh')") == "Invalid boundary mesh"


def test_a_limit_of_processor_time_that_the_user_has_is_kept():
    """On shared machines `ulimit -t` may be below the limit of a mesh; nobody can raise it."""
    import subprocess

    code = "from ast_sim.simulate.shapes.cad import gmsh_process; print(gmsh_process.gmsh_version())"
    command = f"ulimit -t {gmsh_process.START_SECONDS - 5} && exec {sys.executable} -c '{code}'"
    told = subprocess.run(["bash", "-c", command], check=True, capture_output=True, text=True).stdout
    assert told.strip() == gmsh_process.gmsh_version()


def test_a_gmsh_that_does_not_start_names_what_it_needs(monkeypatch):
    gmsh_process.gmsh_version.cache_clear()
    monkeypatch.setattr(gmsh_process, "WORKER", [sys.executable, "-c", "raise OSError('libGLU.so.1: not there')"])
    with pytest.raises(MissingExtra, match="libGLU.so.1: not there.*apt install libglu1-mesa"):
        gmsh_process.gmsh_version()
    gmsh_process.gmsh_version.cache_clear()


def test_geometry_that_gmsh_refuses_is_told(tmp_path):
    tool = {"do": "cut", "shape": "box", "at": [-1, -1, -1], "size": [3, 3, 3]}
    with pytest.raises(gmsh_process.MeshingFailed, match="no closed solid"):
        gmsh_process.mesh_parts([{"solid": [HOLED["solid"][0], tool]}], ["nothing"], 500)
    with pytest.raises(gmsh_process.MeshingFailed, match="."):
        gmsh_process.mesh_parts([{"solid": [{**HOLED["solid"][0], "size": [0, 1, 1]}]}], ["flat"], 500)


def test_what_is_checked_when_a_part_is_drawn(monkeypatch):
    """A drawn part with a bad element is refused like one of the user."""
    position, elements = rectilinear([np.linspace(0, 1, 3)] * 3)
    elements[3] = elements[3, [1, 0, 2, 3]]
    monkeypatch.setattr(gmsh_process, "mesh_parts", lambda *_: [gmsh_process.Part(position, elements, "bad")] * 2)
    with pytest.raises(BadMesh, match="bad: 1 inverted tetrahedron: element 3"):
        part_source().draw(np.random.default_rng(0))(100)

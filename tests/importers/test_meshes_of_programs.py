"""Meshes as programs write them whose files bear the endings of other formats, or older formats."""

import re
import subprocess
import sys

import h5py
import numpy as np
import pytest
import pyvista
from data_samples import block

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


@pytest.mark.parametrize("order", [1, 2])
def test_decks_of_nastran_as_gmsh_writes_them_are_read(tmp_path, order):
    deck, mesh = (read_mesh(of_gmsh(tmp_path, 2.2, order, name)) for name in ("a.bdf", "a.msh"))
    np.testing.assert_allclose(deck.points, mesh.points, atol=1e-6)
    np.testing.assert_array_equal(deck.elements, mesh.elements)


@pytest.mark.parametrize(
    ("old", "new", "cause"),
    [
        (r"\$ENDNOD", "", "the section NOD has no end"),
        (r"\$ENDELM", "", "the section ELM has no end"),
        (r"(\d+ 4 5 1 4 \d+ \d+ \d+) \d+\n", r"\1\n", "element [0-9]+ has 3 nodes"),
        (r"\$ELM\n", "$ELM\n1", "it says that it holds 1[0-9,]+ elements, but there are"),
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


def xdmf(grids):
    include = 'xmlns:xi="http://www.w3.org/2001/XInclude"'
    return f'<?xml version="1.0"?>\n<Xdmf Version="3.0" {include}><Domain>{grids}</Domain></Xdmf>'


def items(values, columns):
    text = " ".join(map(str, np.ravel(values)))
    number = "Int" if np.asarray(values).dtype.kind == "i" else "Float"
    return f'<DataItem Dimensions="{len(values)} {columns}" NumberType="{number}" Format="XML">{text}</DataItem>'


POINTS = [(0.0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)]
GEOMETRY = f'<Geometry GeometryType="XYZ">{items(POINTS, 3)}</Geometry>'
INCLUDED = "<xi:include xpointer=\"xpointer(/Xdmf/Domain/Grid[@Name='{}']/{})\" />"


SHARED = INCLUDED.format("mesh", "Geometry")


def marks(name, kind, cells, values, points=SHARED):
    count = f'NumberOfElements="{len(cells)}"'
    topology = f'<Topology TopologyType="{kind}" {count}>{items(cells, len(cells[0]))}</Topology>'
    field = f'<Attribute Name="{name}" AttributeType="Scalar" Center="Cell">{items(values, 1)}</Attribute>'
    return f'<Grid Name="{name}" GridType="Uniform">{points}{topology}{field if len(values) else ""}</Grid>'


CELLS, FACES = [(0, 1, 2, 3), (1, 3, 4, 2)], [(0, 1, 2), (1, 2, 4), (0, 2, 3)]
MESH = marks("mesh", "Tetrahedron", CELLS, [], GEOMETRY)
FACETS = marks("facet markers", "Triangle", FACES, [1, 2, 3])
EITHER = INCLUDED.format("mesh", "*[self::Topology or self::Geometry]")


@pytest.mark.parametrize(
    ("grids", "fields", "left"),
    [
        (MESH + FACETS, [], "facet markers"),
        (MESH + marks("cell markers", "Tetrahedron", CELLS, [7, 8]) + FACETS, ["cell markers"], "facet markers"),
        (MESH + marks("some", "Tetrahedron", CELLS[1:], [8]), [], "some"),
        (MESH + marks("other", "Triangle", FACES, [1, 2, 3], EITHER), [], "other"),
        (
            f'<Grid Name="mesh" GridType="Uniform">{GEOMETRY}</Grid>'
            + FACETS
            + marks("cell markers", "Tetrahedron", CELLS, [7, 8]),
            ["cell markers"],
            "facet markers",
        ),
    ],
)
def test_marks_of_fenics_are_grids_beside_the_mesh(tmp_path, grids, fields, left):
    """dolfinx writes meshtags so. The points may stand in a grid without cells."""
    (tmp_path / "a.xdmf").write_text(xdmf(grids))
    mesh = read_mesh(tmp_path / "a.xdmf")
    np.testing.assert_array_equal(mesh.points, POINTS)
    assert mesh.elements.tolist() == [list(one) for one in CELLS]
    assert list(mesh.source.cell_fields) == fields
    assert f"1 grid on the same points is left out: {left}" in mesh.notes
    if fields:
        assert mesh.fields["cell"]["cell markers"].ravel().tolist() == [7, 8]


@pytest.mark.parametrize(
    ("grids", "cause"),
    [
        (MESH + MESH, "holds 2 grids with points of their own: write all bodies into one grid"),
        (MESH + marks("a", "Triangle", FACES, [1, 2, 3], ""), r"the grid 'a' has no points, but \[\]"),
        (MESH + marks("a", "Triangle", FACES, [1], INCLUDED.format("none", "Geometry")), "the grid 'a' has no points"),
    ],
)
def test_grids_on_other_points_are_refused(tmp_path, grids, cause):
    (tmp_path / "a.xdmf").write_text(xdmf(grids))
    with pytest.raises(DatasetError, match=f"a.xdmf: {cause}"):
        read_mesh(tmp_path / "a.xdmf")


def test_a_solid_of_stl_may_end_in_two_words(tmp_path):
    facet = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
    other = facet.replace("1 0 0", "2 0 0")
    (tmp_path / "a.stl").write_text(f"solid WRAP\n{facet}end solid\nsolid B\n{other}end solid B\n")
    mesh = read_mesh(tmp_path / "a.stl")
    assert mesh.elements.shape == (2, 3) and mesh.points[:, 0].max() == 2
    (tmp_path / "a.stl").write_text(f"solid WRAP\n{facet}")
    with pytest.raises(DatasetError, match="a.stl: .* it is cut off after 1 facet:"):
        read_mesh(tmp_path / "a.stl")


@pytest.mark.parametrize(("written", "named"), [("vtk", "vtu"), ("vtu", "vtk"), ("vtp", "vtk"), ("vts", "vtk")])
def test_files_of_vtk_are_told_by_what_they_hold(tmp_path, written, named):
    """PyLith has written legacy files as .vtu, SOFA XML as .vtk."""
    cube = pyvista.ImageData(dimensions=(2, 2, 2)).cast_to_structured_grid()
    mesh = {"vts": cube, "vtp": cube.extract_surface(algorithm="dataset_surface")}.get(
        written, cube.cast_to_unstructured_grid()
    )
    mesh.save(tmp_path / f"a.{written}", binary=False)
    other = tmp_path / f"b.{named}"
    (tmp_path / f"a.{written}").rename(other)
    read = read_mesh(other)
    np.testing.assert_array_equal(read.points, mesh.points)
    assert read.path == other and len(read.elements) == (12 if written == "vtp" else 6)
    other.write_bytes(other.read_bytes()[:-400])
    with pytest.raises(DatasetError, match=f"^{other}: "):
        read_mesh(other)


SQUARES = [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
CORNERS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
LINES = [f"{x} {y} {z}" for x, y, z in CORNERS]


def off(head="OFF", points=LINES, faces=SQUARES, more=""):
    rows = [f"{len(face)} {' '.join(map(str, face))}{more}" for face in faces]
    return "\n".join([head, f"{len(points)} {len(faces)} 0", *points, *rows]) + "\n"


def volume(mesh):
    """Of tetrahedra, or within a closed surface."""
    corners = mesh.points[mesh.elements]
    if corners.shape[1] == 4:
        corners = corners[:, 1:] - corners[:, :1]
    return np.linalg.det(corners).sum() / 6


@pytest.mark.parametrize(
    "text",
    [
        off(),
        off(more=" 255 0 0"),
        off(more=" 0.1 0.2 0.3 1.0"),
        off("COFF", [f"{line} 9 9 9 255" for line in LINES]),
        off("NOFF", [f"{line} 0 0 1" for line in LINES]),
        off("# a cube\nOFF # of squares\n"),
        off().replace("OFF\n8", "OFF 8"),
        off().replace("\n", "\r\n"),
        off(faces=[half for a, b, c, d in SQUARES for half in ((a, b, c), (a, c, d))]),
        off(faces=[*SQUARES[:-1], *[(3, 0, 4), (3, 4, 7)]]),
    ],
)
def test_off_files_of_quadrilaterals_with_colours(tmp_path, text):
    (tmp_path / "a.off").write_bytes(text.encode())
    mesh = read_mesh(tmp_path / "a.off")
    np.testing.assert_array_equal(mesh.points, CORNERS)
    assert mesh.elements.shape == (12, 3) and volume(mesh) == pytest.approx(1)  # all faces look outwards


RING = [(np.cos(angle), np.sin(angle), z) for z in (0, 1) for angle in np.arange(5) * 0.4 * np.pi]
PRISM = [(4, 3, 2, 1, 0), (5, 6, 7, 8, 9), *((k, (k + 1) % 5, 5 + (k + 1) % 5, 5 + k) for k in range(5))]
BENT = [(0, 0, 0), (2, 0, 0), (2, 2, 0), (1, 0.5, 0), (0, 2, 0)]
FORK = [(0, 0, 0), (3, 0, 0), (3, 2, 0), (2, 2, 0), (2, 1, 0), (1, 1, 0), (1, 2, 0), (0, 2, 0)]


@pytest.mark.parametrize("ending", ["off", "obj"])
def test_faces_of_more_than_four_corners_are_cut_into_triangles(tmp_path, ending):
    def write(points, faces):
        lines = [" ".join(map(str, point)) for point in points]
        of_obj = [f"v {line}" for line in lines] + ["f " + " ".join(str(1 + one) for one in face) for face in faces]
        path = tmp_path / f"a.{ending}"
        path.write_text(off(points=lines, faces=faces) if ending == "off" else "\n".join(of_obj))
        return path

    mesh = read_mesh(write(RING, PRISM))
    assert mesh.elements.shape == (16, 3) and volume(mesh) == pytest.approx(2.5 * np.sin(0.4 * np.pi))
    between = [(1, 0, 0), *BENT[:3], (0, 2, 0)]  # its first corner lies on an edge
    flat = read_mesh(write(between, [(0, 2, 3, 4, 1)]))
    a, b, c = np.moveaxis(flat.points[flat.elements], 1, 0)
    assert np.cross(b - a, c - a)[:, 2].sum() / 2 == pytest.approx(4) and len(flat.elements) == 3
    bent = read_mesh(write(BENT, [(0, 1, 2, 3, 4)]))  # from the corner that points inwards
    a, b, c = np.moveaxis(bent.points[bent.elements], 1, 0)
    assert (np.cross(b - a, c - a)[:, 2] > 0).all() and np.cross(b - a, c - a)[:, 2].sum() / 2 == pytest.approx(2.5)
    with pytest.raises(DatasetError, match=f"a.{ending}: a face of 8 corners cannot be cut from one of them"):
        read_mesh(write(FORK, [tuple(range(8))]))
    assert len(read_mesh(write(CORNERS, [*SQUARES, (0, 1)])).elements) == 12  # an edge is no face


@pytest.mark.parametrize("ending", ["vtp", "vtk"])
def test_polygons_and_strips_of_vtk_are_cut_into_triangles(tmp_path, ending):
    """A polygon need not be convex; the values of its cell go to its triangles."""
    strip = [(x, 0, z) for x in range(4) for z in (-1, -2)]
    surface = pyvista.PolyData(np.array([*FORK, *strip], float), faces=[8, *range(8)], strips=[8, *range(8, 16)])
    surface.cell_data["E"] = [7.0, 8.0]
    surface.save(tmp_path / f"a.{ending}")
    mesh = read_mesh(tmp_path / f"a.{ending}")
    a, b, c = np.moveaxis(mesh.points[mesh.elements], 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    of_polygon = mesh.fields["cell"]["E"] == 7
    assert (of_polygon.sum(), (~of_polygon).sum()) == (6, 6)
    assert areas[of_polygon].sum() == pytest.approx(5) and areas[~of_polygon].sum() == pytest.approx(3)
    assert "polygons and strips are cut into triangles: 10 more cells" in mesh.notes


@pytest.mark.parametrize("ending", ["vtu", "vtk"])
def test_polygons_of_an_unstructured_grid_are_cut_into_triangles(tmp_path, ending):
    """Beside other cells, in any order; the values of a cell go to its triangles."""
    points = np.array([*FORK, *(np.array(RING) + (0, 0, 3)), *(np.array(BENT) - (0, 0, 2))], float)
    cells = [3, 8, 9, 10, 8, *range(8), 4, 13, 14, 15, 16, 5, 18, 19, 20, 21, 22, 4, 0, 1, 2, 3]
    grid = pyvista.UnstructuredGrid(cells, [5, 7, 7, 7, 9], points)
    grid.cell_data["E"] = [1.0, 2.0, 3.0, 4.0, 5.0]
    grid.save(tmp_path / f"a.{ending}")
    mesh = read_mesh(tmp_path / f"a.{ending}")
    a, b, c = np.moveaxis(mesh.points[mesh.elements], 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    of = mesh.fields["cell"]["E"]
    assert [int((of == number).sum()) for number in range(1, 6)] == [1, 6, 2, 3, 2]
    assert areas[of == 2].sum() == pytest.approx(5) and areas[of == 4].sum() == pytest.approx(2.5)
    assert "polygons and strips are cut into triangles: 7 more cells" in mesh.notes


def test_the_polygons_of_a_surface_may_be_a_rigid_tool(tmp_path):
    """Beside a body of tetrahedra."""
    scene = block(2, 2, 1)
    points = np.concatenate([scene.rest_position, np.array(RING) + (1, 1, 2)])
    faces = [np.array(face) + scene.num_nodes for face in PRISM]
    cells = np.concatenate(
        [
            np.hstack([np.full((scene.num_elements, 1), 4), scene.elements]).ravel(),
            *([len(face), *face] for face in faces),
        ]
    )
    grid = pyvista.UnstructuredGrid(cells, [*[10] * scene.num_elements, 7, 7, *[9] * 5], points)
    grid.save(tmp_path / "a.vtu")
    mesh = read_mesh(tmp_path / "a.vtu")
    assert mesh.shell_nodes[scene.num_nodes : scene.num_nodes + 10].all()
    assert len(mesh.elements) == scene.num_elements + 3 * 16


@pytest.mark.parametrize(
    ("name", "content", "cause"),
    [
        ("a.mesh", "\n% GETFEM MESH FILE\n", "is no .mesh file of Medit, but begins with '% GETFEM MESH FILE'"),
        ("a.obj", "L\1\0\0.text", "is no text; compilers use this ending, too"),
        ("a.obj", "P 0.3 0.3 0.4 10 1 8\n1.0 2.0 3.0\n", "holds no points as OBJ files do"),
        ("a.off", "4OFF\n1 0 0\n", "begins with '4OFF', not with OFF"),
        ("a.off", off()[:-12], "holds fewer lines than 8 points and 6 faces"),
        ("a.node", "1 3 0 0\n1 0 0 0\n", "a.ele is not beside it: copy it there"),
    ],
)
def test_files_of_other_programs_with_an_ending_that_is_read_are_refused_by_name(tmp_path, name, content, cause):
    (tmp_path / name).write_text(content)
    with pytest.raises(DatasetError, match=f"{name}: cannot be read as a mesh: {cause}"):
        read_mesh(tmp_path / name)


def test_families_of_med_need_no_groups(tmp_path):
    """Gmsh writes such a family for each of its entities that are in no group."""
    path = of_gmsh(tmp_path, 2.2, name="a.med")
    with h5py.File(path, "r+") as file:
        (families,) = file["FAS"].values()
        assert [name for name in families["ELEME"] if "GRO" not in families["ELEME"][name]] == []
        families["ELEME"].create_group("FAM_-9_").attrs["NUM"] = -9
    mesh = read_mesh(path)
    assert volume(mesh) == pytest.approx(6) and "body" in mesh.groups


def test_a_graded_mesh_whose_points_are_numbered_needs_no_search_for_neighbours(tmp_path, monkeypatch):
    """Where it is fine, thousands of points lie within a millionth of its size."""

    def search(*args):
        raise AssertionError("points are compared")

    monkeypatch.setattr("ast_sim.importers.solids.stitching.KDTree", search)
    path = of_gmsh(tmp_path, 2.2)
    assert volume(read_mesh(path)) == pytest.approx(6)

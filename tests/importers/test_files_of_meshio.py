"""Kinds of files that meshio reads in part, or looks at without end: read whole, or refused."""

import re

import meshio
import numpy as np
import pytest
from data_samples import block

from ast_sim.importers.mesh_file import read_mesh
from ast_sim.simulate.shapes.mesh import second_order
from ast_sim.support.errors import DatasetError

CUBE = block(1, 1, 1)
POINTS = CUBE.rest_position.astype(float)
HEXAHEDRON = ((0, 4, 6, 2, 1, 5, 7, 3),)
BEGIN = "SOL 101\nCEND\nBEGIN BULK\n"


def volume(mesh):
    corners = mesh.points[mesh.elements[:, :4]]
    return np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 6


@pytest.mark.parametrize(
    "name",
    ["a.mesh", "a.meshb", "a.med", "a.vol", "a.node", "a.bdf", "a.avs", "a.f3grid", "a.b8.ugrid", "a.xdmf", "a.xml"],
)
def test_kinds_that_are_read_keep_points_and_elements(tmp_path, name):
    meshio.Mesh(POINTS, [("tetra", CUBE.elements)]).write(tmp_path / name)
    mesh = read_mesh(tmp_path / name)
    assert len(mesh.points) == 8 and len(mesh.elements) == 6
    assert volume(mesh) == pytest.approx(1)


@pytest.mark.parametrize("name", ["a.med", "a.vol", "a.bdf", "a.xdmf"])
def test_second_order_elements_are_kept(tmp_path, name):
    points, elements = second_order(POINTS, CUBE.elements)
    meshio.Mesh(points, [("tetra10", elements)]).write(tmp_path / name)
    mesh = read_mesh(tmp_path / name)
    assert mesh.elements.shape == (6, 10)
    np.testing.assert_allclose(np.sort(mesh.points[mesh.elements].mean(1), 0), np.sort(points[elements].mean(1), 0))


@pytest.mark.parametrize(
    "name", ["a.cgns", "a.tec", "a.dat", "a.su2", "a.post", "a.dato", "a.mdpa", "a.hmf", "a.h5m", "a.svg", "a.wkt"]
)
def test_kinds_that_meshio_reads_in_part_are_refused(tmp_path, name):
    (tmp_path / name).write_text("VARIABLES = X Y Z\n")
    with pytest.raises(DatasetError, match=f"{name}: .* files of the kind .* are not read; write it as .vtu, .vtk"):
        read_mesh(tmp_path / name)


@pytest.mark.parametrize(
    ("old", "new", "cause"),
    [
        (r'<vertex index="7".*', "", "says that it holds 8 vertices, but has 7 of them"),
        (r'<tetrahedron index="2".*', "", "says that it holds 6 cells, but has 5 of them"),
        (r'<tetrahedron index="2"', '<tetrahedron index="3"', "says that it holds 6 cells, but has 5 of them"),
        (r'<vertices size="8"', '<vertices size="900000000000"', "says that it holds 900000000000 vertices, but has 8"),
    ],
)
def test_files_of_dolfin_that_lack_an_entry_are_refused(tmp_path, old, new, cause):
    """meshio takes what stands in the memory for what is missing."""
    path = tmp_path / "a.xml"
    meshio.Mesh(POINTS, [("tetra", CUBE.elements)]).write(path)
    path.write_text(re.sub(old, new, path.read_text()))
    with pytest.raises(DatasetError, match=f"a.xml: {cause}"):
        read_mesh(path)


@pytest.mark.parametrize(
    ("content", "cause"),
    [
        ("", "is no .msh file of Gmsh's format 4.1 or 2.2, or damaged"),
        ("9 8\n0 0 4\n0.5 0 1\n", "is no .msh file of Gmsh's format 4.1 or 2.2, or damaged"),
        ('(0 "Fluent")\n(2 3)\n(10 (0 1 3 0))\n(13 (0 1 1 0))\n', "lists the faces of its cells, as Fluent does"),
        ("(2 3)\n(10 (0 1 3 0))\n( 3013 ( 3 1 1 2 3)(", "lists the faces of its cells, as Fluent does"),
    ],
)
def test_files_of_fluent_and_of_other_programs_are_refused(tmp_path, content, cause):
    """A file of Fluent lists the faces of its cells: they are no elements."""
    (tmp_path / "a.msh").write_text(content)
    with pytest.raises(DatasetError, match=f"a.msh: .*{cause}"):
        read_mesh(tmp_path / "a.msh")


def grid(number, point, system=""):
    return f"{'GRID':8}{number:8}{system:>8}" + "".join(f"{float(x):8.3f}" for x in point) + "\n"


def card(name, nodes, end, number=1):
    """A card of an element, in fields of eight characters; `end` is what stands at the end of lines that go on."""
    fields = [f"{text:>8}" for text in (number, 1, *nodes)]
    lines = ["".join(fields[at : at + 8]) for at in range(0, len(fields), 8)]
    return f"{name:8}" + f"{end}\n        ".join(lines) + "\n"


GRIDS = "".join(grid(1 + row, point) for row, point in enumerate(POINTS))
WHOLE = GRIDS + "".join(card("CTETRA", 1 + cell, "", 1 + row) for row, cell in enumerate(CUBE.elements))


def nastran(folder, text):
    (folder / "a.bdf").write_text(f"{BEGIN}{text}ENDDATA\n")
    return read_mesh(folder / "a.bdf")


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        (f"{WHOLE}CHEX20  {7:8}{1:8}\n", "CHEX20 elements"),
        (f"{WHOLE}CQUADX,7,1,1,2,3,4\n", "CQUADX elements"),
        (f"{WHOLE}GRID,1,,0.,0.,-1.\n", "GRID 1 stands twice, with different fields"),
    ],
)
def test_cards_of_nastran_that_meshio_reads_over_are_refused(tmp_path, text, cause):
    with pytest.raises(DatasetError, match=f"a.bdf: (holds )?{cause}"):
        nastran(tmp_path, text)


@pytest.mark.parametrize("more", ["CONM2,9,1\n", "CORD2C,5,0\n", "CBAR,9,1,1,2\n", "MAT1,1,2.1e5,,0.3\n", "$ CQUADX\n"])
def test_cards_of_nastran_that_say_nothing_of_elements_are_passed_over(tmp_path, more):
    mesh = nastran(tmp_path, WHOLE + more)
    assert len(mesh.elements) == 6 and volume(mesh) == pytest.approx(1)
    in_space = "".join(grid(1 + row, point, "0") for row, point in enumerate(POINTS))
    assert volume(nastran(tmp_path, WHOLE.replace(GRIDS, in_space))) == pytest.approx(1)


@pytest.mark.parametrize("again", ["=,*1,=,*1,*1,*1,*1", "=       *1", "=(3)", "==", "  =,*1"])
def test_cards_of_nastran_that_repeat_the_one_before_are_refused(tmp_path, again):
    """Such lines make elements and points of others; passed over, a part of the mesh would be missing."""
    with pytest.raises(DatasetError, match=r"a.bdf: line \d+ repeats the card before it \('='\), which is not read"):
        nastran(tmp_path, f"{WHOLE}{again}\n")


def test_cards_of_nastran_that_are_no_part_of_a_mesh_are_told(tmp_path):
    more = "RBE2,7,1,123456,2,3\nCONM2,8,1,,1.\nconm2*  9\n*\nCBUSH,9,1,1,2\nRBE3    11\nMAT1,1,2.1e5,,0.3\nPBUSH,1\n"
    (tmp_path / "more.inc").write_text(more)
    for text in (WHOLE + more, WHOLE + "INCLUDE 'more.inc'\n"):
        told = "5 cards that are no part of a mesh are left out: 1 CBUSH, 2 CONM2, 1 RBE2, 1 RBE3"
        assert told in nastran(tmp_path, text).notes
    assert "1 card that is no part of a mesh is left out: 1 MPC" in nastran(tmp_path, WHOLE + "MPC,3,1,1,1.\n").notes
    (tmp_path / "b.bdf").write_text(f"SOL 101\nCEND\nMPC = 3\nBEGIN BULK\n{WHOLE}ENDDATA\nRBE2,7,1,123456,2,3\n")
    assert not any("card" in note for note in read_mesh(tmp_path / "b.bdf").notes)


@pytest.mark.parametrize("end", [" " * 8, "+       ", "", "+A1"])
def test_a_card_of_nastran_goes_on_in_the_next_line(tmp_path, end):
    """An editor that strips lines makes meshio leave out the second line of an element."""
    text = GRIDS + card("CHEXA", [1 + node for node in HEXAHEDRON[0]], end)
    if end.startswith("+"):
        text = text.replace("\n        ", f"\n{end:8}")
    assert volume(nastran(tmp_path, text)) == pytest.approx(1)
    first, second, _ = text.removeprefix(GRIDS).split("\n")
    with pytest.raises(DatasetError, match="CHEXA 1 .line 12. has the nodes 1, 5, 7, 3, 2, 6; must have 8 or 20"):
        nastran(tmp_path, GRIDS + first + "\n")
    if end == "+A1":
        with pytest.raises(DatasetError, match="line 13 does not go on with the line before it: sort its lines"):
            nastran(tmp_path, f"{GRIDS}{first}\n{second.replace('+A1', '+B1')}\n")


def free(number, nodes, more="", name="CTETRA"):
    """An element between commas; in lines of eight fields."""
    return f"{name},{number},1,{','.join(str(node) for node in nodes)}{more}\n"


FREE = "".join(free(1 + row, 1 + cell) for row, cell in enumerate(CUBE.elements))
WIDE = "".join(
    f"{'GRID*':8}{1 + row:16}{'':16}{x:16}{y:16}\n{'*':8}{z:16}\n" for row, (x, y, z) in enumerate(POINTS.tolist())
)
FORTRAN = "".join(
    f"{'GRID*':8}{1 + row:16}{'':16}{x:12.5f}D+00{y:12.5f}D+00\n{'*':8}{z:12.5f}D+00\n"
    for row, (x, y, z) in enumerate(POINTS.tolist())
)
PADDED = "".join(f"GRID,{1 + row:05},,{x},{y},{z}\n" for row, (x, y, z) in enumerate(POINTS.tolist()))
CELLS = list(enumerate(CUBE.elements))
SPELLINGS = {
    "small": GRIDS + WHOLE.removeprefix(GRIDS),
    "free": GRIDS + FREE,
    "lower case": (GRIDS + FREE).lower(),
    "wide": WIDE + FREE,
    "comments": "$ a comment\n" + GRIDS.replace("\n", " $ a point\n") + FREE,
    "windows": (GRIDS + FREE).replace("\n", "\r\n"),
    "tabs": "".join(f"GRID\t{1 + row}\t\t{x}\t{y}\t{z}\n" for row, (x, y, z) in enumerate(POINTS.tolist())) + FREE,
    "a default of points": "GRDSET,,,,,,,6\n" + GRIDS + FREE,
    "Nastran's exponents": GRIDS.replace("1.000", "10.-1") + FREE,
    "Fortran's exponents": FORTRAN + FREE,
    "zeros before numbers": PADDED + FREE,
    "zeros before nodes": GRIDS + "".join(free(1 + row, [f"{node:04}" for node in 1 + cell]) for row, cell in CELLS),
    "blank zeros": GRIDS.replace("0.000", "     ") + FREE,
}


@pytest.mark.parametrize("spelling", SPELLINGS)
@pytest.mark.parametrize(("begin", "end"), [(BEGIN, "ENDDATA\n"), ("", ""), ("BEGIN SUPER=1\n", "ENDDATA")])
def test_decks_of_nastran_in_all_spellings(tmp_path, spelling, begin, end):
    """Gmsh and OptiStruct write decks without BEGIN BULK; included files lack ENDDATA."""
    (tmp_path / "a.bdf").write_bytes((begin + SPELLINGS[spelling] + end).encode())
    mesh = read_mesh(tmp_path / "a.bdf")
    assert len(mesh.elements) == 6 and volume(mesh) == pytest.approx(1)
    np.testing.assert_allclose(mesh.points, POINTS)


FLAT = "".join(
    grid(1 + row, point) for row, point in enumerate([(0, 0, 0), (2, 0, 0), (2, 1, 0), (0, 1, 0), (1, 0, 0)])
)


@pytest.mark.parametrize(
    ("text", "kinds"),
    [
        (free(1, (1, 2, 3), ",30.0,0.1", "CTRIA3"), ["triangle"]),  # an angle, an offset
        (free(1, (1, 2, 3, 4), ",45.", "CQUAD4"), ["quad"]),
        (free(1, (1, 2, 3, 4), "", "CQUADR"), ["quad"]),
        ("CQUAD8,1,1,1,2,3,4,5,,\n+,,,0.1,0.1\n", ["quad"]),  # three middles are left out
        (free(1, (1, 2, 3, 5, "", ""), "", "CTRIA6"), ["triangle"]),
        (free(1, (1, 2, 3), "", "CTRIAR") + free(2, (1, 2), ",0.,1.,0.", "CBAR"), ["triangle", "line"]),
        ("CTRIA3,1,,1,2,3\n", ["triangle"]),  # the property is the number of the element
    ],
)
def test_surfaces_of_nastran_may_have_fields_behind_their_nodes(tmp_path, text, kinds):
    mesh = nastran(tmp_path, FLAT + text)
    assert [block.kind for block in mesh.source.blocks] == kinds
    assert set(mesh.elements.ravel()) == {0, 1, 2, 3} if kinds == ["quad"] else {0, 1, 2}


def test_decks_of_nastran_include_others(tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "points.inc").write_text(GRIDS)
    (tmp_path / "cells.inc").write_text(FREE)
    text = "INCLUDE 'parts\\points.inc'\ninclude \"cells.inc\"\n"
    assert volume(nastran(tmp_path, text)) == pytest.approx(1)
    with pytest.raises(DatasetError, match=r"a.bdf: includes none.inc \(line 4\), which there is not: copy it there"):
        nastran(tmp_path, "INCLUDE none.inc\n")
    (tmp_path / "cells.inc").write_text("INCLUDE 'a.bdf'\n")
    with pytest.raises(DatasetError, match=r"a.bdf: includes a.bdf \(line 1 of cells.inc\)"):
        nastran(tmp_path, text)


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        (GRIDS + free(1, (1, 2, 3, 9)), "an element has the node 9, and there is no GRID of this number"),
        (GRIDS + free(1, (1, 2, 3)), r"CTETRA 1 \(line 12\) has the nodes 1, 2, 3; must have 4 or 10"),
        (GRIDS + free(1, (1, 2, 3, 1.5)), r"CTETRA 1 \(line 12\) has the nodes 1, 2, 3, 1.5"),
        ("MAT1,1,2.1e5,,0.3\n", "holds no GRID, so it is no deck of Nastran"),
    ],
)
def test_decks_of_nastran_that_lack_something_are_refused(tmp_path, text, cause):
    with pytest.raises(DatasetError, match=f"a.bdf: .*{cause}"):
        nastran(tmp_path, text)


TETRAHEDRON = "CTETRA,7,1,1,2,4,8\n"


@pytest.mark.parametrize(
    ("again", "told"),
    [
        (TETRAHEDRON, None),  # as in a file that is included twice
        ("ctetra, 007, 01, 01, 02, 04, 08\n", None),
        (TETRAHEDRON.replace("CTETRA,7", "CTETRA,8"), None),
        ("CTETRA,7,1,1,2,4,6\n", "CTETRA 7"),  # of other nodes
        ("CTETRA,7,1,2,1,4,8\n", "CTETRA 7"),  # in another order
        ("CTETRA,7,3,1,2,4,8\n", "CTETRA 7"),  # of another property
        ("CTETRA,7,1,1,2,4,8,3,5\n,6,7,1,2\n", "CTETRA 7"),  # with middles
        ("CHEXA,7,1,1,2,4,3,5,6,\n,8,7\n", ""),  # Nastran takes both
        ("CTRIA3,7,1,1,2,4\n", ""),
    ],
)
def test_two_elements_of_a_kind_and_one_number_are_refused_unless_they_are_copies(tmp_path, again, told):
    lines = r"\(line 12 and line 13 of more.inc\): leave one out, or give it another number"
    (tmp_path / "more.inc").write_text("$ more\n" * (12 if told else 1) + again)
    if told:
        with pytest.raises(DatasetError, match=f"a.bdf: {told} stands twice, with different fields {lines}"):
            nastran(tmp_path, f"{GRIDS}{TETRAHEDRON}INCLUDE 'more.inc'\n")
        return
    mesh = nastran(tmp_path, f"{GRIDS}{TETRAHEDRON}INCLUDE 'more.inc'\n")
    assert len(mesh.elements) == (6 if "CHEXA" in again else 0) + 1
    assert ("1 element that stands in the file twice is taken once" in mesh.notes) == (told is None)


def test_an_element_without_a_number_is_refused(tmp_path):
    with pytest.raises(DatasetError, match=r"a.bdf: CTETRA \(line 12\) has the number ''; must be a whole number"):
        nastran(tmp_path, GRIDS + TETRAHEDRON.replace("7", ""))


SYSTEM = "CORD2R         5       0     0.0     0.0     0.0     0.0     0.0     1.0\n             1.0     0.0     0.0\n"
HALVES = "".join(f"GRID,{1 + row},,{x / 2},{y / 2},{z / 2}\n" for row, (x, y, z) in enumerate(POINTS.tolist()))
SHORT = HALVES.replace(".0", "")


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (GRIDS.replace(".", ","), 4),
        (GRIDS.replace("1.000", "1,000"), 5),
        (WIDE.replace(".", ","), 4),
        (WIDE.replace("               1.0\n", "               1,0\n"), 7),  # in the second line of a card
        (SYSTEM.replace(".", ",") + GRIDS, 4),
        (SYSTEM.replace("     1.0     0.0     0.0\n", "     1,0     0.0     0.0\n") + GRIDS, 5),
        (GRIDS + card("CTRIA3", [1, 2, 4, "30,0"], "", 8), 12),
    ],
)
def test_a_decimal_comma_in_a_field_of_columns_of_nastran_is_told(tmp_path, text, line):
    """The line would be taken for one between commas, and its card for another or none."""
    (tmp_path / "a.bdf").write_text(f"SOL 101\nCEND\nBEGIN BULK\n{text}{TETRAHEDRON}ENDDATA\n")
    told = rf"a.bdf: line {line} has a comma in a field of 8 or 16 characters: write decimal points"
    with pytest.raises(DatasetError, match=told):
        read_mesh(tmp_path / "a.bdf")


FLAT_HALVES = "".join(f"GRID,{1 + row},,{x},{y},{z / 2}\n" for row, (x, y, z) in enumerate(POINTS.tolist()))


@pytest.mark.parametrize("points", [HALVES, SHORT, HALVES.replace(",0.5", ",-0.5"), FLAT_HALVES])
def test_decimal_commas_between_commas_are_told(tmp_path, points):
    """Each number becomes two, and three coordinates six fields of a GRID; a zero may be written without a comma."""
    told = (
        r"a.bdf: the coordinates .* of GRID \d \(line \d+\) are whole numbers, followed by .*: are the commas decimal"
    )
    with pytest.raises(DatasetError, match=told):
        nastran(tmp_path, points.replace(".", ",") + TETRAHEDRON)
    assert len(nastran(tmp_path, points + TETRAHEDRON).elements) == 1


@pytest.mark.parametrize(
    "text",
    [
        "MAT1           7  2,1+5             0,3\n" + GRIDS,  # of cards that are not read
        "TITLE = A bar, held\nSUBCASE 1\n  LABEL = one, two\n" + GRIDS,
        "  " + PADDED.replace("\n", "\n  "),
        PADDED + "CHEXA,9,1,1,2,4,3,5,6,+1\n+1,8,7,,\n",
        PADDED + "CHEXA,9,1,1,2,4,3,5,6\n        ,8,7\n",
        "".join(f"GRID,{1 + row},0,{x:g},{y:g},{z:g},0,0,0\n" for row, (x, y, z) in enumerate(POINTS.tolist())),
        "".join(f"GRID,{1 + row},,{x:g},{y:g},{z:g},-1,123\n" for row, (x, y, z) in enumerate(POINTS.tolist())),
        SYSTEM + "".join(f"GRID,{1 + row},,{x:g},{y:g},{z:g},5\n" for row, (x, y, z) in enumerate(POINTS.tolist())),
    ],
)
def test_other_commas_of_nastran_are_no_decimal_ones(tmp_path, text):
    (tmp_path / "a.bdf").write_text(f"{text}{TETRAHEDRON}ENDDATA\n")
    mesh = read_mesh(tmp_path / "a.bdf")
    assert mesh.points.tolist() == POINTS.tolist() and len(mesh.elements) == 1 + 6 * ("CHEXA" in text)


@pytest.mark.parametrize(("name", "content"), [("a.off", "OFF\n"), ("a.off", ""), ("a.ply", "ply\nformat ascii 1.0\n")])
def test_a_surface_that_is_cut_off_is_refused_at_once(tmp_path, name, content):
    (tmp_path / name).write_text(content)
    with pytest.raises(DatasetError, match=f"{name}: cannot be read as a mesh: "):
        read_mesh(tmp_path / name)


@pytest.mark.parametrize("ending", [".node", ".ele"])
@pytest.mark.parametrize("content", ["", "# only a comment\n"])
def test_a_file_of_tetgen_that_is_cut_off_is_refused_at_once(tmp_path, ending, content):
    meshio.Mesh(POINTS, [("tetra", CUBE.elements)]).write(tmp_path / "a.node")
    (tmp_path / "a").with_suffix(ending).write_text(content)
    with pytest.raises(DatasetError, match=f"a{ending}: cannot be read as a mesh: it is empty"):
        read_mesh(tmp_path / "a.node")
    (tmp_path / "a.ele").unlink()
    with pytest.raises(DatasetError, match="a.node: cannot be read as a mesh"):
        read_mesh(tmp_path / "a.node")


@pytest.mark.parametrize("columns", ["x y z", "x y z nx", "y x z", "nx x y z", "x y"])
def test_points_of_a_ply_file_are_x_y_and_z(tmp_path, columns):
    names = columns.split()
    rows = [" ".join(str(dict(zip("xyz", point, strict=True)).get(name, 0.5)) for name in names) for point in POINTS]
    properties = "".join(f"property float {name}\n" for name in names)
    head = (
        f"ply\nformat ascii 1.0\nelement vertex 8\n{properties}element face 2\nproperty list uchar int vertex_indices\n"
    )
    (tmp_path / "a.ply").write_text(head + "end_header\n" + "\n".join([*rows, "3 0 1 2", "3 1 3 2"]) + "\n")
    if names[:3] == ["x", "y", "z"]:
        assert np.array_equal(read_mesh(tmp_path / "a.ply").points, POINTS)
    else:
        with pytest.raises(DatasetError, match="its points do not begin with x, y and z"):
            read_mesh(tmp_path / "a.ply")


def test_points_of_a_mesh_in_memory_are_rows():
    mesh = meshio.Mesh(POINTS, [("tetra", CUBE.elements)])
    mesh.points = POINTS.ravel()
    with pytest.raises(DatasetError, match=r"its points have the shape \(24,\); must be rows of up to three"):
        read_mesh(mesh)


TRIANGLES = np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)])
CORNERS = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1.5)])


@pytest.mark.parametrize(
    ("corner", "face", "head"),
    [
        ("v {} {} {}", "f {} {} {}", ""),
        ("v {} {} {}", "f {0}/1/1 {1}/1/1 {2}/1/1", "mtllib a.mtl\nvt 0 0\nvn 0 0 1\nusemtl x\ns off\no body\ng a"),
        ("v {} {} {} 1.0", "f {0}//1 {1}//1 {2}//1  # c", "vn 0 0 1"),
        ("v {} {} {} 0.5 0.5 0.5", "f {0}/1 {1}/1 \\\n{2}/1", "vt 0 0\nvt 1 1"),
    ],
)
@pytest.mark.parametrize("from_end", [False, True])
def test_surfaces_of_obj_with_textures_colours_and_numbers_from_the_end(tmp_path, corner, face, head, from_end):
    numbers = TRIANGLES - 4 if from_end else TRIANGLES + 1
    lines = [head, *(corner.format(*row) for row in CORNERS.tolist()), *(face.format(*row) for row in numbers.tolist())]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    mesh = read_mesh(tmp_path / "a.obj")
    np.testing.assert_array_equal(mesh.points[mesh.elements], CORNERS[TRIANGLES])


@pytest.mark.parametrize("line", ["cstype bspline", "surf 0 1 0 1 1 2 3 4", "v 1 2 3 0.5"])
def test_curved_surfaces_of_obj_are_refused(tmp_path, line):
    (tmp_path / "a.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\n{line}\nf 1 2 3\n")
    with pytest.raises(DatasetError, match="a.obj: holds curves or curved surfaces, and those are not read"):
        read_mesh(tmp_path / "a.obj")


@pytest.mark.parametrize(
    ("form", "columns", "faces", "cause"),
    [
        ("ascii", ["list uchar int vertex_index"], "3 {} {} {}", ""),
        ("ascii", ["list uchar int vertex_indices", "uchar red"], "3 {} {} {} 255", ""),
        ("ascii", ["int flags", "list uchar int vertex_indices"], "9 3 {} {} {}", "do not begin with their corners"),
        ("ascii", ["list uchar int vertex_indices", "list uchar float uv"], "3 {} {} {} 0", "write it without uv"),
        ("binary_little_endian", ["list uchar int vertex_index"], b"", ""),
        ("binary_little_endian", ["list uchar int vertex_indices", "uchar red"], b"\3", "write it without red"),
    ],
)
def test_faces_of_a_ply_file_are_their_corners(tmp_path, form, columns, faces, cause):
    """Of binary files meshio takes what follows the corners of a face for the next face."""
    head = f"ply\nformat {form} 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 4\n" + "".join(f"property {column}\n" for column in columns) + "end_header\n"
    if form == "ascii":
        rows = [" ".join(map(str, row)) for row in CORNERS.tolist()]
        content = "\n".join([*rows, *(faces.format(*row) for row in TRIANGLES.tolist())]).encode()
    else:
        content = CORNERS.astype("<f4").tobytes()
        content += b"".join(b"\3" + row.astype("<i4").tobytes() + faces for row in TRIANGLES)
    (tmp_path / "a.ply").write_bytes(head.encode() + content)
    if cause:
        with pytest.raises(DatasetError, match=f"a.ply: cannot be read as a mesh: its faces .*{cause}; write it as"):
            read_mesh(tmp_path / "a.ply")
        return
    mesh = read_mesh(tmp_path / "a.ply")
    np.testing.assert_array_equal(mesh.points[mesh.elements], CORNERS[TRIANGLES])


def test_a_copy_that_meshio_refuses_is_called_by_the_name_of_the_file(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    columns = "property list uchar int vertex_indices\nelement edge 1\nproperty int vertex1\n"
    (tmp_path / "a.ply").write_text(f"{head}element face 1\n{columns}end_header\n0 0 0\n3 0 0 0\n0\n")
    with pytest.raises(DatasetError, match=re.escape(f"Couldn't read file {tmp_path}/a.ply as ply")):
        read_mesh(tmp_path / "a.ply")

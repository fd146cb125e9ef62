"""Kinds of inputs that once came in wrong or without a word: elements beside tetrahedra, keywords that change the mesh,
marks that are not a number, bodies that lie in each other at rest."""

import meshio
import numpy as np
import pytest
from data_samples import block

from ast_sim import cli
from ast_sim.importers.decks.deck_mesh import deck_mesh
from ast_sim.importers.mesh_file import read_mesh
from ast_sim.importers.scene_mesh import read_scene
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.scene import NodeType
from ast_sim.support.errors import DatasetError

PAD = block(2, 2, 1)
TETRAHEDRA = len(PAD.elements)


def deck(folder, *more):
    """A deck of the pad, whose nodes are 1 to 18, and more lines after it."""
    nodes = [f"{1 + row}, {x:g}, {y:g}, {z:g}" for row, (x, y, z) in enumerate(PAD.rest_position)]
    cells = [", ".join(map(str, [1 + row, *(1 + cell)])) for row, cell in enumerate(PAD.elements)]
    path = folder / "deck.inp"
    path.write_text("\n".join(["*NODE", *nodes, "*ELEMENT, TYPE=C3D4", *cells, *more]) + "\n")
    return path


def on_top(count):
    """Numbers of nodes of the deck around a square of the top."""
    corners = np.array([(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)])[:count]
    return [1 + int(np.flatnonzero((PAD.rest_position == corner).all(axis=1))[0]) for corner in corners]


@pytest.mark.parametrize(
    ("kind", "count", "note"),
    [
        ("R3D3", 3, "1 cell of the kind R3D3 is left out"),
        ("r3d4", 4, "1 cell of the kind r3d4 is left out"),
        ("SPRINGA", 2, "1 element of the type SPRINGA is left out"),
        ("Spring1", 1, "1 element of the type SPRING1 is left out"),
        ("DASHPOTA", 2, "1 element of the type DASHPOTA is left out"),
        ("MASS", 1, "1 element of the type MASS is left out"),
        ("T3D2", 2, "1 element of the type T3D2 is left out"),
    ],
)
def test_elements_on_the_nodes_of_tetrahedra_are_left_out_with_a_note(tmp_path, kind, count, note):
    nodes = ", ".join(map(str, on_top(count)))
    mesh = read_mesh(deck(tmp_path, f"*ELEMENT, TYPE={kind}", f"1001, {nodes}"))
    assert mesh.elements.shape == (TETRAHEDRA, 4) and mesh.shells is None
    assert note.lower() in "; ".join(mesh.notes).lower()


@pytest.mark.parametrize(
    ("kind", "cells"), [("R3D3", ["101, 102, 103", "101, 103, 104"]), ("R3D4", ["101, 102, 103, 104"])]
)
def test_rigid_elements_of_their_own_become_an_obstacle(tmp_path, kind, cells):
    sheet = [f"{101 + row}, {x}, {y}, 1.5" for row, (x, y) in enumerate([(0, 0), (2, 0), (2, 2), (0, 2)])]
    rows = [f"{1001 + row}, {cell}" for row, cell in enumerate(cells)]
    path = deck(
        tmp_path, "*NODE", *sheet, f"*ELEMENT, TYPE={kind}, ELSET=TOOL", *rows, "*RIGID BODY, ELSET=TOOL, REF NODE=1"
    )
    read = read_scene(path, clamps=["0:zmin"])
    one, several = f"1 cell of the kind {kind} is a shell and becomes an obstacle", "are shells and become obstacles"
    assert (one if len(cells) == 1 else f"{len(cells)} cells of the kind {kind} {several}") in read.notes
    assert np.bincount(read.scene.body).tolist() == [PAD.num_nodes, 8]
    assert (read.scene.node_type[read.scene.body == 1] == NodeType.OBSTACLE).all()
    front = read.scene.rest_position[read.scene.body == 1][:4]
    assert (front[:, 2] == 1.5).all()


def test_an_instance_is_moved_and_then_turned_counter_clockwise(tmp_path):
    path = tmp_path / "deck.inp"
    path.write_text("""*PART, NAME=A
*NODE
1, 0, 0, 0
2, 1, 0, 0
3, 0, 1, 0
4, 0, 0, 1
*ELEMENT, TYPE=C3D4
1, 1, 2, 3, 4
*END PART
*ASSEMBLY, NAME=B
*INSTANCE, NAME=C, PART=A
5, 0, 0
1, 1, 0, 1, 1, 7, 90
*END INSTANCE
*END ASSEMBLY
""")
    # (x, y) + (5, 0) about (1, 1): (5, 0) - (1, 1) = (4, -1) goes to (1, 4), and (1, 1) is added again
    points = deck_mesh(path).points
    np.testing.assert_allclose(points, [[2, 5, 0], [2, 6, 0], [1, 5, 0], [2, 5, 1]], atol=1e-12)


@pytest.mark.parametrize("line", ["0, 0, 0, 0, 0, 1", "0, 0, 5"])
def test_a_rotation_without_an_angle_is_refused(tmp_path, line):
    path = tmp_path / "deck.inp"
    nodes = "1, 0, 0, 0\n2, 1, 0, 0\n3, 0, 1, 0\n4, 0, 0, 1\n*ELEMENT, TYPE=C3D4\n1, 1, 2, 3, 4"
    part = f"*PART, NAME=A\n*NODE\n{nodes}\n*END PART\n"
    path.write_text(f"{part}*INSTANCE, NAME=C, PART=A\n5, 0, 0\n{line}\n*END INSTANCE\n")
    with pytest.raises(DatasetError, match=r"deck.inp:12: a rotation has two points of its axis and an angle"):
        read_mesh(path)


@pytest.mark.parametrize("keyword", ["NMAP", "IMPORT", "IMPERFECTION"])
def test_keywords_that_change_the_mesh_are_refused_by_name(tmp_path, keyword):
    path = deck(tmp_path, f"*{keyword[:2].lower()}{keyword[2:]}, NSET=A", "1, 3, 1")
    with pytest.raises(DatasetError, match=rf"deck.inp:\d+: \*{keyword}: this keyword changes the mesh"):
        read_mesh(path)


@pytest.mark.parametrize(
    ("line", "cause"),
    [
        ("*", "a single asterisk; a comment begins with two"),
        ("* the other half", r"the 14 lines after this one seem to belong to \*ELEMENT in line 20; a comment"),
        ("*ELEMNT, TYPE=C3D4", r"is this \*ELEMENT\?"),
        ("*ELEMENTS, TYPE=C3D4", r"is this \*ELEMENT\?"),
    ],
)
def test_elements_behind_a_line_that_is_no_keyword_are_not_lost(tmp_path, line, cause):
    path = deck(tmp_path)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:30], line, *lines[30:]]) + "\n")
    with pytest.raises(DatasetError, match=rf"deck.inp:31: \*\w*: {cause}"):
        read_mesh(path)


LOST = r"deck.inp:\d+: \*\w+: the (\d )?lines? after this one seems? to belong to \*{} in line \d+; a comment"


@pytest.mark.parametrize(
    ("keyword", "lines"),
    [
        ("NSET, NSET=A", ("1, 2, 3", "* more", "4, 5, 6")),
        ("NSET, NSET=A", ("* the clamp", "4, 5, 6")),
        ("NSET, NSET=A", ("1", "* first", "* second", "4,", "5,")),
        ("NSET, NSET=A, GENERATE", ("1, 3, 1", "* node set of the top", "4, 6, 1")),
        ("NSET, NSET=A", ("1", "* and", "all_nodes")),
        ("ELSET, ELSET=A", ("1, 2", "* elements of the top", "4, 5")),
        ("BOUNDARY", ("1, 1, 3", "* the other end", "2, 1, 3, 0.5", "all_nodes, ENCASTRE")),
        ("NODE", ("* nodes of the tool, size=3", "901, 0, 0, 9", "902, 1e-3, 0., .5")),
    ],
)
def test_lines_behind_a_comment_with_one_asterisk_are_not_lost(tmp_path, keyword, lines):
    path = deck(tmp_path, "*NSET, NSET=ALL_NODES, GENERATE", "1, 18, 1", f"*{keyword}", *lines)
    with pytest.raises(DatasetError, match=LOST.format(keyword.partition(",")[0])):
        read_mesh(path)


@pytest.mark.parametrize("lines", [("* moved up", "0, 0, 5"), ("0, 0, 5", "* turned", "0, 0, 0, 0, 0, 1, 90")])
def test_an_instance_behind_a_comment_with_one_asterisk_keeps_its_place(tmp_path, lines):
    path = tmp_path / "deck.inp"
    nodes = "1, 0, 0, 0\n2, 1, 0, 0\n3, 0, 1, 0\n4, 0, 0, 1\n*ELEMENT, TYPE=C3D4\n1, 1, 2, 3, 4"
    part = f"*PART, NAME=A\n*NODE\n{nodes}\n*END PART\n"
    path.write_text("\n".join([f"{part}*INSTANCE, NAME=C, PART=A", *lines, "*END INSTANCE"]))
    with pytest.raises(DatasetError, match=LOST.format("INSTANCE")):
        read_mesh(path)


def test_a_comment_with_one_asterisk_before_a_keyword_loses_nothing(tmp_path):
    path = deck(
        tmp_path, "*NSET, NSET=A", "1, 2", "* end of the sets", "*BOUNDARY", "1, 1, 3", "*SHELL SECTION, ELSET=B", "1"
    )
    assert len(read_mesh(path).groups["A"]) == 2


@pytest.mark.parametrize("keyword", ["BOUNDARY", "SPRING", "MEMBRANE SECTION"])
def test_keywords_behind_elements_are_no_elements(tmp_path, keyword):
    path = deck(tmp_path, "*ELEMENT, TYPE=S3", "1001, 1, 2, 3", f"*{keyword}", "5, 1, 3, 0", "*", "** a comment")
    assert len(read_mesh(path).elements) == TETRAHEDRA


@pytest.mark.parametrize("kind", ["C3D99", "CIN3D8"])
def test_unknown_elements_are_refused_by_name(tmp_path, kind):
    with pytest.raises(DatasetError, match=rf"elements of the type {kind} are not known here"):
        read_mesh(deck(tmp_path, f"*ELEMENT, TYPE={kind}", "1001, 1, 2"))


@pytest.mark.parametrize("unset", [np.nan, 0.0])
@pytest.mark.parametrize("kind", ["frames", "clamp"])
def test_marks_that_are_not_a_number_mark_nothing(tmp_path, unset, kind):
    marked = PAD.rest_position[:, 2] == 0
    marks = np.where(marked, 1.0, unset)
    told = f"the field 'held' is NaN at {(~marked).sum()} nodes: they are not marked"
    if kind == "clamp":
        read = read_scene(
            meshio.Mesh(PAD.rest_position, [("tetra", PAD.elements)], {"held": marks}), clamps=["0:field=held"]
        )
        scene, notes = read.scene, read.notes
    else:
        for frame in range(2):
            fields = {"displacement": np.full((PAD.num_nodes, 3), 0.1 * frame), "held": marks}
            meshio.write(tmp_path / f"f{frame}.vtu", meshio.Mesh(PAD.rest_position, [("tetra", PAD.elements)], fields))
        read = read_series(tmp_path, FieldNames(handle="held"))
        scene, notes = read.scene, read.attributes.get("notes", "")
    assert np.array_equal(scene.node_type == NodeType.HANDLE, marked)
    assert (told in notes) == np.isnan(unset)


def two(gap: float) -> meshio.Mesh:
    """The pad, and a cube whose lower face lies so far above it."""
    cube = block(1, 1, 1)
    points = np.concatenate([PAD.rest_position, cube.rest_position + np.float32([0.5, 0.5, 1 + gap])])
    return meshio.Mesh(points, [("tetra", np.concatenate([PAD.elements, cube.elements + PAD.num_nodes]))])


@pytest.mark.parametrize(("gap", "depth"), [(-0.2, "0.2"), (-0.05, "0.05"), (-0.01, None), (0.01, None), (0.5, None)])
def test_bodies_in_each_other_at_rest_are_told_with_the_depth(gap, depth):
    """Depths below 2 % of the mean edge, which is 1.1 here, are left to rounding and to soft contact."""
    read = read_scene(two(gap), obstacles=[1], clamps=["0:zmin"])
    told = [text for text in read.warnings if "overlap" in text]
    assert len(told) == (depth is not None)
    assert depth is None or f"body 1 lies {depth} inside body 0 at the start" in told[0]


def test_convert_tells_of_bodies_in_each_other_and_strict_refuses_them(tmp_path, capsys):
    mesh = two(-0.2)
    (tmp_path / "r").mkdir()
    tool = (np.arange(len(mesh.points)) >= PAD.num_nodes).astype(float)
    for frame in range(2):
        mesh.point_data = {
            "displacement": -0.1 * frame * np.outer(tool, (0, 0, 1)),
            "tool": tool,
            "von_mises": tool + frame,
        }
        meshio.write(tmp_path / "r" / f"f{frame}.vtu", mesh)
    command = [
        "convert",
        str(tmp_path / "r"),
        "--out",
        str(tmp_path / "d.h5"),
        "--shares",
        "1",
        "0",
        "0",
        "--obstacle",
        "tool",
    ]
    assert cli.main([*command, "--strict"]) == 2
    assert "body 1 lies 0.2 inside body 0" in capsys.readouterr().err and not (tmp_path / "d.h5").exists()
    assert cli.main(command) == 0
    assert "body 1 lies 0.2 inside body 0 at the start" in capsys.readouterr().out


@pytest.mark.parametrize("line", ["18, 4,2, 0,5, 0", "18, 4,2, 0, 0", "18, -4,2E+00, 0, 1"])
def test_a_decimal_comma_in_a_coordinate_is_refused(tmp_path, line):
    path = deck(tmp_path)
    lines = path.read_text().splitlines()
    lines[18] = line
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(DatasetError, match="more entries than a number and three coordinates, and no decimal point"):
        read_mesh(path)


def test_normals_after_the_coordinates_are_no_decimal_commas(tmp_path):
    path = deck(tmp_path)
    lines = [f"{line}, 0., 0., 1." if 0 < row <= 18 else line for row, line in enumerate(path.read_text().splitlines())]
    path.write_text("\n".join(lines) + "\n")
    assert np.array_equal(read_mesh(path).points, PAD.rest_position)


def test_nested_includes_are_named_from_the_folder_of_the_first_file(tmp_path):
    """As Abaqus and CalculiX look for them; a file beside the including one counts where there is no other."""
    whole = deck(tmp_path).read_text()
    nodes, elements = whole[: whole.index("*ELEMENT")], whole[whole.index("*ELEMENT") :]
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "mesh.inp").write_text("*INCLUDE,\nINPUT=sub/nodes.inp\n*INCLUDE, INPUT=elements.inp\n")
    (tmp_path / "sub" / "nodes.inp").write_text(nodes)
    (tmp_path / "sub" / "elements.inp").write_text(elements.replace("C3D4", "C3D4, ELSET=beside"))
    (tmp_path / "job.inp").write_text("*INCLUDE, INPUT=sub/mesh.inp\n")
    read = read_mesh(tmp_path / "job.inp")
    assert np.array_equal(read.points, PAD.rest_position) and list(read.groups) == ["beside"]
    (tmp_path / "elements.inp").write_text(elements.replace("C3D4", "C3D4, ELSET=first"))
    assert list(read_mesh(tmp_path / "job.inp").groups) == ["first"]


def test_data_of_a_keyword_in_a_file_are_named_from_the_folder_of_the_first_file(tmp_path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "numbers.txt").write_text("1, 2, 3\n")
    (tmp_path / "sub" / "sets.inp").write_text("*NSET, NSET=few, INPUT=numbers.txt\n")
    assert len(read_mesh(deck(tmp_path, "*INCLUDE, INPUT=sub/sets.inp")).groups["few"]) == 3


@pytest.mark.parametrize(("line", "count"), [("5", 1), ("1, 9, 2, 4", 4)])
def test_a_set_is_generated_from_two_or_three_numbers(tmp_path, line, count):
    path = deck(tmp_path, "*NSET, NSET=some, GENERATE", line)
    with pytest.raises(DatasetError, match=rf"deck.inp:46: has {count} numbers?; must be the first, the last and"):
        read_mesh(path)


@pytest.mark.parametrize("before", ["", "\n"])
def test_a_rotation_is_not_taken_for_the_shift_of_an_instance(tmp_path, before):
    part = f"*PART, NAME=A\n{deck(tmp_path).read_text()}*END PART\n*ASSEMBLY, NAME=B\n*INSTANCE, NAME=C, PART=A\n"
    path = tmp_path / "turned.inp"
    path.write_text(f"{part}{before}1, 0, 0, 1, 0, 1, 90\n*END INSTANCE\n*END ASSEMBLY\n")
    with pytest.raises(DatasetError, match="the first line of .INSTANCE is its shift, three numbers: write 0, 0, 0"):
        read_mesh(path)


def test_a_node_has_a_number_of_at_least_1(tmp_path):
    """Coordinates in a line of their own are no node."""
    path = deck(tmp_path)
    path.write_text(path.read_text().replace("\n1, 0, 0, 0\n", "\n1,\n0, 0, 0\n"))
    with pytest.raises(DatasetError, match="deck.inp:3: the number of a node is 0; must be at least 1"):
        read_mesh(path)


@pytest.mark.parametrize(
    ("lines", "points"),
    [
        (["5, 0, 0"], [(5, 0, 0), (6, 0, 0), (5, 1, 0), (5, 0, 1)]),
        (["5, 0, 0,"], [(5, 0, 0), (6, 0, 0), (5, 1, 0), (5, 0, 1)]),
        (["5, 0, 0, 6, 0, 0"], [(5, 0, 0), (6, 0, 0), (5, 1, 0), (5, 0, 1)]),
        (["5, 0, 0, 5, 1, 7"], [(5, 0, 0), (5, 1, 0), (4, 0, 0), (5, 0, 1)]),
        (["5, 0, 0, 5, 0, 1", "5, 1, 0"], [(5, 0, 0), (5, 0, 1), (5, 1, 0), (4, 0, 0)]),
        (["0, 0, 5, 0, 0, 0"], [(0, 0, 5)]),
    ],
    ids=["shifted", "with a comma", "the same axes", "x projected", "two lines", "x along z"],
)
def test_nodes_are_given_in_a_system_of_their_own(tmp_path, lines, points):
    """The origin alone shifts; without a second line z stays, and the x axis is projected."""
    path = tmp_path / "a.inp"
    nodes = ["1, 0, 0, 0", "2, 1, 0, 0", "3, 0, 1, 0", "4, 0, 0, 1"]
    path.write_text("\n".join(["*SYSTEM", *lines, "*NODE", *nodes, "*ELEMENT, TYPE=C3D4", "1, 1, 2, 3, 4"]))
    if len(points) == 4:
        np.testing.assert_allclose(read_mesh(path).points, points, atol=1e-12)
    else:
        with pytest.raises(DatasetError, match="SYSTEM: its points lie on a line"):
            read_mesh(path)


@pytest.mark.parametrize(
    ("lines", "told"),
    [
        (["*NSET, NSET=A, NSET=B", "1"], "the option NSET stands twice, as 'A' and 'B'"),
        (["*ELEMENT, TYPE=C3D8, TYPE=C3D4", "99, 1, 2, 3, 4"], "the option TYPE stands twice, as 'C3D8' and 'C3D4'"),
        (["*NSET, NSET=A, N SET=a", "1"], "the option NSET stands twice, as 'A' and 'a'"),
    ],
)
def test_an_option_with_two_values_is_refused(tmp_path, lines, told):
    """The last one counted."""
    with pytest.raises(DatasetError, match=rf"deck.inp:\d+: {told}"):
        read_mesh(deck(tmp_path, *lines))
    assert read_mesh(deck(tmp_path, "*NSET, NSET=A, NSET=A", "1")).groups["A"].tolist() == [0]

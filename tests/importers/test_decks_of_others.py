"""What decks hold that other people have published: user elements over a drawn mesh, tools without a mesh, parameters,
quadrilaterals alone, options that nothing stands in, meshes that an instance repeats."""

import meshio
import numpy as np
import pytest

from ast_sim.importers.decks.deck_mesh import deck_mesh
from ast_sim.importers.mesh_file import read_mesh
from ast_sim.support.errors import DatasetError

# A cube of side 1: the nodes 1 to 8 in the order of C3D8.
CUBE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
NODES = ["*NODE", *(f"{1 + row}, {x}., {y}., {z}." for row, (x, y, z) in enumerate(CUBE))]
CELL = ["*ELEMENT, TYPE=C3D8, ELSET=ALL", "1, 1, 2, 3, 4, 5, 6, 7, 8"]


def write(folder, *lines):
    path = folder / "deck.inp"
    path.write_text("\n".join(lines) + "\n")
    return path


def volume(path):
    mesh = read_mesh(path)
    corners = mesh.points[mesh.elements]
    return np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 6


@pytest.mark.parametrize(
    "lines",
    [
        [],
        ["*SOLID SECTION, ELSET=ALL,, MATERIAL=M"],
        ["*PARAMETER", "young = 2.1e5", "load = -young / 1e3", "*MATERIAL, NAME=M", "*ELASTIC", "<young>, 0.3"],
        ["*ELEMENT, TYPE=HEATCAP, ELSET=H", "7, 1", "*HEATCAP, ELSET=H", "12.5,"],
        ["*BOUNDARY", "1, 1, 3", "*AQUA", "-10., 5., 9.81, 1025.", "*END"],
        ["*ELEMENT, TYPE=COH3D8", "2, 5, 6, 7, 8, 5, 6, 7, 8"],
        ["*ELSET, ELSET=S", "1", "*MEMBRANE, ELSET=P1, MATERIAL=M1", "        0."],
        [
            "*PARAMETER",
            "n = 8",
            "*USER ELEMENT, TYPE=U1, NODES=<n>",
            "*ELEMENT, TYPE=U1",
            "9, 1, 2, 3, 4, 5,",
            "6, 7, 8",
        ],
    ],
)
def test_what_does_not_change_the_mesh_leaves_it_as_it_is(tmp_path, lines):
    path = write(tmp_path, *NODES, *CELL, *lines)
    mesh = deck_mesh(path)
    assert [block.label for block in mesh.blocks] == ["C3D8"] and mesh.groups.keys() >= {"ALL"}
    assert len(mesh.points) == 8 and volume(path) == pytest.approx(1)


@pytest.mark.parametrize(
    ("lines", "told"),
    [
        (["*ELEMENT, TYPE=COH3D8", "2, 5, 6, 7, 8, 5, 6, 7, 8"], "1 element of the type COH3D8 is left out"),
        (
            ["*ELEMENT, TYPE=vu12", "8, 1, 2, 3, 4", "9, 1, 2, 3, 4, 5,", "6, 7, 8"],
            "2 elements of the user's own type VU12 are left out: others have their nodes",
        ),
        (
            [
                "*SURFACE, TYPE=SEGMENTS, NAME=Punch",
                "START, 0., 2.",
                "LINE, 1., 2.",
                "*Surface, type=Revolution, name=B",
            ],
            "2 rigid surfaces without elements are left out: Punch, B; a tool needs a mesh",
        ),
        (
            ["*RIGID SURFACE, TYPE=SEGMENTS", "START, 0., 2."],
            "1 rigid surface without elements is left out: of line 12",
        ),
        (["*SURFACE, TYPE=ELEMENT, NAME=Top", "ALL, S2"], None),
    ],
)
def test_what_is_left_out_is_told(tmp_path, lines, told):
    notes = "; ".join(deck_mesh(write(tmp_path, *NODES, *CELL, *lines)).notes)
    assert told in notes if told else "left out" not in notes


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (
            ["*NODE", "9, 0.5, 0.5, 2.", "*USER ELEMENT, TYPE=U1, NODES=5", "*ELEMENT, TYPE=U1", "2, 5, 6, 7, 8, 9"],
            "deck.inp:15: .*type U1 are the user's own, .* and 1 of their 5 nodes belong to no other element",
        ),
        (["*PARAMETER", "h = 2", "*NODE", "9, 0.5, 0.5, <h>"], "deck.inp:15: '<h>' is no number"),
        (["*ELEMENT, TYPE=C3D8", "1, 2, 1, 4, 3, 6, 5, 8, 7"], "element 1 stands in the deck twice, with different"),
        (["*PART, NAME=P", *NODES, "*END"], r"deck.inp:22: \*END: is this a short form"),
    ],
)
def test_what_would_change_the_mesh_is_refused(tmp_path, lines, message):
    with pytest.raises(DatasetError, match=message):
        deck_mesh(write(tmp_path, *NODES, *CELL, *lines))


def test_a_cube_with_two_numbers_behind_its_nodes_is_a_cube(tmp_path):
    """CalculiX does not read them either. A set of nodes with an option for results has its nodes."""
    path = write(tmp_path, *NODES, CELL[0], f"{CELL[1]}, 9, 10,", "*NSET, NSET=N, FREQUENCY=100", "1, 2")
    mesh = read_mesh(path)
    assert volume(path) == pytest.approx(1) and mesh.groups["N"].tolist() == [0, 1]
    told = "ignored keywords: ELEMENT (two numbers behind the nodes of each C3D8), NSET (its FREQUENCY)"
    assert told in mesh.notes


@pytest.mark.parametrize("rows", [["9, 10, 11"], ["9"], ["9, 10", "9"], ["9, 10", ""]])
def test_other_numbers_behind_the_nodes_are_refused(tmp_path, rows):
    """A line with another number of nodes may be of another type."""
    lines = [f"{row}{CELL[1][1:]}, {more}".rstrip(", ") for row, more in enumerate(rows, 1)]
    with pytest.raises(DatasetError, match=r"element \d has (9|1\d) nodes; its type has 8"):
        read_mesh(write(tmp_path, *NODES, CELL[0], *lines))


def test_a_comment_with_a_sign_before_it_may_be_the_first_line(tmp_path):
    path = write(tmp_path, ">** a cube", ">**", *NODES, *CELL)
    assert volume(path) == pytest.approx(1)
    for first in ("1, 0, 0, 0", "> ** a", "x** a", "8 6 1 0 0"):
        path = write(tmp_path, first, *NODES, *CELL)
        if first.startswith(">"):
            assert volume(path) == pytest.approx(1)
        else:
            with pytest.raises(DatasetError, match="deck.inp:1: a data line before the first keyword"):
                read_mesh(path)


def test_an_instance_that_repeats_the_mesh_of_its_part_has_it_once(tmp_path):
    part = ["*PART, NAME=P", *NODES, *CELL, "*END PART"]
    path = write(tmp_path, *part, "*INSTANCE, NAME=I, PART=P", *NODES, *CELL, "*END INSTANCE")
    mesh = read_mesh(path)
    assert len(mesh.points) == 8 and volume(path) == pytest.approx(1)
    assert "1 element that stands in the file twice is taken once" in mesh.notes


PLANE = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0], [1, 1, 0], [2, 1, 0], [3, 0, 0]], float)
QUADS = [[1, 2, 5, 4], [2, 3, 6, 5], [3, 7, 6, 6]]  # the last one is a triangle


@pytest.mark.parametrize("kind", ["CPE4R", "CPS4", "CAX4", "S4R"])
def test_quadrilaterals_alone_are_cut_into_triangles(tmp_path, kind):
    nodes = ["*NODE", *(f"{1 + row}, {x:g}, {y:g}" for row, (x, y, _) in enumerate(PLANE))]
    cells = [f"{1 + row}, {', '.join(map(str, cell))}" for row, cell in enumerate(QUADS)]
    mesh = read_mesh(write(tmp_path, *nodes, f"*ELEMENT, TYPE={kind}", *cells))
    a, b, c = np.moveaxis(mesh.points[mesh.elements], 1, 0)
    assert np.cross(b - a, c - a)[:, 2] / 2 == pytest.approx(np.full(5, 0.5))
    assert mesh.element_rows.tolist() == [0, 0, 1, 1, 2]
    assert "3 cells of the kind quad are cut into 5 triangles" in mesh.notes


def test_fields_of_quadrilaterals_beside_triangles_go_to_their_triangles():
    cells = [("triangle", np.array([[2, 6, 5]])), ("quad", np.array(QUADS[:2]) - 1)]
    mesh = read_mesh(meshio.Mesh(PLANE, cells, cell_data={"s": [np.array([7.0]), np.array([1.0, 2.0])]}))
    assert mesh.field("cell", "s").ravel().tolist() == [7, 1, 1, 2, 2]
    a, b, c = np.moveaxis(mesh.points[mesh.elements], 1, 0)
    assert np.cross(b - a, c - a)[:, 2].sum() / 2 == pytest.approx(2.5)

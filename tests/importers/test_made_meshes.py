"""Decks of Abaqus that make nodes and elements from others: *NGEN, *NFILL, *NCOPY, *ELGEN, *ELCOPY."""

import numpy as np
import pytest

from ast_sim.importers.decks.deck_mesh import deck_mesh
from ast_sim.importers.mesh_file import read_mesh
from ast_sim.support.errors import DatasetError

EDGES = {
    "C3D10": [(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)],
    "C3D15": [(0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3), (0, 3), (1, 4), (2, 5)],
    "C3D20": [
        *((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)),
    ],
    "CPS6": [(0, 1), (1, 2), (2, 0)],
    "CPS8": [(0, 1), (1, 2), (2, 3), (3, 0)],
}
CORNERS = {
    "C3D4": [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)],
    "C3D5": [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.4, 0.4, 1)],
    "C3D6": [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (0, 1, 1)],
    "C3D8": [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)],
    "CPS3": [(0, 0, 0), (1, 0, 0), (0, 1, 0)],
    "CPS4": [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)],
}
CORNERS |= {"C3D10": CORNERS["C3D4"], "C3D15": CORNERS["C3D6"], "C3D20": CORNERS["C3D8"]}
CORNERS |= {"CPS6": CORNERS["CPS3"], "CPS8": CORNERS["CPS4"]}
TRIANGLE = ["*NODE", "9001, 90., 0.", "9002, 91., 0.", "9003, 90., 1.", "*ELEMENT, TYPE=CPS3", "9001, 9001, 9002, 9003"]


def write(folder, *lines):
    path = folder / "deck.inp"
    path.write_text("\n".join(lines) + "\n")
    return path


def nodes(folder, *lines):
    """The nodes that a deck has beside a triangle far away: by number."""
    mesh = deck_mesh(write(folder, *TRIANGLE, *lines))
    return {n: p.tolist() for n, p in zip(mesh.same_point, mesh.points, strict=True) if n < 9000}, mesh.groups


def members(folder, name, *lines):
    mesh = deck_mesh(write(folder, *TRIANGLE, *lines))
    return mesh.same_point[mesh.groups[name]].tolist()


def test_nodes_lie_on_the_line_between_two_and_may_use_the_line_before(tmp_path):
    lines = ["*NODE", "1, 0., 0., 0.", "9, 4., 8., 0.", "*NGEN, NSET=ROW", "1, 9, 2", "3, 1", "1, 3"]
    lines[5:] = ["3, 5, 1"]
    made, _ = nodes(tmp_path, *lines)
    assert made[3] == [1, 2, 0] and made[7] == [3, 6, 0] and made[4] == [1.5, 3, 0] and len(made) == 6
    assert members(tmp_path, "ROW", *lines) == [1, 3, 4, 5, 7, 9]
    lines[4:] = ["9, 1, -4", "*NGEN", "5, 5"]
    assert nodes(tmp_path, *lines)[0] == {1: [0, 0, 0], 5: [2, 4, 0], 9: [4, 8, 0]}


@pytest.mark.parametrize(
    ("line", "system", "middle"),
    [
        ("1, 3, 1, 8", "", (1 + 2**0.5, 5 + 2**0.5)),
        ("1, 3, 1, , 1., 5., 0.", "", (1 + 2**0.5, 5 + 2**0.5)),
        ("1, 3, 1, , 5.0990195136, 78.690067526", ", SYSTEM=C", (1 + 2**0.5, 5 + 2**0.5)),
        ("1, 3, 1, , 1., 5., 0., 0., 0., 4.", "", (1 + 2**0.5, 5 + 2**0.5)),
        ("1, 3, 1, 8, , , , 0., 0., -1.", "", (1 - 2**0.5, 5 - 2**0.5)),
        ("1, 7, 3, 8, , , , 0., 0., 1.", "", (1, 7)),
        ("1, 6, 5, 8, , , , 0., 0., 1.", "", None),
    ],
)
def test_nodes_lie_on_an_arc(tmp_path, line, system, middle):
    ends = ["*NODE", "8, 1., 5.", "1, 3., 5.", "3, 1., 7.", "7, -1., 5.", "6, 3., 5."]
    made, _ = nodes(tmp_path, *ends, f"*NGEN, LINE=C{system}", line)
    for number in set(made) - {1, 3, 6, 7, 8}:
        assert made[number] == pytest.approx([*middle, 0], abs=1e-7)
    circle, _ = nodes(tmp_path, *ends, "*NODE", "101, 3., 5.", "*NGEN, LINE=C", "1, 101, 25, 8,,,,0,0,1")
    assert [circle[n] for n in (26, 51, 76)] == [pytest.approx(p) for p in ([1, 7, 0], [-1, 5, 0], [1, 3, 0])]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("", [1, 2, 3, 4, 5]),
        (", BIAS=0.5", [6 / 63, 18 / 63, 42 / 63, 90 / 63, 186 / 63]),
        (", BIAS=2.", [6 - x for x in (186 / 63, 90 / 63, 42 / 63, 18 / 63, 6 / 63)]),
        (", BIAS=0.5, TWO STEP", [3 / 7, 6 / 7, 12 / 7, 18 / 7, 30 / 7]),
    ],
)
def test_nodes_fill_the_lines_between_two_sets(tmp_path, options, expected):
    lines = ["*NODE, NSET=A", "1, 0., 0.", "2, 0., 1.", "*NODE, NSET=B", "61, 6., 0.", "62, 6., 1."]
    made, _ = nodes(tmp_path, *lines, f"*NFILL, NSET=ALL{options}", "A, B, 6, 10")
    assert [made[11 + 10 * row] for row in range(5)] == [pytest.approx([x, 0, 0]) for x in expected]
    assert [made[12 + 10 * row] for row in range(5)] == [pytest.approx([x, 1, 0]) for x in expected]
    assert len(made) == 14 and len(members(tmp_path, "ALL", *lines, "*NFILL, NSET=ALL", "A, B, 6, 10")) == 14


def test_an_unsorted_set_is_filled_in_its_order(tmp_path):
    lines = ["*NODE, NSET=A", "1, 0., 0.", "2, 0., 1.", "*NODE", "61, 6., 0.", "62, 6., 1.", "*NSET, NSET=ONE", "61"]
    filled = ["*NFILL", "A, B, 2, 10"]
    crossed, _ = nodes(tmp_path, *lines, "*NSET, NSET=B, UNSORTED", "62, ONE", *filled)
    assert crossed[11] == [3, 0.5, 0] and crossed[12] == [3, 0.5, 0]
    copied = ["*NCOPY, OLD SET=B, NEW SET=C, CHANGE NUMBER=100, SHIFT", "0., 0., 1."]
    crossed, _ = nodes(tmp_path, *lines, "*NSET, NSET=B, UNSORTED", "62, ONE", *copied, "*NFILL", "A, C, 2, 10")
    assert crossed[11] == [3, 0.5, 0.5]
    straight, _ = nodes(tmp_path, *lines, "*NSET, NSET=B", "62, ONE", *filled)
    assert straight[11] == [3, 0, 0] and straight[12] == [3, 1, 0]


@pytest.mark.parametrize(
    ("options", "data", "expected"),
    [
        ("SHIFT", ["10., 0., 1."], [(11, 2, 4), (10, 0, 1)]),
        ("SHIFT", ["10., 0., 0.", "0., 0., 0., 0., 0., 1., 90."], [(-2, 11, 3), (0, 10, 0)]),
        ("SHIFT, MULTIPLE=2", [",", "0., 0., 0., 0., 0., 1., 90."], [(-1, -2, 3), (0, 0, 0)]),
        ("REFLECT=POINT", ["1., 1., 1."], [(1, 0, -1), (2, 2, 2)]),
        ("REFLECT=LINE", ["5., 0., 0., 7., 0., 0."], [(1, -2, -3), (0, 0, 0)]),
        ("REFLECT=MIRROR", ["5., 0., 0., 5., 1., 0.", "5., 0., 1."], [(9, 2, 3), (10, 0, 0)]),
    ],
)
def test_a_set_of_nodes_is_copied(tmp_path, options, data, expected):
    lines = ["*NODE, NSET=A", "1, 1., 2., 3.", "2, 0., 0., 0.", "*NSET, NSET=A", "77"]
    copy = [f"*NCOPY, CHANGE NUMBER=100, OLD SET=A, NEW SET=B, {options}", *data]
    made, _ = nodes(tmp_path, *lines, *copy)
    assert [made[101], made[102]] == [pytest.approx(p, abs=1e-12) for p in expected] and len(made) == 4
    assert members(tmp_path, "B", *lines, *copy) == [101, 102]


BLOCK = [
    *("*NODE", "1, 0., 0., 0.", "3, 2., 0., 0.", "31, 0., 3., 0.", "33, 2., 3., 0."),
    *("*NGEN, NSET=FRONT", "1, 3", "*NGEN, NSET=BACK", "31, 33", "*NFILL, NSET=LOW", "FRONT, BACK, 3, 10"),
    *("*NCOPY, OLD SET=LOW, NEW SET=HIGH, CHANGE NUMBER=200, SHIFT", "0., 0., 4."),
    *("*NFILL, NSET=ALL", "LOW, HIGH, 2, 100"),
    *("*ELEMENT, TYPE=C3D8, ELSET=FIRST", "1, 1, 2, 12, 11, 101, 102, 112, 111"),
    *("*ELGEN, ELSET=CELLS", "1, 2, 1, 1, 3, 10, 2, 2, 100, 6"),
    *("*ELSET, ELSET=ROOF, GEN", "12, 7, -1", "*NSET, NSET=TOP, ELSET=ROOF"),
]


def test_elements_are_made_in_rows_and_layers(tmp_path):
    mesh = deck_mesh(write(tmp_path, *BLOCK))
    numbers = mesh.same_point
    assert len(mesh.points) == 36 and sum(len(block.nodes) for block in mesh.blocks) == 12
    last = mesh.blocks[-1].nodes[-1]  # element 12: the last in all directions
    assert numbers[last].tolist() == [122, 123, 133, 132, 222, 223, 233, 232]
    assert mesh.points[last].mean(axis=0).tolist() == [1.5, 2.5, 3]
    assert len(mesh.groups["CELLS"]) == 36 and len(mesh.groups["FIRST"]) == 8
    assert set(numbers[mesh.groups["TOP"]]) == {n for n in numbers if n > 100}
    read = read_mesh(tmp_path / "deck.inp")
    corners = read.points[read.elements]
    assert np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 6 == pytest.approx(24)


def test_a_part_that_is_made_so_stands_in_each_of_its_instances(tmp_path):
    part = ["*PART, NAME=P", *BLOCK, "*END PART", "*ASSEMBLY, NAME=A"]
    two = ["*INSTANCE, NAME=I, PART=P", "*END INSTANCE", "*INSTANCE, NAME=J, PART=P", "10., 0., 0.", "*END INSTANCE"]
    mesh = deck_mesh(write(tmp_path, *part, *two, "*NSET, NSET=T, INSTANCE=J", "TOP", "*END ASSEMBLY"))
    assert len(mesh.points) == 72 and sum(len(block.nodes) for block in mesh.blocks) == 24
    assert mesh.points[mesh.groups["T"]].min(axis=0).tolist() == [10, 0, 2]


@pytest.mark.parametrize("kind", CORNERS)
def test_copies_of_mirrored_elements_are_not_inside_out(tmp_path, kind):
    corners = np.array(CORNERS[kind], float)
    middles = [corners[list(edge)].mean(axis=0) for edge in EDGES.get(kind, [])]
    points = np.array([*corners, *middles])
    rows = [f"{1 + row}, {x}, {y}, {z}" for row, (x, y, z) in enumerate(points)]
    numbers = [str(1 + row) for row in range(len(points))]
    cell = [", ".join(["1", *numbers[:7]]) + "," * (len(points) > 7), *filter(None, [", ".join(numbers[7:])])]
    copy = ["*NCOPY, OLD SET=N, CHANGE NUMBER=50, REFLECT=MIRROR", "0., 0., 0., 0., 1., 0.", "0., 0., 1."]
    copied = ["*ELCOPY, OLD SET=E, NEW SET=F, ELEMENT SHIFT=7, SHIFT NODES=50, REFLECT"]
    lines = ["*NODE, NSET=N", *rows, f"*ELEMENT, TYPE={kind}, ELSET=E", *cell, *copy, *copied]
    mesh = deck_mesh(write(tmp_path, *lines))
    first, second = (mesh.points[block.nodes[0]] for block in mesh.blocks)
    for cell in (first, second):
        assert all(
            cell[len(corners) + row] == pytest.approx(cell[list(e)].mean(0))
            for row, e in enumerate(EDGES.get(kind, []))
        )
        square = kind in ("C3D5", "C3D8", "C3D20", "CPS4", "CPS8")
        apex = np.array([0, 0, 1.0]) if kind.startswith("CPS") else cell[4 if square else 3] - cell[0]
        other = cell[3 if square else 2]
        assert np.linalg.det([cell[1] - cell[0], other - cell[0], apex]) > 0
    assert second.mean(axis=0) == pytest.approx(first.mean(axis=0) * (-1, 1, 1))
    assert len(mesh.groups["F"]) == len(points)


def test_what_is_left_out_stays_so(tmp_path):
    beams = ["*NODE", "1, 0., 0.", "5, 4., 0.", "*NGEN", "1, 5", "*ELEMENT, TYPE=T3D2, ELSET=B", "1, 1, 2"]
    mesh = deck_mesh(write(tmp_path, *TRIANGLE, *beams, "*ELGEN, ELSET=B", "1, 4", "*ELSET, ELSET=C", "B"))
    assert "4 elements of the type T3D2 are left out" in mesh.notes and len(mesh.groups["B"]) == 0


@pytest.mark.parametrize(
    ("lines", "told"),
    [
        (["*NGEN", "1, 4, 2"], "steps of 2 do not lead from 1 to 4"),
        (["*NGEN", "1, 999999998"], "makes 999999997 of them; must be at most 20000000"),
        (["*NGEN", "1, 6"], "there is no node 6 before this line"),
        (["*NGEN", "1, 4, 1, 2"], "a straight line has no other point"),
        (["*NGEN, LINE=P", "1, 4, 1, 2"], "LINE=P is not understood"),
        (["*NGEN, LINE=C", "1, 3, 1, 2"], "the ends of the arc are 2 and 1 from its centre"),
        (["*NGEN, LINE=C", "1, 2, 1, 5"], "an arc of 180 degrees or more needs a normal"),
        (["*NGEN, LINE=C", "1, 2, 1, 5,,,,1.,0.,1."], "are no normal of the arc"),
        (["*NGEN, LINE=C", "1, 2, 1, 5, 1."], "has a node and coordinates for the centre"),
        (["*SYSTEM", "1., 0., 0.", "*NGEN, LINE=C", "1, 4, 1, 5"], "beside *SYSTEM"),
        (["*SYSTEM", "1., 0., 0.", "*NCOPY, OLD SET=A, CHANGE NUMBER=9, SHIFT", "1."], "beside *SYSTEM"),
        (["*NFILL", "A, B, 2, 10"], "the sets A and B have 2 and 1 nodes"),
        (["*NFILL", "A, C, 2, 10"], "there is no set of nodes 'C'"),
        (["*NFILL, BIAS=-1.", "A, A, 2, 10"], "BIAS=-1 of 2 intervals"),
        (["*NFILL, TWO STEP", "A, A, 3, 10"], "TWO STEP needs an even number"),
        (["*NFILL, SINGULAR=1", "A, A, 2, 10"], "the option SINGULAR is not understood"),
        (["*NFILL", "A, A, 2, -10"], "makes a node -9"),
        (["*NCOPY, OLD SET=A, SHIFT", "1."], "has no CHANGENUMBER="),
        (["*NCOPY, OLD SET=A, CHANGE NUMBER=9", "1."], "has no manner"),
        (["*NCOPY, OLD SET=A, CHANGE NUMBER=9, POLE", "1"], "has POLE"),
        (["*NCOPY, OLD SET=A, CHANGE NUMBER=9, SHIFT", "0., 0., 0., 0., 0., 1., 9."], "write 0, 0, 0 before"),
        (["*NCOPY, OLD SET=A, CHANGE NUMBER=9, REFLECT=MIRROR", "0., 0., 0., 1., 0., 0."], "MIRROR two"),
        (["*NCOPY, OLD SET=A, CHANGE NUMBER=9, REFLECT=LINE", "1., 0., 0., 1., 0., 0."], "lie at one place"),
        (["*ELGEN", "5, 2"], "there is no element 5 before this line"),
        (["*ELGEN", "9001, 2, 1, 1, 2"], "no steps to them"),
        (["*ELGEN", "9001, 2, 1, 1, 2, 1, 1, 1, 1, 1, 7"], "has 11 entries"),
        (["*ELGEN", "9001, 2"], "element 9002 refers to node 9004, which there is not"),
        (["*ELCOPY, OLD SET=E, ELEMENT SHIFT=1, SHIFT NODES=1"], "there is no set of elements 'E'"),
        (["*ELEMENT, TYPE=U1", "5, 1, 2, 3, 4", "*ELGEN", "5, 2"], "beside elements of a user's own"),
        (["*NGEN", "1, 4", "*a comment", "4, 5"], "the line after this one seems to belong to *NGEN"),
        (["*NMAP, NSET=A"], "changes the mesh and is not understood"),
    ],
)
def test_what_is_not_understood_is_refused_by_its_line(tmp_path, lines, told):
    given = ["*NODE", "1, 1., 0.", "2, -1., 0.", "3, -1., 1.", "4, 0., 1.", "5, 0., 0.", "999999998, 1., 1."]
    sets = ["*NSET, NSET=A", "1, 2", "*NSET, NSET=B", "3"]
    with pytest.raises(DatasetError, match=r"deck.inp:\d+: ") as error:
        deck_mesh(write(tmp_path, *TRIANGLE, *given, *sets, *lines))
    assert told in str(error.value)

"""One mesh, written as decks of many kinds: each comes in with the same nodes, elements and sets."""

import re

import numpy as np
import pytest
from data_samples import block

from ast_sim.importers.mesh_file import read_mesh
from ast_sim.importers.scene_mesh import read_scene
from ast_sim.scene import NodeType

PAD, CUBE = block(2, 2, 1), block(1, 1, 1)
PLACES = np.concatenate([PAD.rest_position * (5, 5, 4), CUBE.rest_position * 4 + (3, 3, 4.25)])
PLACES[0, 2] = -0.5  # one negative number, and one with an exponent
PLACES[1, 2] = 4.0625
CELLS = np.concatenate([PAD.elements, CUBE.elements + 18])  # the pad has 18 nodes and 24 elements, the cube 8 and 6
LEFT, RIGHT = (np.flatnonzero((np.arange(26) < 18) & (PLACES[:, 0] == end)) for end in (0, 10))
VOLUME = np.linalg.det(PLACES[CELLS[:, 1:]] - PLACES[CELLS[:, :1]]).sum() / 6

NODES = [f"{1 + row}, {x:g}, {y:g}, {z:g}" for row, (x, y, z) in enumerate(PLACES)]
ROWS = [", ".join(map(str, [1 + row, *(1 + cell)])) for row, cell in enumerate(CELLS)]


def numbers(rows):
    return ", ".join(str(1 + row) for row in rows)


PLATE = ["*ELEMENT, TYPE=C3D4, ELSET=PLATE", *ROWS[:24]]
PUNCH = ["*ELEMENT, TYPE=C3D4, ELSET=PUNCH", *ROWS[24:]]
SETS = ["*NSET, NSET=LEFT", numbers(LEFT), "*NSET, NSET=RIGHT", numbers(RIGHT)]
ENDS = ["*NSET, NSET=ENDS", numbers(LEFT), numbers(RIGHT)]
PLAIN = ["*NODE", *NODES, *PLATE, *PUNCH, *SETS, *ENDS]
BLOCKS = [["*NODE", *NODES[:18]], ["*NODE", *NODES[18:]]]
ODD = ["** ten", "**", "**1, 2, 3, 4, 5", "  ** indented, with commas", "", "***"]


def commented(lines):
    """A comment or an empty line before each line, all kinds of them in turn."""
    return [one for row, line in enumerate(lines) for one in (ODD[row % len(ODD)], line)]


def exponents(kind):
    """Coordinates as Fortran writes them, or C."""
    return ["*NODE", *(f"{1 + row}, {', '.join(kind(x) for x in place)}" for row, place in enumerate(PLACES))]


def in_fortran(x):
    return f"{x:.6E}".replace("E", "D")


def without_a_digit_before_the_point(x):
    mantissa, exponent = f"{x / 10:.6E}".split("E")
    return f"{float(mantissa) / 10:.6f}".replace("0.", ".") + f"d{int(exponent) + 2}"


def three_digits(x):
    return f"{x:.6E}".replace("E+", "+1").replace("E-", "-1").replace("+1", "+0").replace("-1", "-0")


def short(row, place, last=""):
    """A node whose last coordinates are left out if they are 0."""
    entries = [str(1 + row), *(f"{x:g}" for x in place)]
    while entries[-1] == "0":
        entries.pop()
    return ", ".join(entries) + last


GENERATED = [  # the ends of the pad are 1 to 6 and 13 to 18
    *("*NSET, NSET=LEFT, GENERATE", "1, 3, 1", "4, 6", "*NSET, GENERATE, NSET=RIGHT", "13, 17, 2", "14, 18, 2"),
    *("*NSET, NSET=ENDS, GENERATE", "1, 6, 1", "13, 18, 1"),
    *("*ELSET, ELSET=PLATE, GENERATE", "1, 23, 2", "2, 24, 2", "*ELSET, ELSET=PUNCH, GENERATE", "25, 27", "28, 30"),
]
UNNAMED = ["*ELEMENT, TYPE=C3D4", *ROWS[:16], "*ELEMENT, TYPE=C3D4", *ROWS[16:24]]
NAMED_LATER = ["*ELSET, ELSET=PLATE, GENERATE", "1, 24, 1", "*ELSET, ELSET=PUNCH", numbers(range(24, 30))]
NESTED = [
    *("*ELSET, ELSET=FIRST", numbers(range(12)), "*ELSET, ELSET=REST, GENERATE", "13, 24"),
    *("*ELSET, ELSET=PLATE", "FIRST, REST"),
]
WRAPPED = [part for row in ROWS for part in (row.rpartition(",")[0] + ",", row.rpartition(",")[2])]

DECKS = {
    "plain": PLAIN,
    "comments everywhere": commented(PLAIN),
    "a comment in elements": [*PLAIN[:40], "** ten", *PLAIN[40:]],
    "a comment in a set": ["*NODE", *NODES, *PLATE, *PUNCH, *SETS, ENDS[0], ENDS[1], "** and", ENDS[2]],
    "lines of GENERATE": [
        "*NODE",
        *NODES,
        *UNNAMED,
        PUNCH[0].partition(", E")[0],
        *PUNCH[1:],
        *GENERATED,
    ],
    "exponents with D": [*exponents(in_fortran), *PLATE, *PUNCH, *SETS, *ENDS],
    "exponents with d": [*exponents(without_a_digit_before_the_point), *PLATE, *PUNCH, *SETS, *ENDS],
    "exponents of three digits": [*exponents(three_digits), *PLATE, *PUNCH, *SETS, *ENDS],
    "one exponent with D": ["*NODE", *NODES[:1], NODES[1].replace("4.0625", "40.625D-01"), *NODES[2:], *PLAIN[27:]],
    "short lines": ["*NODE", *(short(*one) for one in enumerate(PLACES)), *PLAIN[27:]],
    "short lines with commas": ["*NODE", *(short(*one, ",") for one in enumerate(PLACES)), *PLAIN[27:]],
    "nothing between commas": ["*NODE", *(line.replace(", 0,", ",,") for line in NODES), *PLAIN[27:]],
    "hybrid elements": [line.replace("C3D4", "C3D4H") for line in PLAIN],
    "hybrid pad": [line.replace("C3D4, ELSET=PLATE", "C3D4H, ELSET=PLATE") for line in PLAIN],
    "a set of sets": [*PLAIN[: -len(ENDS)], "*NSET, NSET=ENDS", "LEFT, RIGHT"],
    "a set of sets in two lines": [*PLAIN[: -len(ENDS)], "*NSET, NSET=ENDS", "LEFT,", "RIGHT"],
    "a set of a set and numbers": [*PLAIN[: -len(ENDS)], "*NSET, NSET=ENDS", "LEFT, " + numbers(RIGHT)],
    "a set of sets of elements": ["*NODE", *NODES, *UNNAMED, *NESTED, *PUNCH, *SETS, *ENDS],
    "nodes, elements, nodes, elements": [*BLOCKS[0], *PLATE, *BLOCKS[1], *PUNCH, *SETS, *ENDS],
    "two blocks of nodes first": [*BLOCKS[0], *BLOCKS[1], *PLATE, *PUNCH, *SETS, *ENDS],
    "the other block first": [*BLOCKS[1], *BLOCKS[0], *PLATE, *PUNCH, *SETS, *ENDS],
    "a block for each node": [one for node in NODES for one in ("*NODE", node)] + PLAIN[27:],
    "nodes after elements": [*PLATE, *PUNCH, "*NODE", *NODES, *SETS, *ENDS],
    "named blocks of nodes": [
        *("*NODE, NSET=LEFT", *NODES[:6], "*NODE", *NODES[6:12], "*NODE, NSET=RIGHT", *NODES[12:18], *BLOCKS[1]),
        *(*PLATE, *PUNCH, *ENDS),
    ],
    "lower case": [line.lower() for line in PLAIN],
    "Abaqus/CAE's case": [re.sub(r"\b[A-Z]{3,}\b", lambda word: word[0].title(), line) for line in PLAIN],
    "type in lower case": [line.replace("C3D4", "c3d4") for line in PLAIN],
    "names in two cases": [*PLAIN[: -len(ENDS)], "*nset, nset=ENDS", "left, Right"],
    "unnamed blocks first": ["*NODE", *NODES, *UNNAMED, *PUNCH, "*ELSET, ELSET=PLATE, GENERATE", "1, 24", *SETS, *ENDS],
    "sets between blocks": [
        *("*NODE", *NODES, UNNAMED[0], *ROWS[:24], *NAMED_LATER[:2], UNNAMED[0], *ROWS[24:], *NAMED_LATER[2:]),
        *(*SETS, *ENDS),
    ],
    "elements in two lines": ["*NODE", *NODES, PLATE[0], *WRAPPED[:48], PUNCH[0], *WRAPPED[48:], *SETS, *ENDS],
    "all of it": commented(
        [
            *exponents(in_fortran)[:19],
            *("*element, type=c3d4h", *ROWS[:24], "*elset, elset=plate, generate", "1, 12", "13, 24"),
            *("*node", *(short(18 + row, place, ",") for row, place in enumerate(PLACES[18:]))),
            *("*element, type=c3d4h, elset=punch", *ROWS[24:], "*nset, nset=left, generate", "1, 5, 2", "2, 6, 2"),
            *("*nset, nset=Right", numbers(RIGHT), "*nset, nset=ENDS", "LEFT, RIGHT"),
        ]
    ),
}


@pytest.mark.parametrize("kind", DECKS)
def test_a_deck_of_any_kind_is_the_same_mesh(tmp_path, kind):
    path = tmp_path / "deck.inp"
    path.write_text("\n".join(DECKS[kind]) + "\n")
    mesh = read_mesh(path)
    np.testing.assert_allclose(mesh.points, PLACES, atol=1e-6)
    assert np.array_equal(mesh.elements, CELLS) and not mesh.notes
    corners = mesh.points[mesh.elements]
    assert np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 6 == pytest.approx(VOLUME, rel=1e-6)
    groups = {name.upper(): nodes.tolist() for name, nodes in mesh.groups.items()}
    expected = {"PLATE": range(18), "PUNCH": range(18, 26), "LEFT": LEFT, "RIGHT": RIGHT, "ENDS": [*LEFT, *RIGHT]}
    for name, nodes in expected.items():
        assert groups[name] == list(nodes), name
    read = read_scene(path, obstacles=[1], clamps=[f"0:group={next(n for n in mesh.groups if n.upper() == 'ENDS')}"])
    assert np.bincount(read.scene.body).tolist() == [18, 8]
    assert np.flatnonzero(read.scene.node_type == NodeType.HANDLE).tolist() == [*LEFT, *RIGHT]


CORNERS = {
    "tetra": [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)],
    "wedge": [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (0, 1, 1)],
    "hexahedron": [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)],
}
EDGES = {
    "tetra": "01 12 20 03 13 23",
    "wedge": "01 12 20 34 45 53 03 14 25",
    "hexahedron": "01 12 23 30 45 56 67 74 04 15 26 37",
}


@pytest.mark.parametrize(
    ("kind", "shape", "volume"),
    [
        *[(kind, "tetra", 1 / 6) for kind in ("C3D4H", "c3d4h", "C3D10H", "C3D10MH", "C3D10HS", "C3D10MHT")],
        *[(kind, "wedge", 1 / 2) for kind in ("C3D6H", "C3D15H")],
        *[(kind, "hexahedron", 1) for kind in ("C3D8H", "C3D8RH", "C3D8IH", "C3D8RHT", "C3D20H", "C3D20RH")],
    ],
)
def test_hybrid_elements_have_the_shape_of_the_others(tmp_path, kind, shape, volume):
    """With the pressure as an unknown, as rubber needs them; the letters stand behind the number of nodes."""
    corners = np.array(CORNERS[shape], float)
    middles = [(corners[int(a)] + corners[int(b)]) / 2 for a, b in EDGES[shape].split()]
    count = int(re.findall("[0-9]+", kind)[1])
    places = [*corners, *middles][:count]
    assert len(places) == count
    lines = ["*NODE", *(f"{1 + row}, {x}, {y}, {z}" for row, (x, y, z) in enumerate(places))]
    cell = [str(one) for one in [1, *range(1, 1 + count)]]
    lines += [
        f"*ELEMENT, TYPE={kind}, ELSET=ALL",
        ", ".join(cell[:16]) + ("," if cell[16:] else ""),
        ", ".join(cell[16:]),
    ]
    (tmp_path / "deck.inp").write_text("\n".join(lines) + "\n")
    mesh = read_mesh(tmp_path / "deck.inp")
    ends = mesh.points[mesh.elements[:, :4]]
    assert np.linalg.det(ends[:, 1:] - ends[:, :1]).sum() / 6 == pytest.approx(volume)
    assert mesh.elements.shape[1] == (10 if kind.upper().startswith("C3D10") else 4)
    assert mesh.groups["ALL"].tolist() == list(range(count))

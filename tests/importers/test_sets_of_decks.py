"""Sets of decks that hold other sets, nodes of elements among them, and lines of decks that name no file or no part."""

import numpy as np
import pytest
from data_samples import block

from ast_sim.importers.mesh_file import read_mesh
from ast_sim.support.errors import DatasetError

CUBE = block(1, 1, 1)
NODES = [f"{1 + row}, {x:g}, {y:g}, {z:g}" for row, (x, y, z) in enumerate(CUBE.rest_position)]
CELLS = [", ".join(map(str, [1 + row, *(1 + cell)])) for row, cell in enumerate(CUBE.elements)]
OF_FIRST = sorted(CUBE.elements[0].tolist())
MESH = ["*NODE", *NODES, "*ELEMENT, TYPE=C3D4", *CELLS, "*ELSET, ELSET=one", "1", "*NSET, NSET=of one, ELSET=one"]
PLACED = ["*ASSEMBLY, NAME=a", "*INSTANCE, NAME=low, PART=cube", "*END INSTANCE"]
TWO = [*PLACED, "*INSTANCE, NAME=high, PART=cube", "0, 0, 2", "*END INSTANCE"]
PARTS = ["*PART, NAME=cube", *MESH, "*END PART", *TWO]


def read(folder, *lines):
    path = folder / "deck.inp"
    path.write_text("\n".join(lines) + "\n")
    return read_mesh(path)


@pytest.mark.parametrize(
    ("lines", "nodes"),
    [
        (["*NSET, NSET=a", "of one"], OF_FIRST),
        (["*NSET, NSET=a", "of one, 8"], sorted({*OF_FIRST, 7})),
        (["*NSET, NSET=a", "OF ONE", "*NSET, NSET=a", "8"], sorted({*OF_FIRST, 7})),
        (["*NSET, NSET=b", "of one", "*NSET, NSET=a", "b"], OF_FIRST),
        (["*ELSET, ELSET=two", "one", "*NSET, NSET=a, ELSET=two"], OF_FIRST),
        (["*NSET, NSET=a", "of one", "*NSET, NSET=of one", "8"], OF_FIRST),
        (["*NSET, NSET=a, ELSET=one", "*ELSET, ELSET=one", "2"], OF_FIRST),
        (["*NSET, NSET=a", "OfOne"], OF_FIRST),
        (["*NSET, NSET=a", '"of one"'], OF_FIRST),
        (["*ELSET, ELSET=o n e 2", "1", "*NSET, NSET=a, ELSET=one2"], OF_FIRST),
        (["*NSET, NSET=ofone", "8", "*NSET, NSET=a", "ofone"], [7]),
        (["*NSET, NSET=ofone", "8", "*NSET, NSET=a", "of one"], OF_FIRST),
    ],
    ids=[
        *(
            "a set",
            "and a node",
            "in two lines",
            "a set of a set",
            "a set of elements",
            "later nodes",
            "later elements",
        ),
        *("without spaces", "in quotes", "elements without spaces", "one without", "one with spaces"),
    ],
)
def test_a_set_has_what_the_sets_in_it_have_at_its_line(tmp_path, lines, nodes):
    assert read(tmp_path, *MESH, *lines).groups["a"].tolist() == nodes


@pytest.mark.parametrize(
    ("lines", "instances"),
    [
        (["*NSET, NSET=a, INSTANCE=high", "of one"], [1]),
        (["*NSET, NSET=a", "high.of one"], [1]),
        (["*NSET, NSET=a", "low.of one, high.of one"], [0, 1]),
        (["*NSET, NSET=a, INSTANCE=high, ELSET=one"], [1]),
        (["*NSET, NSET=a, ELSET=high.one"], [1]),
        (["*ELSET, ELSET=b, INSTANCE=low", "one", "*NSET, NSET=a, ELSET=b"], [0]),
        (["*NSET, NSET=a", "high.ofone"], [1]),
        (["*NSET, NSET=a, INSTANCE=h igh", "of one"], [1]),
    ],
)
def test_nodes_of_elements_of_an_instance_are_a_set(tmp_path, lines, instances):
    group = read(tmp_path, *PARTS, *lines, "*END ASSEMBLY").groups["a"]
    assert group.tolist() == [8 * instance + node for instance in instances for node in OF_FIRST]


@pytest.mark.parametrize("lines", [["*NSET, NSET=a, ELSET=one", "8"], ["*NSET, NSET=a, ELSET=one, GENERATE", "1, 3"]])
def test_a_set_of_elements_beside_numbers_of_nodes_is_refused(tmp_path, lines):
    with pytest.raises(
        DatasetError, match=r"deck.inp:\d+: \*NSET: has ELSET= and lines of data, and one of them would"
    ):
        read(tmp_path, *MESH, *lines)


@pytest.mark.parametrize(("line", "kind"), [("*NSET, NSET=a, ELSET=two", "elements"), ("*NSET, NSET=a\none", "nodes")])
def test_a_set_that_there_is_not_is_named_with_its_kind(tmp_path, line, kind):
    with pytest.raises(DatasetError, match=f"there is no set of {kind} '(two|one)' before this line"):
        read(tmp_path, *MESH, line)


@pytest.mark.parametrize(
    "line", ["*INCLUDE INPUT=more.inp", "*Include: more.inp", "* include", "*INCLUDE, FILE=more.inp"]
)
def test_an_include_that_names_no_file_is_refused(tmp_path, line):
    """CalculiX and Abaqus stop there; passed over, the elements of the file would be missing."""
    (tmp_path / "more.inp").write_text("*ELEMENT, TYPE=C3D4\n101, 1, 2, 3, 5\n")
    with pytest.raises(DatasetError, match=r"names no file: write \*INCLUDE, INPUT=FILE"):
        read(tmp_path, *MESH, line)


def test_a_part_without_an_instance_is_told(tmp_path):
    spare = ["*PART, NAME=Spare", *MESH, "*END PART"]
    mesh = read(tmp_path, *spare, *PARTS, "*END ASSEMBLY")
    assert len(mesh.elements) == 12
    assert "the part Spare has no instance: its 6 elements are left out" in mesh.notes
    assert not any("no instance" in note for note in read(tmp_path, *PARTS, "*END ASSEMBLY").notes)


@pytest.mark.parametrize(("kind", "told"), [("CAX3", True), ("cgax3", True), ("DCAX3", True), ("CPE3", False)])
def test_a_section_of_a_body_of_revolution_is_told(tmp_path, kind, told):
    mesh = read(tmp_path, "*NODE", "1, 1, 0", "2, 2, 0", "3, 1, 1", f"*ELEMENT, TYPE={kind}", "1, 1, 2, 3")
    assert np.array_equal(mesh.elements, [[0, 1, 2]])
    assert ("1 element is a section of a body of revolution: taken as a plane" in mesh.notes) == told


@pytest.mark.parametrize(
    ("lines", "nodes", "told"),
    [
        (["*NSET, NSET=one", "8"], [7], ["the set 'one' of nodes is taken, not the one of elements"]),
        (["*NSET, NSET=one, ELSET=one"], OF_FIRST, []),
    ],
    ids=["others", "the same"],
)
def test_of_two_sets_of_one_name_the_nodes_are_taken_with_a_note(tmp_path, lines, nodes, told):
    mesh = read(tmp_path, *MESH, *lines)
    assert mesh.groups["one"].tolist() == nodes and mesh.notes == told


def test_a_set_with_the_name_of_an_instance_is_taken_with_a_note(tmp_path):
    mesh = read(tmp_path, *PARTS, "*NSET, NSET=high", "low.1, high.1", "*END ASSEMBLY")
    assert mesh.groups["high"].tolist() == [0, 8] and mesh.groups["low"].tolist() == [*range(8)]
    assert mesh.notes == ["the set 'high' is taken, not the instance of this name"]


@pytest.mark.parametrize(
    ("old", "new"), [("1, 0, 0, 0", "1, <left>, 0, 0"), ("1, 0, 0, 0", "<n>, 0, 0, 0")], ids=["coordinate", "number"]
)
def test_values_of_parameters_are_refused_as_these(tmp_path, old, new):
    lines = [new if line == old else line for line in MESH]
    with pytest.raises(DatasetError, match=r"'<\w+>' is no (whole )?number: it stands for a value of \*PARAMETER"):
        read(tmp_path, "*PARAMETER", "left = 0", "n = 1", *lines)

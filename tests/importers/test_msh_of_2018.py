"""Gmsh's format 4.0, which Gmsh 4.0 and deal.II wrote: text and binary, with parametric nodes and partitions."""

import struct

import pytest

from ast_sim.importers.mesh_file import read_mesh
from ast_sim.support.errors import DatasetError

# A tetrahedron in the entity 5 of dimension 3, a triangle in the entity 3 of dimension 2, and a point.
NAMES = ["$PhysicalNames", "2", '2 8 "wall"', '3 7 "solid"', "$EndPhysicalNames"]
ENTITIES = ["1 0 1 1", "4 0 0 1 0 0 1 1 9", "3 0 0 0 1 1 0 1 8 0", "5 0 0 0 1 1 1 2 7 6 1 3"]
PARTS = [
    "2",
    "1",
    "6 2",
    "1 0 1 1",
    "14 0 4 1 1 0 0 1 0 0 1 1 9",
    "13 2 3 2 1 2 0 0 0 1 1 0 1 8 0",
    "15 3 5 1 2 0 0 0 1 1 1 2 7 6 1 13",
]
NODES = [
    (4, 0, 0, [(40, 0, 0, 1)]),
    (3, 2, 1, [(30, 0, 0, 0, 0.1, 0.2), (10, 1, 0, 0, 0.1, 0.2)]),
    (5, 3, 0, [(20, 0, 1, 0)]),
]
ELEMENTS = [(4, 0, 15, [(1, 40)]), (3, 2, 2, [(2, 30, 20, 10)]), (5, 3, 4, [(3, 30, 10, 20, 40)])]


def section(name, lines):
    return "\n".join([f"${name}", *lines, f"$End{name}", ""])


def text(shift=0):
    """The file; with a `shift` the entities are parts, whose numbers are larger by it."""
    lines = [section("MeshFormat", ["4 0 8"]), "\n".join([*NAMES, ""]), section("Entities", ENTITIES)]
    if shift:
        lines.append(section("PartitionedEntities", PARTS))
    nodes, elements = ["3 4"], ["3 3"]
    for rows, blocks in ((nodes, NODES), (elements, ELEMENTS)):
        for entity, dimension, kind, entries in blocks:
            rows.append(f"{entity + shift} {dimension} {kind} {len(entries)}")
            rows += [" ".join(map(str, entry)) for entry in entries]
    return "".join([*lines, section("Nodes", nodes), section("Elements", elements)]).encode()


def binary(order):
    def packed(kinds, *values):
        return struct.pack(order + kinds, *values)

    def ints(*values):
        return packed(f"{len(values)}i", *values)

    def box(count):
        return packed(f"{count}d", *[0.0] * count)

    entities = [packed("4Q", 1, 0, 1, 1), ints(4), box(6), packed("Qi", 1, 9), ints(3), box(6), packed("QiQ", 1, 8, 0)]
    entities += [ints(5), box(6), packed("QiiQi", 2, 7, 6, 1, 3)]  # nothing is aligned where the order is given
    nodes = [packed("2Q", 3, 4)]
    for *head, rows in NODES:
        nodes += [
            ints(*head),
            packed("Q", len(rows)),
            *(ints(row[0]) + packed(f"{len(row) - 1}d", *row[1:]) for row in rows),
        ]
    cells = [packed("2Q", 3, 3)]
    for *head, rows in ELEMENTS:
        cells += [ints(*head), packed("Q", len(rows)), *(ints(*row) for row in rows)]
    named = {"Entities": entities, "Nodes": nodes, "Elements": cells}
    parts = [f"${name}\n".encode() + b"".join(values) + f"\n$End{name}\n".encode() for name, values in named.items()]
    start = b"$MeshFormat\n4 1 8\n" + ints(1) + b"\n$EndMeshFormat\n" + "\n".join([*NAMES, ""]).encode()
    return start + b"".join(parts)


@pytest.mark.parametrize(
    "content",
    [text(), text().replace(b"\n", b"\r\n"), text().replace(b"4 0 8", b"4.0 0 8"), text(10), binary("<"), binary(">")],
    ids=["text", "windows", "4.0", "parts", "little", "big"],
)
def test_points_elements_and_groups_come_in(tmp_path, content):
    path = tmp_path / "mesh.msh"
    path.write_bytes(content)
    mesh = read_mesh(path)
    at = dict(zip(mesh.source.same_point.tolist(), mesh.source.points.tolist(), strict=True))
    assert at == {40: [0, 0, 1], 30: [0, 0, 0], 10: [1, 0, 0], 20: [0, 1, 0]}
    assert mesh.points[mesh.elements[0]].tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    members = {name: {int(mesh.source.same_point[n]) for n in nodes} for name, nodes in mesh.groups.items()}
    assert members == {"wall": {10, 20, 30}, "solid": {10, 20, 30, 40}, "6": {10, 20, 30, 40}, "9": {40}}


def test_what_is_cut_off_or_of_format_3_is_refused(tmp_path):
    path = tmp_path / "mesh.msh"
    for content, told in (
        (text().replace(b"3 4\n4 0 0 1", b"3 5\n4 0 0 1"), "it says that it holds 5 nodes, but there are 4"),
        (text()[: text().index(b"$EndElements")], "has no end"),
        (text().replace(b"4 0 8", b"3 0 8"), "is of Gmsh's format 3"),
    ):
        path.write_bytes(content)
        with pytest.raises(DatasetError, match=told):
            read_mesh(path)

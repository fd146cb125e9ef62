"""Meshes as text of MFEM, GiD and FreeFem."""

import numpy as np
import pytest

from ast_sim.importers.frames_in_file import only_frame
from ast_sim.importers.mesh_file import read_mesh
from ast_sim.support.errors import DatasetError

POINTS = [
    (0, 0, 0),
    (1, 0, 0),
    (0, 1, 0),
    (0, 0, 1),
    (2, 0, 0),
    (2, 1, 0),
    (1, 1, 0),
    (1, 0, 1),
    (2, 0, 1),
    (2, 1, 1),
    (1, 1, 1),
]
CUBE = (1, 4, 5, 6, 7, 8, 9, 10)
ROWS = "\n".join(f"{x} {y} {z}" for x, y, z in POINTS)
MFEM = f"""MFEM mesh v1.0

# a comment
dimension
3

elements
2
5 4 0 1 2 3
6 5 {" ".join(map(str, CUBE))} # the cube

boundary
3
8 2 0 2 1
8 2 0 1 3
9 3 4 5 9 8

vertices
11
"""
NODES = "\nnodes\nFiniteElementSpace\nFiniteElementCollection: {kind}\nVDim: 3\nOrdering: {order}\n\n"
BY_AXIS = "\n".join(" ".join(str(p[axis]) for p in [*POINTS, (9, 9, 9)]) for axis in range(3))
GID = f"""# made by GiD
MESH "soft part" dimension 3 ElemType Tetrahedra Nnode 4
Coordinates
{chr(10).join(f"{10 * n} {row}" for n, row in enumerate(ROWS.splitlines(), 1))}
End Coordinates
Elements
1 10 20 30 40 3
end elements
MESH dimension 3 ElemType Hexahedra Nnode 8
Coordinates
end coordinates
Elements
2 {" ".join(str(10 + 10 * n) for n in CUBE)}
end elements
"""
FREEFEM = f"""11 1 2
{chr(10).join(f"{row} 0" for row in ROWS.splitlines())}
1 2 3 4 7
1 3 2 5
1 2 4 6
"""


def written(folder, name, text):
    (folder / name).write_text(text)
    return folder / name


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.mesh", MFEM + "3\n" + ROWS),
        ("a.mesh", MFEM.replace("\n", "\r\n") + "3\r\n" + ROWS + "\nmfem_mesh_end\n"),
        ("a.mesh", MFEM.replace("v1.0", "v1.2") + NODES.format(kind="Linear", order=1) + ROWS + "\n\nmfem_mesh_end\n"),
        ("a.mesh", MFEM + NODES.format(kind="H1_3D_P2", order=0) + BY_AXIS),
        ("a.msh", GID),
        ("a.msh", GID.upper()),
        ("a.msh", GID.replace("\nMESH", "\n\n mesh").replace("3 ElemType", "3  elemtype")),
    ],
)
def test_points_and_cells_are_the_ones_of_the_file(tmp_path, name, text):
    path = written(tmp_path, name, text)
    mesh = only_frame(path)
    assert mesh.points.tolist() == [list(map(float, p)) for p in POINTS]
    cells = {block.kind: block.nodes.tolist() for block in mesh.blocks}
    assert cells["tetra"] == [[0, 1, 2, 3]] and cells["hexahedron"] == [list(CUBE)]
    read = read_mesh(path)
    corners = read.points[read.elements]
    assert np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 6 == pytest.approx(7 / 6)
    groups = {key.lower(): nodes.tolist() for key, nodes in mesh.groups.items()}
    if name == "a.mesh":
        assert groups == {"boundary 8": [0, 1, 2, 3], "boundary 9": [4, 5, 8, 9]}
        assert mesh.cell_fields["attribute"][0].tolist() == [5] and mesh.cell_fields["attribute"][1].tolist() == [6]
    else:
        assert groups == {"soft part": [0, 1, 2, 3]}
    assert mesh.notes == (
        ["1 point within curved elements is left out: the corners are taken"] if "_P2" in text else []
    )


def test_freefem_in_space_and_in_the_plane(tmp_path):
    mesh = only_frame(written(tmp_path, "a.msh", FREEFEM))
    assert mesh.points.tolist() == [list(map(float, p)) for p in POINTS]
    assert mesh.blocks[0].nodes.tolist() == [[0, 1, 2, 3]] and mesh.cell_fields["label"][0].tolist() == [7]
    assert {name: nodes.tolist() for name, nodes in mesh.groups.items()} == {
        "boundary 5": [0, 1, 2],
        "boundary 6": [0, 1, 3],
    }
    flat = read_mesh(written(tmp_path, "a.msh", "3 1 1\n0 0 1\n2 0 1\n0 1.5 2\n1 2 3 0\n2 3 4\n"))
    assert flat.points.tolist() == [[0, 0, 0], [2, 0, 0], [0, 1.5, 0]] and flat.elements.tolist() == [[0, 1, 2]]
    assert flat.groups["boundary 4"].tolist() == [1, 2]


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("a.mesh", MFEM.replace("mesh v1.0", "NURBS mesh v1.0"), "is of the format MFEM NURBS mesh v1.0; must be"),
        ("a.mesh", MFEM + NODES.format(kind="L2_T1_3D_P1", order=1) + ROWS, "do not share points .L2_T1_3D_P1."),
        ("a.mesh", MFEM + "3\n" + ROWS[:-6], "it is damaged"),
        ("a.mesh", MFEM + "3\n" + ROWS + "\n1 1 1\n", "has a section '1'"),
        ("a.mesh", MFEM, "it says that it holds 11 vertices, but there are 0"),
        ("a.mesh", MFEM.replace("5 4 0 1 2 3", "5 4 0 1 2 33") + "3\n" + ROWS, "refers to a point that there is not"),
        ("a.mesh", MFEM.replace("5 4 0 1 2 3", "5 4 0 1 2") + "3\n" + ROWS, "it is damaged"),
        ("a.mesh", MFEM.replace("5 4 0 1 2 3", "5 -1 0 1 2 3 4") + "3\n" + ROWS, "it is damaged: -1"),
        ("a.msh", GID.replace("\n20 ", "\n10 "), "a point has the number of another one"),
        ("a.msh", GID.replace("Tetrahedra", "Sphere"), "has the line 'MESH .*Sphere.*, which is not read"),
        ("a.msh", GID.replace("1 10 20 30 40 3", "1 10 20 30 40 3 9"), "element 1 has 6 entries behind its number"),
        ("a.msh", GID[: GID.index("end elements")], "it ends early"),
        ("a.msh", GID.replace("end coordinates", "Result"), "it is damaged"),
        ("a.msh", FREEFEM[:-8], "it says that it holds 14 points and cells, but there are 13"),
        ("a.msh", FREEFEM.replace("1 2 3 4 7", "1 2 3 44 7"), "refers to a point that there is not"),
    ],
)
def test_what_is_damaged_or_of_another_kind_is_refused(tmp_path, name, text, told):
    with pytest.raises(DatasetError, match=told) as error:
        read_mesh(written(tmp_path, name, text))
    assert "damaged: /" not in str(error.value)

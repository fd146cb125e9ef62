"""Bodies that lie in each other although no node of one lies inside the other and no edge cuts a face: their faces lie
on each other, with both bodies on one side."""

import meshio
import numpy as np
import pytest
from simulate.own_assembly.assemblies import SPEC, box, case_of, write_assembly, write_box

from ast_sim import read_scene
from ast_sim.simulate.own_assembly.rest_check import BadAssembly

CUBE = (0, 0, 0), (6, 6, 6), (1, 1, 1)


def warnings_of(*boxes):
    points, elements = [], []
    for low, high, cells in boxes:
        position, tetrahedra = box(low, high, cells)
        elements.append(tetrahedra + sum(map(len, points)))
        points.append(position)
    mesh = meshio.Mesh(np.concatenate(points), [("tetra", np.concatenate(elements))])
    return [text for text in read_scene(mesh, obstacles=[1], clamps=["0:zmin"]).warnings if "overlap" in text]


@pytest.mark.parametrize(
    "other",
    [
        ((0, 0, 0), (6, 6, 6), (1, 1, 1)),
        ((0, 0, 0), (6, 6, 6), (2, 3, 2)),
        ((0, 0, 3), (6, 6, 6), (1, 1, 1)),
        ((0, 0, 0), (3, 3, 6), (1, 1, 1)),
    ],
    ids=["the same mesh", "another mesh", "the upper half", "a quarter"],
)
def test_bodies_at_one_place_are_told(other):
    (told,) = warnings_of(CUBE, other)
    assert "body 1 stands where body 0 stands, wholly or in part, at the start" in told or "cuts body 0" in told


@pytest.mark.parametrize(
    "other",
    [((0, 0, 6), (6, 6, 9), (1, 1, 1)), ((0, 0, 6), (6, 6, 6.01), (2, 2, 1)), ((6, 0, 0), (9, 6, 6), (1, 1, 1))],
    ids=["on it", "a foil on it", "beside it"],
)
def test_bodies_that_touch_with_whole_faces_do_not_overlap(other):
    assert not warnings_of(CUBE, other) and not warnings_of(other, CUBE)


def test_parts_of_an_assembly_at_one_place_are_refused_as_that(tmp_path):
    """The depth that is left after their surfaces were set back would say less."""
    path = write_assembly(tmp_path, SPEC.replace("contact_distance = 0.05\n", ""))
    write_box(tmp_path / "punch.vtu", (0, 0, 0), (10, 10, 5), (3, 3, 2))
    with pytest.raises(BadAssembly, match="block and punch stand at the same place, wholly or in part, around"):
        case_of(path, travel=1.0)

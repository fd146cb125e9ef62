"""Broken meshes and surfaces are refused with a line that says what and where; sound ones pass."""

import re

import numpy as np
import pytest

from ast_sim.element_topology import turned_over
from ast_sim.simulate.shapes.mesh import second_order
from ast_sim.simulate.shapes.mesh_check import BadMesh, boundary, check_mesh, check_surface, smallest_dihedral
from ast_sim.simulate.shapes.parts import oriented, rectilinear, volumes


def block(cells: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """A cube of side 10 around (5, 5, 5)."""
    return rectilinear([np.linspace(0, 10, cells + 1)] * 3)


def refusal(check, *arguments) -> str:
    with pytest.raises(BadMesh) as caught:
        check(*arguments, "thing.msh")
    text = str(caught.value)
    assert text.startswith("thing.msh: ") and "\n" not in text
    return text


def points_in(text: str) -> np.ndarray:
    """The points that a text names."""
    return np.array(
        [[float(x) for x in found.split(",")] for found in re.findall(r"\(([^()[]*,[^()[]*,[^()[]*)\)", text)]
    )


def test_sound_ones_pass():
    position, elements = block()
    check_mesh(position, elements, "block")
    check_surface(position, boundary(elements), "block")
    check_mesh(1e-4 * position + 7, elements, "small block")
    check_surface(1e4 * position, boundary(elements), "large block")


def test_no_elements():
    position, _ = block()
    assert "no tetrahedra" in refusal(check_mesh, position, np.zeros((0, 4), int))
    assert "no triangles" in refusal(check_surface, position, np.zeros((0, 3), int))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_positions_that_are_not_finite(value):
    position, elements = block()
    position[5, 1] = value
    assert "position of node 5 is not finite" in refusal(check_mesh, position, elements)
    assert "not finite" in refusal(check_surface, position, boundary(elements))


def test_too_many_nodes(monkeypatch):
    monkeypatch.setattr("ast_sim.simulate.shapes.mesh_check.MOST_NODES", 20)
    assert "27 nodes, more than the 20" in refusal(check_mesh, *block())


def test_two_nodes_at_one_place():
    position, elements = block()
    position[20] = position[3]
    text = refusal(check_mesh, position, elements)
    assert "the first 3 and 20" in text
    assert np.allclose(points_in(text), [position[3]])


def test_inverted_tetrahedra():
    position, elements = block()
    elements[[4, 9]] = elements[[4, 9]][:, [0, 2, 1, 3]]
    text = refusal(check_mesh, position, elements)
    assert f"2 inverted tetrahedra: element 4 (nodes {elements[4].tolist()})" in text
    assert np.allclose(points_in(text)[-1], position[elements[4]].mean(axis=0), rtol=1e-4)


def test_flat_tetrahedra():
    position, elements = block()
    corner = elements[6]
    position = np.concatenate([position, [position[corner[:3]].mean(axis=0)]])
    elements = np.concatenate([elements, [[*corner[:3], len(position) - 1]]])
    assert "1 tetrahedron of zero volume: element 48" in refusal(check_mesh, position, elements)


def test_no_volume():
    position, elements = block()
    position[:, 2] *= 1e-6
    assert "volume" in refusal(check_mesh, position, elements)
    assert "as good as zero for its size, 14.1" in refusal(check_surface, position, boundary(elements))


def test_pieces():
    position, elements = block()
    twice = np.concatenate([position, position + [20, 0, 0]])
    text = refusal(check_mesh, twice, np.concatenate([elements, elements + 27]))
    assert "2 pieces" in text and np.allclose(points_in(text), [[5, 5, 5], [25, 5, 5]])
    faces = boundary(elements)
    text = refusal(check_surface, twice, np.concatenate([faces, faces + 27]))
    assert "2 pieces" in text and np.allclose(points_in(text), [[5, 5, 5], [25, 5, 5]])


def test_pieces_that_share_an_edge_only_are_two():
    keep = np.array([[True, False], [False, True]])[:, :, None]
    position, elements = rectilinear([np.arange(3.0)] * 2 + [np.arange(2.0)], keep)
    assert "2 pieces not joined by a common face" in refusal(check_mesh, position, elements)


def test_sharp_elements():
    position, elements = block()
    centre = int(np.flatnonzero((position == 5).all(axis=1))[0])
    position[centre] = [5, 5, 9.95]
    text = refusal(check_mesh, position, elements)
    assert "dihedral angle below 5 degrees" in text
    worst = int(np.argmin(smallest_dihedral(position, elements)))
    assert f"element {worst} " in text


def folded(cells: int, out: float, second: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A cube with an inner node beyond the farthest face of the elements around it, by a share `out` of their size, all
    of positive volume as readers give them; and which elements the move turns over."""
    position, elements = block(cells)
    centre = int(np.flatnonzero(np.isclose(position, 5 if cells % 2 == 0 else 10 / cells).all(axis=1))[0])
    position[centre] += 10 / cells * np.array([1 + out, 0.1, 0.2])
    wrong = volumes(position, elements) < 0
    if second:
        position, elements = second_order(position, elements)
    return position, turned_over(elements, wrong), wrong


@pytest.mark.parametrize("second", [False, True])
@pytest.mark.parametrize(("cells", "out"), [(3, 0.1), (3, 0.5), (4, 0.3), (4, 0.9)])
def test_a_mesh_that_folds_over_itself(cells, out, second):
    """An inner node has gone through a face of its star. Each element has a positive volume, and the surface is whole:
    only the sides of faces tell."""
    position, elements, wrong = folded(cells, out, second)
    assert (volumes(position, elements) > 0).all()
    text = refusal(check_mesh, position, elements)
    lie_on_others = int(re.search(r"(\d+) tetrahedra in a fold of the mesh", text)[1])
    assert lie_on_others > wrong.sum() > 0
    number = int(re.search(r"element (\d+) ", text)[1])
    assert np.allclose(points_in(text)[0], position[elements[number]].mean(axis=0), rtol=1e-4)
    assert text.endswith("mesh it again")


def test_dihedral_angles_of_known_tetrahedra():
    regular = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    position = np.concatenate([regular, corner])
    angle = smallest_dihedral(position, np.array([[0, 2, 1, 3], [4, 5, 6, 7]]))
    # arccos 1/3 between all faces; arccos 1/sqrt(3) between a side and the slanted face of a cut-off corner
    assert angle == pytest.approx(np.degrees(np.arccos([1 / 3, 3**-0.5])))


def test_open_surface():
    position, elements = block()
    faces = boundary(elements)
    missing = faces[5]
    text = refusal(check_surface, position, np.delete(faces, 5, axis=0))
    assert "open: 3 edges with a triangle on one side only" in text
    ends = points_in(text)
    assert len(ends) == 2 and all((np.abs(position[missing] - end).sum(axis=1) < 1e-4).any() for end in ends)


def test_an_edge_of_four_triangles():
    keep = np.array([[True, False], [False, True]])[:, :, None]
    position, elements = rectilinear([np.arange(3.0)] * 2 + [np.arange(2.0)], keep)
    text = refusal(check_surface, position, boundary(elements))
    assert "1 edge with more than two triangles" in text
    assert np.allclose(np.sort(points_in(text), axis=0), [[1, 1, 0], [1, 1, 1]])


def test_surfaces_that_cut_themselves():
    position, elements = block()
    faces = boundary(elements)
    top = int(np.flatnonzero((position == [5, 5, 10]).all(axis=1))[0])
    position[top, 2] = -3  # the middle of the top side, pushed out of the bottom side
    text = refusal(check_surface, position, faces)
    named = [[int(i) for i in found.split(",")] for found in re.findall(r"\[([^]]*)\]", text)]
    assert "cuts itself" in text and len(named) == 2
    rows = {tuple(sorted(face)) for face in faces.tolist()}
    assert all(tuple(sorted(face)) in rows for face in named)
    assert sum(top in face for face in named) == 1


def test_a_solid_that_runs_through_itself():
    """A bar bent into a loop: every element is sound, but its end lies in its side."""
    along = np.linspace(0, 1, 41)
    position, elements = rectilinear([along, np.linspace(-0.1, 0.1, 3), np.linspace(-0.1, 0.1, 3)])
    check_mesh(position, elements, "bar")
    angle = 2 * np.pi * 1.03 * position[:, 0]
    radius = 1 + position[:, 1] + 0.05 * position[:, 0]
    bent = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), position[:, 2]])
    assert "its surface cuts itself: the triangles [" in refusal(check_mesh, bent, oriented(bent, elements))

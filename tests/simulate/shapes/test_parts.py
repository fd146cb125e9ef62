"""The structured parts: sizes, orientation, closed surfaces, repeatability."""

import numpy as np
import pytest

from ast_sim.simulate.shapes.mesh_check import boundary, check_mesh, smallest_dihedral
from ast_sim.simulate.shapes.parts import draw_structured, extruded, oriented, rectilinear, volumes


@pytest.mark.parametrize("nodes", [100, 500, 2000])
def test_structured_parts_are_sound_and_of_the_wanted_size(nodes):
    names = set()
    for seed in range(24):
        part = draw_structured(np.random.default_rng(seed))(nodes)
        names.add(part.name)
        check_mesh(part.position, part.elements, part.name)
        assert volumes(part.position, part.elements).min() > 0
        assert smallest_dihedral(part.position, part.elements).min() > 6
        assert 0.5 * nodes <= len(part.position) <= 1.5 * nodes
        assert 0.4 < np.ptp(part.position, axis=0).max() < 1.4
    assert names == {f"structured {shape}" for shape in ("block", "cylinder", "plate with hole", "finned plate")}


def test_the_same_seed_gives_the_same_part():
    first, second = (draw_structured(np.random.default_rng(7))(800) for _ in range(2))
    assert np.array_equal(first.position, second.position) and np.array_equal(first.elements, second.elements)
    assert not np.array_equal(first.position, draw_structured(np.random.default_rng(8))(800).position)


def test_parts_enclose_their_volume():
    for seed in range(12):
        part = draw_structured(np.random.default_rng(seed))(600)
        a, b, c = part.position[boundary(part.elements)].transpose(1, 0, 2)
        enclosed = np.einsum("fi,fi->", np.cross(b - a, c - a), a) / 6  # divergence theorem: needs outward normals
        assert enclosed == pytest.approx(volumes(part.position, part.elements).sum(), rel=1e-9)


def test_an_extruded_square_is_a_block():
    points = np.array([[0.0, 0], [1, 0], [1, 2], [0, 2]])
    position, elements = extruded(points, np.array([[0, 1, 2], [0, 2, 3]]), np.array([0.0, 1, 3]))
    assert len(elements) == 2 * 2 * 3
    assert volumes(position, elements).sum() == pytest.approx(6)
    assert len(boundary(elements)) == 2 * 2 + 4 * 2 * 2


def test_a_rectilinear_mesh_leaves_cells_out():
    keep = np.ones((2, 1, 2), bool)
    keep[1, 0, 1] = False
    position, elements = rectilinear([np.array([0.0, 1, 3]), np.array([0.0, 1]), np.array([0.0, 0.5, 2])], keep)
    assert volumes(position, elements).sum() == pytest.approx(1 * 0.5 + 2 * 0.5 + 1 * 1.5)
    assert not ((position[:, 0] > 1) & (position[:, 2] > 0.5)).any()


def test_orientation_turns_only_what_is_inverted():
    position = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    elements = np.array([[0, 1, 2, 3], [0, 2, 1, 3]])
    assert np.array_equal(oriented(position, elements), [[0, 1, 2, 3], [0, 1, 2, 3]])

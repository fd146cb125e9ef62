"""Triangles between curves and plates made of them: exact rims, good shapes, conforming elements."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from test_mesh import as_scene, volumes

from ast_sim.simulate.shapes import plate_mesh
from ast_sim.simulate.shapes.plate_mesh import extrude, smallest_angle, triangulate
from ast_sim.simulate.shapes.plate_outline_and_holes import HOLES, OUTLINES, distance_to, draw_outline, encloses

CORNERS = np.array([[-0.25, -0.15], [0.25, -0.15], [0.25, 0.15], [-0.25, 0.15]])
RECTANGLE = [np.stack([a, b]) for a, b in zip(CORNERS, np.roll(CORNERS, -1, axis=0), strict=True)]


def circle(centre, radius: float) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, 1000)
    return centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def area_of(mesh) -> float:
    corners = mesh.points[mesh.triangles]
    (a, b), (c, d) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    return float((a * d - b * c).sum()) / 2


def rim_of(mesh) -> np.ndarray:
    """Edges of one triangle only, [B,2]."""
    sides = np.sort(mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    found, count = np.unique(sides, axis=0, return_counts=True)
    assert count.max() == 2
    return found[count == 1]


def test_rims_are_exact_and_triangles_are_nearly_equilateral():
    centre = np.array([0.06, 0.02])
    mesh = triangulate(RECTANGLE, [circle(centre, 0.05)], 0.02)
    rim = mesh.points[np.unique(rim_of(mesh))]
    distance = np.hypot(*(rim - centre).T)
    on_hole = distance < 0.06
    assert on_hole.sum() == round(2 * np.pi * 0.05 / 0.02)
    np.testing.assert_allclose(distance[on_hole], 0.05, rtol=1e-5)
    to_sides = np.minimum(0.25 - np.abs(rim[:, 0]), 0.15 - np.abs(rim[:, 1]))
    np.testing.assert_allclose(to_sides[~on_hole], 0, atol=1e-15)
    assert np.degrees(smallest_angle(mesh)) > 26
    polygon = 0.5 * on_hole.sum() * 0.05**2 * np.sin(2 * np.pi / on_hole.sum())
    assert area_of(mesh) == pytest.approx(0.5 * 0.3 - polygon, rel=1e-4)
    assert len(np.unique(mesh.triangles)) == len(mesh.points) and (np.diff(mesh.points[:, 0]) >= 0).all()


def test_the_spacing_gives_the_number_of_nodes():
    for points in (40, 300, 1000):
        mesh = triangulate(RECTANGLE, [], plate_mesh.spacing_for(points, 0.15, 1.6))
        assert len(mesh.points) == pytest.approx(points, rel=0.12)


def test_the_nodes_of_a_piece_lie_on_it():
    mesh = triangulate(RECTANGLE, [], 0.03)
    for piece, (axis, value) in zip(mesh.pieces, [(1, -0.15), (0, 0.25), (1, 0.15), (0, -0.25)], strict=True):
        assert set(piece) == set(np.flatnonzero(np.isclose(mesh.points[:, axis], value, atol=1e-12)))


def test_curves_that_cross_are_refused():
    assert triangulate(RECTANGLE, [circle([0.0, 0.1], 0.08)], 0.02) is None
    assert triangulate(RECTANGLE, [circle([0.0, 0.0], 0.1)], 0.05) is not None


def test_the_smallest_angle_is_in_the_worst_triangle():
    points = np.array([[0.0, 0.0], [1.0, 0.0], [0.5, np.sqrt(3) / 2], [1.0, 0.1]])
    mesh = plate_mesh.PlaneMesh(points, np.array([[0, 1, 2], [0, 1, 3]]), [])
    assert smallest_angle(mesh) == pytest.approx(np.arctan(0.1))
    assert smallest_angle(plate_mesh.PlaneMesh(points, np.array([[0, 1, 2]]), [])) == pytest.approx(np.pi / 3)


def test_extruded_plates_are_solid_and_closed():
    mesh = triangulate(RECTANGLE, [circle([-0.1, 0.0], 0.05)], 0.03)
    thickness = 0.03 + 0.02 * mesh.points[:, 0]
    position, elements = extrude(mesh, thickness, 3)
    assert volumes(position, elements).min() > 0 and len(position) == 4 * len(mesh.points)
    layer = mesh.triangles
    exact = 0.5 * np.abs(np.linalg.det(mesh.points[layer][:, 1:] - mesh.points[layer][:, :1]))
    assert volumes(position, elements).sum() == pytest.approx((exact * thickness[layer].mean(axis=1)).sum())
    faces = as_scene(position, elements).surface()
    _, count = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0, return_counts=True)
    assert set(count) == {2}
    assert len(faces) == 2 * len(mesh.triangles) + 3 * 2 * len(rim_of(mesh))  # nothing inside lies open


def test_drawn_outlines_of_every_kind_close_and_keep_their_holes_apart():
    kinds, hole_kinds, spacing = set(), set(), 0.022
    for seed in range(40):
        outline = draw_outline(np.random.default_rng(seed), 0.5, 0.3, spacing)
        loop = np.concatenate(outline.pieces)
        following = [*outline.pieces[1:], outline.pieces[0]]
        assert all(np.allclose(a[-1], b[0]) for a, b in zip(outline.pieces, following, strict=True))
        assert 0.5 * 0.3 * 0.6 < plate_mesh.area(loop) < 0.5 * 0.3 * 1.3  # counter-clockwise
        left, right = (outline.pieces[end] for end in outline.ends)
        assert left[:, 0].max() < -0.2 and right[:, 0].min() > 0.2 and len(left) == len(right) == 2
        curves = [np.linspace(piece[:-1], piece[1:], 20, axis=1).reshape(-1, 2) for piece in outline.pieces]
        others = [np.concatenate(curves)]
        for hole in outline.holes:
            assert encloses(loop, hole[::20]).all()
            assert min(cdist(hole[::20], other).min() for other in others) > 1.19 * spacing
            others.append(hole)
        if seed % 8 == 0:
            mesh = triangulate(outline.pieces, outline.holes, spacing)
            inner = sum(abs(plate_mesh.area(hole)) for hole in outline.holes)
            assert area_of(mesh) == pytest.approx(plate_mesh.area(loop) - inner, rel=0.01)
        kinds.add(outline.kind)
        hole_kinds.update(outline.hole_kinds)
    assert kinds == set(OUTLINES) and hole_kinds == set(HOLES)


def test_distances_to_a_loop_are_negative_inside():
    loop = circle(np.zeros(2), 0.1)
    assert distance_to(loop, np.array([0.04, 0.0])) == pytest.approx(-0.06, abs=1e-5)
    assert distance_to(loop, np.array([0.0, 0.3])) == pytest.approx(0.2, abs=1e-5)

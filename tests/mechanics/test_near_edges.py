"""Edges that pass each other: their places against closed forms, and what they add to Newton steps."""

import numpy as np
import pytest
from simulate.own_assembly.assemblies import SPEC, box, case_of, write_assembly, write_box

from ast_sim.element_topology import surface_triangles
from ast_sim.mechanics.linearised.linearised_contact import CLEARANCE, NewtonSteps
from ast_sim.mechanics.linearised.near_edges import SurfaceEdges, passing
from ast_sim.simulate.families import assembly
from ast_sim.support.nearest_surface import near_boxes


def bars(gap: float, turned: float = 90.0):
    """A bar along x from z = 0 to 1 and, that far above it, one that is turned about z: positions, and their edges."""
    low, elements = box((0, -0.5, 0), (4, 0.5, 1), (1, 1, 1))
    high = low - [2, 0, 0]
    angle = np.radians(turned)
    spin = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    faces = surface_triangles(low, elements)
    position = np.concatenate([low, high @ spin.T + [1.3, 0, 1 + gap]])
    return position, SurfaceEdges(faces), SurfaceEdges(faces + len(low))


@pytest.mark.parametrize("gap", [0.05, -0.05])
@pytest.mark.parametrize("swapped", [False, True])
def test_bars_that_cross_have_four_places(gap, swapped):
    position, low, high = bars(gap)
    one, other = (high, low) if swapped else (low, high)
    found = passing(one.at(position), other.at(position), inside=0.2, outside=0.2)
    up = 1.0 if swapped else -1.0  # the normal leads from the second to the first
    rims = np.abs(found.normal - [0, 0, up]).max(axis=1) < 1e-9
    assert rims.sum() >= 4
    np.testing.assert_allclose(found.gap[rims], gap, atol=1e-9)
    places = np.einsum("pk,pki->pi", np.abs(found.shares[:, :2]), position[found.nodes[:, :2]])[rims]
    wanted = [(x, y) for x in (0.8, 1.8) for y in (-0.5, 0.5)]
    assert all(np.abs(places[:, :2] - corner).max(axis=1).min() < 1e-9 for corner in wanted)
    np.testing.assert_allclose(found.shares.sum(axis=1), 0, atol=1e-12)


def test_what_is_far_parallel_or_looks_away_is_left_out():
    position, low, high = bars(0.3)
    assert not len(passing(low.at(position), high.at(position), inside=0.2, outside=0.2).gap)
    position, low, high = bars(0.05, turned=3.0)  # nodes and faces see the sides, which are nearly parallel
    near = passing(low.at(position), high.at(position), inside=0.2, outside=0.2)
    along = position[near.nodes[:, [1, 3]]] - position[near.nodes[:, [0, 2]]]
    along /= np.linalg.norm(along, axis=2, keepdims=True)
    assert len(near.gap) and np.linalg.norm(np.cross(along[:, 0], along[:, 1]), axis=1).min() > 0.1
    position, low, high = bars(0.05)  # of two upper rims, or two lower ones, none is on the outer side of the other
    whole = passing(low.at(position), high.at(position), inside=3, outside=3)
    np.testing.assert_allclose(np.linalg.norm(whole.normal, axis=1), 1)


def test_edges_of_flat_faces_are_left_out():
    """The diagonals of the flat sides of both bars cross, too; nodes and faces say all of these."""
    position, low, high = bars(0.05)
    found = passing(low.at(position), high.at(position), inside=0.2, outside=0.2)
    one, other = low.at(position), high.at(position)
    sharp = {tuple(nodes) for edges in (one, other) for nodes in edges.nodes[edges.sharp].tolist()}
    assert len(sharp) == 24
    assert all(tuple(row[:2]) in sharp or tuple(row[2:]) in sharp for row in found.nodes.tolist())


def test_boxes_that_are_near():
    rng = np.random.default_rng(0)
    low, low_others = rng.uniform(-1, 1, (40, 3)), rng.uniform(-1, 1, (50, 3))
    high, high_others = low + rng.uniform(0, 0.5, (40, 3)), low_others + rng.uniform(0, 0.2, (50, 3))
    first, second = near_boxes(low, high, low_others, high_others, 0.1)
    wanted = ((low[:, None] <= high_others + 0.1) & (low_others - 0.1 <= high[:, None])).all(axis=2)
    assert 0 < wanted.sum() < wanted.size
    assert set(zip(first.tolist(), second.tolist(), strict=True)) == set(zip(*np.nonzero(wanted), strict=True))
    assert len(first) == wanted.sum()
    assert not len(near_boxes(low, high, low_others + 9, high_others + 9, 0.1)[0])
    assert not len(near_boxes(low[:0], high[:0], low_others, high_others, 0.1)[0])


def test_newton_steps_of_bars_that_cross(tmp_path):
    """A rigid bar bends an elastic one that it crosses. No node of either is near a face of the other; without edges
    the steps leave it as it was."""
    spec = write_assembly(tmp_path, SPEC.replace('fixed = "zmin"', 'fixed = "xmin,xmax"'))
    write_box(tmp_path / "block.vtu", (0, 4, 0), (10, 6, 1), (5, 1, 1))
    write_box(tmp_path / "punch.vtu", (4.3, 0, 1.2), (5.6, 10, 3), (1, 1, 1))
    case = case_of(spec, travel=0.6)
    scene, truth = case.scene, assembly.solve(case).position[-1].astype(float)
    steps = NewtonSteps(scene, case.material, CLEARANCE * case.contact.dhat)
    position = np.where(scene.prescribed[:, None], truth, scene.rest_position.astype(float))
    for step in range(8):
        position = steps.step(position, from_afar=step == 0)
    free = ~scene.prescribed
    displacement = np.linalg.norm((truth - scene.rest_position)[free])
    assert np.linalg.norm((position - truth)[free]) < 0.03 * displacement

"""Free nodes are carried along: rigidly where the prescribed nodes of their body move rigidly, else harmonically."""

from dataclasses import replace

import numpy as np
import pytest
from data_samples import block

from ast_sim.batches import carry
from ast_sim.batches.carry import Carrier, rigid_motion
from ast_sim.scene import NodeType, Scene


def turned(points: np.ndarray, degrees: float, axis: int = 2) -> np.ndarray:
    angle, others = np.radians(degrees), [i for i in range(3) if i != axis]
    rotation = np.eye(3)
    rotation[np.ix_(others, others)] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return points @ rotation.T


def bar(cells: int = 4) -> Scene:
    """A bar along x with handles at both ends."""
    scene = block(cells, 1, 1)
    ends = np.isin(scene.rest_position[:, 0], (0, cells))
    return replace(scene, node_type=np.where(ends, NodeType.HANDLE, NodeType.NORMAL).astype(np.uint8))


@pytest.mark.parametrize("degrees", [0, 30, 180, 300])
def test_a_body_whose_handles_move_rigidly_moves_with_them(degrees):
    scene = block(2, 2, 1)
    there = turned(scene.rest_position.astype(float), degrees) + (0.5, -2.0, 3.0)
    found = Carrier(scene)(scene.rest_position, np.where(scene.prescribed[:, None], there, np.nan))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, there, rtol=0, atol=2e-6)


def test_a_deformed_state_is_carried_with_its_deformation():
    scene = block(2, 2, 1)
    state = scene.rest_position + np.where(scene.prescribed[:, None], 0, 0.1).astype(np.float32)
    found = Carrier(scene)(state, turned(scene.rest_position, 90))
    np.testing.assert_allclose(found, turned(state, 90), rtol=0, atol=2e-6)


def test_handles_that_stretch_a_bar_stretch_it_evenly():
    scene = bar()
    rest = scene.rest_position
    pulled = rest + np.where(rest[:, :1] == 4, [1.0, 0.0, 0.5], 0.0).astype(np.float32)
    found = Carrier(scene)(rest, pulled)
    share = (rest[:, :1] / 4) * [1.0, 0.0, 0.5]
    np.testing.assert_allclose(found - rest, share, rtol=0, atol=1e-6)


def test_the_extension_has_the_least_energy():
    """The sum over elements of V |grad u|^2 grows whichever free node moves (the finite elements are linear)."""
    scene = bar()
    rest, generator = scene.rest_position.astype(float), np.random.default_rng(0)
    moved = rest + np.where(scene.prescribed[:, None], generator.standard_normal(rest.shape), 0)
    way = Carrier(scene)(scene.rest_position, moved) - rest

    def energy(u: np.ndarray) -> float:
        edges, differences = (np.diff(x[scene.elements], axis=1) for x in (rest, u))
        gradient = np.linalg.solve(edges, differences)
        return float((np.abs(np.linalg.det(edges)) / 6 * np.square(gradient).sum(axis=(1, 2))).sum())

    least = energy(way)
    for node in np.flatnonzero(~scene.prescribed):
        for axis in range(3):
            other = way.copy()
            other[node, axis] += 0.01
            assert energy(other) > least


def test_a_body_without_handles_and_handles_that_stay_move_nothing():
    scene = bar()
    loose = replace(scene, node_type=np.zeros(scene.num_nodes, np.uint8))
    assert np.array_equal(Carrier(loose)(scene.rest_position, scene.rest_position + 1), scene.rest_position)
    bent = scene.rest_position + np.where(scene.prescribed[:, None], 0, 0.1).astype(np.float32)
    assert np.array_equal(Carrier(scene)(bent, scene.rest_position), bent)


def test_a_piece_of_a_body_that_no_handle_holds_stays():
    scene, other = bar(), block(1, 1, 1)
    both = Scene(
        np.concatenate([scene.rest_position, other.rest_position + 10]),
        np.concatenate([scene.elements, other.elements + scene.num_nodes]),
        np.concatenate([scene.node_type, np.zeros(other.num_nodes, np.uint8)]),
        np.zeros(scene.num_nodes + other.num_nodes, np.int32),
    )
    rest = both.rest_position
    found = Carrier(both)(rest, rest + np.where(rest[:, :1] == 4, [1, 0, 0], 0).astype(np.float32))
    assert np.array_equal(found[scene.num_nodes :], rest[scene.num_nodes :])
    assert (found[: scene.num_nodes, 0] > rest[: scene.num_nodes, 0]).sum() > 4


def test_nodes_of_no_element_stay():
    scene = bar()
    loose = Scene(
        np.concatenate([scene.rest_position, np.float32([[9, 9, 9], [0, 0, 0]])]),
        scene.elements,
        np.append(scene.node_type, np.zeros(2, np.uint8)),
        np.zeros(scene.num_nodes + 2, np.int32),
    )
    rest = loose.rest_position
    pulled = rest + np.where(rest[:, :1] == 4, [1, 0, 0], 0).astype(np.float32)
    found = Carrier(loose)(rest, pulled)
    assert np.array_equal(found[-2:], rest[-2:])
    np.testing.assert_allclose(found[:-2], Carrier(scene)(rest[:-2], pulled[:-2]), rtol=0, atol=1e-7)


def test_an_element_without_a_volume_pulls_nothing():
    scene = bar()
    free = np.flatnonzero(~scene.prescribed)
    flat = np.append(scene.elements, np.int32([[free[0], free[1], free[2], free[0]]]), axis=0)
    rest = scene.rest_position
    pulled = rest + np.where(rest[:, :1] == 4, [1.0, 0.0, 0.5], 0.0).astype(np.float32)
    found = Carrier(replace(scene, elements=flat))(rest, pulled)
    np.testing.assert_allclose(found, Carrier(scene)(rest, pulled), rtol=0, atol=1e-6)


def test_a_sheet_is_stretched_evenly():
    x, y = np.meshgrid(np.arange(5.0), np.arange(3.0), indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), np.zeros(15)], axis=1).astype(np.float32)
    low = np.array([3 * i + j for i in range(4) for j in range(2)])
    triangles = np.concatenate([np.stack([low, low + 3, low + 4], 1), np.stack([low, low + 4, low + 1], 1)])
    ends = np.isin(points[:, 0], (0, 4))
    types = np.where(ends, NodeType.HANDLE, NodeType.NORMAL).astype(np.uint8)
    sheet = Scene(points, triangles.astype(np.int32), types, np.zeros(15, np.int32))
    pulled = points + np.where(points[:, :1] == 4, [1.0, 0.5, 0.0], 0.0).astype(np.float32)
    found = Carrier(sheet)(points, pulled)
    np.testing.assert_allclose(found - points, points[:, :1] / 4 * [1.0, 0.5, 0.0], rtol=0, atol=1e-6)


def test_points_on_a_line_that_turn_do_not_say_how():
    line = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
    assert rigid_motion(line, turned(line, 40)) is None
    rotation, shift = rigid_motion(line, line + [0, 2, 0])
    assert np.array_equal(rotation, np.eye(3)) and np.array_equal(shift, [0, 2, 0])


def test_a_mirror_image_is_no_rigid_motion():
    points = np.random.default_rng(0).standard_normal((5, 3))
    assert rigid_motion(points, points * [1, 1, -1]) is None


def test_a_wide_band_and_an_indefinite_matrix_are_solved_by_a_sparse_factor(monkeypatch):
    scene = bar()
    held, free = np.flatnonzero(scene.prescribed), np.flatnonzero(~scene.prescribed)
    way = np.random.default_rng(0).normal(size=(len(held), 3))
    by_band = carry.harmonic_extension(scene, held, free)(way)
    with monkeypatch.context() as patched:
        patched.setattr(carry, "LARGEST_BAND", 0)
        patched.setattr(carry, "_solver_of_band", lambda *_: pytest.fail("the band is too wide"))
        by_sparse = carry.harmonic_extension(scene, held, free)(way)
    np.testing.assert_allclose(by_sparse, by_band, rtol=0, atol=1e-9)
    monkeypatch.setattr(carry, "_solver_of_band", lambda *_: None)
    np.testing.assert_allclose(carry.harmonic_extension(scene, held, free)(way), by_band, rtol=0, atol=1e-9)

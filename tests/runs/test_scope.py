"""The ranges of the training scenes: how prescribed nodes move along each axis, and where bodies are held."""

from dataclasses import replace

import numpy as np
import pytest

import ast_sim
from ast_sim.dataset.layout import DatasetInfo
from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.models.data_facts import DataFacts
from ast_sim.prescribed_motion import Motion
from ast_sim.training.data_lengths import scope_of

DEPTHS = (0.1, 0.2)
SIDEWAYS = ((0.1, "x"), (-0.1, "y"))


def pressed(displacement, ends=2):
    """A bar along x that is held at its ends (1 or 2 of them), and a punch over it that moves by `displacement`."""
    bar = ast_sim.box((0, 0, 0), (4, 1, 1), cells=(4, 1, 1))
    held = (bar.rest_position[:, 0] == 0) | ((bar.rest_position[:, 0] == 4) & (ends == 2))
    kinds = np.where(held, ast_sim.NodeType.HANDLE, bar.node_type).astype(np.uint8)
    punch = ast_sim.box((1.5, 0, 1.1), (2.5, 1, 2), cells=(1, 1, 1))
    rigid = replace(punch, node_type=np.full_like(punch.node_type, ast_sim.NodeType.OBSTACLE))
    scene = ast_sim.Scene.join(replace(bar, node_type=kinds), rigid)
    position = np.repeat(scene.rest_position[None], 2, axis=0)
    position[1, scene.body == 1] += np.float32(displacement)
    return scene, position


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """The bar, pressed down by two depths."""
    path = tmp_path_factory.mktemp("scope") / "bars.h5"
    info = DatasetInfo("bars", "quasi_static", "none", (0.0, 0.0, 0.0), 10.0, 1.0, 0.0)
    with DatasetWriter(path, info) as writer:
        for depth in DEPTHS:
            writer.add("train", ast_sim.Trajectory(*pressed((0, 0, -depth)), None, {}))
    with Dataset(path) as opened:
        yield opened


def notes(dataset, scene, position, mirror=()):
    scope = scope_of(dataset, DataFacts.of(dataset.info, (), 1.0), mirror)
    return list(scope.notes(scene, Motion(position), each_frame=False))


@pytest.mark.parametrize(
    ("displacement", "mirror", "told"),
    [
        ((0, 0, -0.15), "", []),
        ((0, 0, -0.209), "", []),  # within the leeway
        ((0, 0, 0.15), "", ["prescribed nodes move 0.15 m along z; in training -0.2 m to 0 m"]),
        ((0, 0, 0.15), "z", []),
        ((0.15, 0, 0), "z", ["prescribed nodes move 0.15 m along x; in training 0 m to 0 m"]),
        (
            (0.1, -0.1, -0.1),
            "",
            [f"prescribed nodes move {move} m along {axis}; in training 0 m to 0 m" for move, axis in SIDEWAYS],
        ),
        ((0.4, 0, 0), "", ["prescribed nodes move up to 0.4 m from their start; in training 0 m to 0.2 m"]),
    ],
)
def test_a_motion_along_another_axis_is_told(dataset, displacement, mirror, told):
    assert notes(dataset, *pressed(displacement), mirror) == told


def test_what_is_held_elsewhere_is_told(dataset):
    width, size = np.sqrt(2), np.sqrt(18)
    words = f"the held nodes span {width / size:.4g} of the size of the deforming bodies; in training 1"
    assert notes(dataset, *pressed((0, 0, -0.15), ends=1)) == [words]


def test_the_ranges_are_those_of_all_scenes(dataset):
    facts = DataFacts.of(dataset.info, (), 1.0)
    plain, mirrored = scope_of(dataset, facts), scope_of(dataset, facts, ("x", "z"))
    assert plain.held == (1.0, 1.0) and plain.travel == pytest.approx(DEPTHS)
    np.testing.assert_allclose(plain.motion_low, (0, 0, -0.2), atol=1e-6)
    np.testing.assert_allclose(plain.motion_high, (0, 0, 0), atol=1e-6)
    np.testing.assert_allclose(mirrored.motion_low, (0, 0, -0.2), atol=1e-6)
    np.testing.assert_allclose(mirrored.motion_high, (0, 0, 0.2), atol=1e-6)


def test_what_was_prescribed_before_the_first_frame_counts(dataset):
    """A motion whose first frame is pressed in already has travelled from rest, though nothing moves after it."""
    scene, position = pressed((0, 0, -0.6))
    pressed_in = np.repeat(position[1:], 2, axis=0)
    told = ["prescribed nodes move up to 0.6 m from their start; in training 0 m to 0.2 m"]
    assert notes(dataset, scene, pressed_in) == notes(dataset, scene, position) == told
    scene, position = pressed((0.15, 0, 0))
    told = ["prescribed nodes move 0.15 m along x; in training 0 m to 0 m"]
    assert notes(dataset, scene, np.repeat(position[1:], 2, axis=0)) == told


def test_the_ranges_of_the_training_begin_at_rest_but_with_inertia_in_the_first_frame(dataset, tmp_path):
    scene, position = pressed((0, 0, -0.2))
    for kind, travel in (("quasi_static", 0.2), ("dynamic", 0.0)):
        info = replace(dataset.info, integration=kind, time_step=0.1)
        with DatasetWriter(tmp_path / f"{kind}.h5", info) as writer:
            writer.add("train", ast_sim.Trajectory(scene, np.repeat(position[1:], 3, axis=0), None, {}))
        with Dataset(tmp_path / f"{kind}.h5") as opened:
            assert scope_of(opened, DataFacts.of(info, (), 1.0)).travel == pytest.approx((travel, travel), abs=1e-6)

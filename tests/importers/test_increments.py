"""Displacements that are counted from the frame before are told or refused; other motions that stand still are not."""

import meshio
import numpy as np
import pytest
from data_samples import block
from scipy.spatial.transform import Rotation

from ast_sim.importers.series import FieldNames, read_series
from ast_sim.plausibility.motion import in_trajectory
from ast_sim.scene import NodeType, Scene, Trajectory
from ast_sim.support.errors import DatasetError

CUBE = block(2, 2, 2)
GAP = 0.4
FRAMES = 21
REST = np.concatenate([CUBE.rest_position, CUBE.rest_position + (0, 0, 2 + GAP)]).astype(np.float32)
TOOL = np.arange(len(REST)) >= len(CUBE.rest_position)
HELD = REST[:, 2] == 0
SCENE = Scene(
    rest_position=REST,
    elements=np.concatenate([CUBE.elements, CUBE.elements + len(CUBE.rest_position)]),
    node_type=np.where(TOOL, NodeType.OBSTACLE, np.where(REST[:, 2] == 0, NodeType.HANDLE, NodeType.NORMAL)).astype(
        "u1"
    ),
    body=TOOL.astype(np.int32),
)
EVEN = np.linspace(0, 1, FRAMES)


def displacements(travel):
    """[S, N, 3]: a cube comes down on another, which gives way from the contact on."""
    moved = np.zeros((len(travel), *REST.shape))
    moved[:, TOOL, 2] = -travel[:, None]
    moved[:, ~TOOL, 2] = -np.maximum(0, travel - GAP)[:, None] * REST[~TOOL, 2] / 2
    return moved


def from_frame_before(moved):
    return np.concatenate([moved[:1], np.diff(moved, axis=0)])


def told(moved):
    findings = in_trajectory(Trajectory(SCENE, (REST + moved).astype(np.float32)))
    return [one.places for one in findings if one.what == "frames in which only free nodes move"]


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("travel", [EVEN, np.concatenate([EVEN, EVEN[-2::-1]])], ids=["down", "down and up again"])
def test_displacements_from_the_frame_before_are_told(travel, first):
    """Also if the frame at rest is missing."""
    assert told(from_frame_before(displacements(travel))[first:]) != []


def test_the_frames_are_named():
    assert told(from_frame_before(displacements(EVEN))) == ["frame 9"]


@pytest.mark.parametrize(
    "travel",
    [
        EVEN,
        EVEN**2,
        np.concatenate([EVEN, EVEN[-2::-1], EVEN[1:]]),
        np.concatenate([EVEN, np.ones(100)]),
        np.sin(4 * np.pi * EVEN) ** 2,
        np.array([0, *[1] * 20]),
        np.array([0, *[0.5, 1] * 10]),
        np.random.default_rng(0).uniform(size=FRAMES),
        np.array([0, *[0.3] * 20, *[0.9] * 20]),
    ],
)
def test_displacements_from_rest_are_not_told(travel):
    assert told(displacements(np.asarray(travel, float))) == []


def turning(angles, axis=1, pivot=(1, 1, 2 + GAP), shift=0.0):
    """[S, N, 3]: the upper cube turns about an axis through a point of it, and goes down; the lower one leans."""
    moved = np.zeros((len(angles), *REST.shape))
    for frame, angle in enumerate(angles):
        turn = Rotation.from_rotvec(np.eye(3)[axis] * angle).as_matrix()
        moved[frame, TOOL] = (REST[TOOL] - pivot) @ turn.T + pivot - REST[TOOL] - (0, 0, shift * frame)
        moved[frame, ~TOOL, 0] = 0.1 * np.sin(angle) * REST[~TOOL, 2]
    return moved


TURNS = {
    "even": EVEN,
    "faster and faster": EVEN**2,
    "to and fro": np.sin(2 * np.pi * EVEN),
    "random": np.random.default_rng(0).uniform(size=FRAMES),
}


def shapes(moved):
    findings = in_trajectory(Trajectory(SCENE, (REST + moved).astype(np.float32)))
    return [one.count for one in findings if one.what == "frames in which prescribed nodes change their shape"]


@pytest.mark.parametrize("angle", [0.05, 0.5, 3.0])
@pytest.mark.parametrize("profile", TURNS)
@pytest.mark.parametrize("shift", [0, 0.02])
def test_tools_that_turn_tell_displacements_from_the_frame_before(angle, profile, shift):
    moved = turning(angle * TURNS[profile], shift=shift)
    assert shapes(moved) == [] and told(moved) == []
    before = from_frame_before(moved)
    assert told(before) != [] or shapes(before) != [] or angle < 0.5  # small turns leave the shape as it is


def test_the_frames_in_which_the_shape_changes_are_counted():
    assert shapes(from_frame_before(turning(3 * EVEN))) == [19]
    soft = turning(EVEN)
    soft[:, TOOL] *= 1 + 0.1 * REST[TOOL, :1]  # no rigid tool, which is another finding
    assert shapes(soft) == []


def test_a_load_on_a_body_that_is_held_is_not_told():
    """The held nodes have moved by rounding."""
    moved = EVEN[:, None, None] * (0.1, 0, 0) * REST[:, 2:] * ~TOOL[:, None]
    moved[1:] += 1e-6
    assert told(moved) == []


def test_they_are_refused_where_the_points_move_as_well(tmp_path):
    moved = displacements(EVEN[:4] * 5)
    for frame, (shift, step) in enumerate(zip(moved, from_frame_before(moved), strict=True)):
        fields = {"displacement": step, "tool": TOOL.astype(float)}
        meshio.write(tmp_path / f"f{frame}.vtu", meshio.Mesh(REST + shift, [("tetra", SCENE.elements)], fields))
    with pytest.raises(DatasetError, match="the displacement is counted from the frame before: the points move by it"):
        read_series(tmp_path, FieldNames(obstacle="tool"))

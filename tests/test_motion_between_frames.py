"""The course of prescribed nodes between frames: legs, arcs, turning points, and what frames do not show."""

import warnings

import numpy as np
import pytest

from ast_sim.motion_between_frames import Course, MovedNodes
from ast_sim.prescribed_motion import Motion, RigidMotion
from ast_sim.scene import NodeType, Scene

REST = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]])
HELD = np.array([True, True, False])
ORIGIN = np.array([100.0, -50.0, 7.0])


def course(motion, frames, nodes=(0, 1), origin=ORIGIN):
    nodes = np.array(nodes)
    return Course.of(REST, HELD, (MovedNodes(nodes, REST[nodes], motion, origin, "the tool"),), frames)


def distance(a, b):
    return np.linalg.norm(np.asarray(a) - b, axis=-1)


@pytest.mark.parametrize(
    ("degrees", "frames", "count"), [(270, 2, 9), (270, 10, 1), (30, 2, 1), (31, 2, 2), (-720, 2, 24)]
)
def test_a_turn_is_cut_into_legs_and_keeps_to_its_arc(degrees, frames, count):
    turning = course(RigidMotion(rotation=degrees, point=ORIGIN), frames)
    legs = turning.legs(1)
    assert len(legs) == count
    start = REST
    for number, leg in enumerate(legs, 1):
        angle = np.radians(degrees * number / count / (frames - 1))
        np.testing.assert_allclose(leg.end[0], [np.cos(angle), np.sin(angle), 0], rtol=0, atol=1e-12)
        assert np.array_equal(leg.end[2], REST[2])  # a free node
        middle = leg.along(0.5)
        np.testing.assert_allclose(distance(middle[:2], 0), [1, 2], rtol=0, atol=1e-12)  # a chord would be nearer
        np.testing.assert_allclose(distance(middle[0], start[0]), distance(middle[0], leg.end[0]), rtol=0, atol=1e-12)
        start = leg.end
    assert np.array_equal(legs[-1].end, turning.position[1])


def test_a_straight_way_is_one_leg_to_the_bit_of_the_frames():
    straight = course(RigidMotion((0.1, 0.2, -0.7)), 6)
    for frame in range(1, 6):
        (leg,) = straight.legs(frame)
        assert leg.along is None and np.array_equal(leg.end, straight.position[frame])


def test_legs_end_where_a_path_turns_between_frames():
    """1 down and 2 up: the corner is at a third of the way, and again when frames are left out."""
    path = course(RigidMotion([(0, 0, -1), (0, 0, 1)]), 6)
    ends = [[leg.end[0, 2] for leg in path.legs(frame)] for frame in range(1, 6)]
    np.testing.assert_allclose(np.concatenate(ends), [-0.6, -1, -0.8, -0.2, 0.4, 1], rtol=0, atol=1e-12)
    assert [len(one) for one in ends] == [1, 2, 1, 1, 1]
    (first, last), (only,) = path.storing((0, 5)).legs(1), path.storing((0, 1)).legs(1)
    assert (first.end[0, 2], last.end[0, 2], only.end[0, 2]) == pytest.approx((-1, 1, -0.6))


def test_positions_between_frames_follow_the_motion():
    both = course(RigidMotion((0, 0, -2), 90, point=ORIGIN), 2)
    np.testing.assert_allclose(both.at(0.5)[0], [0.5**0.5, 0.5**0.5, -1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(both.direct(1).along(0.25)[0, 2], -0.5, rtol=0, atol=1e-12)
    assert np.array_equal(both.at(1.0), both.position[1])


def rows(values):
    """The course of a node along x of which only frames are known."""
    position = np.repeat(REST[None], len(values), axis=0)
    position[:, 0, 0] += values
    return Course(position, HELD)


@pytest.mark.parametrize(
    ("values", "kept", "ends"),
    [
        ([0, 1, 2, 3], (0, 3), [3]),  # straight on
        ([0, 1, 3, 3.5], (0, 3), [3.5]),  # not evenly, but on
        ([0, 2, 4, 4, 2, 0], (0, 5), [4, 0]),  # stays, then comes back
        ([0, 2, 4, 4, 2, 0], (0, 3, 5), [4, 0]),
        ([0, 1, -1, 1, 0], (0, 4), [1, -1, 1, 0]),
    ],
)
def test_frames_that_are_left_out_are_passed_where_a_node_turns_back(values, kept, ends):
    stored = rows(np.array(values, float)).storing(kept)
    found = [leg.end[0, 0] - 1 for frame in range(1, len(kept)) for leg in stored.legs(frame)]
    assert found == ends
    told = list(stored.notes())
    assert len(told) == (len(ends) > len(kept) - 1) and all("solved, but not stored" in note for note in told)


def test_a_circle_known_in_frames_is_not_cut_short():
    """Every step goes on from the one before, but half of the way round the node comes nearer again."""
    angle = np.radians(np.arange(0, 361, 20))
    circle = np.repeat(REST[None], len(angle), axis=0)
    circle[:, 0] = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    ends = [leg.end[0] for leg in Course(circle, HELD).storing((0, len(angle) - 1)).legs(1)]
    np.testing.assert_allclose(ends, [[-1, 0, 0], [1, 0, 0]], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("motion", "frames", "told"),
    [
        (RigidMotion([(0, 0, -1), (0, 0, 0)]), 5, []),
        (RigidMotion([(0, 0, -1), (0, 0, -2)]), 4, []),  # a waypoint, but no corner
        (RigidMotion([(0, 0, -1), (0, 0, 0)]), 4, ["the tool turns at 1.5 of 3 frames, which no frame shows: with 5"]),
        (RigidMotion([(0, 0, -1), (0, 0, 1)]), 6, ["turns at 1.667 of 5 frames, which no frame shows: with 7"]),
        (RigidMotion(rotation=-270), 2, ["turns 270 degrees .* take 2 times as many frames"]),
        (RigidMotion(rotation=360), 2, ["turns 360 degrees .* take 3 times"]),
        (RigidMotion(rotation=179), 2, []),
        (RigidMotion(rotation=720), 6, []),
    ],
)  # fmt: skip
def test_what_no_frame_shows_is_told(motion, frames, told):
    import re

    found = list(course(motion, frames).notes())
    assert len(found) == len(told) and all(re.search(text, note) for text, note in zip(told, found, strict=True)), found


def test_frames_behind_the_last_one_that_is_kept_do_not_matter():
    path = course(RigidMotion([(0, 0, -1), (0, 0, 0)]), 6)
    assert not list(path.storing((0, 1, 2)).notes())
    assert len(list(path.storing((0, 2, 3)).notes())) == 1


def test_frames_that_show_what_the_kept_ones_do_not_are_named():
    there_and_back = course(RigidMotion([(0, 0, -1), (0, 0, 0)]), 5).storing((0, 4))
    assert list(there_and_back.notes()) == ["the tool turns at 2 of 4 frames, which no frame shows: keep frame 2, too"]
    between = course(RigidMotion([(0, 0, -1), (0, 0, 0)]), 6).storing((0, 5))
    assert list(between.notes()) == ["the tool turns at 2.5 of 5 frames, which no frame shows: with 7 frames one does"]
    (turn,) = course(RigidMotion(rotation=270), 10).storing((0, 9)).notes()
    assert turn.endswith("look like another turn: keep frames between")


def test_the_motion_of_a_question_tells_it_too():
    kinds = np.array([NodeType.NORMAL] * 4 + [NodeType.OBSTACLE], np.uint8)
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], np.float32)
    scene = Scene(points, np.array([[0, 1, 2, 3], [1, 2, 3, 4]]), kinds, np.array([0, 0, 0, 0, 1]))
    with pytest.warns(UserWarning, match="the motion of body 1 turns 200 degrees"):
        Motion.of_bodies(scene, {1: RigidMotion(rotation=200)}, 2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Motion.of_bodies(scene, {1: RigidMotion([(0, 0, 1), (0, 0, 0)], 200)}, 3)

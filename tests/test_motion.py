"""What is prescribed: rigid motions against SciPy's rotations, paths, numbers of frames, and every error."""

import numpy as np
import pytest
import toy
from meshes import two_tetrahedra
from scipy.spatial.transform import Rotation

from ast_sim.prescribed_motion import Motion, RigidMotion, frames_for, parse_move
from ast_sim.scene import NodeType
from ast_sim.support.errors import ConfigError

SCENE = (
    two_tetrahedra()
)  # body 0: nodes 0 to 3, node 0 is a handle at the origin; body 1: the obstacle node 4 at (1, 1, 1)
POINTS = np.random.default_rng(0).standard_normal((20, 3))


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_rotation_about_any_axis_is_scipys_and_is_carried_along(share):
    axis, point, moved = np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.2, -1.0]), np.array([0.1, 0.0, -0.4])
    found = RigidMotion(translation=moved, rotation=400, axis=axis, point=point).at(share, POINTS)
    rotation = Rotation.from_rotvec(np.radians(400) * share * axis / np.linalg.norm(axis))
    np.testing.assert_allclose(found, rotation.apply(POINTS - point) + point + share * moved, rtol=0, atol=1e-14)


def test_a_quarter_turn_is_counter_clockwise():
    found = RigidMotion(rotation=90, point=(1, 0, 0)).at(1.0, np.array([[2.0, 0.0, 5.0]]))
    np.testing.assert_allclose(found, [[1, 1, 5]], rtol=0, atol=1e-15)


def test_a_path_is_passed_at_the_same_speed():
    """1 down, 3 sideways, a waypoint twice, and back to where it began: 1 + 3 + 4 = 8 in all."""
    motion = RigidMotion([(0, 0, -1), (3, 0, -1), (3, 0, -1), (3, 4, -1)])
    for share, expected in [(0, (0, 0, 0)), (1 / 16, (0, 0, -0.5)), (0.125, (0, 0, -1)), (0.25, (1, 0, -1))]:
        np.testing.assert_allclose(motion.at(share, np.zeros((1, 3))), [expected], rtol=0, atol=1e-15)
    np.testing.assert_allclose(motion.at(0.5, np.zeros((1, 3))), [(3, 0, -1)], rtol=0, atol=1e-15)
    np.testing.assert_allclose(motion.at(1, np.zeros((1, 3))), [(3, 4, -1)], rtol=0, atol=1e-15)
    assert np.array_equal(RigidMotion([(0, 0, 0)]).at(0.5, POINTS), POINTS)


def test_bodies_move_rigidly_and_all_else_stands_still():
    motion = Motion.of_bodies(SCENE, {1: (0, 0, -0.5), 0: RigidMotion(translation=[(1, 0, 0), (0, 0, 0)])}, 5)
    expected = np.repeat(SCENE.rest_position[None], 5, axis=0)
    expected[:, 4, 2] = [1, 0.875, 0.75, 0.625, 0.5]
    expected[:, 0, 0] = [0, 0.5, 1, 0.5, 0]
    assert motion.position.dtype == np.float32 and np.array_equal(motion.position, expected)
    still = Motion.of_bodies(SCENE, {1: RigidMotion(rotation=90)}, 2)
    assert np.array_equal(still.position[:, :4], np.repeat(SCENE.rest_position[None, :4], 2, axis=0))
    np.testing.assert_allclose(still.position[1, 4], [-1, 1, 1], rtol=0, atol=1e-7)
    assert np.array_equal(Motion.of_bodies(SCENE, {}, 3).position, np.repeat(SCENE.rest_position[None], 3, axis=0))


def test_positions_of_all_nodes_or_of_the_prescribed_ones():
    given = np.random.default_rng(1).standard_normal((3, 5, 3)).astype(np.float32)
    assert np.array_equal(Motion.of_positions(SCENE, given).position, given)
    found = Motion.of_positions(SCENE, given[:, [0, 4]].tolist())
    assert found.num_frames == 3 and np.array_equal(found.position[:, [0, 4]], given[:, [0, 4]])
    assert np.array_equal(found.position[:, 1:4], np.repeat(SCENE.rest_position[None, 1:4], 3, axis=0))


def test_increments_and_travel_are_of_prescribed_nodes():
    position = np.repeat(SCENE.rest_position[None], 4, axis=0)
    position[:, 4, 0] += [0, 3, 3, 1]
    position[:, 4, 1] += [0, 4, 4, 4]
    position[2, 1] = 100  # a free node
    motion = Motion.of_positions(SCENE, position)
    assert (max(motion.increments(SCENE)), motion.travel(SCENE)) == (5.0, 5.0)
    motion.position[3, 4] = [-6, 1, 1]
    assert max(motion.increments(SCENE)) == pytest.approx(np.hypot(10, 4)) and motion.travel(SCENE) == 7.0


@pytest.mark.parametrize(
    ("motion", "increment", "frames"),
    [
        ((0, 0, -0.01), 0.001, 11),
        ((0, 0, -0.01), 0.00099, 12),
        ((0, 0, -2.1), 0.3, 8),  # 2.1 / 0.3 is 7 and a little more in float64
        ((0, 0, 0), 0.1, 2),
        ((0, 0, -0.01), 1.0, 2),
        (RigidMotion([(0, 0, -0.01), (0, 0, 0)]), 0.001, 21),  # comes back: 20 times 0.001
        (RigidMotion(rotation=360), 0.1, 1 + 89),  # a circle of the radius sqrt(2): 8.886
        (RigidMotion(rotation=-90, point=(1, 1, 7)), 0.1, 2),  # the node lies on the axis
    ],
)
def test_the_number_of_frames(motion, increment, frames):
    assert frames_for(SCENE, {1: motion}, increment) == frames
    assert frames_for(SCENE, {}, increment) == 2


@pytest.mark.parametrize("angle", [200.0, -70.0])
def test_the_largest_speed_of_a_motion_that_turns_and_moves(angle):
    motion = RigidMotion([(0.3, 0, 0), (0.3, 0.5, -0.2)], rotation=angle, axis=(0.2, -0.3, 1), point=(0.1, 0, 0))
    shares = np.linspace(0, 1, 4001)
    for point in POINTS[:5]:
        path = np.concatenate([motion.at(share, point[None]) for share in shares])
        measured = np.linalg.norm(np.diff(path, axis=0), axis=1).max() * 4000
        assert motion.largest_speed(point[None]) == pytest.approx(measured, rel=3e-4)
    slowest = max(motion.largest_speed(point[None]) for point in POINTS)
    assert motion.largest_speed(POINTS) == slowest


@pytest.mark.parametrize(
    ("text", "body", "motion"),
    [
        ("1=0,0,-0.01", 1, RigidMotion(((0, 0, -0.01),))),
        ("12= 0, 1e-2 ,-.5", 12, RigidMotion(((0, 0.01, -0.5),))),
        ("0=0,0,-1 then 2,0,-1  then 0,0,0", 0, RigidMotion(((0, 0, -1), (2, 0, -1), (0, 0, 0)))),
        ("1=rotate 30 about 0,0,1 at 0,0,0.1", 1, RigidMotion(rotation=30, axis=(0, 0, 1), point=(0, 0, 0.1))),
        ("1=1,2,3 rotate -9 about 1,0,0 at 0,0,0", 1, RigidMotion(((1, 2, 3),), -9, (1, 0, 0), (0, 0, 0))),
    ],
)
def test_a_move_in_words(text, body, motion):
    assert parse_move(text) == (body, motion)


WRONG_MOVES = [
    "",
    "1",
    "1=",
    "punch=0,0,1",
    "1=0,0",
    "1=0,0,x",
    "1=0,0,1,2",
    "1=rotate 30",
    "1=0,0,1 then",
    "1=0,0,1 2",
]


@pytest.mark.parametrize("text", WRONG_MOVES)
def test_a_move_that_cannot_be_read(text):
    with pytest.raises(ConfigError, match="cannot be read; write it as '1=0,0,-0.01'") as error:
        parse_move(text)
    assert repr(text) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RigidMotion((0, 0)), r"translation of a motion must be three numbers or a list of triples.*\(0, 0\)"),
        (lambda: RigidMotion([]), "translation of a motion must be three numbers or a list of triples"),
        (lambda: RigidMotion((0, 0, np.nan)), "translation of a motion must be .*all finite"),
        (
            lambda: RigidMotion(rotation=np.inf),
            r"rotation of a motion must be one finite number of at most 1e\+15, not inf",
        ),
        (lambda: RigidMotion(rotation="30"), r"rotation of a motion must be one finite number of .*, not '30'$"),
        (lambda: RigidMotion(rotation=9, axis=(0, 0, 0)), "axis of a motion must be three numbers, not all zero"),
        (lambda: RigidMotion(rotation=9, point=(0, 0)), "point of a motion must be three numbers"),
        (lambda: parse_move("1=0,0,nan"), "translation of a motion must be .*all finite"),
        (
            lambda: Motion.of_bodies(SCENE, {7: (0, 0, 1)}, 3),
            r"there is no body 7; there are: 0 \(4 nodes\), 1 \(1 node\)",
        ),
        (lambda: Motion.of_bodies(SCENE, {1: (0, 0, 1)}, 1), "at least 2 frames, not 1"),
        (lambda: frames_for(SCENE, {7: (0, 0, 1)}, 1.0), "there is no body 7"),
        (lambda: frames_for(SCENE, {1: (0, 0, 1)}, 0.0), "must be above 0, not 0.0"),
        (
            lambda: Motion.of_positions(SCENE, np.zeros((3, 4, 3))),
            r"shape \[3, 4, 3\], must be \[frames, 5 nodes, 3\] or \[frames, 2 prescribed nodes, 3\]",
        ),
        (lambda: Motion.of_positions(SCENE, np.zeros((1, 5, 3))), "with at least 2 frames"),
        (lambda: Motion.of_positions(SCENE, np.zeros((5, 3))), r"shape \[5, 3\]"),
    ],
)
def test_what_is_wrong_is_named(make, message):
    with pytest.raises(ConfigError, match=message) as error:
        make()
    assert "\n" not in str(error.value)


def test_a_body_without_prescribed_nodes_and_positions_that_are_not_finite_are_named():
    free = two_tetrahedra(node_type=np.array([0, 0, 0, 0, NodeType.OBSTACLE], np.uint8))
    with pytest.raises(
        ConfigError, match="body 0 has no prescribed node .*obstacles=.0. .--obstacle 0. or .*--clamp 0:PLACE"
    ):
        Motion.of_bodies(free, {0: (0, 0, 1)}, 3)
    position = np.zeros((3, 2, 3))
    position[2, 1, 0] = np.inf
    with pytest.raises(ConfigError, match=r"not finite in frame 2 at node 4: \[inf, 0.0, 0.0\]"):
        Motion.of_positions(SCENE, position)


@pytest.mark.parametrize("value", [(0, 0, 1j), ("0", "0", "1"), "001", (0, 0), (0, 0, None), {1: 2}])
@pytest.mark.parametrize("name", ["translation", "axis", "point"])
def test_what_are_no_three_real_numbers_is_refused(name, value):
    with pytest.raises(ConfigError, match=f"^{name} of a motion must be three numbers"):
        RigidMotion(**{name: value})


@pytest.mark.parametrize("value", [[(0, 0, 1), (0, 0)], [], [[]], np.zeros((0, 3)), np.zeros((2, 2, 3))])
def test_a_path_has_triples_alone(value):
    with pytest.raises(ConfigError, match="^translation of a motion must be three numbers or a list of triples"):
        RigidMotion(value)


def test_motions_that_are_too_far_or_too_long_are_refused():
    scene = toy.plate().scene
    for wrong in ({"translation": (1e300, 0, 0)}, {"rotation": 1e300}, {"rotation": 30, "axis": (1e-300, 0, 0)}):
        with pytest.raises(ConfigError, match=f"^{list(wrong)[-1]} of a motion must be"):
            RigidMotion(**wrong)
    frames = frames_for(scene, {1: (1e15, 0, 0)}, 1e-6)
    assert frames == pytest.approx(1e21, rel=1e-5)
    for count in (frames, 2**63 - 1, 2_000_000):
        with pytest.raises(ConfigError, match=f"a motion of {count:,} frames would take .* GB: give a shorter"):
            Motion.of_bodies(scene, {1: (0, 0, -0.01)}, count)

"""Which nodes a reaction is of, and around which axis they turn."""

import numpy as np
import pytest
from meshes import box
from scipy.spatial.transform import Rotation

from ast_sim.mechanics.driven import Driven
from ast_sim.scene import NodeType, Scene

X, LENGTH = np.eye(3)[0], 4.0


def bar(held: np.ndarray | None = None, second: bool = False) -> Scene:
    """A bar along x with handles at both ends; a rigid block above it if `second`."""
    nodes, elements = box((8, 2, 2), (LENGTH, 1, 1))
    types = np.where(np.isclose(abs(nodes[:, 0]), LENGTH / 2) if held is None else held(nodes), NodeType.HANDLE, 0)
    body = np.zeros(len(nodes))
    if second:
        block, more = box((1, 1, 1), (1, 1, 1), (0, 0, 3))
        nodes, elements = np.concatenate([nodes, block]), np.concatenate([elements, more + len(nodes)])
        types, body = np.append(types, [NodeType.OBSTACLE] * 8), np.append(body, [1] * 8)
    return Scene(np.float32(nodes), np.int32(elements), np.uint8(types), np.int32(body))


def turned(points: np.ndarray, degrees: float, axis=X, point=(0.0, 0.0, 0.0)) -> np.ndarray:
    return Rotation.from_rotvec(np.radians(degrees) * np.array(axis)).apply(points - point) + point


def driven(scene: Scene, *moves, frames: int = 4) -> Driven:
    """`moves` are pairs: a function of the rest positions that selects nodes, and one of a share that moves them."""
    rest = scene.rest_position.astype(float)
    targets = np.repeat(rest[None], frames, axis=0)
    for where, motion in moves:
        for frame, share in enumerate(np.linspace(0, 1, frames)):
            targets[frame, where(rest)] = motion(rest[where(rest)], share)
    return Driven.of(scene, targets)


def right(x):
    return np.isclose(x[:, 0], LENGTH / 2)


def left(x):
    return np.isclose(x[:, 0], -LENGTH / 2)


def test_of_a_part_that_is_held_and_moved_it_is_the_moved_end():
    scene = bar()
    found = driven(scene, (right, lambda x, share: x + [0, 0, share]))
    np.testing.assert_array_equal(found.nodes, right(scene.rest_position))
    assert found.axis is None and found.body == 0


def test_of_two_ends_that_move_apart_it_is_the_one_that_goes_farther():
    scene = bar()
    found = driven(scene, (right, lambda x, share: x + share * X), (left, lambda x, share: x - 1.1 * share * X))
    np.testing.assert_array_equal(found.nodes, left(scene.rest_position))


def test_two_ends_that_move_alike_are_one_clamp():
    scene = bar()
    found = driven(scene, *((end, lambda x, share: x + share * X) for end in (left, right)))
    np.testing.assert_array_equal(found.nodes, scene.prescribed)


@pytest.mark.parametrize("degrees", [20.0, 150.0, -150.0, 300.0])
def test_a_twisted_end_has_its_middle_which_stands_still_and_its_axis(degrees):
    """The middle of the other end stands still on the axis, too, but it is held there by its neighbours."""
    scene = bar()
    found = driven(scene, (right, lambda x, share: turned(x, degrees * share)), frames=5)
    np.testing.assert_array_equal(found.nodes, right(scene.rest_position))
    assert found.axis.direction == pytest.approx(np.sign(degrees) * X, abs=1e-6)
    assert found.axis.point == pytest.approx([LENGTH / 2, 0, 0], abs=1e-6)


def test_an_end_that_is_turned_about_a_line_in_it_has_the_nodes_of_that_line():
    scene = bar()
    found = driven(scene, (right, lambda x, share: turned(x, 30 * share, [0, 1, 0], (LENGTH / 2, 0, 0))))
    np.testing.assert_array_equal(found.nodes, right(scene.rest_position))


def test_the_torque_is_about_the_pivot_of_a_lever():
    """A force of 3 N, 5 m from the pivot; and the pitch of a screw adds nothing."""
    scene, pivot = bar(second=True), np.array([0, -2.0, 3.0])

    def block(x):
        return scene.body == 1

    found = driven(scene, (block, lambda x, share: turned(x, 40 * share, X, pivot) + share * X))
    np.testing.assert_array_equal(found.nodes, scene.body == 1)
    assert found.axis.direction == pytest.approx(X, abs=1e-6) and found.axis.point[1:] == pytest.approx(pivot[1:])
    at = np.array([[7.0, 3.0, 3.0]])
    assert found.axis.torque(at, np.array([[9.0, 0, 3]])) == pytest.approx(15)
    assert found.axis.torque(at, np.array([[9.0, 3, 0]])) == pytest.approx(0, abs=1e-9)


def test_a_clamp_that_changes_shape_has_no_axis():
    scene = bar()
    found = driven(scene, (right, lambda x, share: x + share * X + share * 0.3 * np.sin(5 * x[:, [2, 0, 1]])))
    np.testing.assert_array_equal(found.nodes, right(scene.rest_position))
    assert found.axis is None


def test_noise_of_a_clamp_is_no_motion():
    scene, rng = bar(), np.random.default_rng(0)
    found = driven(
        scene,
        (left, lambda x, share: x + share * 1e-5 * rng.normal(size=x.shape)),
        (right, lambda x, share: x + share * X),
    )
    np.testing.assert_array_equal(found.nodes, right(scene.rest_position))


def test_where_nothing_moves_all_prescribed_nodes_of_a_body_count():
    scene = bar()
    found = driven(scene)
    np.testing.assert_array_equal(found.nodes, scene.prescribed)
    assert found.axis is None

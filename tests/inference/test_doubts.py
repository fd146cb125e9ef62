"""What is said against a question or an answer whose numbers look as good as others."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

import ast_sim
from ast_sim.inference.answering import doubts
from ast_sim.support.errors import DatasetError


@pytest.fixture(scope="module")
def plate():
    """A plate and a punch, as the run that comes with the package knows them, and their motion."""
    scene = ast_sim.Scene.join(
        ast_sim.plate((0.48, 0.32, 0.03), cells=(8, 6, 2)),
        ast_sim.box((-0.05, -0.05, 0.023), (0.05, 0.05, 0.123), cells=(2, 2, 2)),
    )
    motion = np.repeat(scene.rest_position[None], 2, axis=0)
    motion[1, scene.node_type == ast_sim.NodeType.OBSTACLE] -= np.float32([0, 0, 0.03])
    return scene, motion


def told(scene, motion):
    """The warnings of a prediction by the run that comes with the package."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        answer = ast_sim.example_run("plates").predict(scene, motion, effort=ast_sim.Effort())
    return answer, [str(one.message) for one in caught]


def test_elements_that_are_turned_over_are_told_with_their_number_and_frame(plate):
    scene, motion = plate
    answer, before = told(scene, motion)
    assert not any("turned over" in line for line in before)
    position = answer.position.copy()
    corner = scene.elements[np.flatnonzero(scene.deforming_elements)[0]]
    position[1, corner[3]] = 2 * position[1, corner[:3]].mean(axis=0) - position[1, corner[3]]
    bent = replace(answer, position=position)
    count = int(bent.check().turned_over.value)
    assert count > 0
    assert doubts(bent) == [f"{count} elements are turned over in frame 1, which no body can do (Answer.check)"]
    assert doubts(answer) == []


def test_elements_that_are_numbered_inside_out_are_not_turned_over(plate):
    """As `Answer.check` counts: what matters is the sign at rest."""
    scene, motion = plate
    numbered = replace(scene, elements=scene.elements[:, [0, 1, 3, 2]])
    answer, lines = told(numbered, motion)
    assert answer.check().turned_over.value == 0 and not any("turned over" in line for line in lines)


def test_a_scene_so_flat_that_its_answer_turns_over_is_told(plate):
    """Its size and its edges are as in training; before, only Newton steps said that something is wrong."""
    scene, motion = plate
    flat = np.float32([1, 1, 1e-3])
    _, lines = told(replace(scene, rest_position=scene.rest_position * flat), motion * flat)
    assert any("elements are turned over in frame 1" in line for line in lines)


def test_positions_that_single_precision_has_rounded_are_refused(plate):
    scene, motion = plate
    for distance, fits in ((1e3, True), (1e6, False)):
        shift = np.float32([distance, 0, 0])
        moved = replace(scene, rest_position=scene.rest_position + shift)
        if fits:
            told(moved, motion + shift)
            continue
        with pytest.raises(
            DatasetError, match=r"lies 1e\+06 from the origin, where single precision keeps steps of 0.06"
        ):
            told(moved, motion + shift)


def test_free_nodes_of_no_element_are_told(plate):
    scene, motion = plate
    more = np.float32([[0.01 * k, 0, 0.01] for k in range(3)])
    wider = ast_sim.Scene(
        np.concatenate([scene.rest_position, more]),
        scene.elements,
        np.concatenate([scene.node_type, np.zeros(3, np.uint8)]),
        np.concatenate([scene.body, np.zeros(3, np.int32)]),
    )
    _, lines = told(wider, np.concatenate([motion, np.repeat(more[None], 2, axis=0)], axis=1))
    assert any("3 free nodes belong to no element: what is predicted for them means nothing" in line for line in lines)

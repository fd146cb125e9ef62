"""What `ast-sim info` says of a dataset."""

from dataclasses import replace

import numpy as np
import pytest
from data_samples import block, write

import ast_sim
from ast_sim.dataset.contents import describe_dataset, text
from ast_sim.dataset.reader import Dataset
from ast_sim.element_topology import MIDDLES, linear_elements, signed_volumes
from ast_sim.scene import NodeType, Scene, Trajectory


def moved(node, by):
    scene = block(2, 1, 1)
    position = np.stack([scene.rest_position] * 3)
    position[1:, node] += np.float32(by)
    return Trajectory(scene, position)


def test_the_box_and_the_largest_displacement_of_each_split(tmp_path):
    train = [moved(0, (-0.5, 0, 0)), moved(11, (0.3, 0, 0.4))]
    path = write(tmp_path / "d.h5", {"train": train, "test": [moved(5, (0, 0, 0))]})
    found = describe_dataset(path)
    splits = found["splits"]
    assert splits["train"]["bounding_box"] == [[-0.5, 0, 0], [2.3, 1, 1.4]]
    assert splits["train"]["largest_displacement"] == 0.5
    assert splits["test"]["bounding_box"] == [[0, 0, 0], [2, 1, 1]]
    assert splits["test"]["largest_displacement"] == 0
    shown = text(found)
    assert "bounding_box          [-0.5, 0.0, 0.0], [2.3, 1.0, 1.4]" in shown
    assert "largest_displacement  0.5" in shown


def test_the_fields_are_the_arrays_of_the_file(tmp_path):
    shown = describe_dataset(write(tmp_path / "d.h5", {"train": [moved(0, (0.1, 0, 0))]}))
    assert list(shown["splits"]["train"]["fields"]) == ["rest_position", "elements", "node_type", "body", "position"]


@pytest.mark.parametrize(("integration", "told"), [("quasi_static", 0), ("dynamic", 1)])
def test_frames_that_stop_dead_are_told_where_bodies_have_inertia(tmp_path, integration, told):
    """A quasi-static frame is the one before once more wherever all prescribed nodes hold still."""
    frames = moved(0, (0.1, 0, 0)).position[[0, 0, 1, 1, 1]]  # rests, moves, and stops at once in frame 3
    frames[4, 5] += np.float32(0.1)
    path = write(tmp_path / "d.h5", {"train": [Trajectory(block(2, 1, 1), frames)]}, integration=integration)
    wrong = [(one["what"], one["count"], one["places"]) for one in describe_dataset(path)["looks_wrong"]]
    assert wrong.count(("frames that repeat", 1, "frame 3")) == told == sum("repeat" in what for what, *_ in wrong)


def test_elements_that_all_lie_at_one_point_are_told(tmp_path):
    scene = block(1, 1, 1)
    flat = replace(scene, rest_position=np.zeros_like(scene.rest_position), elements=scene.elements[[0, 0]])
    path = write(tmp_path / "d.h5", {"train": [Trajectory(flat, np.stack([flat.rest_position, scene.rest_position]))]})
    wrong = {one["what"]: one["meaning"] for one in describe_dataset(path)["looks_wrong"]}
    assert {"elements that stand twice", "elements inside out"} <= set(wrong)
    assert wrong["frames with very large displacements"].startswith("nodes move by 1.73, from one point")


def test_what_the_solver_makes_looks_right(tmp_path):
    """In plate 6 the obstacle holds still in frames 30 and 31."""
    press = {"nodes": 100, "frames": 41, "keep": (29, 30, 31), "workers": 1, "progress": False}
    ast_sim.generate("deforming_plate", tmp_path / "d.h5", train=7, valid=0, test=0, **press)
    with Dataset(tmp_path / "d.h5") as data:
        position = data["train"][6].position
    assert np.array_equal(position[1], position[2]) and np.array_equal(position[2], position[3])
    assert describe_dataset(tmp_path / "d.h5")["looks_wrong"] == []


@pytest.mark.parametrize(("curved", "told"), [(1, 0), (4, 1)])
def test_curved_edges_of_a_good_element_are_not_told(tmp_path, curved, told):
    """A piece between nodes is inside out, but the determinant is above 0 in the whole element, unless its edges are
    curved more."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    points = np.concatenate([corners, [corners[list(ends)].mean(axis=0) for ends in MIDDLES]])
    points[[7, 9]] += curved * np.array([(0.21, -0.04, 0.02), (-0.22, -0.23, 0.02)])
    kinds = np.where(points[:, 2] == 0, NodeType.HANDLE, NodeType.NORMAL).astype(np.uint8)
    scene = Scene(np.float32(points), np.arange(10, dtype=np.int32)[None], kinds, np.zeros(10, np.int32))
    assert (signed_volumes(scene.rest_position, linear_elements(scene.elements)) < 0).any()
    frames = np.stack([scene.rest_position, scene.rest_position + np.float32(0.1)])
    path = write(tmp_path / "d.h5", {"train": [Trajectory(scene, frames)]})
    kinds_of_wrong = [one["what"] for one in describe_dataset(path)["looks_wrong"]]
    assert sum("inside out" in what for what in kinds_of_wrong) == told

"""What `ast-sim info` says of a dataset."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from data_samples import block, write

import ast_sim
from ast_sim.dataset.contents import describe_dataset, text
from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.element_topology import linear_elements, signed_volumes
from ast_sim.scene import Trajectory
from ast_sim.simulate.families import assembly
from ast_sim.simulate.own_assembly.parameters import values_of
from ast_sim.simulate.own_assembly.spec_reader import read_spec


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
    assert wrong.count(("frames that repeat", 1, "frames 3")) == told == sum("repeat" in what for what, *_ in wrong)


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


def test_curved_edges_of_a_good_element_are_not_told(tmp_path):
    """An element of the ram has a piece between nodes that is inside out, and det J > 0."""
    clips = Path(__file__).parents[2] / "examples" / "clip"
    with Dataset(clips / "test_scenes.h5") as data:
        values = values_of(data.attributes("test", 1))
        case = assembly.scene_of(read_spec(clips / "SPEC.toml"), values, 1400, 7).case
        path = tmp_path / "clip.h5"
        stress = np.zeros((1, case.scene.num_nodes, 1), np.float32)
        with DatasetWriter(path, data.info) as writer:
            writer.add("test", Trajectory(case.scene, case.scene.rest_position[None], stress))
    pieces = signed_volumes(case.scene.rest_position, linear_elements(case.scene.elements))
    assert int((pieces < 0).sum()) == 1
    assert describe_dataset(path)["looks_wrong"] == []

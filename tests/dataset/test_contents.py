"""What `ast-sim info` says of a dataset."""

import numpy as np
from data_samples import block, write

from ast_sim.dataset.contents import describe_dataset, text
from ast_sim.scene import Trajectory


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

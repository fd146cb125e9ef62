"""Scenes that have trained or chosen a run are known in other datasets, too."""

import dataclasses

import numpy as np
import pytest
import toy

import ast_sim
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.support.errors import ConfigError

SMALL = {"steps": 2, "batch_size": 2, "model": "mgn", "model_settings": {"hidden": 8, "blocks": 1}}


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run that has learned from 40 plates for a moment, and its dataset."""
    folder = tmp_path_factory.mktemp("known")
    data = toy.write(folder / "toy.h5", (40, 1, 24))
    return ast_sim.train(data, folder / "run", **SMALL), data


def converted_again(path, data, known, new):
    """A dataset with these training scenes (by number) and test scenes of another one, each of them in three
    splits, with other attributes."""
    with ast_sim.Dataset(data) as first:
        scenes = [first["train"][index] for index in known] + [first["test"][index] for index in range(new)]
        with DatasetWriter(path, first.info) as writer:
            for split in ("train", "calibration", "test"):
                for scene in scenes:
                    writer.add(split, dataclasses.replace(scene, attributes={"origin_of_file": "again"}))
    return path


def test_calibration_leaves_out_scenes_that_trained_the_run_and_counts_them(trained, tmp_path):
    run, data = trained
    mixed = converted_again(tmp_path / "mixed.h5", data, (3, 7, 30), 24)
    with pytest.warns(
        UserWarning, match="3 scenes do not count, which have trained or chosen the run; the first is cal"
    ):
        mine = ast_sim.calibrate(run, mixed)
    assert mine == ast_sim.calibrate(run, data, "test")


def test_too_few_scenes_are_left_without_the_known_ones(trained, tmp_path):
    run, data = trained
    most = converted_again(tmp_path / "most.h5", data, range(20), 2)
    with pytest.raises(
        ConfigError, match="19 calibration scenes, and there are 22, 20 of which have trained or chosen"
    ):
        ast_sim.calibrate(run, most)
    every = converted_again(tmp_path / "every.h5", data, range(20), 0)
    for split in ("train", "calibration"):
        with pytest.raises(ConfigError, match=f"the scenes of {split} have trained or chosen the run"):
            ast_sim.calibrate(run, every, split)


def test_trade_refuses_known_scenes_and_evaluation_tells_them(trained, tmp_path):
    run, data = trained
    mixed = converted_again(tmp_path / "mixed.h5", data, (3,), 2)
    with pytest.raises(
        ConfigError, match="1 of 3 scenes of test have trained or chosen the run, the first is test/000000"
    ):
        ast_sim.trade(run, mixed)
    with pytest.warns(UserWarning, match=r"learned from 1 of 3 scenes \(.*split test; the first is test/000000\): new"):
        run.evaluate(mixed, solver_scenes=0)


def test_a_file_and_a_run_that_starts_from_another_know_the_scenes_of_both(trained, tmp_path):
    run, data = trained
    run.save(tmp_path / "file.ast")
    with DatasetWriter(tmp_path / "other.h5", toy.info()) as writer:
        for number, split in enumerate(("train", "train", "train", "train", "valid")):
            writer.add(split, toy.plate(500 + number))
    longer = ast_sim.train(tmp_path / "other.h5", tmp_path / "longer", from_run=tmp_path / "file.ast", steps=2)
    mixed = converted_again(tmp_path / "mixed.h5", data, (3,), 2)
    for one, known in ((ast_sim.Run(tmp_path / "file.ast"), 40), (longer, 44)):
        assert len(one.folder.scenes("train")) == known
        with ast_sim.Dataset(mixed) as dataset:
            assert one.folder.learned(dataset, "test") == [0]


def test_only_the_scenes_that_were_used_are_known(trained, tmp_path):
    _, data = trained
    few = ast_sim.train(data, tmp_path / "few", scenes=5, **SMALL)
    assert few.folder.scenes("train") == trained[0].folder.scenes("train")[:5]


def test_one_position_makes_another_scene(trained, tmp_path):
    run, data = trained
    with ast_sim.Dataset(data) as first, DatasetWriter(tmp_path / "moved.h5", first.info) as writer:
        scene = first["train"][3]
        position = scene.position.copy()
        position[-1, 0, 2] = np.nextafter(position[-1, 0, 2], np.float32(1))
        writer.add("test", dataclasses.replace(scene, position=position))
    with ast_sim.Dataset(tmp_path / "moved.h5") as dataset:
        assert run.folder.learned(dataset, "test") == []

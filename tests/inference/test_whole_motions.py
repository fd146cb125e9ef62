"""Files with some frames of a motion: a model would take the first one for the start, and frames apart for neighbours.

Frames that `generate` keeps are numbered 0, 1, 2 and so on; tests/inference/test_trade.py evaluates such a file.
"""

import dataclasses

import h5py
import pytest
import toy

import ast_sim
from ast_sim import Dataset, DatasetWriter
from ast_sim.cli import main
from ast_sim.simulate.jobs.fastest_solver import deepest_frame, solver_outcomes
from ast_sim.support.errors import ConfigError, DatasetError

SMALL = {"model": "mgn", "model_settings": {"hidden": 16, "blocks": 1}, "steps": 1, "validate_scenes": 1}
ADVICE = "a model needs all frames from 0 on; write whole trajectories; frames that are a motion of their own are"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    return ast_sim.train(toy.write(folder / "toy.h5"), folder / "run", **SMALL, progress=False)


def with_gaps(path, split, frames, dynamic=False):
    """A dataset of which the last scene of a split has these frames of its motion only."""
    with DatasetWriter(path, toy.info(dynamic)) as writer:
        for name in ("train", "valid", "test"):
            for seed in range(2):
                whole = toy.plate(seed, dynamic=dynamic)
                writer.add(name, whole.select(frames) if (name, seed) == (split, 1) else whole)
    return path


@pytest.mark.parametrize(
    ("frames", "shown", "dynamic"),
    [
        ([2, 4, 6], "2, 4, 6", False),
        ([0, 2, 4], "0, 2, 4", False),
        ([1, 2, 3], "1 to 3", False),
        ([5], "5", False),
        ([0, 1, 3, 6], "0 to 1, 3, 6", True),
    ],
)
@pytest.mark.parametrize("split", ["train", "valid"])
def test_no_training_begins_on_them(tmp_path, split, frames, shown, dynamic):
    path = with_gaps(tmp_path / "a.h5", split, frames, dynamic)
    message = f"a.h5: {split}/000001 has the frames {shown} of a motion: {ADVICE}"
    with pytest.raises(ConfigError, match=message):
        ast_sim.train(path, tmp_path / "run", **SMALL)
    assert not (tmp_path / "run").exists()
    with Dataset(path) as data:
        for begin in (
            lambda: ast_sim.new_model(data, "mgn"),
            lambda: data.torch(split),
            lambda: ast_sim.new_model(toy.write(tmp_path / "whole.h5", dynamic=dynamic), "mgn").pairs(data, split),
        ):
            with pytest.raises(ConfigError, match=message):
                begin()


@pytest.mark.parametrize("frames", [["first", "last"], [0.0, float("nan")]])
def test_numbers_that_are_none_are_refused_by_name(tmp_path, frames):
    path = toy.write(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        file["train/000001"].attrs["frames"] = frames
    with pytest.raises(DatasetError, match="a.h5: .*attribute.* of train/000001 cannot be read; the file is damaged"):
        ast_sim.train(path, tmp_path / "run", **SMALL)


@pytest.mark.parametrize(("frames", "shown"), [([2, 4, 6], "2, 4, 6"), ([0, 2, 4, 6], "0, 2, 4, 6"), ([5], "5")])
def test_no_evaluation_begins_on_them(run, tmp_path, capsys, monkeypatch, frames, shown):
    monkeypatch.setattr(type(run.folder), "learned", lambda *_: [])  # the scenes are of the training
    path = with_gaps(tmp_path / "a.h5", "test", frames)
    message = f"a.h5: test/000001 has the frames {shown} of a motion: {ADVICE}"
    told = []
    for begin in (
        lambda: run.evaluate(path, solver_scenes=0, progress=lambda *values: told.append(values)),
        lambda: ast_sim.trade(run, path, progress=False),
        lambda: solver_outcomes(path, "test", [0]),
    ):
        with pytest.raises(ConfigError, match=message):
            begin()
    assert not told
    assert main(["evaluate", str(run.path), str(path)]) == 2
    assert message in capsys.readouterr().err
    assert run.evaluate(path, "valid", solver_scenes=0, progress=False).figures.failures == 0


def test_frames_of_an_answer_are_no_test_scene_until_they_are_numbered_from_0(run, tmp_path):
    with Dataset(run.settings.data) as data:
        truth = data["test"][0]
    answer = run.predict(truth, frames=[2, 4], progress=False)
    answer.save(tmp_path / "answer.h5")
    with pytest.raises(ConfigError, match="test/000000 has the frames 2, 4 of a motion"):
        run.evaluate(tmp_path / "answer.h5", solver_scenes=0)
    with DatasetWriter(tmp_path / "own.h5", run.info) as writer:
        writer.add("test", dataclasses.replace(answer.trajectory, frames=None, times=None))
    figures = run.evaluate(tmp_path / "own.h5", solver_scenes=0, progress=False).figures
    assert [scene.frames for scene in figures.scenes] == [2]


def test_the_deepest_frame_is_a_row():
    whole = toy.plate()  # the block is lowest in frame 3 of 0 to 6
    assert deepest_frame(whole) == 3
    part = whole.select([0, 3, 6])
    assert deepest_frame(part) == 1 and part.numbers[1] == 3

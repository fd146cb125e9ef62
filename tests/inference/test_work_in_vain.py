"""Work that would be in vain is refused before it begins, and what is lost is told: calibrations, datasets, outputs."""

import re
import shutil
from dataclasses import replace

import pytest
import toy

import ast_sim
from ast_sim.cli import main
from ast_sim.runs import checkpoint
from ast_sim.support.errors import AstSimError, CheckpointError, ConfigError, DatasetError, TrainingError
from ast_sim.training.start import start_training

SMALL = {"steps": 4, "batch_size": 2, "model": "mgn", "model_settings": {"hidden": 8, "blocks": 1}}


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run that has learned for a moment, and its dataset; 20 test scenes or more lie within its training."""
    folder = tmp_path_factory.mktemp("kept")
    data = toy.write(folder / "toy.h5", (40, 1, 24))
    return ast_sim.train(data, folder / "run", **SMALL).path, data


def test_a_run_that_trains_is_not_calibrated(trained, tmp_path):
    """Its best checkpoint may be another one at the end: 40 scenes were measured in vain."""
    path, data = trained
    run = ast_sim.Run(shutil.copytree(path, tmp_path / "run"))
    measured = []
    with checkpoint.lock(run.path), pytest.raises(CheckpointError, match="is in use by process"):
        ast_sim.calibrate(run, data, "test", progress=lambda *told: measured.append(told))
    assert not measured and run.calibration is None
    ast_sim.calibrate(run, data, "test", progress=False)
    assert ast_sim.Run(run.path).calibration == run.calibration is not None


def test_a_run_that_cannot_be_written_is_not_calibrated(trained, tmp_path, monkeypatch):
    path, data = trained
    run = ast_sim.Run(path)
    measured = []

    def read_only(name):
        raise AstSimError(f"{name} cannot be written (Read-only file system): choose another place")

    monkeypatch.setattr("ast_sim.runs.folder.output_file", read_only)
    with pytest.raises(CheckpointError, match=r"run cannot be written, so it cannot keep .*: calibrate a copy, or"):
        ast_sim.calibrate(run, data, "test", progress=lambda *told: measured.append(told))
    assert not measured and run.calibration is None
    run.save(tmp_path / "run.ast")  # a file is not written
    opened = ast_sim.Run(tmp_path / "run.ast")
    with pytest.warns(UserWarning, match="is a file, which is not changed"):
        assert ast_sim.calibrate(opened, data, "test", progress=False) == opened.calibration


def test_why_too_few_scenes_count_is_told(trained):
    """22 scenes of another mesh did not count, and the advice was to make more."""
    path, data = trained
    run = ast_sim.Run(path)
    run.scope = replace(run.scope, nodes=(500, 600))
    with pytest.raises(ConfigError) as caught:
        ast_sim.calibrate(run, data, "test", progress=False)
    left_out = (
        r"24, 24 of which lie outside the training or do not move \(the first, test/000000: the scene has 5. nodes"
    )
    assert re.search(left_out, str(caught.value))
    assert str(caught.value).endswith(
        "in training 500 to 600): make more with generate(..., calibration=N)"
        " (--calibration N), like the training scenes"
    )


def test_a_training_tells_that_a_calibration_does_not_hold_any_more(trained, tmp_path):
    path, data = trained
    run = tmp_path / "run"

    class Stopped(Exception):
        """Ends a training."""

    def stop(step, figures):
        raise Stopped

    with pytest.raises(Stopped):
        ast_sim.train(data, run, **SMALL, validate_every=2, log_every=2, callback=stop)
    lines = []
    mark = checkpoint.read_best(run) or checkpoint.Best(2, 1.0, {})
    checkpoint.mark_best(run, mark.step, 1e6, {"calibration": {"scenes": 20}})
    ast_sim.train(
        data, run, **SMALL, validate_every=2, log_every=2, resume=True, progress=lambda _, __, text: lines.append(text)
    )
    (told,) = [line for line in lines if line.startswith("the calibration was of step 2 and does not hold")]
    assert told.endswith("answers have no band until the run is calibrated again")
    assert "calibration" not in checkpoint.read_best(run).answers


def test_a_run_that_was_moved_while_it_trained_is_named(trained, tmp_path):
    _, data = trained
    run = tmp_path / "run"
    moved = []

    def move(step, figures):
        if not moved:
            moved.append(run.rename(tmp_path / "elsewhere"))

    with pytest.raises(TrainingError, match=r"run is gone since the training began: if it was moved, go on with"):
        ast_sim.train(data, run, **SMALL, validate_every=2, log_every=1, callback=move)
    ast_sim.train(data, moved[0], **SMALL, validate_every=2, log_every=1, resume=True)


def test_a_dataset_that_is_gone_is_told_with_what_to_do(tmp_path):
    data = toy.write(tmp_path / "toy.h5", (3, 1, 1))
    run = ast_sim.train(data, tmp_path / "run", **SMALL)
    data.rename(tmp_path / "moved.h5")
    for use in (run.evaluate, run.open, lambda: start_training(run.path, resume=True)):
        with pytest.raises(DatasetError, match=r"toy.h5, from which .*run learned, is not there: name the dataset"):
            use()
    run.open(tmp_path / "moved.h5").close()


def test_a_table_of_forces_does_not_replace_the_answer(tmp_path, capsys):
    """`--out a.csv --forces a.csv` wrote one over the other, and said nothing."""
    (tmp_path / "a").mkdir()
    for forces in (tmp_path / "a.csv", tmp_path / "a" / ".." / "a.csv"):
        words = ["predict", "run", "mesh.vtu", "--out", str(tmp_path / "a.csv"), "--forces", str(forces)]
        assert main(words) == 2
        assert "would overwrite the prediction of --out: name another file" in capsys.readouterr().err
    assert main([*words[:5], "--forces", str(tmp_path / "a.txt")]) == 2
    assert f"--forces {tmp_path / 'a.txt'}: the name of a table of forces must end in .csv" in capsys.readouterr().err

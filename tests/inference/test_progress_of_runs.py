"""The functions of a run that may take long tell how far they are, all in the same way, and are quiet if asked."""

import logging
import shutil
import warnings

import pytest
import toy

from ast_sim import Dataset, Run, calibrate, trade, train
from ast_sim.support.errors import ConfigError


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The dataset, and its run that jumps."""
    folder = tmp_path_factory.mktemp("progress")
    data = toy.write(folder / "toy.h5", (2, 1, 2))
    few = {"hidden": 8, "blocks": 1, "jumps": True}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run = train(data, folder / "run", model="mgn", model_settings=few, steps=2, batch_size=2, progress=False)
    return data, run


class Told(list):
    """What a function was told."""

    def __call__(self, done: int, total: int, text: str) -> None:
        self.append((done, total, text))


def test_a_quiet_training_writes_nothing_but_the_log(trained, tmp_path, capfd, caplog):
    caplog.set_level(logging.INFO, "ast_sim")
    few = {"hidden": 8, "blocks": 1}
    told = Told()
    for progress in (False, told):
        folder = tmp_path / str(callable(progress))
        options = {"steps": 6, "batch_size": 2, "log_every": 2, "model": "mgn", "model_settings": few}
        train(trained[0], folder, **options, progress=progress)
        assert capfd.readouterr() == ("", "")
        assert (folder / "metrics.jsonl").read_text().count("loss") == 3
    lines = [record.message for record in caplog.records if record.name == "ast_sim"]
    assert sum(line.startswith("parameters  ") for line in lines) == 2
    assert sum(line.startswith("validation after step 6") for line in lines) == 2
    assert {total for _, total, _ in told} == {6}
    steps = [(done, text) for done, _, text in told if ": " not in text]
    assert steps == [(step, f"step {step}") for step in range(1, 7)]
    lines = [(done, text.split(": ")[0]) for done, _, text in told if ": " in text]
    assert [line for line in lines if "validation" not in line[1]] == [(step, f"step {step}/6") for step in (2, 4, 6)]
    validations = [line for line in lines if "validation" in line[1]]
    assert validations == [(step, f"validation after step {step}") for step in range(1, 7)]
    assert next(text for _, _, text in told if "/6: " in text).startswith("step 2/6: loss ")


def test_scenes_that_are_predicted_together_count_frames(trained, capfd):
    data, run = trained
    with Dataset(data) as dataset:
        truths = list(dataset["test"])
    scenes = [(truth.scene, truth.position) for truth in truths]
    told = Told()
    answers = run.predict_scenes(scenes, progress=told)
    assert [done for done, _, _ in told][-1] == told[0][1] == sum(len(answer.position) - 1 for answer in answers) == 12
    told.clear()
    run.predict_motions(*scenes[0][:1], (one.position for one in truths[:1] * 3), frames=[-1], progress=told)
    assert told[-1][:2] == (3, 3)
    assert len(run.predict_scenes(iter(scenes), progress=False)) == len(scenes)
    for scenes, must in ((-1, "at least 0"), (1.5, "a whole number")):
        with pytest.raises(ConfigError, match=f"solver_scenes is {scenes}; it must be {must}"):
            run.evaluate(data, solver_scenes=scenes)
    assert capfd.readouterr() == ("", "")


def test_evaluation_and_trade_count_scenes(trained, capfd):
    data, run = trained
    told = Told()
    run.evaluate(data, progress=told)
    assert told == [(number, 6, f"test/00000{(number - 1) % 2}") for number in range(1, 7)]  # the solver refuses both
    told.clear()
    trade(run, data, solver_seconds=1.0, progress=told)
    assert told == [(1, 2, "test/000000"), (2, 2, "test/000001")]
    assert capfd.readouterr() == ("", "")


def test_calibration_counts_scenes(tmp_path, trained, capfd, monkeypatch):
    data = toy.write(tmp_path / "toy.h5", (0, 0, 19))
    run = Run(shutil.copytree(trained[1].path, tmp_path / "run"))
    told = Told()
    monkeypatch.setattr("ast_sim.inference.calibrate._known_scenes", lambda *_: [])  # three are of the training
    with pytest.raises(ConfigError, match="at least 19 calibration scenes, and there are 19, [0-9]+ of which lie outs"):
        calibrate(run, data, "test", progress=told)
    assert not told  # before it begins
    monkeypatch.setattr("ast_sim.inference.calibrate._why_not", lambda *_: "")
    assert calibrate(run, data, "test", progress=told).scenes == 19
    assert told[-1] == (19, 19, "test/000018") and len(told) == 19
    assert capfd.readouterr() == ("", "")


def test_a_function_may_stop_the_work(trained):
    def stop(done: int, total: int, text: str) -> None:
        raise KeyboardInterrupt

    data, run = trained
    with pytest.raises(KeyboardInterrupt):
        run.evaluate(data, progress=stop)
    with Dataset(data) as dataset, pytest.raises(KeyboardInterrupt):
        truth = dataset["test"][0]
        run.predict_scenes([(truth.scene, truth.position)], progress=stop)

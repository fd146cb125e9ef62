"""Training for a number of minutes, and the word that more scenes would help more."""

from types import SimpleNamespace

import pytest

from ast_sim.runs.config_toml import read_config
from ast_sim.runs.metrics import Metrics
from ast_sim.support.errors import ConfigError
from ast_sim.training import loop, start, time_budget

pytestmark = pytest.mark.usefixtures("linear")
SMALL = ["train.batch_size=2", "train.statistics_pairs=4", "train.checkpoint_every=5"]


def minutes(data, value: float, *more: str):
    return start.configure(data, "tiny", [*SMALL, f"train.minutes={value}", *more])


def test_the_steps_fill_the_minutes_that_the_validations_leave(data, tmp_path, monkeypatch, capsys):
    """With a clock that goes on by 0.125 s whenever it is read, a step takes 0.125 s, and so does a validation:
    (6 - 10 x 0.125) / 0.125 = 38 steps."""
    readings = iter(range(10**6))
    monkeypatch.setattr(time_budget, "time", SimpleNamespace(perf_counter=lambda: 0.125 * next(readings)))
    start.start_training(tmp_path / "run", minutes(data, 0.1))
    train = read_config(tmp_path / "run").train
    assert (train.steps, train.minutes) == (38, 0.1)
    assert train.decay == 38 and train.warmup == 1 and train.validate_every == 3
    assert "38 steps, since a step takes 125.0 ms" in capsys.readouterr().out
    assert [record["step"] for record in Metrics(tmp_path / "run") if "valid_rmse" in record][-1] == 38


def test_a_resumed_training_keeps_the_steps_that_were_fixed(data, tmp_path, monkeypatch):
    monkeypatch.setattr(start, "steps_within", lambda *_: 10)
    start.start_training(tmp_path / "run", minutes(data, 0.1))
    monkeypatch.setattr(start, "steps_within", lambda *_: pytest.fail("timed again"))
    start.start_training(tmp_path / "run", minutes(data, 0.1), resume=True)
    start.start_training(tmp_path / "run", resume=True)
    assert read_config(tmp_path / "run").train.steps == 10
    monkeypatch.setattr(start, "steps_within", lambda *_: 20)
    with pytest.raises(ConfigError, match=r"started with train.steps = 10, not 20|started with train.minutes = 0.1"):
        start.start_training(tmp_path / "run", minutes(data, 0.2), resume=True)


def test_minutes_and_steps_exclude_each_other(data, tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match="train.minutes and train.steps exclude each other"):
        minutes(data, 1, "train.steps=5")
    with pytest.raises(ConfigError, match="train.minutes"):
        start.start_training(tmp_path / "none", minutes(data, 0))
    with pytest.raises(ConfigError, match="too few for one step"):
        start.start_training(tmp_path / "none", minutes(data, 0.001))
    monkeypatch.setattr(start, "steps_within", lambda *_: 10)
    start.start_training(tmp_path / "run", minutes(data, 0.1))
    of_file = start.configure(data, config=tmp_path / "run" / "config.toml")
    assert (of_file.train.steps, of_file.train.minutes) == (10, None)
    again = start.configure(data, config=tmp_path / "run" / "config.toml", changes={"train.minutes": 2.0})
    assert (again.train.steps, again.train.minutes, again.train.decay) == (None, 2.0, None)
    further = start.configure(data, from_run=tmp_path / "run")
    assert (further.train.steps, further.train.minutes) == (10, None)


@pytest.mark.parametrize(("apart", "told"), [(0.0, 1), (100.0, 0)])
def test_it_says_once_that_more_scenes_help_more(data, tmp_path, monkeypatch, capsys, apart, told):
    """The toy has 3 scenes of 6 pairs: 200 steps of 2 pairs are 22 passes; `OFTEN` is passed in step 145."""
    monkeypatch.setattr(loop, "APART", apart)
    start.start_training(tmp_path / "run", start.configure(data, "tiny", [*SMALL, "train.steps=200"]))
    said = capsys.readouterr().out
    assert said.count("more scenes help more than more steps") == told
    if told:
        assert "each pair of frames was seen 17.8 times" in said or "each pair of frames was seen 18 times" in said


def test_it_says_nothing_before_the_data_was_seen_often(data, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(loop, "APART", 0.0)
    start.start_training(tmp_path / "run", start.configure(data, "tiny", [*SMALL, "train.steps=100"]))
    assert "more scenes help" not in capsys.readouterr().out


def test_epochs_count_the_scenes_that_are_trained_on(data, tmp_path, capsys):
    """A scene has 6 pairs, a batch 2: 2 epochs of one scene are 6 steps."""
    config = start.configure(data, "tiny", [*SMALL, "train.epochs=2", "train.scenes=1"])
    start.start_training(tmp_path / "run", config)
    assert read_config(tmp_path / "run").train.steps == 6
    assert "data        1 of 3 scenes of about" in capsys.readouterr().out
    with pytest.raises(ConfigError, match=r"train.scenes is 4, but .*toy.h5 has 3 training scenes"):
        start.start_training(tmp_path / "more", start.configure(data, "tiny", [*SMALL, "train.scenes=4"]))

"""Plans of trainings of the toy: real trainings of a small AST."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import toy

import ast_sim
from ast_sim.planning import plan as plan_module
from ast_sim.planning import trials as module
from ast_sim.planning.plan import planned
from ast_sim.planning.trials import Trial, Trials, candidates, round_sizes
from ast_sim.runs.config_toml import read_config
from ast_sim.runs.folder import RunFolder
from ast_sim.support.errors import RESUME, ConfigError, TrainingError
from ast_sim.training.configure import configure

SMALL = {"hidden": 16, "decoder_hidden": 16, "d_token": 32, "heads": 2, "head_dim": 16, "ffn_inner": 16}
QUICK = {"batch_size": 2, "statistics_pairs": 4}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return toy.write(tmp_path_factory.mktemp("data") / "toy.h5", (6, 3, 1))


def run_config(data, **train):
    changes = {f"model.{key}": value for key, value in SMALL.items()}
    return configure(data, changes=changes | {f"train.{key}": value for key, value in {**QUICK, **train}.items()})


@pytest.fixture
def short(monkeypatch):
    """The first round has trials of four steps, on a machine as busy as it is."""
    monkeypatch.setattr(Trials, "first_steps", lambda _, tried, __: dict.fromkeys(tried, 4))


def test_a_plan_of_real_trainings(short, data, tmp_path, capsys, monkeypatch):
    made = ast_sim.plan(data, tmp_path / "plan", 0.3, model_settings=SMALL, **QUICK)
    longest, half = made.trials[-2:]
    by_round = [made.trials[:4], made.trials[4:6], made.trials[6:7]]
    assert [len(trials) for trials in by_round] == [4, 2, 1] and len(made.trials) == 8
    assert longest.name == min(by_round[1], key=lambda trial: trial.error).name
    assert {trial.name for trial in by_round[1]} == {
        trial.name for trial in sorted(by_round[0], key=lambda trial: trial.error)[:2]
    }
    own = [trial for trial in made.trials if trial.name == longest.name]
    assert [trial.steps for trial in own] == [4, 12, 36, 36]
    assert half.scenes == longest.scenes // 2
    assert made.expected.low < made.expected.error < made.expected.high < 1.3 * longest.error
    kept = json.loads((tmp_path / "plan" / "plan.json").read_text())
    assert kept["trials"] == [dataclasses.asdict(trial) for trial in made.trials]
    assert kept["expected"] == list(made.expected)
    said = capsys.readouterr().err
    assert said.count("scenes, error") == 8 and "the trials take about 9 s" in said
    assert round_sizes(4) == [4, 2, 1]
    assert f"take: {longest.name}" in str(made) and "help more" in str(made)
    monkeypatch.setattr("ast_sim.training.loop.Training.advance", lambda *_: pytest.fail("trained again"))
    again = ast_sim.plan(data, tmp_path / "plan", 0.3, model_settings=SMALL, **QUICK)
    assert (again.trials, again.expected) == (made.trials, made.expected)


def test_errors_that_do_not_fall_are_told(data, tmp_path, monkeypatch):
    def trained(self, name, config, steps, scenes=None, callback=None):
        return Trial(name, steps, scenes or self.scenes, 0.01, 0.5 if steps < 12 else 0.024, "run")

    monkeypatch.setattr(Trials, "trained", trained)
    monkeypatch.setattr(Trials, "first_steps", lambda _, tried, __: dict.fromkeys(tried, 4))
    (tmp_path / "plan").mkdir()  # as the first training does
    made = planned(run_config(data), tmp_path / "plan", 0.3, progress=False)
    assert made.expected is None
    assert "\nno forecast of the error: 12 steps left 2.4 %, 36 steps left 2.4 %; plan with more minutes" in str(made)


def test_validation_scenes_in_which_nothing_moves_are_told(data, tmp_path, monkeypatch):
    record = {"valid_rmse": 0.0, "valid_hold_still": 0.0}
    metrics = SimpleNamespace(validation=lambda _: record, seconds_per_step=lambda: 0.1)
    monkeypatch.setattr(module, "start_training", lambda *_, **__: None)
    monkeypatch.setattr(module, "RunFolder", lambda folder: SimpleNamespace(metrics=metrics))
    with pytest.raises(TrainingError, match="tiny, 4 steps has no error: nothing moves in its validation scenes"):
        Trials(tmp_path, 6, 3).trained("tiny", run_config(data), 4)


def test_its_settings_train(short, data, tmp_path):
    made = planned(run_config(data), tmp_path / "plan", 0.3)
    settings = tmp_path / "plan" / "best.toml"
    run = ast_sim.train(data, tmp_path / "run", config=settings, steps=2)
    assert str(settings) in made.command
    for key, value in made.settings.items():
        part, name = key.split(".")
        assert getattr(getattr(run.settings, part), name) == value


def test_candidates_vary_the_rate_and_the_width(data):
    tried = candidates(run_config(data), "tiny")
    rates = [config.train.peak_rate for config in tried.values()]
    assert rates == [3e-3, 1.5e-3, 6e-3, 3e-3]
    wider = tried["tiny, wider"].model
    assert (wider.hidden, wider.heads, wider.head_dim, wider.d_token) == (24, 3, 16, 48)
    assert tried["tiny"].model == tried["tiny, half the rate"].model


def test_a_trial_with_some_of_the_scenes_sees_no_other(data, tmp_path):
    trial = Trials(tmp_path, 3, 1).trained("tiny", run_config(data), 4, scenes=1)
    assert (trial.scenes, trial.steps) == (1, 4)
    assert read_config(tmp_path / trial.run).train.scenes == 1


def test_better_candidates_go_on(data, tmp_path, monkeypatch):
    """Errors by name: the wider model is best and slow, so it gets fewer steps in equal minutes."""
    errors = {"tiny": 0.4, "tiny, half the rate": 0.6, "tiny, twice the rate": 0.5, "tiny, wider": 0.3}
    seconds = {name: 0.02 if "wider" in name else 0.01 for name in errors}
    monkeypatch.setattr(
        Trials,
        "trained",
        lambda _, name, config, steps, callback=None: Trial(name, steps, 4, seconds[name], errors[name], "run"),
    )
    trials, tried = Trials(tmp_path, 4, 1), candidates(run_config(data), "tiny")
    made = list(trials.rounds(tried, trials.first_steps(tried, 2.0)))
    assert [(trial.name, trial.steps) for trial in made] == [
        ("tiny", 222), ("tiny, half the rate", 222), ("tiny, twice the rate", 222), ("tiny, wider", 111),
        ("tiny, wider", 333), ("tiny", 666), ("tiny, wider", 999),
    ]  # fmt: skip
    with pytest.raises(ConfigError, match=r"0.2 minutes are too few to plan: .* 11 steps; plan for 0.36 minutes"):
        trials.first_steps(tried, 0.2)


@pytest.mark.parametrize(
    ("train", "match"),
    [
        ({"steps": 5}, "train.steps is given, but it follows from the minutes"),
        ({"minutes": 5.0}, "train.minutes is given"),
        ({"peak_rate": None}, "train.peak_rate is unset"),
        ({"scenes": 2}, "has 2 training scenes; a plan needs 4 or more"),
    ],
)
def test_what_cannot_be_planned_is_refused(data, tmp_path, train, match):
    with pytest.raises(ConfigError, match=match):
        planned(run_config(data, **train), tmp_path / "plan", 1.0)
    assert not (tmp_path / "plan").exists()


def test_a_dataset_without_validation_scenes_is_refused(tmp_path):
    alone = toy.write(tmp_path / "alone.h5", (6, 0, 1))
    with pytest.raises(ConfigError, match="has no validation scenes"):
        planned(run_config(alone), tmp_path / "plan", 1.0)


def test_a_trial_whose_validation_failed_is_told(data, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "RunFolder", lambda _: SimpleNamespace(metrics=Failed()))
    with pytest.raises(ast_sim.AstSimError, match="the trial tiny, 4 steps has no error: it exploded"):
        Trials(tmp_path, 3, 1).trained("tiny", run_config(data), 4)


class Failed:
    """Metrics of a training whose validation failed."""

    def validation(self, _step):
        return {"valid_rmse": None, "failure": "it exploded"}

    def seconds_per_step(self):
        return 0.1


def test_the_trials_have_the_processes_of_the_whole_training(data, monkeypatch):
    monkeypatch.setattr(plan_module, "usual_processes", lambda config: 2 if config.train.minutes == 30 else 1)
    assert plan_module._with_processes(run_config(data), 30).train.processes == 2
    assert plan_module._with_processes(run_config(data, processes=1), 30).train.processes == 1


def test_few_steps_are_timed_where_the_minutes_are_too_few(data, tmp_path):
    config = run_config(data)
    tried = {name: one for name, one in candidates(config, "tiny").items() if "rate" not in name}
    trials = Trials(tmp_path / "plan", 6, 3)
    for call in (1, 2):  # what is there is not timed from the start
        with pytest.raises(
            ConfigError, match=r"0.002 minutes are too few to plan: the first trials would have [01] st"
        ):
            trials.first_steps(tried, 0.002)
        for name in ("tiny", "tiny_wider"):
            steps = [one["step"] for one in RunFolder(tmp_path / "plan" / f"{name}_50-steps").metrics if "loss" in one]
            assert steps == list(range(5, 6 + 5 * call, 5))
    assert trials.trained("tiny", config, 50).steps == 50


def test_a_run_is_no_folder_for_trials(data, tmp_path):
    ast_sim.train(data, tmp_path / "run", steps=1, model_settings=SMALL, progress=False, **QUICK)
    before = sorted((tmp_path / "run").rglob("*"))
    for call in (ast_sim.plan, ast_sim.worth):
        source = data if call is ast_sim.plan else Path(__file__).parents[2] / "examples" / "clip" / "SPEC.toml"
        with pytest.raises(ConfigError, match="run holds a run: choose another folder, in which the trials are made"):
            call(source, tmp_path / "run", 1.0)
    assert sorted((tmp_path / "run").rglob("*")) == before


@pytest.mark.parametrize("minutes", [0, -1, float("inf"), float("nan")])
def test_minutes_that_are_none_are_refused(data, tmp_path, minutes):
    with pytest.raises(ConfigError, match="minutes"):
        planned(run_config(data), tmp_path / "plan", minutes)
    with pytest.raises(ConfigError, match="minutes"):
        ast_sim.worth(tmp_path / "SPEC.toml", tmp_path / "worth", minutes)


def test_a_stopped_plan_says_how_it_goes_on(data, tmp_path, monkeypatch, caplog):
    """A trial that stops speaks of --resume, which a plan has not."""

    def full(*_, **__):
        raise TrainingError(f"the disk is full: make room, then {RESUME}")

    with monkeypatch.context() as patch:
        patch.setattr(module, "start_training", full)
        with pytest.raises(TrainingError, match="make room, then plan again in the same folder"):
            planned(run_config(data), tmp_path / "plan", 2.0, progress=False)
    monkeypatch.setattr(module, "start_training", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt), caplog.at_level("INFO", "ast_sim"):
        planned(run_config(data), tmp_path / "plan", 2.0, progress=False)
    assert caplog.messages[-1] == f"stopped: the same call goes on with the trials that are in {tmp_path / 'plan'}"


def test_one_minute_is_one(data, tmp_path, monkeypatch):
    monkeypatch.setattr(Trials, "trained", lambda *_, **__: SimpleNamespace(seconds=60.0))
    with pytest.raises(ConfigError, match="1 minute is too few to plan: the first trials would have 0 steps"):
        planned(run_config(data), tmp_path / "plan", 1.0, progress=False)

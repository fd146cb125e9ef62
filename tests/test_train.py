"""The training loop: its schedule by hand, its records, and what stops it. Kills have their own file."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch
import toy
from toy import one_thread  # noqa: F401 (used by being imported)

from ast_sim import checkpoint, run, train
from ast_sim.baselines.transolver import TransolverConfig
from ast_sim.config import override
from ast_sim.data.file import Dataset, DatasetWriter
from ast_sim.data.scene import NodeType
from ast_sim.errors import CheckpointError, ConfigError, DatasetError, TrainingError
from ast_sim.model.ast_config import ASTConfig
from ast_sim.models import MODELS
from ast_sim.monitor import Clock, duration
from ast_sim.run import Metrics, RunConfig, TrainConfig
from ast_sim.schedule import DataScales, learning_rate, measure, resolve_training, step_seed

SCALES = DataScales(displacement=0.01, increment=0.002, spacing=0.1, nodes=40, trajectories=3, pairs=100)


@pytest.fixture
def linear(monkeypatch):
    """The linear model in the place of AST."""
    monkeypatch.setattr(train, "build_model", toy.LinearSimulator)
    monkeypatch.setattr(run, "build_model", toy.LinearSimulator)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return toy.write(tmp_path_factory.mktemp("data") / "toy.h5")


def settings(data, *assignments: str) -> RunConfig:
    options = TrainConfig(steps=20, batch_size=2, peak_rate=1e-2, validate_every=10, checkpoint_every=5, log_every=4)
    with Dataset(data) as dataset:
        config = RunConfig(toy.config(dataset.info), options, str(data))
    return override(config, list(assignments))


def weights(folder) -> dict[str, torch.Tensor]:
    return checkpoint.load(checkpoint.latest(folder))[0]


# Schedule and settings


def test_learning_rate_by_hand():
    config = TrainConfig(steps=100, warmup=10, decay=110, peak_rate=2.0)
    assert learning_rate(config, 0) == 2.0 * 1e-4
    assert learning_rate(config, 5) == pytest.approx(2.0 * (1e-4 + (1 - 1e-4) / 2))
    assert learning_rate(config, 10) == 2.0
    assert learning_rate(config, 60) == pytest.approx(1.0)  # half the cosine
    assert learning_rate(config, 35) == pytest.approx(1 + math.cos(math.pi / 4))
    assert learning_rate(config, 110) == 0.0


def test_paper_defaults_follow_from_the_data():
    resolved = resolve_training(TrainConfig(), dataclasses.replace(SCALES, pairs=480_000), ASTConfig())
    assert resolved.steps == 100 * 10_000
    assert resolved.peak_rate == pytest.approx(1e-4 * math.sqrt(24))
    assert resolved.warmup == 2000
    assert resolved.decay == 101 * 10_000  # the cosine ends one epoch after the last
    assert resolved.noise == pytest.approx(0.0045)
    assert resolved.noise_gamma == 1.0
    resolved = resolve_training(TrainConfig(), SCALES, ASTConfig(integration="dynamic"))
    assert resolved.noise_gamma == 0.1 and resolved.noise == pytest.approx(0.0002)


def test_given_settings_are_kept_and_a_short_training_warms_up_for_5_percent():
    given = TrainConfig(steps=400, batch_size=4, accumulate=2, noise=0.0, peak_rate=5e-4)
    resolved = resolve_training(given, SCALES, ASTConfig())
    assert (resolved.steps, resolved.warmup, resolved.decay, resolved.noise) == (400, 20, 400, 0.0)
    assert (resolved.peak_rate, resolved.validate_every, resolved.checkpoint_every) == (5e-4, 40, 40)


@pytest.mark.parametrize(
    ("key", "value"), [("batch_size", 0), ("steps", 0), ("validate_every", -1), ("seed", -1), ("shift", -0.1)]
)
def test_settings_out_of_range_are_named(key, value):
    with pytest.raises(ConfigError, match=f"train.{key} is {value}"):
        resolve_training(dataclasses.replace(TrainConfig(), **{key: value}), SCALES, ASTConfig())


def test_step_seeds_differ_and_do_not_change():
    assert len({step_seed(seed, step) for seed in range(30) for step in range(30)}) == 900


def test_scales_of_the_data_by_hand(data):
    with Dataset(data) as dataset:
        found = measure(dataset)
        truths = [dataset.load("train", index) for index in range(3)]
    normal = [t.scene.node_type == NodeType.NORMAL for t in truths]
    moved = [t.position[:, n].astype(float) - t.scene.rest_position[n] for t, n in zip(truths, normal, strict=True)]
    steps = [np.diff(t.position[:, n].astype(float), axis=0) for t, n in zip(truths, normal, strict=True)]
    assert found.displacement == pytest.approx(math.sqrt(np.concatenate([m.ravel() ** 2 for m in moved]).mean()))
    assert found.increment == pytest.approx(math.sqrt(np.concatenate([m.ravel() ** 2 for m in steps]).mean()))
    assert found.trajectories == 3
    assert found.pairs == 18
    # Edges of the plate are 0.1 (or 0.075) m, 0.04 m, and diagonals of these; the block's do not count.
    assert 0.04 < found.spacing < math.sqrt(0.1**2 + 0.1**2 + 0.04**2)


def test_a_preset_that_does_not_exist_names_the_nearest():
    with pytest.raises(ConfigError, match="did you mean deforming_plate"):
        train.configure("data.h5", "deforming_plaet")
    with pytest.raises(ConfigError, match=r"no preset of mgn 'deforming_plate'.*There are tiny, paper, original"):
        train.configure("data.h5", "deforming_plate", model="mgn")
    with pytest.raises(ConfigError, match="no model 'mgm': did you mean mgn"):
        train.configure("data.h5", "tiny", model="mgm")


def test_an_unknown_setting_names_the_nearest(data):
    with pytest.raises(ConfigError, match=r"train\.batch_size"):
        train.configure(data, "tiny", ["train.batchsize=3"])


def test_the_kind_of_the_dataset_decides_which_inputs_there_can_be(data, tmp_path):
    dynamic = toy.write(tmp_path / "dynamic.h5", dynamic=True)
    config = train.configure(dynamic, "tiny", ["model.node_inputs=velocity,displacement"])
    assert config.model.integration == "dynamic"
    assert config.model.node_inputs == ("velocity", "displacement")
    with pytest.raises(ConfigError, match="velocity"):
        train.configure(data, "tiny", ["model.node_inputs=velocity"])


def test_tiny_sees_other_bodies_and_learns_along_rollouts_where_that_was_measured(data, tmp_path):
    still, moving = (train.configure(path, "tiny") for path in (data, toy.write(tmp_path / "d.h5", dynamic=True)))
    assert still.model.node_inputs == ("displacement", "proximity") and still.train.rollout_pool is None
    assert still.train.shift is None and moving.train.shift is None
    assert moving.model.node_inputs == ("displacement", "velocity")
    assert (still.model.places, still.model.exchanges) == ("relative", 2)
    assert (moving.model.places, moving.model.exchanges) == ("absolute", 0)
    asked = train.configure(tmp_path / "d.h5", "tiny", ["model.places=relative", "model.exchanges=1"])
    assert asked.model.exchanges == 1
    paper = train.configure(data, "deforming_plate")
    assert paper.model.node_inputs == ("displacement",) and paper.train.rollout_pool == paper.train.shift == 0


def test_a_dynamic_dataset_is_trained_with_two_given_frames(tmp_path):
    dynamic = toy.write(tmp_path / "dynamic.h5", dynamic=True)
    small = ["model.hidden=16", "model.d_token=16", "model.L_SA=1", "train.steps=3", "train.batch_size=2"]
    train.train(tmp_path / "run", train.configure(dynamic, "tiny", ["model.node_inputs=velocity", *small]))
    model, resolved, _ = run.load_model(tmp_path / "run")
    assert model.config.dynamic
    assert resolved.train.noise_gamma == 0.1 and resolved.train.rollout_pool == 32
    record = next(record for record in Metrics(tmp_path / "run") if "valid_rmse" in record)
    with Dataset(dynamic) as dataset:
        assert measure(dataset).pairs == 3 * 5  # 7 frames, of which 5 follow two others
        truths = [dataset.load("valid", index) for index in range(2)]
    moved = [t.position[2:, ~t.scene.prescribed].astype(float) - t.position[1, ~t.scene.prescribed] for t in truths]
    assert record["valid_hold_still"] == pytest.approx(np.mean([math.sqrt((m**2).mean()) for m in moved]))


# The loop


def test_training_writes_settings_metrics_and_checkpoints(linear, data, tmp_path, capsys):
    train.train(tmp_path / "run", settings(data))
    records = list(Metrics(tmp_path / "run"))
    steps = [record for record in records if "loss" in record]
    validations = [record for record in records if "valid_rmse" in record]
    assert [record["step"] for record in steps] == [4, 8, 12, 16, 20]
    assert [record["step"] for record in validations] == [10, 20]
    for record in steps:
        assert {"loss", "motion", "stress", "rate", "grad_norm", "clipped_share", "seconds"} <= set(record)
        assert record["loss"] == pytest.approx(record["motion"] + 0.01 * record["stress"])
    assert steps[-1]["loss"] < steps[0]["loss"]
    assert 0 <= steps[0]["clipped_share"] <= 1
    model, resolved, step = run.load_model(tmp_path / "run")
    best = min(validations, key=lambda record: record["valid_rmse"])
    assert step == best["step"]
    assert not model.training
    assert resolved.train.decay == 20
    assert run.read_config(tmp_path / "run") == resolved
    shown = capsys.readouterr().out
    assert "x rms increment" in shown and "x mesh spacing" in shown and "parameters  " in shown and "cell side" in shown
    assert "to go" in shown


def test_validation_error_is_that_of_the_rollouts(linear, data, tmp_path):
    from ast_sim.rollout import rollout

    train.train(tmp_path / "run", settings(data, "train.keep=10"))
    record = next(r for r in Metrics(tmp_path / "run") if "valid_rmse" in r and r["step"] == 20)
    model, resolved, _ = run.load_model(tmp_path / "run")
    model.load_state_dict(weights(tmp_path / "run"))
    roots, holds = [], []
    with Dataset(data) as dataset:
        for index in range(2):
            truth = dataset.load("valid", index)
            normal = ~truth.scene.prescribed
            wrong = rollout(model, truth).position[1:, normal].astype(float) - truth.position[1:, normal]
            still = truth.position[1:, normal].astype(float) - truth.position[0, normal]
            roots.append(math.sqrt((wrong**2).mean()))
            holds.append(math.sqrt((still**2).mean()))
    assert record["valid_rmse"] == pytest.approx(sum(roots) / 2, rel=1e-5)
    assert record["valid_hold_still"] == pytest.approx(sum(holds) / 2, rel=1e-9)


def test_accumulated_gradients_are_the_mean_over_the_batches(linear, data, tmp_path):
    # Without dropout, 2 batches of 2 scenes and 1 batch of 4 are the same pairs; sizes differ a little per scene.
    def norm(name, *assignments):
        config = settings(data, "train.steps=1", "train.log_every=1", "train.statistics_pairs=4", *assignments)
        torch.manual_seed(0)
        train.train(tmp_path / name, config)
        return next(iter(Metrics(tmp_path / name)))

    whole = norm("whole", "train.batch_size=4")
    parts = norm("parts", "train.batch_size=2", "train.accumulate=2")
    assert parts["loss"] == pytest.approx(whole["loss"], rel=0.2)
    assert parts["grad_norm"] == pytest.approx(whole["grad_norm"], rel=0.3)


def test_the_same_seed_gives_the_same_bits_and_another_seed_does_not(linear, data, tmp_path):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        train.train(tmp_path / name, settings(data, f"train.seed={seed}"))
    a, b, c = (weights(tmp_path / name) for name in "abc")
    assert all(torch.equal(a[key], b[key]) for key in a)
    assert not torch.equal(a["map.weight"], c["map.weight"])


def test_a_loss_that_is_not_finite_stops_before_the_step_and_names_the_samples(linear, data, tmp_path, monkeypatch):
    real, calls = toy.LinearSimulator.loss, []

    def loss(self, *batch_and_settings):
        losses = real(self, *batch_and_settings)
        calls.append(batch_and_settings[1].names)
        return losses if len(calls) < 8 else {**losses, "loss": losses["loss"] * float("nan")}

    monkeypatch.setattr(toy.LinearSimulator, "loss", loss)
    with pytest.raises(TrainingError, match=r"the loss of step 8 is nan") as error:
        train.train(tmp_path / "run", settings(data))
    assert all(name in str(error.value) for name in calls[-1])
    assert checkpoint.latest(tmp_path / "run").name == "step-5"
    assert "step-5" in str(error.value)
    assert all(value.isfinite().all() for value in weights(tmp_path / "run").values())


def test_a_gradient_that_is_not_finite_stops_before_the_step(linear, data, tmp_path, monkeypatch):
    real = toy.LinearSimulator.loss

    def loss(self, *batch_and_settings):
        losses = real(self, *batch_and_settings)
        # sqrt at 0: a finite value with an infinite slope
        return {**losses, "loss": losses["loss"] + (losses["loss"] - losses["loss"].detach()).sqrt()}

    monkeypatch.setattr(toy.LinearSimulator, "loss", loss)
    with pytest.raises(TrainingError, match=r"norm of the gradient of step 1 is (nan|inf).*train/00000\d frame \d"):
        train.train(tmp_path / "run", settings(data))
    assert checkpoint.latest(tmp_path / "run") is None


def test_a_dead_decoder_is_reported(linear, data, tmp_path, monkeypatch, capsys):
    def forward(self, batch):
        out = self.map.bias.expand(len(batch.position), -1)
        return toy.Prediction(out[:, :3], out[:, 3:])

    monkeypatch.setattr(toy.LinearSimulator, "forward", forward)
    train.train(tmp_path / "run", settings(data, "train.steps=4"))
    assert "warning: the predicted motion is the same at all nodes" in capsys.readouterr().out


def test_a_failing_validation_rollout_is_recorded_and_training_goes_on(linear, data, tmp_path, monkeypatch, capsys):
    def predict(self, batch):
        return toy.Prediction(torch.full_like(batch.position, torch.nan), torch.zeros(len(batch.position), 1))

    monkeypatch.setattr(toy.LinearSimulator, "predict", predict)
    train.train(tmp_path / "run", settings(data))
    records = [record for record in Metrics(tmp_path / "run") if "valid_rmse" in record]
    assert [record["valid_rmse"] for record in records] == [None, None]
    assert "valid/000000" in records[0]["failure"]
    assert checkpoint.best(tmp_path / "run") is None
    assert run.load_model(tmp_path / "run")[2] == 20


# Resuming and refusing


def test_a_run_is_not_overwritten(linear, data, tmp_path):
    train.train(tmp_path / "run", settings(data, "train.steps=2"))
    with pytest.raises(TrainingError, match="already holds a run: go on with --resume"):
        train.train(tmp_path / "run", settings(data))


def test_resuming_with_other_settings_is_refused_naming_the_first(linear, data, tmp_path):
    train.train(tmp_path / "run", settings(data, "train.steps=2"))
    with pytest.raises(ConfigError, match=r"train.steps = 2, not 3"):
        train.train(tmp_path / "run", settings(data, "train.steps=3"), resume=True)


def test_resuming_a_finished_run_changes_nothing(linear, data, tmp_path):
    train.train(tmp_path / "run", settings(data))
    before = (tmp_path / "run" / "metrics.jsonl").read_bytes()
    train.train(tmp_path / "run", resume=True)
    assert (tmp_path / "run" / "metrics.jsonl").read_bytes() == before


def test_resuming_on_another_dataset_is_refused(linear, data, tmp_path):
    other = toy.write(tmp_path / "other.h5", counts=(3, 1, 1))
    train.train(tmp_path / "run", settings(data, "train.steps=2"))
    with pytest.raises(TrainingError, match="other.h5 is not the dataset"):
        train.train(tmp_path / "run", settings(other, "train.steps=2"), resume=True)


def test_resuming_nothing_needs_a_dataset_and_with_one_starts(linear, data, tmp_path):
    with pytest.raises(TrainingError, match="holds no run to resume"):
        train.train(tmp_path / "run", resume=True)
    train.train(tmp_path / "run", settings(data, "train.steps=2"), resume=True)
    assert run.load_model(tmp_path / "run")[2] == 2


def test_a_damaged_newest_checkpoint_falls_back_and_ends_in_the_same_bits(linear, data, tmp_path):
    train.train(tmp_path / "whole", settings(data))
    train.train(tmp_path / "run", settings(data))
    newest = checkpoint.latest(tmp_path / "run") / "model.safetensors"
    newest.write_bytes(newest.read_bytes()[:-1] + b"\x7f")
    with pytest.warns(UserWarning, match="SHA-256"):
        train.train(tmp_path / "run", resume=True)
    a, b = weights(tmp_path / "whole"), weights(tmp_path / "run")
    assert all(torch.equal(a[key], b[key]) for key in a)


def test_along_rollouts_a_resumed_training_ends_in_the_same_bits(linear, data, tmp_path):
    along = settings(data, "train.rollout_pool=6", "train.noise=1e-3", "train.mirror=x,y")
    train.train(tmp_path / "whole", along)
    train.train(tmp_path / "run", along)
    newest = checkpoint.latest(tmp_path / "run") / "training.safetensors"
    newest.write_bytes(newest.read_bytes()[:-1] + b"\x7f")
    with pytest.warns(UserWarning, match="SHA-256"):
        train.train(tmp_path / "run", resume=True)
    a, b = (checkpoint.load(checkpoint.latest(tmp_path / name)) for name in ("whole", "run"))
    for ours, theirs in zip(a[:2], b[:2], strict=True):
        assert ours.keys() == theirs.keys() and all(torch.equal(ours[key], theirs[key]) for key in ours)
    assert {f"rollout_pool.{place}.begun" for place in range(6)} <= a[1].keys()
    train.train(tmp_path / "without", settings(data, "train.noise=1e-3", "train.mirror=x,y"))
    assert any(not torch.equal(a[0][key], value) for key, value in weights(tmp_path / "without").items())


@pytest.mark.parametrize(
    ("assignments", "match"),
    [
        (["train.rollout_pool=5"], r"train.rollout_pool is 5; it must be a multiple.*train.batch_size = 2"),
        (["train.rollout_pool=2"], r"train.rollout_pool is 2; it must be a multiple, at least twice"),
        (["train.rollout_pool=-4"], r"train.rollout_pool is -4"),
        (["train.rollout_pool=4", "train.noise=0"], r"of no use here: without train.noise"),
        (["train.rollout_pool=4", "model.time_conditioned=true"], r"of no use here: each frame follows from the first"),
    ],
)
def test_a_pool_that_cannot_be_is_refused(linear, data, tmp_path, assignments, match):
    with pytest.raises(ConfigError, match=match):
        train.train(tmp_path / "run", settings(data, *assignments))
    assert not run.has_config(tmp_path / "run")


@pytest.mark.parametrize("config", [ASTConfig, TransolverConfig])
def test_a_pool_left_to_the_data_is_of_16_batches_where_there_is_a_drift(config):
    given = TrainConfig(batch_size=4, rollout_pool=None)
    still = resolve_training(given, SCALES, config())
    assert still.rollout_pool == 64 and still.noise == pytest.approx(0.0015)  # a third of that without a pool
    dynamic = resolve_training(given, SCALES, config(integration="dynamic"))
    assert dynamic.rollout_pool == 64 and dynamic.noise_gamma == 0.1 and dynamic.noise == pytest.approx(0.0002)
    assert resolve_training(given, SCALES, config(time_conditioned=True)).rollout_pool == 0
    assert resolve_training(dataclasses.replace(given, noise=0.0), SCALES, config()).rollout_pool == 0
    assert resolve_training(TrainConfig(), SCALES, config()).rollout_pool == 0  # the papers'


@pytest.mark.parametrize("model", sorted(MODELS.keys() - {"ast", "transolver"}))
def test_the_pool_of_a_model_with_edges_between_bodies_is_for_scenes_with_inertia(model):
    still = MODELS[model].presets["tiny"]
    given, moving = TrainConfig(**still.train), dataclasses.replace(still.model, integration="dynamic")
    assert resolve_training(given, SCALES, still.model).rollout_pool == 0
    assert resolve_training(given, SCALES, moving).rollout_pool == 64
    for name, preset in MODELS[model].presets.items():
        assert name == "tiny" or preset.train.get("rollout_pool", 0) == 0  # as published


def test_a_shift_left_open_is_half_a_cell_as_far_as_the_domain_has_room():
    given = TrainConfig(shift=None)
    fine = ASTConfig(L_cell=6, domain_half_width=2.0)
    assert fine.cell_side == 0.0625 and resolve_training(given, SCALES, fine).shift == 0.03125
    coarse = dataclasses.replace(fine, L_cell=2)
    assert coarse.cell_side == 1.0 and resolve_training(given, SCALES, coarse).shift == pytest.approx(0.1)
    assert resolve_training(given, SCALES, MODELS["mgn"].presets["tiny"].model).shift == 0.0  # has no cells
    assert resolve_training(TrainConfig(shift=0.5), SCALES, fine).shift == 0.5
    assert resolve_training(TrainConfig(), SCALES, fine).shift == 0.0  # the paper's


def test_scenes_that_are_moved_out_of_the_domain_are_an_error(data, tmp_path):
    with pytest.raises(DatasetError, match=r"train.*give the dataset a domain_half_width that holds .* train.shift"):
        train.train(tmp_path / "run", train.configure(data, "tiny", ["train.shift=1e3"]))


@pytest.mark.parametrize(
    "setting, message", [("model.time_conditioned=true", "follows from the first"), ("train.noise=0", "have no error")]
)
def test_a_pool_that_is_of_no_use_is_refused(data, tmp_path, setting, message):
    with pytest.raises(ConfigError, match=f"of no use here: .*{message}"):
        train.train(tmp_path / "run", train.configure(data, "tiny", ["train.rollout_pool=8", setting]))


def test_a_second_writer_is_refused(linear, data, tmp_path):
    (tmp_path / "run").mkdir()
    with checkpoint.lock(tmp_path / "run"), pytest.raises(CheckpointError, match="in use by process"):
        train.train(tmp_path / "run", settings(data))


def test_training_needs_training_data(linear, tmp_path):
    with DatasetWriter(tmp_path / "empty.h5", toy.info()) as writer:
        writer.add("test", toy.plate())
    with pytest.raises(TrainingError, match="the split train is empty"):
        train.train(tmp_path / "run", RunConfig(toy.config(toy.info()), TrainConfig(), str(tmp_path / "empty.h5")))


def test_without_validation_scenes_the_latest_checkpoint_is_the_model(linear, tmp_path):
    path = toy.write(tmp_path / "toy.h5", counts=(2, 0, 0))
    train.train(tmp_path / "run", settings(path))
    assert run.load_model(tmp_path / "run")[2] == 20
    assert not any("valid_rmse" in record for record in Metrics(tmp_path / "run"))


# Records and the clock


def test_metrics_survive_a_line_that_was_cut_off(tmp_path):
    metrics = Metrics(tmp_path)
    for step in (1, 2, 3):
        metrics.append({"step": step, "loss": 1.0 / step})
    metrics.append({"step": 3, "valid_rmse": 0.5})
    with open(metrics.path, "a") as file:
        file.write('{"step": 4, "lo')
    assert [record["step"] for record in metrics] == [1, 2, 3, 3]
    metrics.forget_after(2)
    assert [json.loads(line) for line in metrics.path.read_text().splitlines()] == [
        {"step": 1, "loss": 1.0},
        {"step": 2, "loss": 0.5},
    ]
    assert metrics.best() == math.inf


def test_time_to_go_counts_recent_steps_and_validations(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    clock = Clock()
    for _ in range(10):
        now[0] += 0.5
        clock.step()
    assert clock.to_go(100, 0) == "50 s"
    assert clock.to_go(100, 2) == "at least 50 s"
    now[0] += 20.0
    assert clock.validation() == 20.0
    assert clock.to_go(100, 2) == "1 min 30 s"
    for _ in range(Clock.WINDOW):
        now[0] += 0.25
        clock.step()
    assert clock.to_go(4, 0) == "1 s"  # the earlier, slower steps are forgotten


def test_durations():
    assert [duration(s) for s in (0.4, 59.6, 185, 7800)] == ["0 s", "1 min 00 s", "3 min 05 s", "2 h 10 min"]

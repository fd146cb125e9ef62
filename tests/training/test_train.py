"""The training loop: its schedule by hand, its records, and what stops it. Kills have their own file."""

import dataclasses
import math
import random
import warnings

import numpy as np
import pytest
import torch
import toy

from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.inference.effort import Effort, EffortErrors
from ast_sim.inference.evaluation.measures import SquaredError
from ast_sim.inference.trained_run import Run
from ast_sim.models.ast.ast_config import ASTConfig
from ast_sim.models.data_facts import DataFacts
from ast_sim.models.registry import find_model, find_preset
from ast_sim.models.transolver import TransolverConfig
from ast_sim.runs import checkpoint
from ast_sim.runs.config_toml import has_config, read_config, write_config
from ast_sim.runs.folder import RunFolder
from ast_sim.runs.metrics import Metrics
from ast_sim.runs.train_config import RunConfig, TrainConfig
from ast_sim.scene import NodeType
from ast_sim.support.errors import CheckpointError, ConfigError, DatasetError, TrainingError
from ast_sim.support.progress import Clock, duration
from ast_sim.support.toml_settings import assigned, change
from ast_sim.training import loop, start
from ast_sim.training.data_lengths import DataScales, measure, scope_of
from ast_sim.training.defaults_from_data import resolve, resolve_training
from ast_sim.training.rates import Schedule, step_seed
from ast_sim.training.validation import Validated, verdict

DYNAMIC = DataFacts(integration="dynamic")
SCALES = DataScales(displacement=0.01, increment=0.002, spacing=0.1, nodes=40, trajectories=3, pairs=100)

JUMPS = ("model.jumps=true", "model.boundary_motion=false")


def settings(data, *assignments: str) -> RunConfig:
    options = TrainConfig(steps=20, batch_size=2, peak_rate=1e-2, validate_every=10, checkpoint_every=5, log_every=4)
    with Dataset(data) as dataset:
        model = dataclasses.replace(toy.config(dataset.info), boundary_motion=None)
    config = RunConfig(model, options, str(data))
    return change(config, assigned(config, assignments))


def weights(folder) -> dict[str, torch.Tensor]:
    return checkpoint.load(checkpoint.latest(folder))[0]


# Schedule and settings


def test_learning_rate_by_hand():
    schedule = Schedule(steps=100, peak_rate=2.0, warmup=10, decay=110, validate_every=10, checkpoint_every=10)
    assert schedule.rate(0) == 2.0 * 1e-4
    assert schedule.rate(5) == pytest.approx(2.0 * (1e-4 + (1 - 1e-4) / 2))
    assert schedule.rate(10) == 2.0
    assert schedule.rate(60) == pytest.approx(1.0)  # half the cosine
    assert schedule.rate(35) == pytest.approx(1 + math.cos(math.pi / 4))
    assert schedule.rate(110) == 0.0


def test_paper_defaults_follow_from_the_data():
    resolved = resolve_training(TrainConfig(), dataclasses.replace(SCALES, pairs=480_000), ASTConfig())
    assert resolved.steps == 100 * 10_000
    assert resolved.peak_rate == pytest.approx(1e-4 * math.sqrt(24))
    assert resolved.warmup == 2000
    assert resolved.decay == 101 * 10_000  # the cosine ends one epoch after the last
    assert resolved.noise == pytest.approx(0.0045)
    assert resolved.noise_gamma == 1.0
    resolved = resolve_training(TrainConfig(), SCALES, ASTConfig(data=DYNAMIC))
    assert resolved.noise_gamma == 0.1 and resolved.noise == pytest.approx(0.0002)


def test_given_settings_are_kept_and_a_short_training_warms_up_for_5_percent():
    given = TrainConfig(steps=400, batch_size=4, accumulate=2, noise=0.0, peak_rate=5e-4)
    resolved = resolve_training(given, SCALES, ASTConfig())
    assert (resolved.steps, resolved.warmup, resolved.decay, resolved.noise) == (400, 20, 400, 0.0)
    assert (resolved.peak_rate, resolved.validate_every, resolved.checkpoint_every) == (5e-4, 40, 40)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("batch_size", 0), ("steps", 0), ("validate_every", -1), ("seed", -1), ("shift", -0.1), ("noise", math.inf),
        ("noise", -1.0), ("clip", 0.0), ("clip", -1.0), ("warmup", -1), ("statistics_pairs", 0), ("peak_rate", 0.0),
        ("peak_rate", -1e-3), ("peak_rate", math.inf), ("peak_rate", 2.0), ("stress_weight", -1.0),
        ("stress_weight", math.inf), ("noise_gamma", 1.5), ("noise_gamma", -0.5), ("decay", 0), ("validate_scenes", -1),
    ],
)  # fmt: skip
def test_settings_out_of_range_are_named(key, value):
    with pytest.raises(ConfigError, match=f"train.{key} is {value}"):
        resolve_training(dataclasses.replace(TrainConfig(), **{key: value}), SCALES, ASTConfig())


def test_a_warmup_that_never_reaches_the_peak_is_refused():
    with pytest.raises(ConfigError, match=r"train.warmup is 20; it must be below train.decay = 10"):
        resolve_training(TrainConfig(steps=10, warmup=20), SCALES, ASTConfig())


def test_a_seed_of_20_digits_is_refused():
    largest = start.configure("d.h5", "tiny", [f"train.seed={2**63 - 1}"])
    assert largest.train.seed == 2**63 - 1
    with pytest.raises(ConfigError, match=r"train.seed is above 9223372036854775807, the largest whole number"):
        start.configure("d.h5", "tiny", ["train.seed=12345678901234567890"])
    with pytest.raises(ConfigError, match=r"train.noise is above 9223372036854775807"):
        start.configure("d.h5", "tiny", [f"train.noise={'9' * 400}"])
    with pytest.raises(ConfigError, match=r"train.seed is '99.*; must be an integer"):
        start.configure("d.h5", "tiny", [f"train.seed={'9' * 5000}"])


@pytest.mark.parametrize(
    ("model", "key", "values"),
    [
        *(("ast", key, (0, -3, 10**9)) for key in ("hidden", "decoder_hidden", "d_token", "heads", "ffn_inner")),
        ("ast", "num_tokens", (0, -3, 10**9)), ("ast", "L_SA", (-1,)), ("ast", "dropout", (-0.1, 1.0)),
        ("ast", "cell_spacings", (0.0, -1.0)), ("ast", "proximity_radius", (-1.0, math.inf)),
        *((model, "hidden", (0, -3, 10**9)) for model in ("mgn", "bsms", "hcmt", "transolver")),
        ("mgn", "blocks", (0,)), ("mgn", "world_radius", (-1.0,)), ("mgn", "most_world_edges", (-1,)),
        ("bsms", "levels", (0,)), ("hcmt", "heads", (0,)), ("hcmt", "contact_blocks", (-1,)),
        ("transolver", "heads", (0,)), ("transolver", "slices", (0,)),
    ],
)  # fmt: skip
def test_a_model_that_cannot_be_is_refused_with_its_setting(model, key, values):
    for value in values:
        with pytest.raises(ConfigError, match=rf"^model.{key} is {value}; it must be at (least|most) [\d.]+$"):
            start.configure("d.h5", "tiny", [f"model.{key}={value}"], model)


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
    with pytest.raises(ConfigError, match="did you mean 'deforming_plate'"):
        start.configure("data.h5", "deforming_plaet")
    with pytest.raises(ConfigError, match=r"no preset of mgn 'deforming_plate'; there are: tiny, paper, original"):
        start.configure("data.h5", "deforming_plate", model="mgn")
    with pytest.raises(ConfigError, match="no model 'mgm'; did you mean 'mgn'"):
        start.configure("data.h5", "tiny", model="mgm")


def test_an_unknown_setting_names_the_nearest():
    with pytest.raises(ConfigError, match=r"the nearest is train\.batch_size"):
        start.configure("data.h5", "tiny", ["train.batchsize=3"])
    with pytest.raises(ConfigError, match=r"there is no setting model\.L_sa; the nearest is model\.L_SA"):
        start.configure("data.h5", "tiny", ["model.L_sa=3"])


def resolved(data, *settings: str, preset: str = "tiny", model: str = "ast") -> RunConfig:
    """What a run on the dataset would be trained with."""
    with Dataset(data) as dataset:
        return resolve(start.configure(data, preset, settings, model), dataset, measure(dataset))


def test_configure_opens_no_dataset():
    config = start.configure("absent.h5", "tiny", ["model.hidden=16", "train.steps=3"], "mgn")
    assert config.data == "absent.h5" and (config.model.hidden, config.train.steps) == (16, 3)
    assert config.model.node_inputs is None and config.train.noise is None


def test_the_kind_of_the_dataset_decides_which_inputs_there_can_be(data, tmp_path):
    dynamic = toy.write(tmp_path / "dynamic.h5", dynamic=True)
    config = resolved(dynamic, "model.node_inputs=velocity,displacement")
    assert config.model.data.integration == "dynamic"
    assert config.model.node_inputs == ("velocity", "displacement")
    with pytest.raises(ConfigError, match="model.node_inputs: velocity is an input of dynamic scenes only"):
        start.start_training(tmp_path / "run", start.configure(data, "tiny", ["model.node_inputs=velocity"]))
    assert not has_config(tmp_path / "run")


def test_tiny_sees_other_bodies_and_learns_along_rollouts_where_that_was_measured(data, tmp_path):
    toy.write(tmp_path / "d.h5", dynamic=True)
    still, moving = resolved(data), resolved(tmp_path / "d.h5")
    assert still.model.node_inputs == ("displacement", "proximity", "out_of_balance")
    assert still.model.jumps and still.train.corrections == 0 and still.train.rollout_pool == 0
    assert resolved(data, "model.jumps=false").train.rollout_pool == 128
    assert still.train.shift == moving.train.shift == 0.025  # 0.05 of the half width
    assert moving.model.node_inputs == ("displacement", "velocity") and moving.train.rollout_pool == 128
    assert not moving.model.jumps and moving.train.corrections == 0
    assert (still.model.places, still.model.exchanges) == ("relative", 2)
    assert (moving.model.places, moving.model.exchanges) == ("absolute", 0)
    assert resolved(tmp_path / "d.h5", "model.places=relative", "model.exchanges=1").model.exchanges == 1
    paper = resolved(data, preset="deforming_plate")
    assert paper.model.node_inputs == ("displacement",) and paper.train.rollout_pool == paper.train.shift == 0
    assert resolved(data, model="mgn").model.node_inputs == ("out_of_balance",)
    assert resolved(tmp_path / "d.h5", model="mgn").model.node_inputs == ("velocity",)
    assert resolved(data, preset="original", model="transolver").model.node_inputs == ()


def test_a_resolved_run_is_not_changed_by_resolving_it_again(data):
    config = resolved(data)
    with Dataset(data) as dataset:
        assert resolve(config, dataset, measure(dataset)) == config


def test_a_dynamic_dataset_is_trained_with_two_given_frames(tmp_path):
    dynamic = toy.write(tmp_path / "dynamic.h5", dynamic=True)
    small = ["model.hidden=16", "model.d_token=16", "model.L_SA=1", "train.steps=3", "train.batch_size=2"]
    start.start_training(tmp_path / "run", start.configure(dynamic, "tiny", ["model.node_inputs=velocity", *small]))
    trained = RunFolder(tmp_path / "run")
    model, resolved = trained.load_model(), trained.settings
    assert model.config.data.dynamic
    assert resolved.train.noise_gamma == 0.1 and resolved.train.rollout_pool == 32
    record = next(record for record in Metrics(tmp_path / "run") if "valid_rmse" in record)
    with Dataset(dynamic) as dataset:
        assert measure(dataset).pairs == 3 * 5  # 7 frames, of which 5 follow two others
        truths = [dataset.load("valid", index) for index in range(2)]
    moved = [t.position[2:, ~t.scene.prescribed].astype(float) - t.position[1, ~t.scene.prescribed] for t in truths]
    assert record["valid_hold_still"] == pytest.approx(np.mean([math.sqrt((m**2).mean()) for m in moved]))


# The loop


def test_training_writes_settings_metrics_and_checkpoints(linear, data, tmp_path, capsys):
    start.start_training(tmp_path / "run", settings(data))
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
    trained_run = RunFolder(tmp_path / "run")
    model, resolved, step = trained_run.load_model(), trained_run.settings, trained_run.chosen.step
    best = min(validations, key=lambda record: record["valid_rmse"])
    assert step == best["step"]
    assert not model.training
    assert resolved.train.decay == 20
    assert read_config(tmp_path / "run") == resolved
    shown = capsys.readouterr().out
    assert "x rms increment" in shown and "x mesh spacing" in shown and "parameters  " in shown and "cell side" in shown
    assert "to go" in shown


def test_validation_error_is_the_error_of_the_rollouts(linear, data, tmp_path):
    start.start_training(tmp_path / "run", settings(data, "train.keep=10"))
    record = next(r for r in Metrics(tmp_path / "run") if "valid_rmse" in r and r["step"] == 20)
    model = RunFolder(tmp_path / "run").load_model()
    model.load_state_dict(weights(tmp_path / "run"))
    roots, holds = [], []
    with Dataset(data) as dataset:
        for index in range(2):
            truth = dataset.load("valid", index)
            normal = ~truth.scene.prescribed
            wrong = toy.answer(model, truth).position[1:, normal].astype(float) - truth.position[1:, normal]
            still = truth.position[1:, normal].astype(float) - truth.position[0, normal]
            roots.append(math.sqrt((wrong**2).mean()))
            holds.append(math.sqrt((still**2).mean()))
    assert record["valid_rmse"] == pytest.approx(sum(roots) / 2, rel=1e-5)
    assert record["valid_hold_still"] == pytest.approx(sum(holds) / 2, rel=1e-9)


def test_the_checkpoint_is_chosen_by_the_network_alone_and_the_effort_by_the_answers():
    """Newton steps make all checkpoints alike: their errors must not choose."""
    by_calls = [SquaredError(total, 4) for total in (4.0, 0.16, 0.16)]
    efforts = [EffortErrors(Effort(0, n), error, None, n, 0.0) for n, error in ((0, 0.4), (10, 0.01))]
    said = verdict([Validated(0, by_calls, SquaredError(16.0, 4), None, efforts)], math.inf, "m")
    assert said.error == said.record["valid_rmse"] == pytest.approx(0.2) and said.effort == Effort(0, 10)
    assert said.text == (
        "network alone: error 0.2 m = 0.10 of the error of hold still after 1 correction, the best so far;"
        " answers at the deepest frame: error 1 % of the displacement after 0 corrections, up to 10 Newton steps"
    )


def test_accumulated_gradients_are_the_mean_over_the_batches(linear, data, tmp_path):
    # Without dropout, 2 batches of 2 scenes and 1 batch of 4 are the same pairs; sizes differ a little per scene.
    def norm(name, *assignments):
        config = settings(data, "train.steps=1", "train.log_every=1", "train.statistics_pairs=4", *assignments)
        torch.manual_seed(0)
        start.start_training(tmp_path / name, config)
        return next(iter(Metrics(tmp_path / name)))

    whole = norm("whole", "train.batch_size=4")
    parts = norm("parts", "train.batch_size=2", "train.accumulate=2")
    assert parts["loss"] == pytest.approx(whole["loss"], rel=0.2)
    assert parts["grad_norm"] == pytest.approx(whole["grad_norm"], rel=0.3)


def test_the_same_seed_gives_the_same_bits_and_another_seed_does_not(linear, data, tmp_path):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        start.start_training(tmp_path / name, settings(data, f"train.seed={seed}"))
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
        start.start_training(tmp_path / "run", settings(data))
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
        start.start_training(tmp_path / "run", settings(data))
    assert checkpoint.latest(tmp_path / "run") is None


def test_a_dead_decoder_is_reported(linear, data, tmp_path, monkeypatch, capsys):
    def forward(self, batch):
        out = self.map.bias.expand(len(batch.position), -1)
        return toy.Prediction.of(self.config.data, out)

    monkeypatch.setattr(toy.LinearSimulator, "forward", forward)
    start.start_training(tmp_path / "run", settings(data, "train.steps=4"))
    assert "warning: the predicted motion is the same at all nodes" in capsys.readouterr().out


def test_a_failing_validation_rollout_is_recorded_and_training_goes_on(linear, data, tmp_path, monkeypatch, capsys):
    def predict(self, batch):
        return toy.Prediction(
            torch.full_like(batch.position, torch.nan), {"stress": torch.zeros(len(batch.position), 1)}
        )

    monkeypatch.setattr(toy.LinearSimulator, "predict", predict)
    start.start_training(tmp_path / "run", settings(data))
    records = [record for record in Metrics(tmp_path / "run") if "valid_rmse" in record]
    assert [record["valid_rmse"] for record in records] == [None, None]
    assert "valid/000000" in records[0]["failure"]
    assert checkpoint.best(tmp_path / "run") is None
    assert RunFolder(tmp_path / "run").chosen.step == 20


# Resuming and refusing


def test_a_run_is_not_overwritten(linear, data, tmp_path):
    start.start_training(tmp_path / "run", settings(data, "train.steps=2"))
    with pytest.raises(TrainingError, match=r"already holds a run: go on with resume=True \(--resume\)"):
        start.start_training(tmp_path / "run", settings(data))


def test_resuming_with_other_settings_is_refused_naming_the_first(linear, data, tmp_path):
    start.start_training(tmp_path / "run", settings(data, "train.steps=2"))
    with pytest.raises(ConfigError, match=r"train.steps = 2, not 3"):
        start.start_training(tmp_path / "run", settings(data, "train.steps=3"), resume=True)


def test_resuming_a_finished_run_changes_nothing(linear, data, tmp_path):
    start.start_training(tmp_path / "run", settings(data))
    before = (tmp_path / "run" / "metrics.jsonl").read_bytes()
    start.start_training(tmp_path / "run", resume=True)
    assert (tmp_path / "run" / "metrics.jsonl").read_bytes() == before


def test_resuming_on_another_dataset_is_refused(linear, data, tmp_path):
    other = toy.write(tmp_path / "other.h5", counts=(3, 1, 1))
    start.start_training(tmp_path / "run", settings(data, "train.steps=2"))
    with pytest.raises(TrainingError, match="other.h5 is not the dataset"):
        start.start_training(tmp_path / "run", settings(other, "train.steps=2"), resume=True)


def test_resuming_nothing_needs_a_dataset_and_with_one_starts(linear, data, tmp_path):
    with pytest.raises(TrainingError, match="holds no run to resume"):
        start.start_training(tmp_path / "run", resume=True)
    start.start_training(tmp_path / "run", settings(data, "train.steps=2"), resume=True)
    assert RunFolder(tmp_path / "run").chosen.step == 2


def test_a_damaged_newest_checkpoint_falls_back_and_ends_in_the_same_bits(linear, data, tmp_path):
    start.start_training(tmp_path / "whole", settings(data))
    start.start_training(tmp_path / "run", settings(data))
    newest = checkpoint.latest(tmp_path / "run") / "model.safetensors"
    newest.write_bytes(newest.read_bytes()[:-1] + b"\x7f")
    with pytest.warns(UserWarning, match="SHA-256"):
        start.start_training(tmp_path / "run", resume=True)
    a, b = weights(tmp_path / "whole"), weights(tmp_path / "run")
    assert all(torch.equal(a[key], b[key]) for key in a)


def test_along_rollouts_a_resumed_training_ends_in_the_same_bits(linear, data, tmp_path):
    along = settings(data, "train.rollout_pool=6", "train.noise=1e-3", "train.mirror=x,y")
    start.start_training(tmp_path / "whole", along)
    start.start_training(tmp_path / "run", along)
    newest = checkpoint.latest(tmp_path / "run") / "training.safetensors"
    newest.write_bytes(newest.read_bytes()[:-1] + b"\x7f")
    with pytest.warns(UserWarning, match="SHA-256"):
        start.start_training(tmp_path / "run", resume=True)
    a, b = (checkpoint.load(checkpoint.latest(tmp_path / name)) for name in ("whole", "run"))
    for ours, theirs in zip(a[:2], b[:2], strict=True):
        assert ours.keys() == theirs.keys() and all(torch.equal(ours[key], theirs[key]) for key in ours)
    assert {f"pool.{place}.begun" for place in range(6)} <= a[1].keys()
    start.start_training(tmp_path / "without", settings(data, "train.noise=1e-3", "train.mirror=x,y"))
    assert any(not torch.equal(a[0][key], value) for key, value in weights(tmp_path / "without").items())


def test_jumps_that_are_resumed_end_in_the_same_bits(linear, data, tmp_path, monkeypatch):
    """As along rollouts; the guesses of the pool and the running errors of the calls are in the checkpoint."""
    monkeypatch.setattr(loop, "JUMP_BATCHES", 3)  # so that 20 steps make all calls
    jumps = settings(data, *JUMPS, "train.corrections=2", "train.mirror=x,y")
    start.start_training(tmp_path / "whole", jumps)
    start.start_training(tmp_path / "run", jumps)
    newest = checkpoint.latest(tmp_path / "run") / "training.safetensors"
    newest.write_bytes(newest.read_bytes()[:-1] + b"\x7f")
    with pytest.warns(UserWarning, match="SHA-256"):
        start.start_training(tmp_path / "run", resume=True)
    a, b = (checkpoint.load(checkpoint.latest(tmp_path / name)) for name in ("whole", "run"))
    for ours, theirs in zip(a[:2], b[:2], strict=True):
        assert ours.keys() == theirs.keys() and all(torch.equal(ours[key], theirs[key]) for key in ours)
    assert a[1]["pool.squares"].isfinite().all() and any(key.endswith(".error") for key in a[1])
    record = [line for line in Metrics(tmp_path / "run") if "effort" in line][-1]
    assert len(record["valid_by_calls"]) == 5 and 0 <= record["effort"]["corrections"] < 5
    (tmp_path / "run" / "metrics.jsonl").unlink()  # the default effort lies beside the checkpoint
    with pytest.warns(UserWarning, match="its curves are not complete"):
        run = Run(tmp_path / "run")
    validation = Metrics(tmp_path / "whole").validation(run.step)
    assert run.effort == Effort(**validation["effort"])
    errors = [one["error"] for one in validation["valid_by_effort"]]
    with run.open() as dataset:
        truth = dataset["valid"][0]
    answers = [run.predict(truth, frames=[-1], effort=Effort(corrections)) for corrections in (0, 2, 3)]
    assert [answer.expected_error for answer in answers] == [errors[0], errors[2], None] and len(errors) == 3
    assert answers[0].trajectory.attributes["expected_error"] == errors[0]


@pytest.mark.parametrize(
    ("assignments", "match"),
    [
        (["train.corrections=1"], r"train.corrections is 1; without model.jumps it must be 0"),
        (["train.rollout_pool=5"], r"train.rollout_pool is 5; it must be a multiple.*train.batch_size = 2"),
        (
            ["train.rollout_pool=2"],
            r"train.rollout_pool is 2; it must be a multiple of train.batch_size = 2, at least 4",
        ),
        (["train.rollout_pool=-4"], r"train.rollout_pool is -4"),
        (["train.rollout_pool=4", "train.noise=0"], r"of no use here: without train.noise"),
        (["train.rollout_pool=4", *JUMPS], r"of no use here: with model.jumps, each frame follows"),
    ],
)
def test_a_pool_that_cannot_be_is_refused(linear, data, tmp_path, assignments, match):
    with pytest.raises(ConfigError, match=match):
        start.start_training(tmp_path / "run", settings(data, *assignments))
    assert not has_config(tmp_path / "run")


@pytest.mark.parametrize("config", [ASTConfig, TransolverConfig])
def test_a_pool_left_to_the_data_is_of_16_batches_where_there_is_a_drift(config):
    given = TrainConfig(batch_size=4, rollout_pool=None)
    still = resolve_training(given, SCALES, config())
    assert still.rollout_pool == 64 and still.noise == pytest.approx(0.0015)  # a third of that without a pool
    dynamic = resolve_training(given, SCALES, config(data=DYNAMIC))
    assert dynamic.rollout_pool == 64 and dynamic.noise_gamma == 0.1 and dynamic.noise == pytest.approx(0.0002)
    assert resolve_training(given, SCALES, config(jumps=True)).rollout_pool == 0
    assert resolve_training(dataclasses.replace(given, noise=0.0), SCALES, config()).rollout_pool == 0
    assert resolve_training(TrainConfig(), SCALES, config()).rollout_pool == 0  # the papers'


@pytest.mark.parametrize("model", ["bsms", "hcmt", "mgn"])
def test_the_pool_of_a_model_with_edges_between_bodies_is_for_scenes_with_inertia(model):
    still = find_preset(model, "tiny")
    given, moving = TrainConfig(**still.train), dataclasses.replace(still.model, data=DYNAMIC)
    assert resolve_training(given, SCALES, still.model).rollout_pool == 0
    assert resolve_training(given, SCALES, moving).rollout_pool == 64
    for name, preset in find_model(model).presets.items():
        assert name == "tiny" or preset.train.get("rollout_pool", 0) == 0  # as published


def test_a_shift_left_open_is_half_a_cell_as_far_as_the_domain_has_room():
    given = TrainConfig(shift=None)
    fine = ASTConfig(L_cell=6, data=DataFacts(domain_half_width=2.0))
    assert fine.cell_side == 0.0625 and resolve_training(given, SCALES, fine).shift == 0.03125
    coarse = dataclasses.replace(fine, L_cell=2)
    assert coarse.cell_side == 1.0 and resolve_training(given, SCALES, coarse).shift == pytest.approx(0.1)
    assert resolve_training(given, SCALES, find_preset("mgn", "tiny").model).shift == 0.0  # has no cells
    assert resolve_training(TrainConfig(shift=0.5), SCALES, fine).shift == 0.5
    assert resolve_training(TrainConfig(), SCALES, fine).shift == 0.0  # the paper's


def test_scenes_that_are_moved_out_of_the_domain_are_an_error(data, tmp_path, monkeypatch):
    far = start.configure(data, "tiny", ["train.shift=1e3"])
    with pytest.raises(ConfigError, match=r"train.shift is 1000, but a training scene is 0.3 from the boundary"):
        start.start_training(tmp_path / "run", far)
    assert not (tmp_path / "run").exists()
    monkeypatch.setattr(start, "measure", lambda data: dataclasses.replace(measure(data), room=math.inf))
    with pytest.raises(DatasetError, match=r"train.*give the dataset a domain_half_width that holds .* train.shift"):
        start.start_training(tmp_path / "run", far)


@pytest.mark.parametrize(
    "setting, message", [("model.jumps=true", "follows from the first"), ("train.noise=0", "have no error")]
)
def test_a_pool_that_is_of_no_use_is_refused(data, tmp_path, setting, message):
    with pytest.raises(ConfigError, match=f"of no use here: .*{message}"):
        settings = ["model.jumps=false", "train.rollout_pool=8", setting]
        start.start_training(tmp_path / "run", start.configure(data, "tiny", settings))


@pytest.mark.parametrize(
    "settings, message",
    [
        (["model.jumps=true", "train.noise=0.05"], "train.noise = 0.05 is of no use here: with model.jumps"),
        (["model.jumps=true", "train.noise_gamma=0.5"], "train.noise_gamma = 0.5 is of no use here: there is no noise"),
        (
            ["model.jumps=false", "train.noise=0", "train.noise_gamma=0.5"],
            "train.noise_gamma = 0.5 is of no use here: there is no noise",
        ),
        (
            ["model.jumps=true", "model.boundary_motion=true"],
            "model.boundary_motion is of no use here: with model.jumps",
        ),
        (
            ["model.node_inputs=displacement", "model.proximity_radius=0.1"],
            "model.proximity_radius is of no use here: proximity is not in model.node_inputs",
        ),
        (["model.L_cell=4", "model.cell_spacings=2"], "model.cell_spacings is of no use with model.L_cell"),
        (["model.young=5"], "model.young is no setting but a fact of the data"),
        (
            ["model.residual=m2e", "model.element_inputs="],
            "model.residual: m2e is of no use here: nothing is predicted on elements",
        ),
        (
            ["model.residual=m2m,e2m", "model.element_inputs="],
            "model.residual: e2m is of no use here: there are no model.element_inputs",
        ),
        (
            ["model.residual=m2m,m2c", "model.element_inputs=displacement"],
            "model.residual: m2m is of no use here: elements are nodes of the graph",
        ),
        (["model.residual=c2m"], "model.residual: c2m is of no use here: nodes and tokens attend to each other"),
        (["model.node_inputs=displacement,displacement"], "model.node_inputs is displacement, displacement; name each"),
        (["model.residual=m2c,m2c"], "model.residual is m2c, m2c; name each once"),
        (["train.epochs=5", "train.steps=1"], "train.steps and train.epochs exclude each other: give one of them"),
        (["train.epochs=5", "train.minutes=1"], "train.minutes and train.epochs exclude each other: give one of them"),
    ],
)
def test_settings_without_effect_are_refused(data, tmp_path, settings, message):
    with pytest.raises(ConfigError, match=message):
        start.start_training(tmp_path / "run", start.configure(data, "tiny", settings))
    assert not (tmp_path / "run").exists()


def test_settings_without_effect_on_this_dataset_are_refused(data, tmp_path):
    bare = toy.write(tmp_path / "bare.h5", (2, 0, 1), stress=False)
    for changes, message in (
        ({"stress_weight": 0.5}, "train.stress_weight = 0.5 is of no use here: no stress and no field is predicted"),
        ({"validate_every": 3}, "train.validate_every = 3 is of no use here: .*bare.h5 has no validation scenes"),
        ({"validate_scenes": 8}, "train.validate_scenes = 8 is of no use here: .*bare.h5 has no validation scenes"),
    ):
        with pytest.raises(ConfigError, match=message):
            start.train(bare, tmp_path / "run", steps=1, **changes)
        assert not (tmp_path / "run").exists()
        assert start.configure(data, "tiny", [f"train.{key}={value}" for key, value in changes.items()])
    assert start.configure(bare, "tiny", ["train.stress_weight=0", "train.validate_scenes=0"])
    assert start.configure(bare, "tiny", ["model.state=PEEQ", "train.stress_weight=0.5"])


def test_epochs_replace_the_steps_of_a_preset(data):
    with_steps = start.configure(data, "original", model="mgn").train
    assert with_steps.steps == 10_000_000
    by_epochs = start.configure(data, "original", ["train.epochs=5"], model="mgn").train
    assert (by_epochs.steps, by_epochs.epochs) == (None, 5)


@pytest.mark.parametrize("jumps", [True, False])
def test_resolved_settings_are_themselves_settings_to_start_from(data, tmp_path, jumps):
    """What had no effect is unset in them, so nothing in them is refused; the facts of the data are not among them."""
    with Dataset(data) as dataset:
        config = start.configure(data, "tiny", [f"model.jumps={str(jumps).lower()}", "train.steps=9"])
        resolved = resolve(config, dataset, measure(dataset))
        write_config(tmp_path, resolved, scope_of(dataset, resolved.model.data), dataset.fingerprint())
        again = resolve(start.configure(data, config=tmp_path / "config.toml"), dataset, measure(dataset))
    assert again == resolved == read_config(tmp_path)
    assert resolved.model.data.domain_half_width == 0.5 and resolved.model.data.stress == "node"
    text = (tmp_path / "config.toml").read_text()
    assert "domain_half_width" not in text and "domain_half_width = 0.5" in (tmp_path / "scope.toml").read_text()


def test_a_new_model_has_the_statistics_of_a_training(data, tmp_path):
    few = {"hidden": 16, "blocks": 1}
    run = start.train(data, tmp_path / "run", model="mgn", model_settings=few, steps=1, validate_scenes=0)
    with Dataset(data) as dataset:
        model = start.new_model(dataset, "mgn", model_settings=few)
    fitted, trained = ({k: v for k, v in m.state_dict().items() if "normalizer" in k} for m in (model, run.model))
    assert fitted.keys() == trained.keys() and all(torch.equal(fitted[key], trained[key]) for key in fitted)
    assert 0 < float(model.motion_normalizer.scale) < 0.1  # an untrained one has 1


def test_a_second_writer_is_refused(linear, data, tmp_path):
    (tmp_path / "run").mkdir()
    with checkpoint.lock(tmp_path / "run"), pytest.raises(CheckpointError, match="in use by process"):
        start.start_training(tmp_path / "run", settings(data))


def test_training_needs_training_data(linear, tmp_path):
    with DatasetWriter(tmp_path / "empty.h5", toy.info()) as writer:
        writer.add("test", toy.plate())
    with pytest.raises(TrainingError, match="the split train is empty"):
        start.start_training(
            tmp_path / "run", RunConfig(toy.config(toy.info()), TrainConfig(), str(tmp_path / "empty.h5"))
        )


def test_without_validation_scenes_the_latest_checkpoint_is_the_model(linear, tmp_path):
    path = toy.write(tmp_path / "toy.h5", counts=(2, 0, 0))
    start.start_training(tmp_path / "run", settings(path))
    assert RunFolder(tmp_path / "run").chosen.step == 20
    assert not any("valid_rmse" in record for record in Metrics(tmp_path / "run"))


# Records and the clock


def test_metrics_survive_a_line_that_was_cut_off(tmp_path):
    metrics = Metrics(tmp_path)
    for step in (1, 2, 3):
        metrics.append({"step": step, "loss": 1.0 / step})
    metrics.append({"step": 3, "valid_rmse": 0.5})
    with open(metrics.path, "a") as file:
        file.write('{"step": 4, "lo')
    with pytest.warns(UserWarning, match=r"metrics.jsonl: 1 of 5 lines are damaged and left out, the first is line 5"):
        assert [record["step"] for record in metrics] == [1, 2, 3, 3]
    with pytest.warns(UserWarning, match="line 5"):
        metrics.forget_after(2)
    assert list(metrics) == [{"step": 1, "loss": 1.0}, {"step": 2, "loss": 0.5}] and metrics.best() is None


def test_no_damage_of_the_metrics_changes_a_record_or_the_best_in_silence(linear, data, tmp_path):
    run, draw = tmp_path / "run", random.Random(1)
    start.start_training(run, settings(data))
    intact, step, content = list(Metrics(run)), RunFolder(run).chosen.step, (run / "metrics.jsonl").read_bytes()
    damages = [content[: draw.randrange(len(content) - 1)] for _ in range(30)]
    for _ in range(100):
        place = draw.randrange(len(content))
        damages.append(content[:place] + bytes([content[place] ^ 1 << draw.randrange(8)]) + content[place + 1 :])
    for damaged in damages:
        (run / "metrics.jsonl").write_bytes(damaged)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            records = list(Metrics(run))
            assert RunFolder(run).chosen.step == step
        assert records == intact or any("metrics.jsonl" in str(warning.message) for warning in told)
        assert all(record in intact for record in records)


def test_metrics_without_their_last_lines_give_a_warning(linear, data, tmp_path):
    run = tmp_path / "run"
    start.start_training(run, settings(data))
    assert RunFolder(run).describe()["best_validation"]["step"] == 20
    lines = (run / "metrics.jsonl").read_text().splitlines(keepends=True)
    (run / "metrics.jsonl").write_text("".join(lines[:3]))
    with pytest.warns(UserWarning, match=r"metrics.jsonl misses 3 of 6 lines"):
        RunFolder(run).load_model()
    with pytest.warns(UserWarning, match="metrics.jsonl misses the validation after step 20, the best one"):
        assert RunFolder(run).describe()["best_validation"] is None


def test_a_missing_or_damaged_best_is_refused_until_a_resume_writes_it_again(linear, data, tmp_path):
    run = tmp_path / "run"
    start.start_training(run, settings(data))
    mark, step = (run / "best").read_text(), RunFolder(run).chosen.step
    (run / "best").write_text(mark.replace(f'"step": {step}', f'"step": {30 - step}'))
    with pytest.raises(CheckpointError, match=r"best: is damaged: remove it, then ast-sim train --resume --out"):
        RunFolder(run).load_model()
    (run / "best").unlink()
    with pytest.raises(CheckpointError, match=r"best is missing, but validations were recorded: ast-sim train --resu"):
        RunFolder(run).load_model()
    start.start_training(run, resume=True)
    assert (run / "best").read_text() == mark and RunFolder(run).chosen.step == step


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


@pytest.mark.parametrize("part", ["stress", "valid", "node_type"])
def test_a_changed_dataset_is_not_gone_on_with(linear, tmp_path, part):
    """One number of a trajectory in the middle, of the validation scenes, or one node's type."""

    def changed(split, trajectory):
        if part == "stress" and split == "train":
            trajectory.stress[3, 10] += 1
        elif part == "valid" and split == "valid":
            trajectory.position[3, 10, 2] += 0.001
        elif part == "node_type" and split == "train":
            types = trajectory.scene.node_type.copy()
            types[0] = NodeType.NORMAL
            return dataclasses.replace(trajectory, scene=dataclasses.replace(trajectory.scene, node_type=types))
        return trajectory

    path = toy.write(tmp_path / "toy.h5")
    start.start_training(tmp_path / "run", settings(path, "train.steps=5"))
    with DatasetWriter(path, toy.info()) as writer:
        for split, seeds in (("train", range(3)), ("valid", range(3, 5)), ("test", range(5, 7))):
            for seed in seeds:
                trajectory = toy.plate(seed)
                writer.add(split, changed(split, trajectory) if seed in (1, 3) else trajectory)
    with pytest.raises(TrainingError, match="is not the dataset that"):
        start.start_training(tmp_path / "run", resume=True)
    toy.write(path)
    start.start_training(tmp_path / "run", resume=True)


def test_a_call_that_fails_leaves_no_folder(data, tmp_path):
    for path, changes in ((tmp_path / "missing.h5", {}), (data, {"batch_size": 0}), (data, {"stepps": 3})):
        with pytest.raises((DatasetError, ConfigError)):
            start.train(path, tmp_path / "deep" / "run", **changes)
        assert not (tmp_path / "deep").exists()
    (tmp_path / "kept").mkdir()
    with pytest.raises(DatasetError, match="there is no such file"):
        start.train(tmp_path / "missing.h5", tmp_path / "kept" / "run")
    assert (tmp_path / "kept").is_dir() and not (tmp_path / "kept" / "run").exists()

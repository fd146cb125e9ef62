"""Models that predict each frame at once from the first: what they are given, and that no prediction feeds another."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import toy
from toy import one_thread  # noqa: F401 (used by being imported)

from ast_sim.batches.horizons import FROM_FIRST
from ast_sim.batches.pairs import PairSampler
from ast_sim.dataset.reader import Dataset
from ast_sim.inference.evaluation import evaluate, table
from ast_sim.models import node_inputs
from ast_sim.models.model_config import DataFacts
from ast_sim.models.registry import build_model
from ast_sim.models.simulator import Prediction, Simulator
from ast_sim.models.transolver import TransolverConfig
from ast_sim.runs.folder import load_model
from ast_sim.runs.train_config import RunConfig, TrainConfig, read_config
from ast_sim.support.errors import ConfigError
from ast_sim.support.toml_settings import from_toml, to_toml
from ast_sim.training.start import configure, start_training


def config(model: str, **changes):
    """Small settings of a model that fits the toy plates."""
    if model == "ast":
        return replace(toy.config(toy.info()), **{"time_conditioned": True, **changes})
    small = TransolverConfig(hidden=32, blocks=2, heads=2, slices=8, time_conditioned=True)
    return replace(small.resolve(DataFacts(toy.info(), 0, 0.1)), **{"node_inputs": ("displacement",), **changes})


def model_of(model: str, **changes) -> Simulator:
    torch.manual_seed(3)
    built = build_model(config(model, **changes))
    built.motion_normalizer.scale.fill_(1e-3)
    return built


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return toy.write(tmp_path_factory.mktemp("data") / "toy.h5")


def test_the_sampler_pairs_the_first_frame_with_every_other(data):
    with Dataset(data) as dataset:
        draws = PairSampler(
            dataset, "train", batch_size=18, seed=0, noise=0.0, make_graph=model_of("ast").graph, dynamic=False,
            gamma=1.0, horizon=FROM_FIRST,
        )  # fmt: skip
        assert draws.num_pairs == 18
        batch, target = draws.batch(0)
        truths = [dataset.load("train", index) for index in range(3)]
    assert sorted(batch.names) == sorted(f"train/{i:06d} frame {t}" for i in range(3) for t in range(6))
    bounds = batch.graph.node_offsets.tolist()
    for name, number, first, last in zip(batch.names, batch.frame.tolist(), bounds, bounds[1:], strict=False):
        truth, frame, nodes = truths[int(name[6:12])], int(name.split()[-1]) + 1, slice(first, last)
        way = truth.position[frame] - truth.position[0]
        assert number == frame
        assert np.array_equal(batch.position[nodes], truth.position[0])
        assert np.array_equal(target.motion[nodes], way)
        assert np.array_equal(batch.boundary_motion[nodes], np.where(truth.scene.prescribed[:, None], way, 0))
        assert np.array_equal(batch.stress[nodes], truth.stress[0])
        assert np.array_equal(target.stress[nodes], truth.stress[frame])


def test_the_inputs_by_hand(data):
    """Prescribed nodes are where they will be, the others where they were; the last column is the frame's number."""
    seen = config("ast")
    with Dataset(data) as dataset:
        truth = dataset.load("train", 1)
        draws = PairSampler(
            dataset, "train", batch_size=18, seed=0, noise=0.0, make_graph=model_of("ast").graph, dynamic=False,
            gamma=1.0, horizon=FROM_FIRST,
        )  # fmt: skip
        batch, _ = draws.batch(0)
    found, now = node_inputs.node_features(seen, batch), seen.horizon.present(batch)
    place = batch.names.index("train/000001 frame 3")
    nodes = slice(*batch.graph.node_offsets[place : place + 2].tolist())
    prescribed = truth.scene.prescribed
    expected = np.where(prescribed[:, None], truth.position[4], truth.position[0])
    np.testing.assert_allclose(now[nodes], expected, rtol=0, atol=1e-7)
    np.testing.assert_allclose(found[nodes, 3:6], expected - truth.scene.rest_position, rtol=0, atol=1e-7)
    assert np.array_equal(found[nodes, 6:9], batch.boundary_motion[nodes])
    assert (found[nodes, 9] == 4.0).all() and found.shape[1] == 10 == node_inputs.normalizer_of(seen, "node").width
    still = replace(seen, time_conditioned=False)
    assert still.horizon.present(batch) is batch.position and node_inputs.node_features(still, batch).shape[1] == 9


class Linear(Simulator):
    """The motion from the first frame is the frame's number times a vector, the stress that number."""

    def forward(self, batch):
        frame = batch.frame.repeat_interleave(batch.graph.node_offsets.diff())[:, None]
        return Prediction(frame * torch.tensor([0.001, 0.0, -0.002]), frame)


def test_each_frame_is_the_first_and_its_own_motion():
    truth = toy.plate(1)
    result = toy.answer(Linear(config("ast")), truth)
    free = ~truth.scene.prescribed
    way = np.arange(7)[:, None, None] * np.array([0.001, 0.0, -0.002])
    np.testing.assert_allclose(result.position[:, free], truth.position[0, free] + way, rtol=0, atol=1e-7)
    assert np.array_equal(result.position[:, ~free], truth.position[:, ~free])
    assert [float(frame.max()) for frame in result.stress[1:]] == [1, 2, 3, 4, 5, 6]


def poisoned(model: Simulator, frame: int) -> Simulator:
    """The same model, whose prediction of one frame is far off."""
    predict = model.predict

    def spoiled(batch):
        found = predict(batch)
        wrong = float(batch.frame[0]) == frame
        return Prediction(found.motion + 0.05, found.stress + 1e9) if wrong else found

    model.predict = spoiled
    return model


@pytest.mark.parametrize("model", ["ast", "transolver"])
def test_no_prediction_depends_on_another(model):
    """With frame 3 poisoned all other frames keep their bits; step by step, every later frame changes."""
    truth = toy.plate(0)
    free = ~truth.scene.prescribed
    for conditioned in (True, False):
        clean = toy.answer(model_of(model, time_conditioned=conditioned), truth)
        spoiled = toy.answer(poisoned(model_of(model, time_conditioned=conditioned), 3), truth)
        differs = [not np.array_equal(a[free], b[free]) for a, b in zip(clean.position, spoiled.position, strict=True)]
        stress = [not np.array_equal(a, b) for a, b in zip(clean.stress, spoiled.stress, strict=True)]
        expected = [False, False, False, True] + [not conditioned] * 3
        assert differs == stress == expected


@pytest.mark.parametrize("model", ["ast", "transolver"])
def test_scenes_together_give_what_each_gives_alone(model):
    truths = [toy.plate(0, frames=5), toy.plate(1, frames=7)]
    built = model_of(model)
    for truth, result in zip(truths, toy.answers(built, truths, ["a", "b"]), strict=True):
        alone = toy.answer(built, truth)
        np.testing.assert_allclose(result.position, alone.position, rtol=0, atol=2e-6)
        np.testing.assert_allclose(result.stress, alone.stress, rtol=1e-4, atol=1e-4)


def test_the_domain_grows_around_obstacles_that_leave_it():
    truth = toy.plate(0)
    position = truth.position.copy()
    position[3:, -8:, 2] += 2.0  # the block flies off; the domain reaches 0.5
    result = toy.answer(model_of("ast"), replace(truth, position=position))
    assert len(result.position) == 7 and np.array_equal(result.position[:, -8:], position[:, -8:])


def test_the_evaluation_says_that_one_step_is_the_rollout(data):
    with Dataset(data) as dataset:
        found, _ = evaluate(model_of("transolver"), dataset)
        stepwise, _ = evaluate(model_of("transolver", time_conditioned=False), dataset)
    for quantity in ("displacement", "stress"):
        errors = found["summary"]["model"][quantity]
        assert errors["one_step"] == errors["rollout_all"]
    assert found["time_conditioned"] is True and stepwise["time_conditioned"] is False
    assert "one_step is its rollout" in table(found) and "one_step is its rollout" not in table(stepwise)


def test_a_failed_rollout_has_no_one_step(data):
    model = model_of("ast")
    model.motion_normalizer.scale.fill_(math.nan)
    with Dataset(data) as dataset:
        found, _ = evaluate(model, dataset)
    assert found["failures"] == 2
    assert found["summary"]["model"]["displacement"]["one_step"]["normal"]["rmse_sequence"] is None
    assert found["summary"]["model"]["stress"]["one_step"]["deforming"]["rmse_sequence"] is None


@pytest.mark.parametrize("model", ["ast", "transolver"])
def test_dynamic_scenes_are_refused(model, tmp_path):
    with pytest.raises(ConfigError, match="model.time_conditioned: the dataset is dynamic"):
        config(model).resolve(DataFacts(toy.info(dynamic=True), 0, 0.1))
    moving = toy.write(tmp_path / "moving.h5", dynamic=True)
    with pytest.raises(ConfigError, match="model.time_conditioned: the dataset is dynamic"):
        start_training(tmp_path / "run", configure(moving, "tiny", ["model.time_conditioned=true"], model=model))


@pytest.mark.parametrize("model", ["ast", "transolver"])
def test_the_setting_survives_toml_and_is_off_where_it_is_left_out(model):
    settings = RunConfig(config(model), TrainConfig(), "data.h5")
    text = to_toml(settings)
    assert from_toml(RunConfig, text) == settings
    left_out = from_toml(RunConfig, text.replace("time_conditioned = true\n", ""))
    assert left_out.model == config(model, time_conditioned=False)


@pytest.mark.parametrize("model", ["ast", "transolver"])
def test_training_brings_the_rollout_below_holding_still(model, data, tmp_path):
    settings = ["model.time_conditioned=true", "train.steps=60", "train.validate_every=60", "train.peak_rate=2e-3"]
    start_training(tmp_path / "run", configure(data, "tiny", settings, model=model))
    assert read_config(tmp_path / "run").train.noise == 0.0  # there is no drift to get used to
    trained, _, _ = load_model(tmp_path / "run")
    with Dataset(data) as dataset:
        errors = evaluate(trained, dataset)[0]["summary"]
    reached, still = (errors[key]["displacement"]["rollout_all"]["normal"] for key in ("model", "hold_still"))
    assert reached["rmse_sequence"] < 0.7 * still["rmse_sequence"]

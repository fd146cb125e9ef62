"""Models that jump: what they are given, that no frame depends on another, and that calls correct each other."""

import math
import tomllib
from dataclasses import replace

import numpy as np
import pytest
import torch
import toy

from ast_sim.batches.carry import Carrier
from ast_sim.batches.pairs import PairSampler
from ast_sim.batches.scheme import Scheme
from ast_sim.dataset.reader import Dataset
from ast_sim.inference.answering import answers
from ast_sim.inference.effort import Effort
from ast_sim.inference.evaluation.evaluate import evaluate, table
from ast_sim.inference.predicting.jump import answer_steps
from ast_sim.inference.predicting.question import Question
from ast_sim.models.data_facts import DataFacts
from ast_sim.models.registry import build_model, find_preset, model_names
from ast_sim.models.simulator import Prediction, Simulator
from ast_sim.models.transolver import TransolverConfig
from ast_sim.runs.config_toml import read_config
from ast_sim.runs.folder import RunFolder
from ast_sim.runs.train_config import RunConfig, TrainConfig
from ast_sim.scene import Trajectory
from ast_sim.support.errors import ConfigError, RolloutError
from ast_sim.support.toml_settings import from_values, to_toml
from ast_sim.training.configure import configure
from ast_sim.training.start import start_training


def config(model: str, **changes):
    """Small settings of a model that fits the toy plates."""
    if model == "ast":
        return replace(toy.config(toy.info()), **{"jumps": True, "boundary_motion": False, **changes})
    small = TransolverConfig(hidden=32, blocks=2, heads=2, slices=8, jumps=True)
    return replace(small.resolve(DataFacts.of(toy.info(), (), 0.1)), **{"node_inputs": ("displacement",), **changes})


def model_of(model: str, **changes) -> Simulator:
    torch.manual_seed(3)
    built = build_model(config(model, **changes))
    built.motion_normalizer.scale.fill_(1e-3)
    return built


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return toy.write(tmp_path_factory.mktemp("data") / "toy.h5")


def test_the_sampler_carries_the_first_frame_to_every_other(data):
    with Dataset(data) as dataset:
        draws = PairSampler(
            dataset, "train", batch_size=18, seed=0, noise=0.0, make_graph=model_of("ast").graph, scheme=Scheme(True),
            gamma=1.0,
        )  # fmt: skip
        assert draws.num_pairs == 18
        batch, target = draws.batch(0)
        truths = [dataset.load("train", index) for index in range(3)]
    assert sorted(batch.names) == sorted(f"train/{i:06d} frame {t}" for i in range(3) for t in range(1, 7))
    bounds, shares = batch.graph.node_offsets.tolist(), []
    for name, first, last in zip(batch.names, bounds, bounds[1:], strict=False):
        truth, frame, nodes = truths[int(name[6:12])], int(name.split()[-1]), slice(first, last)
        start = Carrier(truth.scene)(truth.position[0], truth.position[frame])
        missing = (truth.position[frame] - start)[:, 2]
        node = np.argmax(np.abs(missing))
        share = float(target.motion[nodes][node, 2] / missing[node]) if missing.any() else 1.0
        guess = truth.position[frame] + share * (start - truth.position[frame])
        np.testing.assert_allclose(batch.position[nodes], guess, rtol=0, atol=1e-7)
        reached = batch.position[nodes] + target.motion[nodes]
        np.testing.assert_allclose(reached, truth.position[frame], rtol=0, atol=1e-7)
        shares.append(share)
        assert not batch.boundary_motion[nodes].any()
        assert np.array_equal(batch.stress[nodes], truth.stress[0])
        assert np.array_equal(target.fields["stress"][nodes], truth.stress[frame])
    whole = [share for share in shares if share > 0.999999]
    assert 4 < len(whole) < 15 and 0 < min(shares) < 0.5


class Halving(Simulator):
    """Goes half of what is missing to a truth that it knows, 0.01 along x from where a node is at rest."""

    def forward(self, batch):
        missing = batch.graph.rest_position + torch.tensor([0.01, 0.0, 0.0]) - batch.position
        return Prediction(missing / 2, {"stress": torch.full((len(missing), 1), float(missing[0, 0]))})


def test_each_call_corrects_the_answer_of_the_call_before():
    truth, model = toy.plate(1), Halving(config("ast"))
    free = ~truth.scene.prescribed
    question = Question.of(truth, "scene", [2, -1])
    (steps,) = answer_steps(model, [question], Effort(3))
    assert steps.steps.tolist() == [0, 0] and steps.after_newton_steps == steps.stress_after_newton_steps == []
    assert [one.shape for one in steps.after_calls] == 4 * [(2, truth.scene.num_nodes, 3)]
    start = truth.position[0, free]
    for call, position in enumerate(steps.after_calls):
        way = (position[:, free] - start)[..., 0]
        np.testing.assert_allclose(way, 0.01 * (1 - 0.5 ** (call + 1)), rtol=0, atol=1e-7)
        assert np.array_equal(position[:, ~free], truth.position[[2, 6]][:, ~free])
    (answer,) = answers(model, [question], Effort(3))
    assert np.array_equal(answer.position, steps.after_calls[-1]) and answer.frames == (2, 6) and answer.computed.all()
    assert len(answer.stress) == 2 == len(answer.step_seconds) and np.array_equal(steps.stress, answer.stress)


def test_only_the_wanted_frames_are_computed(monkeypatch):
    truth, model, seen = toy.plate(0), model_of("ast"), []
    forward = model.forward
    monkeypatch.setattr(model, "forward", lambda batch: seen.append(batch.names) or forward(batch))
    (last,) = answers(model, [Question.of(truth, "scene", [-1])], Effort(2))
    assert seen == [["scene frame 6"]] * 3
    (every,) = answers(model, [Question.of(truth, "scene")], Effort(2))
    assert every.frames == tuple(range(7)) and every.computed.tolist() == [False] + [True] * 6
    (turned,) = answers(model, [Question.of(truth, "scene", [6, 0, 2])], Effort(2))
    assert turned.frames == (6, 0, 2) and turned.trajectory.numbers == (0, 2, 6)
    assert np.array_equal(turned.position[1], truth.position[0])
    np.testing.assert_allclose(turned.position[[0, 2]], every.position[[6, 2]], rtol=0, atol=2e-6)
    for same in (slice(-2, None), np.array([5, 6]), range(5, 7)):
        assert Question.of(truth, "scene", same).frames == (5, 6)
    assert Question.of(truth, "scene", -1).frames == (6,)
    for wrong, told in (
        ([1.5], "; one is 1.5"),
        ([1, "2"], "; one is '2'"),
        ([True], "; one is True"),
        ([np.bool_(True)], "; one is "),
        ([[1, 2]], "; one is of the type list"),
        ([1, [2, [3]]], "; one is of the type list"),
        (np.array([1, 2.5]), "; one is "),
        ("last", ", not 'last'"),
        (2.5, ", not 2.5"),
        (True, ", not True"),
        (slice(1, None, 2.5), ", not of the type slice"),
        (slice(None, None, 0), ", not of the type slice"),
    ):
        with pytest.raises(ConfigError, match=f"frames must be whole numbers, one such number, or a slice{told}"):
            Question.of(truth, "scene", wrong)
    assert Question.of(truth, "scene", [torch.tensor(5), np.array(6)]).frames == (5, 6)
    with pytest.raises(ConfigError, match="scene: frame 6 is named twice: name each frame once"):
        Question.of(truth, "scene", [6, -1])
    np.testing.assert_allclose(last.position[0], every.position[6], rtol=0, atol=2e-6)
    for wrong, message in (([7], "has the frames 0 to 6; there is no frame 7"), ([], "name at least one frame")):
        with pytest.raises(RolloutError, match=message):
            Question.of(truth, "scene", wrong)


@pytest.mark.parametrize("model", ["ast", "transolver"])
def test_frames_with_another_spacing_have_the_same_answers(model):
    """A model is told where the prescribed nodes are, never the number of a frame."""
    truth, built = toy.plate(0), model_of(model)
    order = [0, 0, 1, 3, 3, 6]
    other = Trajectory(truth.scene, truth.position[order], truth.stress[order])
    (plain,), (spaced,) = (
        answers(built, [Question.of(t, "scene", [f])], Effort(2)) for t, f in ((truth, 3), (other, 4))
    )
    assert np.array_equal(plain.position, spaced.position) and np.array_equal(plain.stress, spaced.stress)


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


def test_a_frame_that_fails_keeps_the_others_before_it():
    truth, model = toy.plate(0), model_of("ast")
    predict = model.predict

    def spoiled(batch):
        found = predict(batch)
        wrong = torch.tensor([name.endswith("frame 4") for name in batch.names])
        rows = wrong.repeat_interleave(batch.graph.node_offsets.diff())
        return Prediction(torch.where(rows[:, None], torch.nan, found.motion), found.fields)

    model.predict = spoiled
    result = toy.answer(model, truth)
    assert result.frames == (0, 1, 2, 3) and len(result.position) == 4
    assert "frame 4 is not finite" in result.failure and result.failure.endswith("the frames before it are kept")


def test_a_jump_has_no_error_of_one_step(data):
    with Dataset(data) as dataset:
        jumping = evaluate(model_of("transolver"), dataset, effort=Effort(1))
        stepwise = evaluate(model_of("transolver", jumps=False), dataset)
    for quantity in ("displacement", "stress"):
        assert jumping.error(quantity, horizon="one_step") is None
        assert stepwise.error(quantity, horizon="one_step").rmse_sequence > 0
        assert jumping.error(quantity, horizon="rollout_50").rmse_sequence > 0
    assert jumping.error("displacement", "hold_still", "one_step").rmse_sequence > 0  # beside a run that has steps
    assert jumping.jumps is True and stepwise.jumps is False
    assert "one jump and 1 correction: there is no error" in table(jumping) and "one jump" not in table(stepwise)
    heads = [[line.split() for line in table(one).splitlines() if "rollout_all" in line] for one in (jumping, stepwise)]
    assert (
        heads[0] == [["rollout_50", "rollout_all"]] * 3 and heads[1] == [["one_step", "rollout_50", "rollout_all"]] * 3
    )


def test_a_failed_prediction_has_no_error(data):
    model = model_of("ast")
    model.motion_normalizer.scale.fill_(math.nan)
    with Dataset(data) as dataset:
        found = evaluate(model, dataset)
    assert found.failures == 2
    for quantity in ("displacement", "stress"):
        assert found.error(quantity).rmse_sequence is None


@pytest.mark.parametrize("model", ["ast", "transolver"])
def test_dynamic_scenes_are_refused(model, tmp_path):
    with pytest.raises(ConfigError, match=r"model.jumps: the dataset is dynamic"):
        config(model).resolve(DataFacts.of(toy.info(dynamic=True), (), 0.1))
    moving = toy.write(tmp_path / "moving.h5", dynamic=True)
    with pytest.raises(ConfigError, match=r"model.jumps: the dataset is dynamic"):
        start_training(tmp_path / "run", configure(moving, "tiny", ["model.jumps=true"], model=model))


@pytest.mark.parametrize("model", model_names())
def test_the_preset_tiny_jumps_where_there_is_no_inertia_and_the_papers_presets_never(model):
    for dynamic in (False, True):
        tiny = find_preset(model, "tiny").model.resolve(DataFacts.of(toy.info(dynamic=dynamic), (), 0.1))
        assert tiny.jumps is not dynamic and tiny.boundary_motion is dynamic
        assert ("out_of_balance" in tiny.node_inputs) is not dynamic
    shells = find_preset(model, "tiny").model.resolve(DataFacts.of(toy.info(), (), 0.1, tetrahedra=False))
    assert "out_of_balance" not in shells.node_inputs
    assert find_preset("ast", "deforming_plate").model.jumps is False


def test_forces_need_tetrahedra():
    chosen = replace(find_preset("ast", "tiny").model, node_inputs=("out_of_balance",))
    with pytest.raises(ConfigError, match="out_of_balance needs tetrahedra"):
        chosen.resolve(DataFacts.of(toy.info(), (), 0.1, tetrahedra=False))


@pytest.mark.parametrize("model", ["ast", "transolver"])
def test_the_setting_survives_toml_and_is_off_where_it_is_left_out(model):
    settings = RunConfig(config(model, data=DataFacts()), TrainConfig(), "data.h5")
    text = to_toml(settings)
    assert from_values(RunConfig, tomllib.loads(text)) == settings
    left_out = from_values(RunConfig, tomllib.loads(text.replace("jumps = true\n", "")))
    assert left_out.model == config(model, jumps=False, data=DataFacts())


@pytest.mark.parametrize("model", ["ast", "transolver", "mgn"])
def test_training_brings_the_error_below_holding_still(model, data, tmp_path):
    settings = ["train.steps=120", "train.validate_every=120", "train.peak_rate=2e-3", "train.corrections=1"]
    start_training(tmp_path / "run", configure(data, "tiny", settings, model=model))
    made = read_config(tmp_path / "run")
    assert made.train.noise == 0.0 and made.model.jumps  # a guess has errors of the model's own
    trained = RunFolder(tmp_path / "run").load_model()
    with Dataset(data) as dataset:
        found = evaluate(trained, dataset, effort=Effort(1))
    reached, still = (found.error("displacement", key).rmse_sequence for key in ("model", "hold_still"))
    assert reached < 0.7 * still

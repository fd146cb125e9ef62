"""Named fields that a model predicts: on nodes and elements, by every model, in answers and their files."""

import csv
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
import toy
from toy import one_thread  # noqa: F401

import ast_sim
from ast_sim import Dataset
from ast_sim.batches.batch_builder import Target
from ast_sim.batches.mirror_and_shift import Placement
from ast_sim.models import DataFacts, Prediction
from ast_sim.models.registry import model_names
from ast_sim.named_field import REACTION, NamedField
from ast_sim.support.errors import ConfigError, DatasetError

STATES = ("heat flux", "PEEQ", REACTION)
PARTS = ("stress", "force", *(f"field {name}" for name in STATES))  # of the loss, beside the motion


def with_fields(truth, unit="J/m2"):
    """A plate with a scalar at nodes, a vector in elements and reactions, that follow from its displacement."""
    scene, moved = truth.scene, truth.position - truth.scene.rest_position
    depth = 0.1 - moved[:, :, 2:]
    fields = {
        "PEEQ": NamedField(depth.astype(np.float32), "node"),
        "heat flux": NamedField(1e4 * moved[:, scene.elements].mean(axis=2), "element", unit),
        REACTION: NamedField(1e3 * moved, "node", "N"),
    }
    return replace(truth, fields=fields)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("fields") / "d.h5"
    with toy.DatasetWriter(path, toy.info()) as writer:
        for seed, split in enumerate(("train", "train", "test")):
            writer.add(split, with_fields(toy.plate(seed, frames=4)))
    return path


@pytest.fixture(scope="module")
def run(data, tmp_path_factory):
    return ast_sim.train(data, tmp_path_factory.mktemp("run") / "r", steps=2, batch_size=2, state=STATES)


@pytest.mark.parametrize("name", ["mgn", "bsms", "hcmt", "transolver"])  # `run` is of AST
def test_every_model_predicts_them(data, name, tmp_path):
    assert name in model_names()
    run = ast_sim.train(data, tmp_path / "run", model=name, steps=1, batch_size=2, state=STATES)
    with Dataset(data) as dataset:
        answer = run.predict(dataset["test"][0])
    assert list(answer.fields) == list(STATES) and answer.stress is not None
    assert all(one.values[1:].std() > 0 for one in answer.fields.values())


def test_answers_have_them_with_place_and_unit(run, data, tmp_path):
    with Dataset(data) as dataset:
        truth = dataset["test"][0]
    answer = run.predict(truth, frames=[3, 0])
    scene = truth.scene
    for name, one in answer.fields.items():
        true = truth.fields[name]
        assert (one.location, one.unit, one.values.shape[1:]) == (true.location, true.unit, true.values.shape[1:])
        assert np.array_equal(one.values[1], true.values[0])  # the first frame is given
        assert np.array_equal(answer.frame(3).fields[name], one.values[0])
    assert not answer.fields["PEEQ"].values[0, ~scene.deforming_nodes].any()
    assert not answer.fields["heat flux"].values[0, ~scene.deforming_elements].any()
    assert not answer.fields[REACTION].values[0, ~scene.prescribed].any()
    assert answer.fields[REACTION].values[0, scene.prescribed].any()
    for suffix in (".h5", ".csv", ".vtkhdf"):
        answer.save(tmp_path / f"answer{suffix}", None if suffix == ".h5" else truth)
    with Dataset(tmp_path / "answer.h5") as saved:
        for name, one in saved["test"][0].fields.items():
            assert np.array_equal(one.values, answer.fields[name].values[::-1])
    rows = list(csv.DictReader((tmp_path / "answer.csv").read_text().splitlines()))
    assert float(rows[0]["largest_PEEQ"]) == answer.fields["PEEQ"].values[0].max()
    flux = np.linalg.norm(answer.fields["heat flux"].values[0], axis=1).max()
    assert float(rows[0]["largest_heat flux"]) == pytest.approx(flux) and "largest_reaction" not in rows[0]
    with h5py.File(tmp_path / "answer.vtkhdf") as file:
        error = file["VTKHDF/PointData/PEEQ_error"][:].reshape(2, -1)
        wanted = answer.fields["PEEQ"].values[0, :, 0] - truth.fields["PEEQ"].values[3, :, 0]
        np.testing.assert_array_equal(error[1], wanted)
        assert file["VTKHDF/CellData/heat flux"].shape == (2 * scene.num_elements, 3)


def test_a_scene_without_given_values_starts_at_zero(run):
    answer = run.predict(toy.plate(5, frames=4))
    assert not answer.fields["PEEQ"].values[0].any() and answer.fields["PEEQ"].values[1].any()


def test_a_force_on_bodies_is_the_sum_of_predicted_reactions(run, data):
    with Dataset(data) as dataset:
        truth = dataset["test"][0]
    answer, scene = run.predict(truth), truth.scene
    predicted = answer.fields[REACTION].values.astype(float)
    np.testing.assert_allclose(answer.reaction(), predicted[:, scene.body == 1].sum(axis=1), atol=1e-9)  # the block
    forces = answer.body_forces()
    assert [(one.frame, one.body) for one in forces] == [(f, b) for f in range(4) for b in (0, 1)]
    own = scene.body == 0
    arms = answer.position[3].astype(float) - answer.position[3, own].astype(float).mean(axis=0)
    last = next(one for one in forces if (one.frame, one.body) == (3, 0))
    np.testing.assert_allclose(last.force, predicted[3, own].sum(axis=0), atol=1e-9)
    np.testing.assert_allclose(last.torque, np.cross(arms, predicted[3])[own].sum(axis=0), atol=1e-9)
    assert last.time == 3.0


def test_the_loss_counts_the_forces_on_bodies(run, data):
    """The same error at all nodes of a body is small at each, and large in their sum."""
    model = run.model
    with Dataset(data) as dataset:
        batch, target = model.pairs(dataset, batch_size=6).batch(0)
    with model.predicting():
        prediction = model(batch)
    losses = model.loss(prediction, batch, target)
    off = model.predict(batch).fields[REACTION] - target.fields[REACTION]
    sums, true = [], []
    for first, last in zip(batch.graph.node_offsets, batch.graph.node_offsets[1:], strict=False):
        rows = torch.arange(len(off))
        for body in (0, 1):
            own = (rows >= first) & (rows < last) & (batch.graph.body == body) & batch.graph.prescribed
            sums.append(off[own].sum(dim=0))
            true.append(target.fields[REACTION][own].sum(dim=0))
    scale = float(model.force_normalizer.scale)
    assert 0.5 < scale / float(torch.stack(true).square().mean().sqrt()) < 2
    assert float(losses["force"]) == pytest.approx(float((torch.stack(sums) / scale).square().mean()), rel=1e-4)
    whole = losses["motion"] + 0.01 * sum(value for key, value in losses.items() if key in PARTS)
    assert float(losses["loss"]) == pytest.approx(float(whole), rel=1e-5)


def test_reactions_turn_in_a_mirror_and_columns_are_told_apart():
    flip = Placement(np.array([-1, 1, 1], np.float32), np.zeros(3, np.float32), np.zeros(3, np.float32))
    values = torch.arange(6.0).reshape(2, 3)
    placed = Target(values, {REACTION: values, "PEEQ": values[:, :1]}).placed(flip)
    assert torch.equal(placed.fields[REACTION], values * torch.tensor([-1.0, 1, 1]))
    assert torch.equal(placed.fields["PEEQ"], values[:, :1])
    facts = DataFacts(stress="node", fields=(("q", "element", 2, ""), ("a", "node", 1, ""), ("b", "element", 1, "")))
    assert (facts.output_columns("node"), facts.output_columns("element")) == (2, 3)
    of_nodes, of_elements = torch.arange(10.0).reshape(2, 5), torch.arange(3.0).reshape(1, 3)
    both = Prediction.of(facts, of_nodes, of_elements)
    assert torch.equal(both.motion, of_nodes[:, :3]) and list(both.fields) == ["stress", "q", "a", "b"]
    assert torch.equal(both.fields["stress"], of_nodes[:, 3:4]) and torch.equal(both.fields["a"], of_nodes[:, 4:])
    assert torch.equal(both.fields["q"], of_elements[:, :2]) and torch.equal(both.fields["b"], of_elements[:, 2:])
    assert list(Prediction.of(facts, of_nodes).fields) == ["stress", "a"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"state": ("PEQ",)}, r"has no field 'PEQ'; it has: PEEQ, heat flux, reaction; keep one with ast-sim convert"),
        ({"state": ("PEEQ", "PEEQ")}, "model.state names 'PEEQ' twice"),
        ({"state": ("heat flux",), "mirror": ("x",)}, "train.mirror: heat flux has several columns"),
    ],
)
def test_what_cannot_be_predicted_is_refused(data, tmp_path, options, message):
    with pytest.raises(ConfigError, match=message):
        ast_sim.train(data, tmp_path / "run", steps=1, **options)


def test_data_of_another_kind_are_refused(run, data, tmp_path):
    other = tmp_path / "other.h5"
    with toy.DatasetWriter(other, toy.info()) as writer:
        for split in ("train", "test"):
            writer.add(split, with_fields(toy.plate(0, frames=4), unit="J/mm2"))
    for ask in (
        lambda: run.evaluate(other, rival_scenes=0),
        lambda: ast_sim.train(other, tmp_path / "r", from_run=run.path),
    ):
        with pytest.raises(
            DatasetError, match=r"needs the field heat flux \(3 at each element, J/m2\); it has .*J/mm2"
        ):
            ask()


def test_an_evaluation_has_their_errors(run, data):
    figures = run.evaluate(data, rival_scenes=0).figures
    with Dataset(data) as dataset:
        truth = dataset["test"][0]
    answer = run.predict(truth, effort=ast_sim.Effort(**figures.effort))
    for name, rows in (("PEEQ", truth.scene.deforming_nodes), (REACTION, truth.scene.prescribed)):
        error = answer.fields[name].values[1:, rows] - truth.fields[name].values[1:, rows].astype(float)
        rmse = np.sqrt(np.mean(error**2))
        assert figures.error(name).rmse_pooled == pytest.approx(rmse, rel=1e-3)
        size = np.sqrt(np.mean(np.square(truth.fields[name].values[1:, rows], dtype=float)))
        assert figures.relative(name) == pytest.approx(rmse / size, rel=1e-3)
    assert figures.unit("heat flux") == "J/m2" and figures.to_json()["errors"][REACTION]["model"]


def test_a_model_that_predicts_the_stress_alone_is_refused(data, tmp_path, monkeypatch):
    monkeypatch.setattr(
        Prediction, "of", lambda facts, out, on_elements=None: Prediction(out[:, :3], {"stress": out[:, 3:4]})
    )
    with pytest.raises(ConfigError, match="the model transolver does not predict PEEQ: leave it out"):
        ast_sim.train(data, tmp_path / "run", model="transolver", steps=1, state=("PEEQ",))

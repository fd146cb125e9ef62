"""Named fields that a model predicts: on nodes and elements, by every model, in answers and their files."""

import csv
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
import toy

import ast_sim
from ast_sim import Dataset
from ast_sim.batches.batch_builder import Target
from ast_sim.batches.mirror_and_shift import Placement
from ast_sim.models import DataFacts, Prediction
from ast_sim.models.registry import model_names
from ast_sim.named_field import REACTION, NamedField
from ast_sim.support.errors import ConfigError, DatasetError

STATES = ("heat flux", "PEEQ", REACTION)


def with_fields(truth, unit="J/m2"):
    """A plate with a scalar at nodes, a vector in elements and reactions, that follow from its displacement."""
    scene, moved = truth.scene, truth.position - truth.scene.rest_position
    depth = 0.1 - moved[:, :, 2:]
    fields = {
        "PEEQ": NamedField(depth.astype(np.float32), "node"),
        "heat flux": NamedField(1e4 * moved[:, scene.elements].mean(axis=2), "element", unit),
        REACTION: NamedField(moved * np.float32(1e3 + np.arange(scene.num_nodes) % 3)[:, None], "node", "N"),
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


def test_what_the_network_says_of_a_body_is_in_the_mean_the_force_on_it(run, data):
    """An error that is alike at all nodes of a body counts as much as one of the force, not as one of a node."""
    model = run.model
    with Dataset(data) as dataset:
        batch, target = model.pairs(dataset, batch_size=6).batch(0)
    with model.predicting():
        said, nodal = model(batch).fields[REACTION], model.predict(batch).fields[REACTION]
        losses = model.loss(model(batch), batch, target)
    force, scale = float(model.force_normalizer.scale), float(model.field_normalizers[2].scale)
    rows, sums, errors = torch.arange(len(said)), [], []
    for first, last in zip(batch.graph.node_offsets, batch.graph.node_offsets[1:], strict=False):
        for body in (0, 1):
            own = (rows >= first) & (rows < last) & (batch.graph.body == body) & batch.graph.prescribed
            true = target.fields[REACTION][own]
            sums.append(true.sum(dim=0).expand_as(true))
            wanted = (true - true.mean(dim=0)) / scale + true.sum(dim=0) / force
            errors.append(said[own] - wanted)
            np.testing.assert_allclose(nodal[own].sum(dim=0), force * said[own].mean(dim=0), rtol=1e-3, atol=1e-4)
            deviation = said[own] - said[own].mean(dim=0)
            np.testing.assert_allclose(nodal[own] - nodal[own].mean(dim=0), scale * deviation, rtol=1e-3, atol=1e-4)
    assert 0.5 < force / float(torch.cat(sums).square().mean().sqrt()) < 2
    assert float(losses[f"field {REACTION}"]) == pytest.approx(float(torch.cat(errors).square().mean()), rel=1e-4)


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
        lambda: run.evaluate(other, solver_scenes=0),
        lambda: ast_sim.train(other, tmp_path / "r", from_run=run.path),
    ):
        with pytest.raises(
            DatasetError, match=r"needs the field heat flux \(3 at each element, J/m2\); it has .*J/mm2"
        ):
            ask()


def test_an_evaluation_has_their_errors(run, data):
    figures = run.evaluate(data, solver_scenes=0).figures
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
    monkeypatch.setattr(Prediction, "of", lambda facts, out, *_: Prediction(out[:, :3], {"stress": out[:, 3:4]}))
    with pytest.raises(ConfigError, match="the model transolver does not predict PEEQ: leave it out"):
        ast_sim.train(data, tmp_path / "run", model="transolver", steps=1, state=("PEEQ",))

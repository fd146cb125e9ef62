"""The force of an answer: from predicted reactions by the network alone, from the positions after Newton steps."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

import ast_sim
from ast_sim.inference.quantities.band import compared
from ast_sim.named_field import REACTION

EXACT = ast_sim.Effort.exact()


@pytest.fixture(scope="module")
def plate(tmp_path_factory):
    """A run that predicts reactions, though it has learnt little, and a plate of the bundled solver."""
    folder = tmp_path_factory.mktemp("force")
    path = folder / "d.h5"
    counts = {"train": 2, "valid": 1, "test": 1}
    ast_sim.generate("deforming_plate", path, **counts, nodes=400, frames=41, keep=(14, 24), progress=False)
    run = ast_sim.train(path, folder / "run", steps=2, batch_size=1, state=(REACTION,), progress=False)
    with ast_sim.Dataset(path) as data:
        return run, data["test"][0]


def test_the_network_alone_predicts_it_and_an_exact_answer_has_the_right_one(plate):
    run, truth = plate
    moved = truth.scene.body == 1
    alone = run.predict(truth, effort=ast_sim.Effort())
    predicted = alone.fields[REACTION].values.astype(float)[:, moved].sum(axis=1)
    np.testing.assert_allclose(alone.reaction(), predicted, atol=1e-9)
    assert alone.errors(truth)["reaction"] > 0.1  # two steps teach little
    finished = run.predict(truth, effort=ast_sim.Effort.exact())
    assert finished.errors(truth)["reaction"] < 0.01
    by_law = replace(finished, fields={}).reaction()
    assert np.array_equal(finished.reaction(), by_law) and not np.allclose(by_law, predicted, rtol=0.1)


@pytest.mark.parametrize("effort", [ast_sim.Effort(newton_steps=1), ast_sim.Effort(newton_steps=3), EXACT])
def test_an_answer_holds_one_force(plate, effort, tmp_path):
    """After Newton steps the predicted reactions would belong to other positions: no answer and no file has them."""
    run, truth = plate
    answer = run.predict(truth, effort=effort)
    assert answer.fields == {} and answer.frame(2).fields == {} and len(answer.last_steps) == 2
    assert answer.errors(answer.trajectory) == {"displacement": 0, "reaction": 0, "stress": 0}
    answer.save(tmp_path / "a.h5")
    with ast_sim.Dataset(tmp_path / "a.h5") as data:
        assert data["test"][0].fields == {}
    answer.save(tmp_path / "a.vtkhdf")
    with h5py.File(tmp_path / "a.vtkhdf") as file:
        assert "von_mises" in file["VTKHDF/PointData"] and "reaction" not in file["VTKHDF/PointData"]
    assert np.linalg.norm(answer.body_forces()[-1].force) == pytest.approx(np.linalg.norm(answer.reaction()[-1]))


def test_the_true_reactions_of_a_file_are_the_force_of_the_true_positions(plate):
    run, truth = plate
    answer = run.predict(truth, effort=ast_sim.Effort())
    true = replace(answer, position=truth.position, fields=truth.fields)
    np.testing.assert_allclose(true.reaction(), replace(true, fields={}).reaction(), rtol=2e-3, atol=0.05)
    assert np.linalg.norm(true.reaction(), axis=1)[1:] == pytest.approx(truth.attributes["reaction"][1:], rel=1e-4)


@pytest.mark.parametrize("effort", [ast_sim.Effort(), ast_sim.Effort(newton_steps=1)])
def test_a_force_is_compared_with_the_stored_one(plate, effort):
    """Of data that follow another law than ours, or in which a tool presses on held nodes: positions do not tell."""
    run, truth = plate
    stored = truth.fields[REACTION]
    other = replace(truth, fields={REACTION: replace(stored, values=3 * stored.values)})
    answer = run.predict(truth, effort=effort)
    force = np.linalg.norm(answer.reaction()[-1] - other.fields[REACTION].values[-1, answer.driven.nodes].sum(axis=0))
    true = 3 * truth.attributes["reaction"][-1]
    assert answer.errors(other)["reaction"] == pytest.approx(force / true, rel=1e-3)
    assert compared(answer, other)["reaction"].errors[-1] == pytest.approx(force, rel=1e-3)

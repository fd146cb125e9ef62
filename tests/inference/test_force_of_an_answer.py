"""The force of an answer: from predicted reactions by the network alone, from the positions after Newton steps."""

from dataclasses import replace

import numpy as np
import pytest

import ast_sim
from ast_sim.named_field import REACTION


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


def test_the_true_reactions_of_a_file_are_the_force_of_the_true_positions(plate):
    run, truth = plate
    answer = run.predict(truth, effort=ast_sim.Effort())
    true = replace(answer, position=truth.position, fields=truth.fields)
    np.testing.assert_allclose(true.reaction(), replace(true, fields={}).reaction(), rtol=2e-3, atol=0.05)
    assert np.linalg.norm(true.reaction(), axis=1)[1:] == pytest.approx(truth.attributes["reaction"][1:], rel=1e-4)

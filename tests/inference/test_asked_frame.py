"""The asked frame: relative errors, stress, times, and the solver's ways to the same frame."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
import toy
from toy import one_thread  # noqa: F401 (used by being imported)

from ast_sim import Dataset, generate
from ast_sim.inference.asked_frame import asked_frames, lines
from ast_sim.models.simulator import Prediction, Simulator
from ast_sim.simulate.jobs.rival import deepest_frame


class Share(Simulator):
    """Goes a share of the way that is missing to the truth of one scene; the stress is a share of the true one."""

    def __init__(self, config, truth, frame, share):
        super().__init__(config)
        self.truth, self.stress, self.share = torch.tensor(truth.position[frame]), truth.stress[frame], share

    def forward(self, batch):
        return Prediction(self.share * (self.truth - batch.position), torch.tensor(self.share * self.stress))


@pytest.fixture
def one(tmp_path):
    """A dataset whose test split is one toy plate."""
    with Dataset(toy.write(tmp_path / "toy.h5", counts=(1, 0, 1))) as dataset:
        yield dataset


def test_errors_are_shares_of_the_displacement(one):
    truth = one.load("test", 0)
    frame = deepest_frame(truth)
    assert 0 < frame < 6
    model = Share(replace(toy.config(toy.info()), jumps=True), truth, frame, 0.75)
    scene, *_ = asked_frames(model, one, "test", 2)["scenes"]
    free = ~truth.scene.prescribed
    size = np.sqrt(np.mean(np.square((truth.position[frame] - truth.position[0])[free].astype(float))))
    assert (scene["name"], scene["frame"], scene["displacement"]) == ("test/000000", frame, pytest.approx(size))
    assert scene["by_calls"] == pytest.approx([0.25, 0.25**2, 0.25**3], rel=1e-4)
    assert scene["relative_error"] == pytest.approx(0.25**3, rel=1e-4) and scene["seconds"] > 0
    there = truth.stress[frame][truth.scene.deforming("node")].astype(float)
    assert scene["stress_share"] == pytest.approx(0.25 * np.sqrt(np.mean(there**2)) / there.std(), rel=1e-5)
    assert scene["largest_stress"] == pytest.approx(0.25, rel=1e-5)


def test_a_failure_and_a_dataset_without_a_solver_are_told(one):
    truth = one.load("test", 0)
    model = Share(replace(toy.config(toy.info()), jumps=True), truth, 3, float("nan"))
    found = asked_frames(model, one, "test", 1, rival_scenes=1)
    assert found["relative_error"] is None and lines(found) == ["the deepest frame: every prediction failed"]
    model.share = 0.5
    found = asked_frames(model, one, "test", 1, rival_scenes=1)
    assert found["solver"] is None and "the solver was not run:" in lines(found)[-1]
    json.dumps(found, allow_nan=False)


def test_beside_the_solver(tmp_path):
    """A model that gives the truth: only ways as accurate as that count, so the own stop test is the cheapest."""
    made = generate("deforming_plate", tmp_path / "d.h5", train=1, valid=0, test=1, nodes=100, frames=5, workers=1)
    with Dataset(made.path) as dataset:
        truth = dataset.load("test", 0)
        frame = deepest_frame(truth)
        config = replace(toy.config(dataset.info), jumps=True, stress="node")
        found = asked_frames(Share(config, truth, frame, 0.99), dataset, "test", 0, rival_scenes=1)
    solver = found["scenes"][0]["solver"]
    assert found["relative_error"] == pytest.approx(0.01, rel=1e-3)
    assert solver["ways"]["own stop test"]["relative_error"] < 1e-3
    assert solver["cheapest_seconds"] <= solver["seconds"]
    assert solver["ways"][solver["cheapest"]]["relative_error"] <= 0.01
    assert found["solver"]["ratio"] == pytest.approx(solver["seconds"] / found["scenes"][0]["seconds"])
    assert any("the solver, straight to this frame" in line for line in lines(found))
    json.dumps(found, allow_nan=False)

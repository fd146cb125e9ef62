"""Rollouts: the script is followed exactly, batches change nothing, and a failure keeps the frames before it."""

import re

import numpy as np
import pytest
import torch
import toy

from ast_sim.batches.batch_builder import Batch
from ast_sim.models.ast.network import AST
from ast_sim.models.registry import build_model
from ast_sim.models.simulator import Prediction, Simulator
from ast_sim.scene import Trajectory
from ast_sim.support.errors import RolloutError


class Constant(Simulator):
    """Every node moves (or accelerates) by the same vector; `spoil` may change the motion of a given call.

    It has AST's domain.
    """

    domain = AST.domain

    def __init__(self, config, motion=(0.0, 0.0, 0.0), spoil=None) -> None:
        super().__init__(config)
        self.motion, self.spoil, self.calls = torch.tensor(motion), spoil, 0

    def forward(self, batch: Batch) -> Prediction:
        self.calls += 1
        motion = self.motion.expand(len(batch.position), 3).clone()
        if self.spoil is not None:
            self.spoil(self.calls, motion)
        stress = torch.full((len(motion), 1), float(self.calls))
        return Prediction(motion, {"stress": stress} if self.config.data.stress == "node" else {})


def model_of(kind=toy.LinearSimulator, dynamic=False, stress=True, **options):
    torch.manual_seed(3)
    model = kind(toy.config(toy.info(dynamic, stress)), **options)
    model.motion_normalizer.scale.fill_(1.0 if kind is Constant else 1e-3)
    return model


def test_positions_add_up_the_increments_and_prescribed_nodes_follow_the_script_to_the_bit():
    truth = toy.plate(1)
    result = toy.answer(model_of(Constant, motion=(0.01, 0.0, -0.02)), truth)
    normal = ~truth.scene.prescribed
    assert result.given == 1
    assert result.position.dtype == np.float32
    assert np.array_equal(result.position[:, ~normal], truth.position[:, ~normal])
    assert np.array_equal(result.position[0], truth.position[0])
    steps = np.arange(7)[:, None, None] * np.array([0.01, 0.0, -0.02])
    np.testing.assert_allclose(result.position[:, normal], truth.position[0, normal] + steps, atol=1e-6)
    assert len(result.step_seconds) == 6
    assert all(seconds > 0 for seconds in result.step_seconds)


def test_dynamic_scenes_start_from_two_frames_and_integrate_accelerations():
    truth = toy.plate(1, dynamic=True)
    result = toy.answer(model_of(Constant, dynamic=True, motion=(0.0, 0.001, 0.0)), truth)
    normal = ~truth.scene.prescribed
    assert result.given == 2
    assert np.array_equal(result.position[:2], truth.position[:2])
    velocity = truth.position[1, normal] - truth.position[0, normal]
    k = np.arange(6)[:, None, None]
    expected = truth.position[1, normal] + k * velocity + k * (k + 1) / 2 * np.array([0, 0.001, 0])
    np.testing.assert_allclose(result.position[1:, normal], expected, atol=1e-6)


def test_stress_starts_with_the_truths_and_follows_the_predictions():
    truth = toy.plate(0)
    result = toy.answer(model_of(Constant), truth)
    assert np.array_equal(result.stress[0], truth.stress[0])
    assert [float(frame.min()) for frame in result.stress[1:]] == [1, 2, 3, 4, 5, 6]
    assert toy.answer(model_of(Constant, stress=False), toy.plate(0, stress=False)).stress is None


@pytest.mark.parametrize("kind", [toy.LinearSimulator, build_model])
def test_a_batch_of_scenes_gives_what_each_gives_alone(kind):
    truths = [toy.plate(0, frames=5), toy.plate(1, frames=9), toy.plate(2, frames=7)]
    model = model_of(kind)
    together = toy.answers(model, truths, ["a", "b", "c"])
    for truth, result in zip(truths, together, strict=True):
        alone = toy.answer(model, truth)
        assert result.position.shape == truth.position.shape
        np.testing.assert_allclose(result.position, alone.position, rtol=0, atol=2e-6)
        np.testing.assert_allclose(result.stress, alone.stress, rtol=1e-4, atol=1e-4)
        assert result.failure is None


def test_the_mode_of_the_model_is_kept_and_dropout_is_off():
    model = model_of().train()
    first, second = toy.answer(model, toy.plate(0)), toy.answer(model, toy.plate(0))
    assert model.training
    assert np.array_equal(first.position, second.position)


def test_a_position_that_is_not_finite_names_frame_and_node_and_keeps_the_frames_before():
    def spoil(call, motion):
        if call == 3:
            motion[10, 1] = torch.inf

    found = toy.answer(model_of(Constant, spoil=spoil), toy.plate(0), "valid/000004")
    assert "valid/000004: the predicted position of node 10 in frame 3 is not finite" in found.failure
    assert found.position.shape[0] == 3
    assert found.stress.shape[0] == 3
    assert np.isfinite(found.position).all()


def test_one_failing_scene_leaves_the_batch_and_the_others_go_on():
    truths = [toy.plate(0), toy.plate(1)]
    size = truths[0].scene.num_nodes

    def spoil(call, motion):
        if call == 2:
            motion[size + 15] = torch.nan

    first, second = toy.answers(model_of(Constant, spoil=spoil), truths, ["a", "b"])
    assert first.failure is None and len(first.position) == 7
    assert "b: the predicted position of node 15 in frame 2" in second.failure
    assert len(second.position) == 2


def test_a_node_that_leaves_the_domain_lets_it_grow_until_the_octree_is_too_deep():
    # The domain reaches 0.5 m from its centre at level 3: 18 doublings reach 131 km.
    truth = toy.plate(0, frames=4)

    def spoil(call, motion):
        motion[10, 2] = [0.0, 100.0, 60_000.0, 100_000.0][call]

    failure = toy.answer(model_of(Constant, spoil=spoil), truth).failure
    assert re.search(r"in frame 3 node 10 is .* from the centre of the domain", failure)

    def leave(call, motion):
        motion[10, 2] = 100.0

    assert len(toy.answer(model_of(Constant, spoil=leave), truth).position) == 4


def test_the_model_goes_on_when_a_node_leaves_the_domain():
    truth = toy.plate(0)
    position = truth.position.copy()
    position[3:, -8:, 2] += 2.0  # the block flies off
    moved = Trajectory(truth.scene, position, truth.stress)
    result = toy.answer(model_of(build_model), moved)
    assert len(result.position) == 7
    assert np.array_equal(result.position[:, -8:], position[:, -8:])


def test_a_trajectory_of_one_frame_cannot_be_rolled_out():
    truth = toy.plate(0)
    with pytest.raises(RolloutError, match="one has 1 frame;"):
        toy.answer(model_of(), Trajectory(truth.scene, truth.position[:1], truth.stress[:1]), "one")

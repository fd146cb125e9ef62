"""Every figure of an evaluation against a computation by hand on scenes of a few numbers."""

import json
import math
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
import toy

import ast_sim
from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.solver_seconds import write_seconds
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.inference.answer import Answer
from ast_sim.inference.evaluation.evaluate import evaluate, table
from ast_sim.inference.evaluation.trivial_predictors import displacement_errors, errors_over_scenes, field_errors
from ast_sim.scene import NodeType, Scene, Trajectory
from ast_sim.support.errors import DatasetError
from ast_sim.support.provenance import provenance

HORIZONS = ("one_step", "rollout_50", "rollout_all")


def one_triangle(frames: list[float], obstacle: list[float] | None = None) -> Trajectory:
    """Node 0 NORMAL with x given frame by frame, node 1 HANDLE at rest, node 2 OBSTACLE with its own x."""
    scene = Scene(
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32),
        np.array([[0, 1, 2]], np.int32),
        np.array([NodeType.NORMAL, NodeType.HANDLE, NodeType.OBSTACLE], np.uint8),
        np.array([0, 0, 1], np.int32),
    )
    position = np.repeat(scene.rest_position[None], len(frames), axis=0)
    position[:, 0, 0] = frames
    position[:, 2, 0] = frames if obstacle is None else obstacle
    return Trajectory(scene, position)


def answer_of(truth: Trajectory, position, stress, given: int, failure: str | None = None) -> Answer:
    return Answer("scene", truth.scene, position, stress, given, [], failure)


def predicted(truth: Trajectory, x: list[float], given: int) -> Answer:
    position = truth.position.copy()
    position[given:, 0, 0] = x
    return answer_of(truth, position, None, given)


def test_displacement_errors_by_hand():
    truth = one_triangle([0.0, 1.0, 3.0, 3.0])
    # One step: predictions 2, 2, 3 for the truths 1, 3, 3: errors 1, -1, 0. Rollout: 1, 1, 1: errors 0, -2, -2.
    one_step = truth.position[1:].copy()
    one_step[:, 0, 0] = [2.0, 2.0, 3.0]
    errors = displacement_errors(truth, one_step, predicted(truth, [1.0, 1.0, 1.0], 1))
    # One coordinate of three moves, on one node of one NORMAL (3 frames x 3 numbers), or of three (27 numbers).
    assert errors["model"]["one_step"]["normal"].total == 2.0
    assert errors["model"]["one_step"]["normal"].count == 9
    assert errors["model"]["one_step"]["all"].count == 27
    assert errors["model"]["rollout_all"]["normal"].total == 8.0
    # Hold still, one step: 0, 1, 3 for 1, 3, 3: errors 1, 2, 0. Rollout: 0 for 1, 3, 3.
    assert errors["hold_still"]["one_step"]["normal"].total == 5.0
    assert errors["hold_still"]["rollout_all"]["normal"].total == 19.0
    # Repeat the last increment, one step: 0 + 0, 1 + 1, 3 + 2 for 1, 3, 3: errors 1, 1, 2.
    assert errors["repeat_last"]["one_step"]["normal"].total == 6.0
    # Its rollout knows frame 0 only, before which nothing moved: the same as hold still.
    assert errors["repeat_last"]["rollout_all"]["normal"].total == 19.0


def test_prescribed_nodes_are_at_their_places_in_every_prediction():
    truth = one_triangle([0.0, 0.0, 0.0], obstacle=[0.0, 5.0, 9.0])
    errors = displacement_errors(truth, np.full((2, 3, 3), 7.0), predicted(truth, [0.0, 0.0], 1))
    assert errors["hold_still"]["rollout_all"]["all"].total == 0.0
    assert errors["hold_still"]["one_step"]["all"].total == 0.0
    assert errors["model"]["one_step"]["all"].total == errors["model"]["one_step"]["normal"].total == 2 * 3 * 49


def test_dynamic_scenes_give_two_frames_and_repeat_their_increment():
    truth = one_triangle([0.0, 1.0, 3.0, 6.0])
    one_step = truth.position[2:].copy()
    errors = displacement_errors(truth, one_step, predicted(truth, [3.0, 6.0], 2))
    assert errors["model"]["one_step"]["normal"].total == 0.0
    # Hold still: from frame 1 on at 1, for 3 and 6. Repeat last: 2 and 3 for 3 and 6; one step: 2 and 5.
    assert errors["hold_still"]["rollout_all"]["normal"].total == 4.0 + 25.0
    assert errors["repeat_last"]["rollout_all"]["normal"].total == 1.0 + 9.0
    assert errors["repeat_last"]["one_step"]["normal"].total == 1.0 + 1.0


def test_rollout_50_ends_after_50_predicted_frames():
    truth = one_triangle([0.0] + [1.0] * 50 + [11.0] * 10)
    result = predicted(truth, [1.0] * 60, 1)
    errors = displacement_errors(truth, truth.position[1:], result)["model"]
    assert errors["rollout_50"]["normal"].total == 0.0
    assert errors["rollout_50"]["normal"].count == 150
    assert errors["rollout_all"]["normal"].total == 10 * 100.0


def test_stress_errors_by_hand():
    truth = one_triangle([0.0, 0.0, 0.0])
    stress = np.array([[0, 0, 0], [2, 4, 100], [6, 2, 100]], np.float32)[:, :, None]
    truth = Trajectory(truth.scene, truth.position, stress)
    result = answer_of(truth, truth.position, np.array([[0, 0, 0], [2, 3, 0], [6, 0, 0]], np.float32)[:, :, None], 1)
    errors = field_errors("stress", "node", truth, result.stress[1:] + np.float32(1.0), result, constant=3.0)
    by = {key: value["rollout_all"]["deforming"] for key, value in errors.items()}
    # The obstacle's node 2 does not count. Truths 2, 4 and 6, 2.
    assert by["model"].total == 1.0 + 4.0
    assert by["model"].count == 4
    assert by["stress_zero"].total == 4 + 16 + 36 + 4
    assert by["stress_constant"].total == 1 + 1 + 9 + 1
    assert by["stress_frame_mean"].total == 1 + 1 + 4 + 4  # the means are 3 and 4
    assert errors["model"]["one_step"]["deforming"].total == 1 + 0 + 1 + 1


def test_stress_of_elements_leaves_out_elements_with_an_obstacle_node():
    scene = Scene(
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float32),
        np.array([[0, 1, 2], [1, 2, 3]], np.int32),
        np.array([0, 0, 0, NodeType.OBSTACLE], np.uint8),
        np.zeros(4, np.int32),
    )
    position = np.repeat(scene.rest_position[None], 2, axis=0)
    truth = Trajectory(scene, position, np.array([[0, 0], [5, 50]], np.float32)[:, :, None])
    result = answer_of(truth, position, np.zeros((2, 2, 1), np.float32), 1)
    errors = field_errors("stress", "element", truth, result.stress[1:], result, constant=4.0)
    assert errors["model"]["rollout_all"]["deforming"].total == 25.0
    assert errors["stress_constant"]["rollout_all"]["deforming"].total == 1.0


def test_a_failed_rollout_has_no_error_and_no_summary():
    truth = one_triangle([0.0, 1.0, 2.0])
    failed = answer_of(truth, truth.position[:2], None, 1, "node 0 in frame 2 is not finite")
    errors = displacement_errors(truth, truth.position[1:], failed)
    rows = {(r.predictor, r.horizon, r.nodes): r for r in errors_over_scenes("displacement", [errors])}
    failed = rows["model", "rollout_all", "normal"]
    assert failed.rmse_sequence is None and failed.rmse_pooled is None
    assert rows["model", "one_step", "normal"].rmse_sequence == 0.0


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory):
    torch.manual_seed(0)
    path = toy.write(tmp_path_factory.mktemp("evaluate") / "toy.h5")
    with Dataset(path) as dataset:
        model = toy.LinearSimulator(toy.config(dataset.info))
        model.motion_normalizer.scale.fill_(1e-3)
        truths = [dataset.load("test", index) for index in range(2)]
        train = [dataset.load("train", index) for index in range(3)]
        return evaluate(model, dataset, "test"), truths, train


def test_evaluation_of_a_dataset_agrees_with_its_formulas(evaluated):
    found, truths, train = evaluated
    roots, squares, numbers = [], 0.0, 0
    for truth in truths:
        normal = truth.scene.node_type == NodeType.NORMAL
        moved = (truth.position[1:, normal].astype(float) - truth.position[0, normal]) ** 2
        roots.append(math.sqrt(moved.mean()))
        squares, numbers = squares + moved.sum(), numbers + moved.size
    hold = found.error("displacement", "hold_still")
    assert hold.rmse_sequence == pytest.approx(sum(roots) / 2, rel=1e-12)
    assert hold.rmse_pooled == pytest.approx(math.sqrt(squares / numbers), rel=1e-12)
    assert [scene.error("displacement", "hold_still") for scene in found.scenes] == pytest.approx(roots)

    rows = [t.scene.node_type != NodeType.OBSTACLE for t in train]
    constant = np.concatenate([t.stress[:, r].ravel() for t, r in zip(train, rows, strict=True)]).mean(dtype=float)
    expected = []
    for truth in truths:
        stress = truth.stress[1:, truth.scene.node_type != NodeType.OBSTACLE].astype(float)
        expected.append(math.sqrt(((stress - constant) ** 2).mean()))
    assert found.error("stress", "stress_constant").rmse_sequence == pytest.approx(sum(expected) / 2, rel=1e-6)


def test_every_predictor_has_every_horizon_and_the_speed_is_the_solvers_over_the_models(evaluated):
    found, truths, _ = evaluated
    for predictor in ("model", "hold_still", "repeat_last"):
        for horizon in HORIZONS:
            for nodes in ("normal", "all"):
                row = found.error("displacement", predictor, horizon, nodes)
                assert row.rmse_sequence >= 0 and row.rmse_pooled >= 0
    for predictor in ("model", "stress_zero", "stress_constant", "stress_frame_mean"):
        assert all(found.error("stress", predictor, horizon).rmse_sequence >= 0 for horizon in HORIZONS)
    for scene, truth in zip(found.scenes, truths, strict=True):
        assert (scene.nodes, scene.frames, scene.solver_seconds_per_step) == (truth.scene.num_nodes, 7, 0.5)
    assert found.speedup == pytest.approx(np.median([0.5 / scene.model_seconds_per_step for scene in found.scenes]))
    assert found.failures == 0


def test_the_figures_are_json_and_a_readable_table(evaluated):
    found, _, _ = evaluated
    written = json.loads(json.dumps(found.to_json(), allow_nan=False))
    pooled = written["errors"]["displacement"]["model"]["one_step"]["all"]["rmse_pooled"]
    assert pooled == found.error("displacement", horizon="one_step", nodes="all").rmse_pooled
    scene = written["scenes"][0]
    assert scene["errors"]["stress"]["model"]["rollout_all"]["deforming"] == found.scenes[0].error("stress")
    after = {"corrections": 0, "newton_steps": 0, "solved": False, "solved_beyond": 0.0, "precision": "float32"}
    assert (scene["name"], written["effort"]) == ("test/000000", after)
    lines = table(found).splitlines()
    hold = found.error("displacement", "hold_still")
    row = next(line for line in lines if line.startswith("  hold_still"))
    assert row.endswith(f"{hold.rmse_sequence:.4g} / {hold.rmse_pooled:.4g}")
    assert sum(line.startswith("  model") for line in lines) == 3


def test_the_solvers_seconds_beside_the_dataset_count_and_without_them_the_speed_is_unknown(tmp_path):
    def speed(path):
        with Dataset(path) as dataset:
            model = toy.LinearSimulator(toy.config(dataset.info))
            model.motion_normalizer.scale.fill_(1e-3)
            return evaluate(model, dataset, "test")

    path = tmp_path / "toy.h5"
    plate = toy.plate()
    del plate.attributes["solve_seconds"]
    with DatasetWriter(path, toy.info()) as writer:
        writer.add("train", plate)
        writer.add("test", plate)
    unknown = speed(path)
    assert unknown.speedup is None and unknown.scenes[0].solver_seconds_per_step is None
    text = table(unknown)
    assert "scenes: 1, failed: 0, threads: " in text
    assert "speed relative to the solver: unknown." in text and ".seconds.json" in text
    write_seconds(path, toy.info().generator, {"test/000000": {"solve_seconds": [0.0] + [3.0] * 6}})
    known = speed(path)
    (scene,) = known.scenes
    assert scene.solver_seconds_per_step == 3.0
    assert known.speedup == pytest.approx(3.0 / scene.model_seconds_per_step)
    assert "times faster than the solver was when it made them (median, one thread each)" in table(known)
    torch.set_num_threads(2)
    try:
        unequal = speed(path)
    finally:
        torch.set_num_threads(1)
    assert unequal.speedup is None and "times faster" not in table(unequal)
    took = 1000 * unequal.scenes[0].model_seconds_per_step
    assert f"the model {took:.3g} ms on 2 threads, the solver 3 s on one thread" in table(unequal)


def test_an_empty_split_is_an_error(tmp_path):
    path = tmp_path / "train_only.h5"
    with DatasetWriter(path, toy.info()) as writer:
        writer.add("train", toy.plate())
    with Dataset(path) as dataset, pytest.raises(DatasetError, match="the split test has no frame to predict"):
        evaluate(toy.LinearSimulator(toy.config(dataset.info)), dataset, "test")


def test_provenance_names_command_processor_and_versions():
    found = provenance("ast-sim evaluate RUN DATA")
    assert found["command"] == "ast-sim evaluate RUN DATA"
    assert found["processor"]
    assert found["versions"]["torch"] == torch.__version__
    root = Path(ast_sim.__file__).parents[1]
    words = ["git", "-C", str(root), "rev-parse", "HEAD"]
    head = subprocess.check_output(words, text=True).strip() if (root / ".git").exists() else None
    assert found["commit"] == head

"""Models of metal that yields: jumps start where the motion turned back last, from the model's own answer there."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import toy

from ast_sim import Dataset, train
from ast_sim.inference.answering import answers
from ast_sim.inference.effort import Effort
from ast_sim.inference.predicting.jump import answer_steps
from ast_sim.inference.predicting.question import Question
from ast_sim.models.node_inputs import node_features
from ast_sim.models.registry import model_names
from ast_sim.named_field import NamedField
from ast_sim.scene import Trajectory
from ast_sim.support.errors import ConfigError

TURN, LAST, ELASTIC = 3, 6, 0.02
METAL = ["young", "poisson", "yield_stress"]


def pressed(depth: float) -> Trajectory:
    """A plate of metal that a block presses in until frame 3 and lets go; what is deeper than `ELASTIC` stays."""
    truth = toy.plate(0)
    scene = replace(truth.scene, material=np.float32([2e11, 0.3, 3e8]) * truth.scene.deforming_elements[:, None])
    shape = (truth.position[TURN] - truth.position[0]).astype(float)
    shape /= np.abs(shape[-1, 2])  # 1 at the block
    down = depth * np.interp(np.arange(LAST + 1), [0, TURN, LAST], [0, 1, 0])
    plastic = np.where(np.arange(LAST + 1) < TURN, np.maximum(down - ELASTIC, 0), depth - ELASTIC)
    plate = scene.body == 0
    way = np.where(plate, np.maximum(down, plastic)[:, None], down[:, None])
    position = (truth.position[0] + way[:, :, None] * shape).astype(np.float32)
    strain = np.float32(plastic[:, None] * np.abs(shape[:, 2]) * plate)[:, :, None]
    return Trajectory(scene, position, 1e9 * strain, fields={"PEEQ": NamedField(strain, "node")})


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("metal") / "d.h5"
    with toy.DatasetWriter(path, replace(toy.info(), generator={"material": METAL})) as writer:
        for depth in np.linspace(0.025, 0.06, 8):
            writer.add("train", pressed(depth))
        writer.add("valid", pressed(0.041))
    return path


def small(data, folder, steps=1, state=("PEEQ",), **changes):
    settings = {"hidden": 32, "d_token": 32, "heads": 1, "L_SA": 1, "ffn_inner": 32, "num_tokens": 32, **changes}
    return train(data, folder / "run", state=state, model_settings=settings, steps=steps, batch_size=8, shift=0.0)


def set_of(run, depth: float, frames=(LAST,)) -> float:
    """The permanent set in the middle of the plate, as the run predicts it."""
    truth = pressed(depth)
    node = np.argmax(np.abs(truth.position[LAST] - truth.position[0])[:, 2])
    answer = run.predict(truth, frames=list(frames))
    return float(truth.position[0, node, 2] - answer.position[-1, node, 2])


def test_two_travels_that_end_at_one_place_leave_two_sets(data, tmp_path):
    depths = (0.033, 0.053)
    wanted = [depth - ELASTIC for depth in depths]
    run = small(data, tmp_path, steps=200)
    assert np.array_equal(*(pressed(depth).position[LAST, -8:] for depth in depths))  # the block is back
    sets = [set_of(run, depth) for depth in depths]
    np.testing.assert_allclose(sets, wanted, rtol=0.15)
    assert run.settings.model.history is not None and "out_of_balance" not in run.settings.model.node_inputs
    # A model without a history has the same inputs for both.
    (tmp_path / "blind").mkdir()
    blind = small(data, tmp_path / "blind", node_inputs=["displacement", "material", "proximity"])
    assert blind.settings.model.history is None
    assert set_of(blind, depths[0]) == set_of(blind, depths[1])


@pytest.mark.parametrize("name", model_names())
def test_turning_points_are_predicted_first_and_are_the_starts(data, tmp_path, name, monkeypatch):
    run = train(data, tmp_path / "run", model=name, state=["PEEQ"], steps=1, batch_size=2)
    model, truth, seen = run.model, pressed(0.05), []
    predict = model.predict
    monkeypatch.setattr(model, "predict", lambda batch: seen.append(batch) or predict(batch))
    (answer,) = answers(model, [Question.of(truth, "scene", [5, LAST])])
    assert [batch.names for batch in seen] == [["scene frame 3"], ["scene frame 5", "scene frame 6"]]
    assert answer.frames == (5, LAST) and len(answer.step_seconds) == 2 == len(answer.position)
    first, second = seen
    scene = truth.scene
    assert torch.equal(first.source, torch.from_numpy(truth.position[0])) and not first.history.any()
    (turn,) = answers(model, [Question.of(truth, "scene", [TURN])])
    there = torch.from_numpy(turn.position[0])
    assert torch.equal(second.source, torch.cat([there, there]))
    known = np.concatenate([turn.stress[0], turn.fields["PEEQ"].values[0]], axis=1)
    assert np.array_equal(second.history, np.concatenate([known, known]))
    carried = second.position[: scene.num_nodes]
    assert np.array_equal(carried[scene.prescribed], truth.position[5][scene.prescribed])
    assert torch.equal(carried[~torch.from_numpy(scene.prescribed)], there[~torch.from_numpy(scene.prescribed)])
    (way,) = answer_steps(model, [Question.of(truth, "scene", [5, LAST])], Effort())
    assert np.array_equal(way.after_calls[0], answer.position)


def test_a_turning_point_that_fails_takes_what_starts_from_it_along(data, tmp_path):
    run = small(data, tmp_path)
    predict = run.model.predict

    def spoiled(batch):
        found = predict(batch)
        wrong = torch.tensor([name.endswith("frame 3") for name in batch.names])
        rows = wrong.repeat_interleave(batch.graph.node_offsets.diff())
        return replace(found, motion=torch.where(rows[:, None], torch.nan, found.motion))

    run.model.predict = spoiled
    (answer,) = answers(run.model, [Question.of(pressed(0.05), "scene", [2, 5])])
    assert answer.frames == (2,) and "of node 8 in frame 3 is not finite" in answer.failure


def test_each_number_of_material_and_history_has_a_scale_of_its_own(data, tmp_path):
    """Young's modulus is 2e11, the yield stress 3e8, the plastic strain 0.01."""
    run = small(data, tmp_path)
    assert run.settings.model.node_inputs == ("displacement", "proximity", "material", "history")
    with Dataset(data) as dataset:
        batch, _ = run.model.pairs(dataset, batch_size=40).batch(0)
        seen = node_features(run.settings.model, batch)
    scales = run.model.node_inputs.scale
    material, way, known = slice(6, 9), slice(14, 17), slice(17, 19)  # after type, displacement; proximity between
    np.testing.assert_allclose(scales[material], seen[:, material].double().std(dim=0, correction=0), rtol=0.2)
    assert 0.5 < scales[known][0] / seen[:, 17].std() < 2 and 0.5 < scales[known][1] / seen[:, 18].std() < 2
    assert len(set(scales[way].tolist())) == 1


def test_a_history_needs_jumps(data, tmp_path):
    with pytest.raises(ConfigError, match="model.node_inputs: history is an input of models that jump"):
        small(data, tmp_path, jumps=False, node_inputs=["history"])


def test_where_a_plastic_strain_is_predicted_the_history_counts_without_a_yield_stress(tmp_path):
    """As in results of Abaqus, which have no material."""
    with toy.DatasetWriter(tmp_path / "d.h5", toy.info()) as writer:
        for split in ("train", "valid"):
            truth = pressed(0.05)
            writer.add(split, replace(truth, scene=replace(truth.scene, material=None)))
    run = small(tmp_path / "d.h5", tmp_path)
    assert run.settings.model.node_inputs == ("displacement", "proximity", "history")
    assert [output.name for output in run.settings.model.history] == ["stress", "PEEQ"]


def test_elastic_scenes_have_no_history(tmp_path):
    with toy.DatasetWriter(tmp_path / "d.h5", replace(toy.info(), generator={"material": METAL[:2]})) as writer:
        for split in ("train", "valid"):
            truth = pressed(0.05)
            material = truth.scene.material[:, :2].copy()
            writer.add(split, replace(truth, scene=replace(truth.scene, material=material)))
    run = small(tmp_path / "d.h5", tmp_path, state=())
    assert run.settings.model.node_inputs == ("displacement", "proximity", "material", "out_of_balance")
    with Dataset(tmp_path / "d.h5") as dataset:
        batch, _ = run.model.pairs(dataset, batch_size=6).batch(0)
    assert batch.source is None and batch.history is None

"""docs/architecture.md, followed: its functions in its order give the first loss of a training and a run's answer."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
import toy
from toy import one_thread  # noqa: F401 (used by being imported)

import ast_sim
from ast_sim.batches.batch_builder import Batch, State, Target
from ast_sim.batches.mirror_and_shift import Placement
from ast_sim.inference.rollout import Question
from ast_sim.models.registry import build_model
from ast_sim.runs import checkpoint
from ast_sim.runs.metrics import Metrics

PAGE = (Path(__file__).parents[2] / "docs" / "architecture.md").read_text(encoding="utf-8")
SMALL = {"hidden": 16, "decoder_hidden": 16, "d_token": 16, "heads": 1, "head_dim": 16, "ffn_inner": 16, "L_SA": 1}


def named(title: str) -> list[str]:
    """The functions that a part of the page counts, in order."""
    part = PAGE.split(f"## {title}\n")[1].split("\n## ")[0]
    return re.findall(r"^\d\. `([\w.]+)`", part, re.MULTILINE)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """One step on four pairs without noise, at a rate that changes no bit of the weights."""
    folder = tmp_path_factory.mktemp("architecture")
    data = toy.write(folder / "toy.h5")
    plain = {"noise": 0.0, "rollout_pool": 0, "shift": 0.0, "statistics_pairs": 4, "log_every": 1}
    return ast_sim.train(data, folder / "run", model_settings=SMALL, steps=1, peak_rate=1e-30, **plain)


def test_from_the_file_to_the_loss(run):
    assert named("From the file to the loss") == [
        "Dataset.frames", "Simulator.graph", "Batch.build", "Batch.placed", "Batch.concatenate", "Simulator.forward",
        "Simulator.loss",
    ]  # fmt: skip
    (first,) = [record["loss"] for record in Metrics(run.path) if "loss" in record]
    model = build_model(run.settings.model)
    model.load_state_dict(checkpoint.load(checkpoint.latest(run.path))[0])
    unmoved = Placement(np.ones(3, np.float32), np.zeros(3, np.float32), np.zeros(3, np.float32))
    batches, targets = [], []
    with ast_sim.Dataset(run.settings.data) as dataset:
        drawn, _ = model.pairs(dataset, "train", batch_size=4).batch(0)
        for name in drawn.names:
            index, t = int(name[6:12]), int(name.split()[-1])
            position, stress = dataset.frames("train", index, t, t + 2)
            graph = model.graph(dataset.scene("train", index))
            state = State(torch.tensor(position[0]), None, torch.tensor(stress[0]))
            batch = Batch.build(graph, state, torch.tensor(position[1]), [name], torch.tensor([t + 1.0]))
            batches.append(batch.placed(unmoved))
            targets.append(Target(torch.tensor(position[1] - position[0]), torch.tensor(stress[1])))
    batch, target = Batch.concatenate(batches), Target.concatenate(targets)
    loss = model.loss(model(batch), batch, target, run.settings.train.stress_weight)["loss"]
    assert loss.item() == first


def test_from_a_scene_to_an_answer(run):
    assert named("From a scene to an answer") == [
        "Motion.of_bodies", "Question", "Simulator.graph", "State", "Batch.build", "Simulator.advance",
    ]  # fmt: skip
    scene, moves = toy.plate(5).scene, {1: (0.0, 0.0, -0.01)}
    answer = run.predict(scene, moves, frames=4)
    motion = ast_sim.Motion.of_bodies(scene, moves, 4)
    question = Question("scene", scene, motion.position)
    graph = run.model.graph(scene)
    script = torch.tensor(question.script)
    positions, stress = [script[0]], torch.zeros(scene.num_nodes, 1)
    for frame in range(1, 4):
        state = State(positions[-1], None, stress)
        with torch.inference_mode():
            batch = Batch.build(graph, state, script[frame], ["scene"], torch.tensor([float(frame)]))
            position, stress = run.model.advance(batch, script[frame])
        positions.append(position)
    assert np.array_equal(torch.stack(positions).numpy(), answer.position)
    assert np.array_equal(stress.numpy(), answer.stress[-1])

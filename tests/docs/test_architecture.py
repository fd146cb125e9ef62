"""docs/architecture.md, followed: its functions in its order give the first loss of a training and a run's answer."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
import toy

import ast_sim
from ast_sim.batches.batch_builder import Batch, State, Target
from ast_sim.batches.carry import Carrier
from ast_sim.batches.mirror_and_shift import Placement
from ast_sim.batches.training_corrections import JumpPool
from ast_sim.inference.predicting.question import Question
from ast_sim.models.registry import build_model
from ast_sim.runs import checkpoint
from ast_sim.runs.metrics import Metrics
from ast_sim.training.loop import JUMP_BATCHES

PACKAGE = Path(ast_sim.__file__).parent
PAGE = (Path(__file__).parents[2] / "docs" / "architecture.md").read_text(encoding="utf-8")
SMALL = {"hidden": 16, "decoder_hidden": 16, "d_token": 16, "heads": 1, "head_dim": 16, "ffn_inner": 16, "L_SA": 1}


def named(title: str) -> list[str]:
    """The functions that a part of the page counts, in order."""
    part = PAGE.split(f"## {title}\n")[1].split("\n## ")[0]
    return re.findall(r"^\d\. `([\w.]+)`", part, re.MULTILINE)


def test_every_room_stands_in_the_table():
    table = PAGE.split("## The rooms\n")[1].split("\n## ")[0]
    rooms = set(re.findall(r"`(\w+(?:/|\.py))`", table))
    there = {path.name + "/" * path.is_dir() for path in PACKAGE.iterdir() if path.suffix in ("", ".py")}
    assert there - rooms - {"__pycache__/"} == {"__init__.py"}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """One step on the first call of four jumps, at a rate that changes no bit of the weights."""
    folder = tmp_path_factory.mktemp("architecture")
    data = toy.write(folder / "toy.h5")
    plain = {"rollout_pool": 0, "shift": 0.0, "statistics_pairs": 4, "log_every": 1}
    return ast_sim.train(data, folder / "run", model_settings=SMALL, steps=1, peak_rate=1e-30, **plain)


def test_from_the_file_to_the_loss(run):
    assert named("From the file to the loss") == [
        "Dataset.frames", "Carrier", "Simulator.graph", "Batch.build", "Batch.concatenate", "Simulator.forward",
        "Simulator.loss",
    ]  # fmt: skip
    (first,) = [record["loss"] for record in Metrics(run.path) if "loss" in record]
    model = build_model(run.settings.model)
    model.load_state_dict(checkpoint.load(checkpoint.latest(run.path))[0])
    unmoved = Placement(np.ones(3, np.float32), np.zeros(3, np.float32), np.zeros(3, np.float32))
    batches, targets = [], []
    with ast_sim.Dataset(run.settings.data) as dataset:
        pool = JumpPool(
            model.pairs(dataset, "train", batch_size=8), JUMP_BATCHES * 8, 1 + run.settings.train.corrections, 1.0
        )
        drawn, _ = pool.batch(0)
        for name, place in zip(drawn.names, range(8), strict=True):
            jump = pool._going[place]
            assert name == f"train/{jump.index:06d} frame {jump.frame}"
            (before,), (stress,) = dataset.frames("train", jump.index, jump.source, jump.source + 1)
            (after,), (next_stress,) = dataset.frames("train", jump.index, jump.frame, jump.frame + 1)
            scene = dataset.scene("train", jump.index)
            start = Carrier(scene)(before, after)
            state = State(torch.from_numpy(start), None, torch.tensor(stress))
            batch = Batch.build(model.graph(scene), state, torch.tensor(after), [name])
            batches.append(batch.placed(unmoved))
            targets.append(Target(torch.from_numpy(after - start), {"stress": torch.tensor(next_stress)}))
    batch, target = Batch.concatenate(batches), Target.concatenate(targets)
    options = run.settings.train
    loss = model.loss(model(batch), batch, target, options.stress_weight, strain_weight=options.strain_weight)["loss"]
    assert loss.item() == first


def test_from_a_scene_to_an_answer(run):
    assert named("From a scene to an answer") == [
        "Motion.of_bodies", "Question", "Simulator.graph", "Carrier", "State", "Batch.build", "Simulator.advance",
    ]  # fmt: skip
    scene, moves = toy.plate(5).scene, {1: (0.0, 0.0, -0.01)}
    answer = run.predict(scene, moves, num_frames=4, frames=[-1], effort=ast_sim.Effort(2))
    motion = ast_sim.Motion.of_bodies(scene, moves, 4)
    question = Question("scene", scene, motion.position)
    graph, there = run.model.graph(scene), question.prescribed_position[-1]
    position, prescribed = torch.from_numpy(Carrier(scene)(scene.rest_position, there)), torch.tensor(there)
    for _ in range(3):
        state = State(position, None, torch.zeros(scene.num_nodes, 1))
        with torch.inference_mode():
            batch = Batch.build(graph, state, prescribed, ["scene"])
            position, prediction = run.model.advance(batch, prescribed)
    assert np.array_equal(position.numpy()[None], answer.position)
    assert np.array_equal(prediction.fields["stress"].numpy()[None], answer.stress)

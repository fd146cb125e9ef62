"""A dataset made by hand and a linear model: what the tests of training, rollout and evaluation run on.

A clamped plate bends under a block that presses and releases; positions are analytic, so every frame is smooth.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from meshes import box
from torch import Tensor, nn

from ast_sim.batches.batch_builder import Batch
from ast_sim.dataset.layout import DatasetInfo
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.inference import answering
from ast_sim.inference.answer import Answer
from ast_sim.inference.predicting.question import Question
from ast_sim.models.ast.ast_config import ASTConfig
from ast_sim.models.data_facts import DataFacts
from ast_sim.models.simulator import Prediction, Simulator
from ast_sim.scene import NodeType, Scene, Trajectory


def plate(seed: int = 0, frames: int = 7, dynamic: bool = False, stress: bool = True) -> Trajectory:
    """A plate of 4 x (3 or 4) x 1 cells, its short ends handles, and a block above that moves down and up again."""
    rng = np.random.default_rng(seed)
    nodes, elements = box((4, 3 + seed % 2, 1), (0.4, 0.3, 0.04))
    block, block_elements = box((1, 1, 1), (0.1, 0.1, 0.1))
    place = rng.uniform(-0.05, 0.05, 2)
    depth = rng.uniform(0.02, 0.04)
    n = len(nodes)
    rest = np.concatenate([nodes, block + (*place, 0.07)])
    node_type = np.full(len(rest), NodeType.NORMAL)
    node_type[:n][np.abs(nodes[:, 0]) > 0.199] = NodeType.HANDLE
    node_type[n:] = NodeType.OBSTACLE
    scene = Scene(
        rest.astype(np.float32),
        np.concatenate([elements, block_elements + n]).astype(np.int32),
        node_type.astype(np.uint8),
        np.repeat([0, 1], [n, len(block)]).astype(np.int32),
    )
    travel = depth * np.sin(np.pi * np.arange(frames) / (frames - 1))
    if dynamic:
        travel = depth * (np.arange(frames) / (frames - 1)) ** 2
    shape = np.concatenate(
        [(1 - (nodes[:, 0] / 0.2) ** 2) * np.exp(-(((nodes[:, 1] - place[1]) / 0.2) ** 2)), np.ones(8)]
    )
    position = np.repeat(rest[None], frames, axis=0)
    position[:, :, 2] -= travel[:, None] * shape
    von_mises = (1e5 * travel[:, None] / depth * np.abs(shape - 0.5))[:, :, None]
    return Trajectory(
        scene,
        position.astype(np.float32),
        von_mises.astype(np.float32) if stress else None,
        {"seed": seed, "solve_seconds": [0.0] + [0.5] * (frames - 1)},
    )


def info(dynamic: bool = False, stress: bool = True) -> DatasetInfo:
    return DatasetInfo(
        family="toy_plate",
        integration="dynamic" if dynamic else "quasi_static",
        stress_location="node" if stress else "none",
        domain_center=(0.0, 0.0, 0.0),
        domain_half_width=0.5,
        contact_radius=0.001,
        time_step=1.0,
        generator={"program": "tests"},
    )


def write(path: Path, counts: tuple[int, int, int] = (3, 2, 2), **kind: bool) -> Path:
    """A dataset with `counts` trajectories for training, validation and test."""
    with DatasetWriter(path, info(**kind)) as writer:
        seed = 0
        for split, count in zip(("train", "valid", "test"), counts, strict=True):
            for _ in range(count):
                writer.add(split, plate(seed, **kind))
                seed += 1
    return path


def config(info: DatasetInfo, mesh_spacing: float = 0.1) -> ASTConfig:
    """The settings of a small AST that fits the dataset."""
    small = ASTConfig(
        hidden=16,
        decoder_hidden=16,
        d_token=16,
        heads=1,
        head_dim=16,
        ffn_inner=16,
        L_SA=1,
        num_tokens=16,
        L_cell=3,
        element_inputs=(),
        edge_strain=True,
    )
    return small.resolve(DataFacts.of(info, (), mesh_spacing))


def answers(model: Simulator, truths: list[Trajectory], names: list[str]) -> list[Answer]:
    """The scenes of the trajectories, predicted together."""
    return answering.answers(model, [Question.of(truth, name) for truth, name in zip(truths, names, strict=True)])


def answer(model: Simulator, truth: Trajectory, name: str = "scene") -> Answer:
    """The scene of the trajectory, predicted."""
    return answers(model, [truth], [name])[0]


class LinearSimulator(Simulator):
    """One linear map of displacement, boundary motion and their scene means; with dropout, to be of use in tests."""

    def __init__(self, config: ASTConfig) -> None:
        super().__init__(config)
        self.map = nn.Linear(12, 3 + config.data.output_columns("node"))
        self.dropout = nn.Dropout(0.1)

    def observe(self, batch: Batch) -> None:
        pass

    def forward(self, batch: Batch) -> Prediction:
        values = torch.cat([batch.position - batch.graph.rest_position, batch.boundary_motion], dim=1) / 0.01
        sizes = batch.graph.node_offsets.diff()
        means = torch.cat([part.mean(dim=0).expand(len(part), -1) for part in values.split(sizes.tolist())])
        out: Tensor = self.map(self.dropout(torch.cat([values, means], dim=1)))
        return Prediction.of(self.config.data, out)

"""The scenes on which whole steps are timed, and the settings of their presets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ast_sim.dataset.layout import DatasetInfo
from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.scene import NodeType, Scene, Trajectory
from ast_sim.simulate.jobs.generate import generate
from ast_sim.simulate.shapes.mesh import hexahedral_grid

CASES = ("tiny", "deforming_plate", "abcd_xl_12k", "abcd_xl")


@dataclass(frozen=True)
class Case:
    """What is trained on what.

    Attributes:
        preset: of the model.
        settings: as for `ast-sim train --set`.
        data: the dataset; a rollout step is of its first test scene.
        nodes: in a batch.
        shape, rollout_shape: the sizes of a batch and of the test scene, in words.
        steps: of one sample.
        most_repeats: samples at most, where a step is long.
        every_thread: time it with every number of threads, not with the most only.
    """

    preset: str
    settings: list[str]
    data: Path
    nodes: int
    shape: str
    rollout_shape: str
    steps: int
    most_repeats: int
    every_thread: bool


def make(name: str, folder: Path) -> Case:
    """Write the dataset of a case into the folder."""
    data = folder / f"{name}.h5"
    if name.startswith("abcd_xl"):
        side = 55 if name.endswith("12k") else 158
        write_plates(data, side)
        return _case("abcd_xl", data, 1, steps=1, most_repeats=20 if side == 55 else 3, every_thread=False)
    nodes, batch = (400, 4) if name == "tiny" else (1300, 8)
    generate("deforming_plate", data, train=batch, valid=0, test=1, seed=0, nodes=nodes, frames=41)
    steps = 10 if name == "tiny" else 1
    return _case(name, data, batch, steps=steps, most_repeats=20, every_thread=name == "tiny")


def _case(preset: str, data: Path, batch: int, **options) -> Case:
    with Dataset(data) as dataset:
        scenes = [dataset.scene("train", index) for index in range(batch)]
        test = dataset.scene("test", 0)
    nodes = sum(scene.num_nodes for scene in scenes)
    elements = sum(scene.num_elements for scene in scenes)
    shape = f"batch of {batch}: {nodes:,} nodes, {elements:,} elements"
    settings = [f"train.batch_size={batch}"]
    return Case(preset, settings, data, nodes, shape, f"{test.num_nodes:,} nodes", **options)


def write_plates(path: Path, side: int) -> None:
    """Two plates of side x side x 2 nodes, the upper one sagging onto the lower; stress and material on elements."""
    info = DatasetInfo(
        family="abcd_xl",
        integration="quasi_static",
        stress_location="element",
        domain_center=(0.0, 0.0, 0.0),
        domain_half_width=1.0,
        contact_radius=0.01,
        time_step=0.0,
    )
    with DatasetWriter(path, info) as writer:
        for split in ("train", "test"):
            writer.add(split, _plates(side))


def _plates(side: int, frames: int = 3) -> Trajectory:
    step = 1.8 / (side - 1)
    coordinates, tetrahedra = hexahedral_grid((side - 1, side - 1, 1))
    grid = coordinates * step - (0.9, 0.9, 0)
    rest = np.concatenate([grid, grid + (0, 0, 1.5 * step)])
    edge = np.abs(rest[:, :2]).max(axis=1) > 0.9 - 1e-9
    sag = (1 - np.abs(rest[:, 0]) / 0.9) * (1 - np.abs(rest[:, 1]) / 0.9)
    position = np.repeat(rest[None], frames, axis=0)
    position[:, :, 2] -= step * np.linspace(0, 1, frames)[:, None] * sag
    elements = np.concatenate([tetrahedra, tetrahedra + len(grid)]).astype(np.int32)
    scene = Scene(
        rest.astype(np.float32),
        elements,
        np.where(edge, NodeType.HANDLE, NodeType.NORMAL).astype(np.uint8),
        np.repeat([0, 1], len(grid)).astype(np.int32),
        np.ones((len(elements), 1), np.float32),
    )
    stress = np.linspace(0, 1e5, frames)[:, None, None] * sag[elements].mean(axis=1)[None, :, None]
    return Trajectory(scene, position.astype(np.float32), stress.astype(np.float32), {})

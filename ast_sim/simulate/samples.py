"""One generated sample as a pure function of (family, seed, split, index), and its file.

A sample lies in a small file of its own until the dataset is whole; the file appears under its name complete or not
at all.
"""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import numpy as np

from ast_sim.data.disk import replacing
from ast_sim.data.file import SPLITS
from ast_sim.data.scene import Scene, Trajectory
from ast_sim.errors import SimulationError
from ast_sim.simulate import deforming_plate

# A family is a module with INFO, DEFAULT_NODES, draw(rng, nodes) -> case and solve(case) -> Trajectory.
FAMILIES: dict[str, ModuleType] = {"deforming_plate": deforming_plate}

Sample = tuple[str, int]  # split and index in it

_SCENE = ("rest_position", "elements", "node_type", "body", "material")


def family_module(family: str) -> ModuleType:
    """The module of a scene family.

    Raises:
        SimulationError: an unknown family.
    """
    if family not in FAMILIES:
        raise SimulationError(f"there is no scene family {family!r}; use one of {', '.join(FAMILIES)}")
    return FAMILIES[family]


def make_sample(family: str, seed: int, split: str, index: int, nodes: int) -> Trajectory:
    """Draw and solve one sample; the same arguments give the same arrays, whoever else is drawn."""
    sequence = np.random.SeedSequence(seed, spawn_key=(SPLITS.index(split), index))
    module = family_module(family)
    trajectory = module.solve(module.draw(np.random.default_rng(sequence), nodes))
    trajectory.attributes.update(seed=seed, index=index)
    return trajectory


def sample_name(split: str, index: int) -> str:
    """The name of a sample in messages, that of its group in the dataset file."""
    return f"{split}/{index:06d}"


def sample_path(folder: Path, split: str, index: int) -> Path:
    """Where a sample lies in its folder."""
    return folder / f"{split}-{index:06d}.npz"


def save_sample(path: Path, trajectory: Trajectory) -> None:
    """Write a sample: there is a whole file or none."""
    scene = {key: getattr(trajectory.scene, key) for key in _SCENE if getattr(trajectory.scene, key) is not None}
    arrays = {**scene, "position": trajectory.position, "attributes": np.array(json.dumps(trajectory.attributes))}
    if trajectory.stress is not None:
        arrays["stress"] = trajectory.stress
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **arrays)


def load_sample(path: Path) -> Trajectory:
    """Read what `save_sample` wrote."""
    with np.load(path, allow_pickle=False) as file:
        scene = Scene(**{key: file[key] for key in _SCENE if key in file})
        return Trajectory(scene, file["position"], file.get("stress"), json.loads(str(file["attributes"])))

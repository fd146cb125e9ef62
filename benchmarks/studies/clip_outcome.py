"""What an engineer asks of the metal clip of `examples/clip`: the permanent set, and the peak force on the ram."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import ast_sim
from ast_sim.named_field import REACTION

SPEC = Path(__file__).parents[2] / "examples" / "clip" / "SPEC.toml"
CLIP, RAM = 0, 1  # bodies
TURN, LAST = 3, 6  # the frames in which the ram turns and is back


class Outcome(NamedTuple):
    """The permanent set in the unit of length, and the peak force on the ram in newton."""

    set: float
    peak: float


def outcome(scene: ast_sim.Scene, first: np.ndarray, last: np.ndarray, reaction: np.ndarray) -> Outcome:
    """The set is the length of the mean displacement of the free end of the arm, its upper face, when the ram is back.

    Args:
        first, last: [N, 3], the positions in the first and in the last frame.
        reaction: [S, N, 3], the forces on the prescribed nodes in all frames.
    """
    height = np.where(scene.body == CLIP, scene.rest_position[:, 2], -np.inf)
    end = height > height.max() - 1e-3 * np.ptp(scene.rest_position[:, 2])
    way = (last[end].astype(np.float64) - first[end]).mean(axis=0)
    force = reaction[:, scene.body == RAM].astype(np.float64).sum(axis=1)
    return Outcome(float(np.linalg.norm(way)), float(np.linalg.norm(force, axis=1).max()))


def true_outcome(truth: ast_sim.Trajectory) -> Outcome:
    """The one that CalculiX found."""
    return outcome(truth.scene, truth.position[0], truth.position[-1], truth.fields[REACTION].values)


def errors(scenes: Sequence[dict[str, Any]], key: str, number: str) -> np.ndarray:
    """[n]: the relative errors of the set or the peak force in an answer."""
    return np.array([abs(scene[key][number] / scene["true"][number] - 1) for scene in scenes])

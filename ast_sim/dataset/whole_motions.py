"""What evaluations and trainings need of a dataset: all frames of each motion."""

from __future__ import annotations

from ast_sim.dataset.reader import Dataset
from ast_sim.number_arrays import require_whole_motion


def require_whole_motions(dataset: Dataset, *splits: str) -> None:
    """Raise ConfigError if a trajectory of these splits has some frames of its motion only: a model would take its
    first frame for the start, and frames that are apart for neighbours. Frames that `generate` keeps are numbered from
    0 on."""
    for split in splits:
        for index in range(dataset.count(split)):
            require_whole_motion(
                f"{dataset.path}: {split}/{index:06d}",
                dataset.numbers(split, index),
                "write whole trajectories; frames that are a motion of their own are numbered from 0:"
                " dataclasses.replace(trajectory, frames=None)",
            )

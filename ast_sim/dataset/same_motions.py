"""Scenes by their content: the same simulation in two datasets, whatever else these hold."""

from __future__ import annotations

from collections.abc import Collection

from ast_sim.dataset.reader import Dataset

DIGITS = 12  # hexadecimal, of a hash: two of a million simulations have the same ones with a chance of 0.2 %


def motion_hashes(dataset: Dataset, split: str) -> list[str]:
    """The first digits of the stored hash of all positions of each trajectory of a split. Nothing is compared: numbers
    that are read elsewhere are. Fields, materials and attributes, which a second conversion may change, do not
    count."""
    hashes = []
    for index in range(dataset.count(split)):
        positions = dataset._file.array(dataset._unverified(split, index), "position")
        hashes.append(dataset._file.stored_hash(positions)[:DIGITS])
    return hashes


def same_motions(dataset: Dataset, split: str, known: Collection[str]) -> list[int]:
    """The numbers of the trajectories of a split whose hashes are among the known ones."""
    if not known:
        return []
    return [index for index, one in enumerate(motion_hashes(dataset, split)) if one in known]

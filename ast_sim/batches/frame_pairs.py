"""The frames of a dataset for training loops that torch's DataLoader feeds."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset as TorchDataset

from ast_sim.dataset.layout import GIVEN_FRAMES
from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.whole_motions import require_whole_motions
from ast_sim.ops import join_indices
from ast_sim.support.argument_checks import require_type, several
from ast_sim.support.errors import ConfigError, DatasetError
from ast_sim.support.notebook_table import one_line


def target_counts(dataset: Dataset, split: str) -> list[int]:
    """How many frames of each trajectory of a split can be predicted: all but the given ones."""
    given = GIVEN_FRAMES[dataset.info.integration]
    return [max(0, dataset.num_frames(split, index) - given) for index in range(dataset.count(split))]


def place_of(number: int, count: int) -> int:
    """The place of an item of `count`, from 0; negative numbers count from the end. The IndexError where there is none
    ends a loop over all."""
    try:
        return range(count)[operator.index(number)]
    except IndexError:
        raise IndexError(f"there is no item {number}: there are {count:,}") from None


def to_collate(items: Any, types: type | tuple[type, ...], what: str) -> list[Any]:
    """The items that are to become one batch, each of these types, which `what` says in words.

    Raises:
        ConfigError: there are none, or one is of another type.
    """
    listed = several("items", items, f"{what}s")
    if not listed:
        raise ConfigError(f"items is empty; a batch needs one {what} or more")
    for number, item in enumerate(listed):
        require_type(f"item {number}", item, types, f"one {what}")
    return listed


class FramePairs(TorchDataset[dict[str, Tensor]]):
    """Each frame of a split that can be predicted, with the frame before it: a map-style dataset of torch, whose items
    are tensors by name. `dataset.torch("train")` makes it.

        pairs = dataset.torch("train")
        for batch in DataLoader(pairs, batch_size=4, shuffle=True, collate_fn=pairs.collate):
            motion = my_network(batch) - batch["position"]

    The models of this package take batches of their own: `model.pairs(dataset)` is a dataset for a DataLoader, too.

    An item has N nodes and E elements of k nodes; floats are float32, integers int64:

    - `rest_position` [N, 3], `node_type` [N] (values of `NodeType`), `body` [N], `elements` [E, k], and `material`
      [E, m] if there is one;
    - `position` [N, 3] and `stress` [N or E, 1] (pascal, if there is one) in the frame before, and in a dynamic dataset
      `previous_position` in the frame before that;
    - `next_position` and `next_stress` in the frame to predict. There the nodes that are not NORMAL are given;
    - `trajectory` and `frame` [1]: the number of the trajectory in the split, and of the frame to predict.

    Raises:
        ConfigError: a trajectory has some frames of its motion only.
        DatasetError: no trajectory of the split has a frame to predict; or, from an item, a sample cannot be read.
    """

    def __init__(self, dataset: Dataset, split: str) -> None:
        require_type("dataset", dataset, Dataset, "an open ast_sim.Dataset")
        require_whole_motions(dataset, split)
        self._dataset = dataset
        self._split = split
        self._given = GIVEN_FRAMES[dataset.info.integration]
        self._starts = np.cumsum([0, *target_counts(dataset, split)])
        if not len(self):
            raise DatasetError(f"{dataset.path}: no trajectory of {split} has {self._given + 1} frames")

    def __repr__(self) -> str:
        return one_line(
            "FramePairs", {"pairs": f"{len(self):,}", "split": self._split, "file": self._dataset.path.name}
        )

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getitem__(self, number: int) -> dict[str, Tensor]:
        number = place_of(number, len(self))
        index = int(np.searchsorted(self._starts, number, side="right")) - 1
        frame = self._given + number - int(self._starts[index])
        scene = self._dataset.scene(self._split, index)
        position, stress = self._dataset.frames(self._split, index, frame - self._given, frame + 1)
        arrays = {
            "rest_position": scene.rest_position,
            "node_type": scene.node_type.astype(np.int64),
            "body": scene.body.astype(np.int64),
            "elements": scene.elements.astype(np.int64),
            "material": scene.material,
            "position": position[-2],
            "previous_position": position[-3] if self._given > 1 else None,
            "next_position": position[-1],
            "stress": None if stress is None else stress[-2],
            "next_stress": None if stress is None else stress[-1],
            "trajectory": np.array([index]),
            "frame": np.array([frame]),
        }
        return {name: torch.tensor(values) for name, values in arrays.items() if values is not None}

    @staticmethod
    def collate(items: Sequence[dict[str, Tensor]]) -> dict[str, Tensor]:
        """Several items as one, without padding: the rows of all items one after another. The elements count the nodes
        of the whole batch. `scene` [N] int64 is the item that each node belongs to.

        Raises:
            ConfigError: there are no items, or they are not of one kind.
        """
        items = to_collate(items, Mapping, "item of FramePairs")
        kinds = [{name: tuple(values.shape[1:]) for name, values in item.items()} for item in items]
        for number, kind in enumerate(kinds):
            if "position" not in kind or kind != kinds[0]:
                shown = ", ".join(f"{name} {['rows', *shape]}".replace("'", "") for name, shape in kind.items())
                raise ConfigError(
                    f"item {number} is no item of FramePairs, or of another dataset than item 0; it has: {shown}"
                )
        nodes = [len(item["position"]) for item in items]
        batch = {name: torch.cat([item[name] for item in items]) for name in items[0]}
        batch["elements"] = join_indices([item["elements"] for item in items], nodes)
        batch["scene"] = torch.arange(len(items)).repeat_interleave(torch.tensor(nodes))
        return batch

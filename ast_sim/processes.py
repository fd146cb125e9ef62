"""The processes that train one model together, started by `torchrun`: what they add up and what they agree on.

Each takes its part of every batch. Sums over all of them stand for those over the batch, so that training is what one
process would do with the whole batch, up to the rounding of sums.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from datetime import timedelta
from typing import Any, TypeVar

import torch
from torch import Tensor, distributed

PATIENCE = timedelta(hours=12)  # others may wait so long for one that writes a checkpoint or validates

T = TypeVar("T")


class Processes:
    """This process among all that `torchrun` has started; alone without it.

    Attributes:
        rank: which one this is, from 0.
        count: how many there are.
    """

    def __init__(self) -> None:
        self.rank, self.count = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))

    def __enter__(self) -> Processes:
        if self.count > 1:
            # Default arguments in there hold the group that stands when it is imported, and torch._dynamo imports it
            # when first needed: within the group that would keep the group and its threads alive until Python ends.
            import torch.distributed.nn  # noqa: F401

            distributed.init_process_group("gloo", timeout=PATIENCE)
        return self

    def __exit__(self, *error: object) -> None:
        if self.count > 1:
            distributed.destroy_process_group()

    @property
    def leads(self) -> bool:
        """Whether this one tells, writes and restores for all."""
        return self.rank == 0

    def add(self, values: Tensor) -> Tensor:
        """The sum over all processes, in place."""
        if self.count > 1:
            distributed.all_reduce(values)
        return values

    def share(self, rows: int) -> float:
        """This process's part of all the rows."""
        if self.count == 1:
            return 1.0
        total = int(self.add(torch.tensor([rows])))
        return rows / total if total else 0.0

    def any(self, flag: bool) -> bool:
        """Whether it is so in any process."""
        return flag if self.count == 1 else bool(self.add(torch.tensor([int(flag)])))

    def gathered(self, values: list[T]) -> list[T]:
        """The lists of all processes as one, in the order of their ranks."""
        if self.count == 1:
            return values
        lists: list[Any] = [None] * self.count
        distributed.all_gather_object(lists, values)
        return [value for values in lists for value in values]

    def of_leader(self, value: T) -> T:
        """What the leading process has."""
        if self.count == 1:
            return value
        values = [value]
        distributed.broadcast_object_list(values)
        return values[0]

    def spread(self, tensors: Iterable[Tensor]) -> None:
        """Give all processes the leading one's tensors, in place."""
        if self.count > 1:
            for tensor in tensors:
                distributed.broadcast(tensor.detach(), 0)

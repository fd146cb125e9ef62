"""The processes that train one model together, started by `torchrun`: what they sum and what they agree on.

Each process takes its part of every batch. The sum over the processes is the sum over the whole batch, so the training
equals the training of one process with whole batches, up to the rounding of sums.
"""

from __future__ import annotations

from collections.abc import Iterable
from datetime import timedelta
from typing import Any, TypeVar

import torch
from torch import Tensor, distributed

from ast_sim.support.environment import place_among_processes

PATIENCE = timedelta(hours=12)  # how long a process waits for another one that writes a checkpoint or validates

T = TypeVar("T")


class Processes:
    """This process, and how it talks to the other processes that `torchrun` has started, if there are any.

    Attributes:
        rank: number of this process, from 0.
        count: number of processes; 1 without `torchrun`.

    Raises:
        ConfigError: the environment tells of several processes, but not all that `torchrun` would.
    """

    def __init__(self) -> None:
        self.rank, self.count = place_among_processes()

    def __enter__(self) -> Processes:
        if self.count > 1:
            # This module must be imported before the process group exists: its default arguments keep a group that
            # exists at its import, and then the group's threads run until Python ends. torch._dynamo imports it later.
            import torch.distributed.nn  # noqa: F401

            distributed.init_process_group("gloo", timeout=PATIENCE)
        return self

    def __exit__(self, *error: object) -> None:
        if self.count > 1:
            distributed.destroy_process_group()

    @property
    def leads(self) -> bool:
        """Whether this process prints, writes and reads files for all processes."""
        return self.rank == 0

    def add(self, values: Tensor) -> Tensor:
        """Replace the values by their sum over all processes; returns them."""
        if self.count > 1:
            distributed.all_reduce(values)
        return values

    def share(self, rows: int) -> float:
        """The number of this process's rows, divided by the rows of all processes."""
        if self.count == 1:
            return 1.0
        total = int(self.add(torch.tensor([rows])))
        return rows / total if total else 0.0

    def any(self, flag: bool) -> bool:
        """Whether the flag is set in any process."""
        return flag if self.count == 1 else bool(self.add(torch.tensor([int(flag)])))

    def gathered(self, values: list[T]) -> list[T]:
        """The lists of all processes joined to one list, in the order of their ranks."""
        if self.count == 1:
            return values
        lists: list[Any] = [None] * self.count
        distributed.all_gather_object(lists, values)
        return [value for values in lists for value in values]

    def of_leader(self, value: T) -> T:
        """The value that the leading process has given."""
        if self.count == 1:
            return value
        values = [value]
        distributed.broadcast_object_list(values)
        return values[0]

    def spread(self, tensors: Iterable[Tensor]) -> None:
        """Overwrite the tensors of all processes with the tensors of the leading process."""
        if self.count > 1:
            for tensor in tensors:
                distributed.broadcast(tensor.detach(), 0)

"""A set of directed edges, sorted once, over which messages are passed many times.

Legend: M edges, S senders, R receivers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor


def offsets_of(index: Tensor, num: int) -> Tensor:
    """[num + 1] int64: where each value of a sorted index starts and ends."""
    offsets = index.new_zeros(num + 1)
    torch.cumsum(torch.bincount(index, minlength=num), 0, out=offsets[1:])
    return offsets


@dataclass(frozen=True)
class EdgeSet:
    """Directed edges by receiver, then sender.

    Attributes:
        senders: [M] int64.
        receivers: [M] int64, ascending.
        receiver_offsets: [R + 1] int64; the edges into r are receiver_offsets[r]:receiver_offsets[r + 1].
        num_senders: S.
    """

    senders: Tensor
    receivers: Tensor
    receiver_offsets: Tensor
    num_senders: int

    @staticmethod
    def from_pairs(senders: Tensor, receivers: Tensor, num_senders: int, num_receivers: int) -> EdgeSet:
        """Sort edges given as index pairs.

        Raises:
            ValueError: for an index out of range, with its place and value.
        """
        for name, index, num in (("senders", senders, num_senders), ("receivers", receivers, num_receivers)):
            wrong = ((index < 0) | (index >= num)).nonzero()
            if len(wrong):
                at = int(wrong[0])
                raise ValueError(f"EdgeSet: {name}[{at}] = {int(index[at])} is not an index below {num}")
        order = torch.argsort(receivers * max(num_senders, 1) + senders, stable=True)
        senders, receivers = senders[order], receivers[order]
        return EdgeSet(senders, receivers, offsets_of(receivers, num_receivers), num_senders)

    @staticmethod
    def concatenate(sets: list[EdgeSet]) -> EdgeSet:
        """The edge sets of several scenes as one, with shifted indices."""
        if len(sets) == 1:
            return sets[0]
        senders, receivers, edges = 0, 0, 0
        parts: list[list[Tensor]] = [[], [], [sets[0].receiver_offsets[:1]]]
        for s in sets:
            parts[0].append(s.senders + senders)
            parts[1].append(s.receivers + receivers)
            parts[2].append(s.receiver_offsets[1:] + edges)
            senders += s.num_senders
            receivers += s.num_receivers
            edges += len(s)
        return EdgeSet(*(torch.cat(part) for part in parts), senders)

    @property
    def num_receivers(self) -> int:
        return len(self.receiver_offsets) - 1

    @cached_property
    def by_receiver(self) -> tuple[Tensor, Tensor]:
        """The edges in stored order, and where each receiver's start: as segment ops take them."""
        return torch.arange(len(self)), self.receiver_offsets

    @cached_property
    def by_sender(self) -> tuple[Tensor, Tensor]:
        """The edges in order of their senders, and where each sender's start."""
        return torch.argsort(self.senders, stable=True), offsets_of(self.senders, self.num_senders)

    def __len__(self) -> int:
        return len(self.senders)

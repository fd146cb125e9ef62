"""A set of directed edges, sorted once, over which messages are passed many times.

Legend: M edges, S senders, R receivers, F channels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from ast_sim.ops.segment import gather, segment_sum


def offsets_of(index: Tensor, num: int) -> Tensor:
    """[num + 1] int64: where each value of a sorted index starts and ends."""
    offsets = index.new_zeros(num + 1)
    torch.cumsum(torch.bincount(index, minlength=num), 0, out=offsets[1:])
    return offsets


@dataclass(frozen=True)
class EdgeSet:
    """Directed edges by receiver, then sender, with the order by sender beside it.

    Attributes:
        senders: [M] int64.
        receivers: [M] int64, ascending.
        receiver_offsets: [R + 1] int64; the edges into r are receiver_offsets[r]:receiver_offsets[r + 1].
        sender_order: [M] int64, the edges sorted by sender.
        sender_offsets: [S + 1] int64; the edges out of s are sender_order[sender_offsets[s]:sender_offsets[s + 1]].
    """

    senders: Tensor
    receivers: Tensor
    receiver_offsets: Tensor
    sender_order: Tensor
    sender_offsets: Tensor

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
        sender_order = torch.argsort(senders, stable=True)
        return EdgeSet(
            senders,
            receivers,
            offsets_of(receivers, num_receivers),
            sender_order,
            offsets_of(senders[sender_order], num_senders),
        )

    @staticmethod
    def concatenate(sets: list[EdgeSet]) -> EdgeSet:
        """The edge sets of several scenes as one, with shifted indices."""
        if len(sets) == 1:
            return sets[0]
        senders, receivers, edges = 0, 0, 0
        parts: list[list[Tensor]] = [[], [], [sets[0].receiver_offsets[:1]], [], [sets[0].sender_offsets[:1]]]
        for s in sets:
            parts[0].append(s.senders + senders)
            parts[1].append(s.receivers + receivers)
            parts[2].append(s.receiver_offsets[1:] + edges)
            parts[3].append(s.sender_order + edges)
            parts[4].append(s.sender_offsets[1:] + edges)
            senders += len(s.sender_offsets) - 1
            receivers += len(s.receiver_offsets) - 1
            edges += len(s.senders)
        return EdgeSet(*(torch.cat(part) for part in parts))

    def __len__(self) -> int:
        return len(self.senders)

    @cached_property
    def _stored_order(self) -> Tensor:
        return torch.arange(len(self.senders), device=self.senders.device)

    def from_senders(self, x: Tensor) -> Tensor:
        """[S, F] -> [M, F]: the row of each edge's sender."""
        return gather(x, self.senders, self.sender_order, self.sender_offsets)

    def from_receivers(self, x: Tensor) -> Tensor:
        """[R, F] -> [M, F]: the row of each edge's receiver."""
        return gather(x, self.receivers, self._stored_order, self.receiver_offsets)

    def sum_at_receivers(self, x: Tensor) -> Tensor:
        """[M, F] -> [R, F]: the sum over the edges into each receiver, in stored order; 0 without edges."""
        return segment_sum(x, self._stored_order, self.receiver_offsets)

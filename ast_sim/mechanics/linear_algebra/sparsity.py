"""Where the second derivative of an energy has entries, and their places in the upper triangle of a sparse matrix.

All elements of a kind couple their degrees of freedom alike, and two nodes that are coupled fill a block of 3 x 3
places. So only pairs of nodes are sorted and looked up; the place of an entry follows from its components.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse

from ast_sim.element_topology import distinct


@dataclass(frozen=True, eq=False)
class Entries:
    """Entries of the second derivative of an energy, alike in each of E elements. A degree of freedom, or dof, is
    3 node + component. An entry (r, c) stands for (c, r), too.

    Attributes:
        nodes: [k, E], the nodes of each element.
        rows, columns: [n], the dofs of an element that an entry couples, 3 a + i for component i of its node a. The
            values [n, E] of the entries come entry by entry. Two different components of one node are coupled in one
            order: i <= j.
    """

    nodes: np.ndarray
    rows: np.ndarray
    columns: np.ndarray

    def dofs(self) -> tuple[np.ndarray, np.ndarray]:
        """The dofs [n E] of the rows and the columns of all entries."""
        of_element = (3 * self.nodes[:, None] + np.arange(3)[:, None]).reshape(3 * len(self.nodes), -1)
        return of_element[self.rows].ravel(), of_element[self.columns].ravel()


def entry_dofs(entries: Sequence[Entries]) -> tuple[np.ndarray, np.ndarray]:
    """The dofs [P] of the rows and the columns of all entries, in the order of their values."""
    rows, columns = zip(*(one.dofs() for one in entries), strict=True)
    return np.concatenate(rows), np.concatenate(columns)


class Sparsity:
    """The entries of the upper triangle between free dofs, by rows, ascending; all of each block that has any.

    Args:
        entries: of the whole matrix.
        number: [N] of the free nodes, ascending; -1 for nodes whose rows and columns are left out.

    Attributes:
        starts: [F + 1], where each row begins.
        columns: [n], the column of each entry.
        slot: [P], for each value the number of its entry; n for values that are left out.
    """

    def __init__(self, entries: Sequence[Entries], number: np.ndarray) -> None:
        free = int(number.max(initial=-1)) + 1
        pairs = [_Pairs(one, number) for one in entries]
        diagonal = np.arange(free) * (free + 1)
        keys = [(pair.low * np.int64(free) + pair.high)[pair.low >= 0] for pair in pairs]
        row, column = np.divmod(distinct(np.concatenate([diagonal, *keys])), max(free, 1))
        first = np.searchsorted(row, np.arange(free + 1))
        # A node has three rows: of `width` entries, of one fewer, and of two fewer. Its diagonal block is the first.
        width = 3 * np.diff(first)
        start = np.concatenate([[0], np.cumsum(3 * width - 3)])
        self.starts = np.append((start[:-1, None] + np.outer(width, range(3)) - (0, 0, 1)).ravel(), start[-1])
        corner = start[row] + 3 * (np.arange(len(row)) - first[row])  # place of a block's entry (0, 0)
        self.columns = np.zeros(start[-1], np.int32)
        for i, j in np.ndindex(3, 3):
            kept = (row != column) | (i <= j)
            self.columns[_place(corner[kept], width[row[kept]], i, j)] = 3 * column[kept] + j
        blocks = scipy.sparse.csr_array((np.arange(len(row)), column, first), shape=(free, free))
        slots = [pair.slots(blocks, corner, width, start[-1]) for pair in pairs]
        self.slot = np.concatenate([np.zeros(0, np.int32), *slots])


class _Pairs:
    """The pairs of nodes that entries couple.

    Attributes:
        low, high: [p, E], the smaller and the larger number of the nodes; `low` is -1 where one is left out.
    """

    def __init__(self, entries: Entries, number: np.ndarray) -> None:
        self._components = entries.rows % 3, entries.columns % 3
        nodes = np.stack([entries.rows // 3, entries.columns // 3])
        (one, other), self._pair = np.unique(nodes, axis=1, return_inverse=True)
        of_node = number.astype(np.int32)[entries.nodes]
        self._one = of_node[one]
        self._other = of_node[other]
        self.low = np.minimum(self._one, self._other)
        self.high = np.maximum(self._one, self._other)

    def slots(self, blocks: scipy.sparse.csr_array, corner: np.ndarray, width: np.ndarray, end: int) -> np.ndarray:
        """The places [n E] of the entries; `end` for entries that are left out. For the arguments see `Sparsity`."""
        inside = self.low >= 0
        low = np.where(inside, self.low, 0)
        block = blocks[low.ravel(), np.where(inside, self.high, 0).ravel()].reshape(low.shape)
        corner = corner.astype(np.int32)[block]
        width = width.astype(np.int32)[low]
        exchanged = self._one > self._other
        slot = np.empty((len(self._pair), low.shape[1]), np.int32)
        for entry, (pair, i, j) in enumerate(zip(self._pair, *self._components, strict=True)):
            straight = _place(corner[pair], width[pair], i, j)
            if i != j:
                straight = np.where(exchanged[pair], _place(corner[pair], width[pair], j, i), straight)
            slot[entry] = np.where(inside[pair], straight, end)
        return slot.ravel()


def _place(corner: np.ndarray, width: np.ndarray, i: int, j: int) -> np.ndarray:
    """The places of the entries (i, j) of blocks: row i of the three begins i width - i (i - 1) / 2 after the first,
    and i columns further on."""
    return corner + int(i) * width + int(j - i * (i + 1) // 2)

"""An order of nodes in which the nodes of each element are near each other, for matrices with a narrow band.

Legend: N nodes, E elements of K nodes.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ast_sim.ops.library import Kernel, Op

WALKS = 3


def _reference(elements: Tensor, wanted: Tensor) -> Tensor:
    of_elements, free = elements.tolist(), wanted.tolist()
    at_node: list[list[int]] = [[] for _ in free]
    for number, nodes in enumerate(of_elements):
        for node in nodes:
            at_node[node].append(number)

    def walk(start: int) -> list[int]:
        reached, seen = [start], {start}
        for node in reached:
            for other in (other for number in at_node[node] for other in of_elements[number]):
                if free[other] and other not in seen:
                    seen.add(other)
                    reached.append(other)
        return reached

    order: list[int] = []
    rank = [-1] * len(free)
    for start in range(len(free)):
        if free[start] and rank[start] < 0:
            reached = [start]
            for _ in range(WALKS):
                reached = walk(reached[-1])
            for node in reached:
                rank[node] = len(order)
                order.append(node)
    return torch.tensor(rank, dtype=torch.int64, device=elements.device)


_breadth_first = Op(
    Kernel("breadth_first", "elements[E,K] index(N), wanted[N] index(2) -> rank[N] int64"),
    _reference,
)


def breadth_first(elements: Tensor, wanted: Tensor) -> Tensor:
    """[N] int64: the places of the wanted nodes in an order in which those of each element are near each other; -1 for
    the other nodes.

    After a node come those of its elements that are new. A walk starts at the lowest node that is left, the next one
    from its end, and the last one from there. Then follow the nodes that no element joins to these.

    Args:
        elements: [E, K] int64, nodes.
        wanted: [N] int64, 1 or 0. The walk takes no way through other nodes.

    Raises:
        ValueError: a node is out of range, or `wanted` is neither 1 nor 0.
    """
    return _breadth_first(elements, wanted)

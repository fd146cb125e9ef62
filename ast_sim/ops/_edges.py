"""A set of directed edges, which is sorted once and along which messages are passed many times. What a mesh has: its
edges, the faces that belong to one element only, and an order in which nodes of an element are near each other.

Legend: M edges, S senders, R receivers; N nodes, E elements of K nodes; P edges, Q faces of an element; F outer faces.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate

import torch
import torch.nn.functional as F
from torch import Tensor

from ast_sim.element_topology import LOCAL_EDGES, LOCAL_FACES
from ast_sim.ops.library import IndexSet, Kernel, Op, frozen, is_transformed
from ast_sim.ops.spec import check_index


def offsets_of(index: Tensor, num: int) -> Tensor:
    """[num + 1] int64: value i fills the places offsets[i]:offsets[i + 1] of a sorted index with values below num."""
    offsets = index.new_zeros(num + 1)
    torch.cumsum(torch.bincount(index, minlength=num), 0, out=offsets[1:])
    return offsets


def join_indices(parts: Sequence[Tensor], sizes: Sequence[int]) -> Tensor:
    """The indices of several scenes as one: each scene's indices are shifted by the sizes of the scenes before it."""
    return torch.cat([index + shift for index, shift in zip(parts, accumulate(sizes, initial=0), strict=False)])


def join_offsets(parts: Sequence[Tensor]) -> Tensor:
    """The offsets of several scenes as one, from 0 to the sum of their last ones."""
    return F.pad(torch.cat([offsets.diff() for offsets in parts]).cumsum(0), (1, 0))


def _counting_sort_reference(num: int, index: Tensor) -> tuple[Tensor, Tensor]:
    return torch.argsort(index, stable=True), offsets_of(index, num)


_counting_sort = Op(
    Kernel("counting_sort", "num size(N), index[M] index(N) -> order[M] int64, offsets[N+1] int64"),
    _counting_sort_reference,
)


def counting_sort(index: Tensor, num: int) -> tuple[Tensor, Tensor]:
    """The places of each value of an index.

    Args:
        index: [M] int64, numbers below `num`.

    Returns:
        order: [M] int64, the places sorted by value, then ascending.
        offsets: [num + 1] int64; the places of the value n are order[offsets[n]:offsets[n + 1]].

    Raises:
        ValueError: a value is out of range; the message names its place.
    """
    return _counting_sort(num, index)


def _kept(make: Callable[[EdgeSet], tuple[Tensor, ...]]) -> property:
    """A property that is computed once. While torch traces or transforms it is computed each time and not kept: such a
    tensor may have no values afterwards."""
    name = f"_{make.__name__}"

    def value(self: EdgeSet) -> tuple[Tensor, ...]:
        if hasattr(self, name):
            return getattr(self, name)
        tensors = make(self)
        if not (torch.compiler.is_compiling() or is_transformed()):
            self.__dict__[name] = tensors
        return tensors

    return property(value, doc=make.__doc__)


@dataclass(frozen=True)
class EdgeSet(IndexSet):
    """Directed edges, sorted by receiver, then by sender.

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
            ValueError: an index is out of range; the message names its place and value.
        """
        check_index("EdgeSet", "senders", senders, num_senders)
        check_index("EdgeSet", "receivers", receivers, num_receivers)
        by_sender, _ = counting_sort(senders, num_senders)
        order, offsets = counting_sort(receivers[by_sender], num_receivers)
        order = by_sender[order]
        return EdgeSet(senders[order], receivers[order], offsets, num_senders)

    @staticmethod
    def concatenate(sets: list[EdgeSet]) -> EdgeSet:
        """The edge sets of several scenes as one, whose nodes are numbered scene after scene."""
        if len(sets) == 1:
            return sets[0]
        senders = join_indices([s.senders for s in sets], [s.num_senders for s in sets])
        receivers = join_indices([s.receivers for s in sets], [s.num_receivers for s in sets])
        offsets = join_offsets([s.receiver_offsets for s in sets])
        return EdgeSet(senders, receivers, offsets, sum(s.num_senders for s in sets))

    @property
    def num_receivers(self) -> int:
        return self.receiver_offsets.shape[0] - 1

    @_kept
    def by_receiver(self) -> tuple[Tensor, ...]:
        """The edges in stored order, and the offsets of each receiver's edges, as segment ops take them."""
        return *frozen(torch.arange(self.receivers.shape[0], device=self.receivers.device)), self.receiver_offsets

    @_kept
    def by_sender(self) -> tuple[Tensor, ...]:
        """The edges sorted by sender, and the offsets of each sender's edges, as segment ops take them."""
        return frozen(*counting_sort(self.senders, self.num_senders))

    def __len__(self) -> int:
        return len(self.senders)


_ENDS = {2: ((0, 1),), **LOCAL_EDGES}  # two nodes are an edge


def _edges_reference(num_nodes: int, elements: Tensor, ends: Tensor) -> list[Tensor]:
    one, other = (elements[:, ends[:, side]].flatten() for side in (0, 1))
    apart = one != other
    one, other = one[apart], other[apart]
    keys = torch.cat([one * num_nodes + other, other * num_nodes + one]).unique()
    receivers = keys // max(num_nodes, 1)
    return [keys - receivers * num_nodes, receivers, offsets_of(receivers, num_nodes)]


def _faces_reference(num_nodes: int, elements: Tensor, faces: Tensor) -> list[Tensor]:
    corners = elements[:, faces].flatten(0, 1).sort(dim=1).values
    _, same, count = corners.unique(dim=0, return_inverse=True, return_counts=True)
    return [(count[same] == 1).nonzero()[:, 0]]


_mesh_edges = Op(
    Kernel(
        "mesh_edges",
        "num_nodes size(N), elements[E,K] index(N), ends[P,2] index(K)"
        " -> senders[M] int64, receivers[M] int64, offsets[N+1] int64",
    ),
    _edges_reference,
)
_outer_faces = Op(
    Kernel("outer_faces", "num_nodes size(N), elements[E,K] index(N), faces[Q,3] index(K) -> outer[F] int64"),
    _faces_reference,
)


def mesh_edges(elements: Tensor, num_nodes: int) -> EdgeSet:
    """The edges of triangles, tetrahedra or pairs of nodes [E, K] int64, in both directions and each once.

    Raises:
        ValueError: a node is out of range; the message names its place and value.
    """
    ends = elements.new_tensor(_ENDS[elements.shape[1]])
    senders, receivers, offsets = _mesh_edges(num_nodes, elements, ends)
    return EdgeSet(senders, receivers, offsets, num_nodes)


def outer_faces(elements: Tensor, num_nodes: int) -> Tensor:
    """[F] int64, ascending: the numbers 4 e + face of the faces of tetrahedra [E, 4] or [E, 10] whose corners no other
    face has.

    Raises:
        ValueError: a node is out of range; the message names its place and value.
    """
    (outer,) = _outer_faces(num_nodes, elements, elements.new_tensor(LOCAL_FACES))
    return outer


SEARCHES = 3


def _breadth_first_reference(elements: Tensor, wanted: Tensor) -> Tensor:
    of_elements, free = elements.tolist(), wanted.tolist()
    at_node: list[list[int]] = [[] for _ in free]
    for number, nodes in enumerate(of_elements):
        for node in nodes:
            at_node[node].append(number)

    def search(start: int) -> list[int]:
        reached = [start]
        seen = {start}
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
            for _ in range(SEARCHES):
                reached = search(reached[-1])
            for node in reached:
                rank[node] = len(order)
                order.append(node)
    return torch.tensor(rank, dtype=torch.int64, device=elements.device)


_breadth_first = Op(
    Kernel("breadth_first", "elements[E,K] index(N), wanted[N] index(2) -> rank[N] int64"),
    _breadth_first_reference,
)


def breadth_first(elements: Tensor, wanted: Tensor) -> Tensor:
    """[N] int64: the places of the wanted nodes in an order in which the nodes of an element are near each other; -1
    for the other nodes.

    After a node come the new nodes of its elements. A search starts at the lowest node that is left, the next search at
    the end of the first, and the last at the end of the second. Then follow the nodes that no element joins to these.

    Args:
        elements: [E, K] int64, nodes.
        wanted: [N] int64, 1 or 0. The search does not pass through other nodes.

    Raises:
        ValueError: a node is out of range, or `wanted` is neither 1 nor 0.
    """
    return _breadth_first(elements, wanted)

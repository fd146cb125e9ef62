"""The elastic forces that a guess of the positions leaves out of balance, for St. Venant-Kirchhoff tetrahedra.

    F = Ds Dm^-1,  G = (F^T F - I) / 2,  S = lambda tr(G) I + 2 mu G,  H = -V F S Dm^-T,  V = |det Dm| / 6

Dm has the edges x1 - x0, x2 - x0, x3 - x0 of an element at rest as columns, Ds has its edges in the guess. The columns
of H are the forces on nodes 1 to 3; node 0 gets minus their sum. They are f = -dE/dx of the energy
E = sum of V (lambda/2 tr(G)^2 + mu G:G), a polynomial of the positions: they are finite for any guess.

Legend: N nodes, E elements.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ast_sim.ops._edges import counting_sort, join_indices, join_offsets
from ast_sim.ops.derivatives import gradient_op
from ast_sim.ops.library import IndexSet, Kernel, Op
from ast_sim.ops.spec import check_index

FLAT = 2.0**-21  # a rest volume below this share of the magnitudes that it is the sum of may be rounding alone


@dataclass(frozen=True)
class TetrahedronSet(IndexSet):
    """Tetrahedra, and at each node the corners that meet there.

    Attributes:
        elements: [E, 4] int64, the nodes of each element.
        node_order: [4 E] int64, the numbers 4 e + corner, sorted by the node at that corner, then ascending.
        node_offsets: [N + 1] int64; the corners at node n are node_order[node_offsets[n]:node_offsets[n + 1]].
    """

    elements: Tensor
    node_order: Tensor
    node_offsets: Tensor

    @staticmethod
    def from_elements(elements: Tensor, num_nodes: int) -> TetrahedronSet:
        """Sort the corners of the elements [E, 4] by node.

        Raises:
            TypeError: the elements are not int64.
            ValueError: they are not [E, 4], or a node is out of range; the message names its place and value.
        """
        if elements.dtype != torch.int64:
            raise TypeError(f"TetrahedronSet: elements must be int64, not {elements.dtype}")
        if elements.dim() != 2 or elements.shape[1] != 4:
            raise ValueError(f"TetrahedronSet: elements must have shape [E, 4], not {tuple(elements.shape)}")
        check_index("TetrahedronSet", "elements", elements, num_nodes)
        return TetrahedronSet(elements, *counting_sort(elements.flatten(), num_nodes))

    @staticmethod
    def concatenate(parts: list[TetrahedronSet]) -> TetrahedronSet:
        """The tetrahedra of several scenes as one set, whose nodes and elements are numbered scene after scene."""
        if len(parts) == 1:
            return parts[0]
        elements = join_indices([p.elements for p in parts], [p.num_nodes for p in parts])
        order = join_indices([p.node_order for p in parts], [len(p.node_order) for p in parts])
        return TetrahedronSet(elements, order, join_offsets([p.node_offsets for p in parts]))

    @property
    def num_nodes(self) -> int:
        return self.node_offsets.shape[0] - 1

    def __len__(self) -> int:
        return len(self.elements)


# ---- the composition ----


_SPEC = (
    "position[N,3], rest_position[N,3], lame[E,2], elements[E,4] int64, node_order[4E] int64,"
    " node_offsets[N+1] offsets(4E) corners(elements, node_order)"
)


def _edges(x: Tensor, elements: Tensor) -> Tensor:
    """[E, 3, 3]: the columns are x1 - x0, x2 - x0 and x3 - x0."""
    corners = x[elements]
    return (corners[:, 1:] - corners[:, :1]).mT


@dataclass(frozen=True)
class _Rest:
    """What the rest positions say of each element; an element that does not count has harmless numbers."""

    counts: Tensor  # [E, 1, 1] bool: it has a volume and a stiffness
    inverse: Tensor  # [E, 3, 3]: Dm^-1
    area: Tensor  # [E, 3, 3]: -V Dm^-T = -sign(det) / 6 cof(Dm)
    lame: Tensor  # [E, 2, 3, 3]: lambda and mu in every entry

    @staticmethod
    def of(rest_position: Tensor, lame: Tensor, elements: Tensor) -> _Rest:
        Dm = _edges(rest_position, elements)
        a, b, c = Dm.unbind(-1)
        det = (a * torch.linalg.cross(b, c)).sum(-1)
        size = sum(
            a[:, i].abs() * ((b[:, i - 2] * c[:, i - 1]).abs() + (b[:, i - 1] * c[:, i - 2]).abs()) for i in range(3)
        )
        cofactor = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], -1)
        inverse = (cofactor / det[:, None, None]).mT
        counts = (det.abs() > FLAT * size) & inverse.isfinite().flatten(1).all(1) & (lame != 0).any(1)
        counts = counts[:, None, None]
        area = cofactor * det.sign()[:, None, None] / -6
        of_elements = (inverse, area, lame[:, :, None, None].expand(-1, -1, 3, 3))
        return _Rest(counts, *(torch.where(counts.view(-1, *[1] * (x.dim() - 1)), x, 0) for x in of_elements))

    def gradient(self, x: Tensor, elements: Tensor) -> Tensor:
        """The gradient of a field of the nodes in each element, [E, 3, 3]: of the positions it is F."""
        return torch.where(self.counts, _edges(x, elements), 0) @ self.inverse

    def stress(self, G: Tensor) -> Tensor:
        trace = G.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None]
        return self.lame[:, 0] * trace * torch.eye(3, dtype=G.dtype, device=G.device) + 2 * self.lame[:, 1] * G

    def add(self, P: Tensor, elements: Tensor, num_nodes: int) -> Tensor:
        """[N, 3]: the forces of the first Piola-Kirchhoff stress."""
        H = P @ self.area
        corners = torch.cat([-H.sum(-1, keepdim=True), H], -1).mT.reshape(-1, 3)
        return corners.new_zeros(num_nodes, 3).index_add(0, elements.flatten(), corners)


def _strain(F: Tensor) -> Tensor:
    return (F.mT @ F - torch.eye(3, dtype=F.dtype, device=F.device)) / 2


def _reference(position, rest_position, lame, elements, node_order, node_offsets):
    rest = _Rest.of(rest_position, lame, elements)
    F = rest.gradient(position, elements)
    return rest.add(F @ rest.stress(_strain(F)), elements, len(position))


_forces = Op(Kernel("elastic_forces", f"{_SPEC} -> force[N,3]"), _reference)
_forces_backward = gradient_op(
    _forces, Kernel("elastic_forces_backward", f"dforce[N,3] late, {_SPEC} -> dposition[N,3]")
)


def elastic_forces(position: Tensor, rest_position: Tensor, lame: Tensor, tets: TetrahedronSet) -> Tensor:
    """The elastic force on each node of St. Venant-Kirchhoff tetrahedra, added over its elements in stored order.

    An element contributes exactly nothing, even where positions are infinite or NaN, if its Lame constants are both 0
    (it is rigid), if a rest position is not finite, or if its rest volume is 0 or no more than rounding.

    Args:
        position: [N, 3], a guess; the forces can be differentiated by it.
        rest_position: [N, 3].
        lame: [E, 2], lambda and mu of each element in pascal.
        tets: E elements on N nodes.

    Returns:
        [N, 3] in newton, if positions are in metres; 0 for a node without elements.

    Raises:
        ValueError: shapes do not fit the elements, or rest_position or lame requires a gradient.
    """
    if torch.is_grad_enabled():
        for name, x in (("rest_position", rest_position), ("lame", lame)):
            if x.requires_grad:
                raise ValueError(f"elastic_forces: {name} requires a gradient, but only position has one; detach it")
    return _forces(position, rest_position, lame, tets.elements, tets.node_order, tets.node_offsets)

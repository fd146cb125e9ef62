"""The elastic forces that a guess leaves out of balance, as an input of the nodes.

They are about the right-hand side of Newton's method. Their law is the one of St. Venant and Kirchhoff, with which the
solver's law agrees at small strains only, and contact is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ast_sim.element_topology import SLOPES
from ast_sim.material import ELASTIC, Material
from ast_sim.mechanics.elements.second_order import LARGEST
from ast_sim.ops import TetrahedronSet, elastic_forces, join_indices
from ast_sim.scene import Scene
from ast_sim.support.errors import DatasetError

YOUNG, POISSON = 1.0, 0.3  # where the law of the material is not known
SHARPNESS = 20.0  # forces of strains of 1 / SHARPNESS are of order one


@dataclass(frozen=True, eq=False)
class ElasticTetrahedra:
    """The elastic properties of the tetrahedra of one scene, or of a batch of scenes.

    Second-order tetrahedra have four points of integration. The positions are about linear around each, so each stands
    for a linear tetrahedron, the tangent one, with nodes of its own.

    Attributes:
        tetrahedra: the elements, or the tangent ones [4 E], element by element.
        lame: [E, 2] or [4 E, 2] float32, Lamé's constants lambda and mu; 0 for rigid elements. Tangent elements have a
            quarter: each counts for a quarter of the element.
        force: [N] float32, sum of E V^(2/3) over the elements at each node: the force of a strain of order one.
        nodes: [E, 10] int64, the nodes of second-order elements; None if the elements are linear.
    """

    tetrahedra: TetrahedronSet
    lame: Tensor
    force: Tensor
    nodes: Tensor | None = None

    @staticmethod
    def of(scene: Scene, material: Material) -> ElasticTetrahedra:
        """Of one scene, with Young's modulus and Poisson's ratio of its material. Where its law is not known, or they
        are not allowed in an element, all elements have the same stiffness.

        Raises:
            DatasetError: the elements are no tetrahedra.
        """
        if scene.elements.shape[1] == 3:
            raise DatasetError(
                "the elements are triangles, but the model takes elastic forces of tetrahedra as an input"
            )
        elements = torch.from_numpy(scene.elements.astype("int64"))
        count, corners = elements.shape
        young, poisson = np.full(count, YOUNG, np.float32), np.full(count, POISSON, np.float32)
        if material.law is not None:
            given, ratio = (np.full(count, material.numbers(name, scene.material), np.float32) for name in ELASTIC)
            if (given > 0).all() and (ratio >= 0).all() and (ratio < 0.5).all():
                young = given
                poisson = ratio
        young = young * scene.deforming_elements
        lame = np.stack([young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))], axis=1)
        lame = torch.from_numpy(lame)
        volume = np.abs(scene.rest_volumes)
        if corners == 10:
            volume = volume / 8  # of an eighth, whose edges are as long as nodes are apart
        share = torch.from_numpy(np.repeat((young * volume ** (2 / 3)).astype(np.float32), corners))
        force = torch.zeros(scene.num_nodes, dtype=torch.float32).index_add_(0, elements.reshape(-1), share)
        if corners == 4:
            return ElasticTetrahedra(TetrahedronSet.from_elements(elements, scene.num_nodes), lame, force)
        lame[:, 0] = torch.minimum(lame[:, 0], LARGEST * lame[:, 1])  # as the points of the solver's elements
        own = torch.arange(16 * count).view(-1, 4)
        tangent = TetrahedronSet.from_elements(own, own.numel())
        return ElasticTetrahedra(tangent, (lame / 4).repeat_interleave(4, dim=0), force, elements)

    @staticmethod
    def concatenate(parts: Sequence[ElasticTetrahedra]) -> ElasticTetrahedra:
        """Of several scenes as one."""
        nodes = [part.nodes for part in parts if part.nodes is not None]
        return ElasticTetrahedra(
            TetrahedronSet.concatenate([part.tetrahedra for part in parts]),
            torch.cat([part.lame for part in parts]),
            torch.cat([part.force for part in parts]),
            join_indices(nodes, [len(part.force) for part in parts]) if nodes else None,
        )

    def out_of_balance(self, position: Tensor, rest: Tensor) -> Tensor:
        """[N, 3]: asinh(SHARPNESS f / force) of the forces f on the nodes at `position` [N, 3]; 0 at rigid bodies."""
        if self.nodes is None:
            forces = elastic_forces(position, rest, self.lame, self.tetrahedra)
        else:
            forces = self._second_order_forces(self.nodes, position, rest)
        scale = torch.where(self.force > 0, SHARPNESS / self.force, 0.0)
        return torch.asinh(forces * scale[:, None])

    def _second_order_forces(self, nodes: Tensor, position: Tensor, rest: Tensor) -> Tensor:
        """[N, 3]: with s_ak the slopes of the shape functions, a tangent element has its node 0 at 0 and its node k at
        sum_a s_ak x_a. By the chain rule, node a of the element gets sum_k s_ak f_k of its forces f_k."""
        slopes = torch.tensor(SLOPES, dtype=position.dtype, device=position.device)  # [4, 10, 3]

        def tangent(x: Tensor) -> Tensor:
            edges = torch.einsum("pak,eai->epki", slopes, x[nodes])
            return torch.cat([torch.zeros_like(edges[:, :, :1]), edges], dim=2).reshape(-1, 3)

        forces = elastic_forces(tangent(position), tangent(rest), self.lame, self.tetrahedra)
        of_nodes = torch.einsum("pak,epki->eai", slopes, forces.view(-1, 4, 4, 3)[:, :, 1:])
        return torch.zeros_like(position).index_add(0, nodes.reshape(-1), of_nodes.reshape(-1, 3))

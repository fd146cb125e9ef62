"""The elastic forces that a guess leaves out of balance, as an input of the nodes.

They are the right-hand side of Newton's method: where they are zero at the free nodes, and no contact acts, the guess
is the answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ast_sim.ops import TetrahedronSet, elastic_forces
from ast_sim.scene import Scene
from ast_sim.support.errors import DatasetError

YOUNG, POISSON = 1.0, 0.3  # where the scene has no material
SHARPNESS = 20.0  # forces of strains of 1 / SHARPNESS are of order one


@dataclass(frozen=True, eq=False)
class Elasticity:
    """The elastic properties of the tetrahedra of one scene, or of a batch of scenes.

    Attributes:
        tetrahedra: the elements.
        lame: [E, 2] float32, Lamé's constants lambda and mu; 0 for rigid elements.
        force: [N] float32, sum of E V^(2/3) over the elements at each node: the force of a strain of order one.
    """

    tetrahedra: TetrahedronSet
    lame: Tensor
    force: Tensor

    @staticmethod
    def of(scene: Scene) -> Elasticity:
        """Of one scene. Two columns of material are Young's modulus and Poisson's ratio, if they can be; else all
        elements have the same stiffness.

        Raises:
            DatasetError: the elements are no tetrahedra.
        """
        if scene.elements.shape[1] != 4:
            raise DatasetError(
                "the elements are triangles, but the model takes elastic forces of tetrahedra as an input"
            )
        elements = torch.from_numpy(scene.elements.astype("int64"))
        young, poisson = torch.full((len(elements),), YOUNG), torch.full((len(elements),), POISSON)
        if scene.material is not None and scene.material.shape[1] == 2:
            given, ratio = torch.tensor(scene.material).unbind(1)
            if bool((given > 0).all() and (ratio >= 0).all() and (ratio < 0.5).all()):
                young, poisson = given, ratio
        young = young * torch.from_numpy(scene.deforming_elements)
        lame = torch.stack([young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))], dim=1)
        corners = torch.tensor(scene.rest_position, dtype=torch.float64)[elements]
        volume = torch.linalg.det(corners[:, 1:] - corners[:, :1]).abs() / 6
        share = (young * volume ** (2 / 3)).float().repeat_interleave(4)
        force = torch.zeros(scene.num_nodes).index_add_(0, elements.reshape(-1), share)
        return Elasticity(TetrahedronSet.from_elements(elements, scene.num_nodes), lame, force)

    @staticmethod
    def concatenate(parts: Sequence[Elasticity]) -> Elasticity:
        """Of several scenes as one."""
        return Elasticity(
            TetrahedronSet.concatenate([part.tetrahedra for part in parts]),
            torch.cat([part.lame for part in parts]),
            torch.cat([part.force for part in parts]),
        )

    def out_of_balance(self, position: Tensor, rest: Tensor) -> Tensor:
        """[N, 3]: asinh(SHARPNESS f / force) of the forces f on the nodes at `position` [N, 3]; 0 at rigid bodies."""
        forces = elastic_forces(position, rest, self.lame, self.tetrahedra)
        scale = torch.where(self.force > 0, SHARPNESS / self.force, 0.0)
        return torch.asinh(forces * scale[:, None])

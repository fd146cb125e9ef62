"""Linear tetrahedra (P1): energy, forces and stiffness of an elastic body in double precision.

With N_a the shape functions and x_a the positions of a tetrahedron's four nodes, F = sum_a x_a grad N_a is constant in
it. Everything that depends on the rest shape alone (gradients, volumes, where an entry of an element's stiffness lands
in the global matrix) is computed once. Legend: N nodes, E elements; component-first arrays as in `material.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ast_sim.errors import SimulationError
from ast_sim.simulate.material import NeoHookean, cofactor, determinant, von_mises

# The 78 entries (p, q), p <= q, of an element's symmetric 12 x 12 stiffness; p = 3 a + i for component i of node a.
_ROW, _COLUMN = np.triu_indices(12)
_ENTRY = np.zeros((12, 12), int)
_ENTRY[_ROW, _COLUMN] = _ENTRY[_COLUMN, _ROW] = np.arange(len(_ROW))
# Entry of the pair with the two nodes exchanged and the components kept: (a i, b j) -> (b i, a j).
_SWAPPED = _ENTRY[3 * (_COLUMN // 3) + _ROW % 3, 3 * (_ROW // 3) + _COLUMN % 3]


@dataclass(frozen=True)
class Deformation:
    """Deformation gradients F [3,3,E], their determinants J [E] and cofactors J F^-T [3,3,E]."""

    F: np.ndarray
    J: np.ndarray
    cofactor: np.ndarray


class Elasticity:
    """Elastic body over tetrahedra `elements` [E,4] with rest positions [N,3]; nodes of no element carry no force.

    Raises:
        SimulationError: an element without positive rest volume.
    """

    def __init__(self, rest: np.ndarray, elements: np.ndarray, material: NeoHookean) -> None:
        self.material = material
        self.elements = elements
        self.num_nodes = len(rest)
        edges = np.transpose(rest[elements[:, 1:]] - rest[elements[:, :1]], (2, 1, 0))  # [3, 3, E]: component, edge
        cofactors = cofactor(np.ascontiguousarray(edges))
        six_volumes = determinant(edges, cofactors)
        if (six_volumes <= 0).any():
            worst = int(np.argmin(six_volumes))
            raise SimulationError(f"element {worst} has the rest volume {six_volumes[worst] / 6:.3g}: must be positive")
        self.volume = six_volumes / 6
        gradients = np.transpose(cofactors / six_volumes, (1, 0, 2))  # of nodes 1, 2, 3: rows of the inverse
        self.gradients = np.concatenate([-gradients.sum(0)[None], gradients])  # [4, 3, E]
        self._nodes = np.ascontiguousarray(elements.T)
        self._dofs = (3 * self._nodes[:, None, :] + np.arange(3)[None, :, None]).reshape(12, -1)
        dot = np.einsum("aje,bje->abe", self.gradients, self.gradients)
        same_component = _ROW % 3 == _COLUMN % 3
        self._constant = material.mu * self.volume * dot[_ROW // 3, _COLUMN // 3] * same_component[:, None]  # [78, E]

    @property
    def force_per_stress(self) -> float:
        """Mean nodal force of an element under a stress of one pascal, in m^2: a scale for residuals."""
        return float(np.mean(self.volume * np.abs(self.gradients)))

    def deformation(self, position: np.ndarray) -> Deformation:
        """F, J and cofactors at positions [N,3]."""
        x = position.T[:, self._nodes]  # [3, 4, E]
        F = np.einsum("iae,aje->ije", x, self.gradients)
        cofactors = cofactor(F)
        return Deformation(F, determinant(F, cofactors), cofactors)

    def energy(self, deformation: Deformation) -> float:
        """Elastic energy in joule; infinite if an element is inverted."""
        if deformation.J.min() <= 0:
            return np.inf
        return float(self.volume @ self.material.energy_density(deformation.F, deformation.J))

    def element_forces(self, deformation: Deformation) -> np.ndarray:
        """Derivative of each element's energy by its nodes [12,E], V P grad N_a, in newton."""
        P = self.material.first_piola(deformation.F, deformation.J, deformation.cofactor / deformation.J)
        return np.einsum("ije,aje->aie", P * self.volume, self.gradients).reshape(12, -1)

    def assemble(self, element_forces: np.ndarray) -> np.ndarray:
        """Sum of element forces [12,E] at the nodes [N,3]: the gradient of the energy."""
        total = np.bincount(self._dofs.ravel(), element_forces.ravel(), minlength=3 * self.num_nodes)
        return total.reshape(-1, 3)

    def stiffness(self, deformation: Deformation, project: bool = False) -> np.ndarray:
        """Second derivative of each element's energy as its 78 upper entries [78,E].

        With g_a = F^-T grad N_a the block of nodes a, b is

            K_ab = V [mu (grad N_a . grad N_b) I + lambda J^2 g_a (x) g_b - c g_b (x) g_a],  c = lambda/2 (J^2 - 1) - mu

        (from dP = mu dF + lambda J^2 (F^-T : dF) F^-T - c F^-T dF^T F^-T).

        Args:
            deformation: where.
            project: replace the negative eigenvalues of each element's matrix by zero.
        """
        J = deformation.J
        g = np.einsum("ije,aje->aie", deformation.cofactor / J, self.gradients).reshape(12, -1)
        products = g[_ROW]
        products *= g[_COLUMN]
        entries = products[_SWAPPED]
        entries *= -self.volume * self.material.pressure_factor(J)
        products *= self.volume * self.material.lam * J * J
        entries += products
        entries += self._constant
        return _project(entries) if project else entries

    def entry_dofs(self) -> tuple[np.ndarray, np.ndarray]:
        """Global degrees of freedom (3 node + component) of the rows and columns of `stiffness`, [78,E] each."""
        return self._dofs[_ROW], self._dofs[_COLUMN]

    def von_mises(self, deformation: Deformation) -> np.ndarray:
        """Von Mises stress of each element [E] in pascal."""
        return von_mises(self.material.cauchy(deformation.F, deformation.J))

    def nodal_mean(self, element_values: np.ndarray) -> np.ndarray:
        """Volume-weighted mean [N] of the values [E] of the elements around each node; 0 for nodes without elements."""
        nodes, weight = self._nodes.ravel(), np.tile(self.volume, 4)
        total = np.bincount(nodes, np.tile(element_values, 4) * weight, minlength=self.num_nodes)
        volume = np.bincount(nodes, weight, minlength=self.num_nodes)
        return np.divide(total, volume, out=np.zeros(self.num_nodes), where=volume > 0)


def _project(entries: np.ndarray) -> np.ndarray:
    """Nearest positive semi-definite element matrices, as upper entries [78,E]."""
    values, vectors = np.linalg.eigh(entries[_ENTRY].transpose(2, 0, 1))
    projected = (vectors * np.maximum(values, 0)[:, None, :]) @ vectors.transpose(0, 2, 1)
    return np.ascontiguousarray(projected[:, _ROW, _COLUMN].T)

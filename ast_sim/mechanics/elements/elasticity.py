"""Linear tetrahedra (P1): energy, forces and stiffness of an elastic body in double precision.

With N_a the shape functions and x_a the positions of a tetrahedron's four nodes, F = sum_a x_a grad N_a is constant in
the tetrahedron. Everything that depends on the rest shape alone is computed once: gradients, volumes, and where an
entry of an element's stiffness lands in the global matrix. Legend: N nodes, E elements; component-first arrays as in
`material.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ast_sim.mechanics.elements.neo_hookean import NeoHookean, cofactor, determinant, von_mises
from ast_sim.mechanics.linear_algebra.sparsity import Entries
from ast_sim.support.environment import c_core
from ast_sim.support.errors import SimulationError

_C = c_core()

FLATTEST = 0.2  # the least stretch that `upright` leaves


@dataclass(frozen=True, eq=False)
class Deformation:
    """Deformation gradients F [3,3,E], their determinants J [E], cofactors J F^-T [3,3,E] and the energy in joule.

    The energy is infinite if an element is inverted.
    """

    F: np.ndarray
    J: np.ndarray
    cofactor: np.ndarray
    energy: float


class Elasticity:
    """Elastic body of tetrahedra `elements` [E,4] with rest positions [N,3]. Nodes outside all elements carry no force.

    Raises:
        SimulationError: the rest volume of an element is not positive.
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

    @property
    def unit_force(self) -> float:
        """Mean nodal force of an element whose stress is Young's modulus, in newton: a scale for residuals."""
        return float(np.mean(self.material.young * self.volume * np.abs(self.gradients)))

    @property
    def unit_energy(self) -> float:
        """Energy in joule of a body whose energy density is Young's modulus: a scale for rounding."""
        return float(np.sum(self.material.young * self.volume))

    @property
    def element_volume(self) -> np.ndarray:
        """[E] rest volume of each element."""
        return self.volume

    def lumped_volume(self) -> np.ndarray:
        """[N] volume around each node in m^3: a quarter of the volume of each element around it."""
        return np.bincount(self._nodes.ravel(), np.tile(self.volume / 4, 4), minlength=self.num_nodes)

    def evaluate(self, position: np.ndarray) -> Deformation:
        """F, J, cofactors and energy at positions [N,3]."""
        x = position.T[:, self._nodes]  # [3, 4, E]
        F = np.einsum("iae,aje->ije", x, self.gradients)
        cofactors = cofactor(F)
        J = determinant(F, cofactors)
        energy = np.inf if J.min() <= 0 else float(self.volume @ self.material.energy_density(F, J))
        return Deformation(F, J, cofactors, energy)

    def element_forces(self, deformation: Deformation) -> np.ndarray:
        """Derivative of each element's energy by its nodes [12,E], V P grad N_a, in newton."""
        P = self.material.first_piola(deformation.F, deformation.J, deformation.cofactor / deformation.J)
        return np.einsum("ije,aje->aie", P * self.volume, self.gradients).reshape(12, -1)

    def gradient(self, deformation: Deformation) -> tuple[np.ndarray, float]:
        """Derivative of the energy by the positions [N,3], in newton, and the mean magnitude of an element's forces."""
        forces = self.element_forces(deformation)
        total = np.bincount(self._dofs.ravel(), forces.ravel(), minlength=3 * self.num_nodes)
        return total.reshape(-1, 3), float(np.abs(forces).mean())

    def hessian(self, deformation: Deformation, project: bool = False) -> np.ndarray:
        """Second derivative of each element's energy as its 78 upper entries [78 E], entry by entry.

        Args:
            deformation: the deformation at the positions in question.
            project: replace the negative eigenvalues of d2 psi / dF2 by zero in each element.

        Raises:
            numpy.linalg.LinAlgError: the eigenvalues of an element are smaller than the rounding errors (`stiffness`).
        """
        J = deformation.J
        law = self.material
        arguments = self.gradients, self.volume, law.mu, law.pressure_factor(J), law.lam * J * J
        return stiffness(deformation.F, *arguments, project).ravel()

    def entries(self) -> tuple[Entries]:
        """Of `hessian`."""
        return (Entries(self._nodes, *np.triu_indices(3 * len(self._nodes))),)

    def cauchy(self, deformation: Deformation) -> np.ndarray:
        """True stress of each element [3,3,E] in pascal."""
        return self.material.cauchy(deformation.F, deformation.J)

    def von_mises(self, deformation: Deformation, location: str) -> np.ndarray:
        """Von Mises stress in pascal at `location`: "node" [N] (the mean of the elements around) or "element" [E]."""
        stress = von_mises(self.cauchy(deformation))
        return self.nodal_mean(stress) if location == "node" else stress

    def nodal_mean(self, element_values: np.ndarray) -> np.ndarray:
        """Mean [N] of the values [E] of the elements around each node, weighted by volume; 0 where there are none."""
        nodes = self._nodes.ravel()
        count = len(self._nodes)
        weight = np.tile(self.element_volume, count)
        total = np.bincount(nodes, np.tile(element_values, count) * weight, minlength=self.num_nodes)
        volume = np.bincount(nodes, weight, minlength=self.num_nodes)
        return np.divide(total, volume, out=np.zeros(self.num_nodes), where=volume > 0)


def upright(deformation: Deformation) -> Deformation:
    """The deformation with no element flatter than `FLATTEST`: F = U S V^T with U and V rotations, S raised to it."""
    bad = np.flatnonzero((deformation.J < FLATTEST) | ~np.isfinite(deformation.J))
    if not len(bad):
        return deformation
    left, stretch, right = np.linalg.svd(np.moveaxis(deformation.F[:, :, bad], 2, 0))
    for rotation, axis in ((left, (slice(None), slice(None), 2)), (right, (slice(None), 2))):
        mirrored = np.linalg.det(rotation) < 0
        rotation[axis] *= np.where(mirrored, -1, 1)[:, None]
    F = deformation.F.copy()
    F[:, :, bad] = np.moveaxis((left * np.maximum(stretch, FLATTEST)[:, None, :]) @ right, 0, 2)
    cofactors = cofactor(F)
    return replace(deformation, F=F, J=determinant(F, cofactors), cofactor=cofactors)


def stiffness(
    F: np.ndarray,
    gradients: np.ndarray,
    volume: np.ndarray,
    mu: float | np.ndarray,
    c: np.ndarray,
    spread: np.ndarray,
    project: bool,
) -> np.ndarray:
    """Second derivative of each element's energy by its nodes, from the P points of E elements.

    With g_a = F^-T grad N_a the block of nodes a, b is the sum over the points of

        K_ab = V [mu (grad N_a . grad N_b) I + spread g_a (x) g_b - c g_b (x) g_a].

    For Ciarlet's law, dP = mu dF + lambda J^2 (F^-T : dF) F^-T - c F^-T dF^T F^-T, so spread is lambda J^2 and c is
    `NeoHookean.pressure_factor`. `csrc/elastic_stiffness.c` has the projection (Smith et al. 2019).

    Args:
        F: [3,3,P] the deformation gradients, P = E for 4 nodes and 4 E for 10: the first points of all elements first.
        gradients: [nodes,3,P] of the shape functions.
        volume, mu, c, spread: [P] of each point.
        project: replace the negative eigenvalues of the bracket, as a function of F, by zero at each point.

    Returns:
        [entries,E] the upper triangle, row by row; row 3 a + i is component i of node a.

    Raises:
        numpy.linalg.LinAlgError: to project, one stretch of an element is 7e7 times another, or not finite.
    """
    rows = 3 * len(gradients)
    num_elements = len(volume) if len(gradients) == 4 else len(volume) // 4
    entries = np.empty((rows * (rows + 1) // 2, num_elements))
    of_points = (np.broadcast_to(one, len(volume)) for one in (volume, mu, c, spread))
    arrays = map(np.ascontiguousarray, (F, gradients, *of_points))
    if not _C.elastic_stiffness(entries, *arrays, project):
        raise np.linalg.LinAlgError("one stretch of an element is 7e7 times another, or not finite")
    return entries

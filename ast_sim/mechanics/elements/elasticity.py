"""Linear tetrahedra (P1): energy, forces and stiffness of an elastic body in double precision.

With N_a the shape functions and x_a the positions of a tetrahedron's four nodes, F = sum_a x_a grad N_a is constant in
the tetrahedron. Everything that depends on the rest shape alone is computed once: gradients, volumes, and where an
entry of an element's stiffness lands in the global matrix. Legend: N nodes, E elements; component-first arrays as in
`material.py`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ast_sim.mechanics.elements.neo_hookean import NeoHookean, cofactor, determinant, von_mises
from ast_sim.mechanics.linear_algebra.sparsity import Entries
from ast_sim.support.errors import SimulationError

# The 78 entries (p, q), p <= q, of an element's symmetric 12 x 12 stiffness; p = 3 a + i for component i of node a.
_ROW, _COLUMN = np.triu_indices(12)
_ENTRY = np.zeros((12, 12), int)
_ENTRY[_ROW, _COLUMN] = _ENTRY[_COLUMN, _ROW] = np.arange(len(_ROW))
# Entry of the pair with the two nodes exchanged and the components kept: (a i, b j) -> (b i, a j).
_SWAPPED = _ENTRY[3 * (_COLUMN // 3) + _ROW % 3, 3 * (_ROW // 3) + _COLUMN % 3]
SWEEPS = 12  # of rotations, at most
VANISHING = np.errstate(under="ignore")  # products of numbers near zero are zero, whatever a program wants to be told


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
        dot = np.einsum("aje,bje->abe", self.gradients, self.gradients)
        same_component = _ROW % 3 == _COLUMN % 3
        self._constant = material.mu * self.volume * dot[_ROW // 3, _COLUMN // 3] * same_component[:, None]  # [78, E]

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

        With g_a = F^-T grad N_a the block of nodes a, b is

            K_ab = V [mu (grad N_a . grad N_b) I + lambda J^2 g_a (x) g_b - c g_b (x) g_a],  c = lambda/2 (J^2 - 1) - mu

        (from dP = mu dF + lambda J^2 (F^-T : dF) F^-T - c F^-T dF^T F^-T).

        Args:
            deformation: the deformation at the positions in question.
            project: replace the negative eigenvalues of d2 psi / dF2 by zero in each element.
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
        if project:
            self._lift(entries, deformation)
        return entries.ravel()

    def entries(self) -> tuple[Entries]:
        """Of `hessian`."""
        return (Entries(self._nodes, _ROW, _COLUMN),)

    @VANISHING
    def _lift(self, entries: np.ndarray, deformation: Deformation) -> None:
        """Add to the entries [78,E] of each element what makes the negative eigenvalues of d2 psi / dF2 zero."""
        material, J = self.material, deformation.J
        arguments = material.mu, material.pressure_factor(J), material.lam * J * J
        for elements, direction, value in negative_directions(deformation, *arguments, self.gradients):
            b = direction.reshape(12, -1)
            # Of all elements: to pick the elements that have any takes twice as long.
            whole = np.zeros((12, entries.shape[1]))
            whole[:, elements] = b * np.sqrt(value * self.volume[elements])
            first = 0
            for row in range(12):
                entries[first : first + 12 - row] += whole[row] * whole[row:]
                first += 12 - row

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


def negative_directions(
    deformation: Deformation, mu: float | np.ndarray, c: np.ndarray, spread: np.ndarray, gradients: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Where the second derivative of an energy by F has negative eigenvalues.

    The derivative is mu I + spread F^-T (x) F^-T - c (dF -> F^-T dF^T F^-T). With F = sum_i s_i u_i v_i^T, its
    eigenvectors are of two kinds (Smith et al. 2019). For each axis k the other two, i and j, have the twist
    u_i v_j^T - u_j v_i^T with the eigenvalue mu + c s_k / J, and the flip u_i v_j^T + u_j v_i^T with mu - c s_k / J. At
    most one of them is negative. The other three are sum_i w_i u_i v_i^T, with w an eigenvector of

        A_ij = delta_ij (mu - c / s_i^2) + spread / (s_i s_j),

    which has no negative eigenvalue unless c is positive or spread is negative.

    Args:
        mu, c, spread: of each of the E deformations. For Ciarlet's law, c is `pressure_factor` and spread lambda J^2.
        gradients: [a,3,E] of the shape functions.

    Yields:
        Numbers [n] of deformations, an eigenvector as the change of F with the nodes, [a,3,n], and minus its eigenvalue
        [n], with which it is to be added times itself: twists and flips have the length sqrt(2), so theirs is halved.

    Raises:
        numpy.linalg.LinAlgError: an element is longer than flat by more than 1e7, or its deformation is not finite.
    """
    J = deformation.J
    squares, right = eigenvectors(np.einsum("kie,kje->ije", deformation.F, deformation.F))
    if (squares.min(axis=0) <= np.finfo(float).eps * squares.max(axis=0)).any():
        raise np.linalg.LinAlgError("an element is so flat that its stretch is lost in rounding")
    stretch = np.sqrt(squares)
    left = np.einsum("ije,kje->kie", deformation.F, right) / stretch[:, None]
    across = np.einsum("aje,kje->kae", gradients, right)  # v_k . grad N_a
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        value = mu - np.abs(c) * stretch[k] / J
        below = np.flatnonzero(value < 0)
        one, other = (across[x][:, None, below] * left[y][None, :, below] for x, y in ((j, i), (i, j)))
        yield below, one + np.sign(c[below]) * other, -value[below] / 2
    widened = np.flatnonzero((c > 0) | (spread < 0))
    inverse = 1 / stretch[:, widened]
    A = spread[widened] * inverse[:, None] * inverse[None]
    A[range(3), range(3)] += np.broadcast_to(mu, J.shape)[widened] - c[widened] * inverse * inverse
    for value, weight in zip(*eigenvectors(A), strict=True):
        below = np.flatnonzero(value < 0)
        chosen = widened[below]
        yield (
            chosen,
            np.einsum("ke,kae,kie->aie", weight[:, below], across[:, :, chosen], left[:, :, chosen]),
            -value[below],
        )


@VANISHING
def eigenvectors(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues [3,E], in no order, and eigenvectors [axis,3,E] of symmetric matrices [3,3,E].

    By Jacobi's rotations of all matrices at once, which take half the time of LAPACK, matrix by matrix. They converge
    quadratically: four or five sweeps.

    Raises:
        numpy.linalg.LinAlgError: a number is not finite.
    """
    if not np.isfinite(matrices).all():
        raise np.linalg.LinAlgError("a matrix without finite numbers has no eigenvalues")
    diagonal = [matrices[i, i].copy() for i in range(3)]
    beside = [matrices[1, 2].copy(), matrices[0, 2].copy(), matrices[0, 1].copy()]  # by the third axis
    vectors = [np.broadcast_to(axis[:, None], matrices.shape[1:]) for axis in np.eye(3)]
    rounding = np.finfo(float).eps * np.abs(matrices).max(axis=(0, 1), initial=0)
    for _ in range(SWEEPS):
        if all((np.abs(one) <= rounding).all() for one in beside):
            break
        for p, q, r in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
            half = (diagonal[q] - diagonal[p]) / 2
            length = np.abs(half) + np.sqrt(half * half + beside[r] * beside[r])
            tangent = np.copysign(beside[r], beside[r] * half) / np.maximum(length, np.finfo(float).tiny)
            cosine = 1 / np.sqrt(1 + tangent * tangent)
            sine = tangent * cosine
            diagonal[p] -= tangent * beside[r]
            diagonal[q] += tangent * beside[r]
            beside[r] = np.zeros_like(cosine)
            beside[q], beside[p] = cosine * beside[q] - sine * beside[p], sine * beside[q] + cosine * beside[p]
            vectors[p], vectors[q] = cosine * vectors[p] - sine * vectors[q], sine * vectors[p] + cosine * vectors[q]
    return np.stack(diagonal), np.stack(vectors)

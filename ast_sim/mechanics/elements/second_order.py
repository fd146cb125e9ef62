"""Second-order tetrahedra (P2): they bend as they should, and rubber does not lock in them.

Positions are quadratic in a tetrahedron of ten nodes: four corners, then the middles of its edges (`scene.MIDDLES`),
which may be curved. Forces are integrated at Gauss's four points, as in the element C3D10 of CalculiX and Abaqus. There
are as many points as corners. So if each point kept its volume, rubber would have about as many constraints as
unknowns, and be too stiff. The points therefore count lambda up to `LARGEST` mu only. The rest acts on the mean
dilatation of the element (Simo, Taylor and Pister 1985): the energy of an element is

    sum_p w_p psi(F_p) + V (lambda - lambda') U(Jm),   U(J) = 1/4 (J^2 - 1) - 1/2 ln J,   Jm = sum_p w_p J_p / V,

with Ciarlet's psi of mu and lambda' = min(lambda, LARGEST mu), the weights w_p and the rest volume V = sum_p w_p. Up to
Poisson's ratio 0.476 nothing is left for the mean, and the element is C3D10. With the mean alone, LARGEST = 0, flat
pads are 10 to 30 % too soft on coarse meshes (docs/log.md, 2026-11-26).
"""

from __future__ import annotations

import numpy as np

from ast_sim.element_topology import MIDDLES, POINTS, SLOPES, turned_over
from ast_sim.mechanics.elements.elasticity import Deformation, Elasticity, stiffness
from ast_sim.mechanics.elements.neo_hookean import NeoHookean, cofactor, determinant, von_mises
from ast_sim.plausibility.topology import folds
from ast_sim.scene import Scene
from ast_sim.support.errors import SimulationError

LARGEST = 20.0


def shape_functions(weights: np.ndarray) -> np.ndarray:
    """[n, 10] the shape functions at barycentric coordinates [n, 4]."""
    corners = weights * (2 * weights - 1)
    middles = [4 * weights[:, a] * weights[:, b] for a, b in MIDDLES]
    return np.concatenate([corners, np.stack(middles, axis=1)], axis=1)


def _extrapolation() -> np.ndarray:
    """[10, 4] values at the nodes of the linear function with given values at the points."""
    at_corners = np.linalg.inv(POINTS)
    return np.concatenate([at_corners, [(at_corners[a] + at_corners[b]) / 2 for a, b in MIDDLES]])


_EXTRAPOLATION = _extrapolation()


def points_at_rest(rest: np.ndarray, elements: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rest volume [4, E] of each point, and the gradients [10, 3, 4, E] of the shape functions there.

    A volume that is not positive belongs to an element that is turned over there; its gradients have no meaning.
    """
    x = rest.T[:, elements.T]  # [3, 10, E]
    volumes = []
    gradients = []
    for slopes in SLOPES:
        jacobian = np.einsum("iae,ak->ike", x, slopes)
        cofactors = cofactor(jacobian)
        six_volumes = determinant(jacobian, cofactors)
        volumes.append(six_volumes / 24)
        with np.errstate(divide="ignore", invalid="ignore"):
            gradients.append(np.einsum("ak,ike->aie", slopes, cofactors / six_volumes))
    return np.stack(volumes), np.stack(gradients, axis=2)


class SecondOrder(Elasticity):
    """Elastic body of tetrahedra `elements` [E,10] with rest positions [N,3]; as `Elasticity` otherwise.

    It has deformations at the P = 4 E points: the first points of all elements, then the second ones, ...

    Raises:
        SimulationError: an element is turned over at rest at one of its points.
    """

    def __init__(self, rest: np.ndarray, elements: np.ndarray, material: NeoHookean) -> None:
        self.elements = elements
        self.num_nodes = len(rest)
        self._count = len(elements)
        self._nodes = np.ascontiguousarray(elements.T)
        self._dofs = (3 * self._nodes[:, None, :] + np.arange(3)[None, :, None]).reshape(30, -1)
        volume, gradients = points_at_rest(rest, elements)
        if (volume <= 0).any():
            worst = int(np.argmin(volume.min(axis=0)))
            raise SimulationError(
                f"element {worst} is turned over at rest: a quarter of it has the volume"
                f" {volume[:, worst].min():.3g}, must be positive"
            )
        self.volume = volume.ravel()
        self.gradients = gradients.reshape(10, 3, -1)  # [P], [10, 3, P]
        self._element_volume = volume.sum(axis=0)
        lam, mu = (np.broadcast_to(value, self._count) for value in (material.lam, material.mu))
        at_points = np.minimum(lam, LARGEST * mu)
        self._mean_lam = lam - at_points  # [E], what is left for the mean dilatation
        self.material = NeoHookean.of_lame(np.tile(at_points, 4), np.tile(mu, 4))

    @property
    def element_volume(self) -> np.ndarray:
        return self._element_volume

    def _summed(self, values: np.ndarray) -> np.ndarray:
        """[..., E] the sums of values [..., P] over the points of each element."""
        return values.reshape(*values.shape[:-1], 4, self._count).sum(axis=-2)

    def lumped_volume(self) -> np.ndarray:
        """[N] volume around each node: a tenth of the volume of each element around it."""
        return np.bincount(self._nodes.ravel(), np.tile(self._element_volume / 10, 10), minlength=self.num_nodes)

    def evaluate(self, position: np.ndarray) -> Deformation:
        """F, J, cofactors at the points, and energy, at positions [N,3]."""
        gradients = self.gradients.reshape(10, 3, 4, -1)
        F = np.einsum("iae,ajpe->ijpe", position.T[:, self._nodes], gradients).reshape(3, 3, -1)
        cofactors = cofactor(F)
        J = determinant(F, cofactors)
        energy = np.inf
        if J.min() > 0:
            mean = self._mean_dilatation(J)
            of_mean = self._mean_lam * ((mean * mean - 1) / 4 - np.log(mean) / 2)
            energy = float(self.volume @ self.material.energy_density(F, J) + self._element_volume @ of_mean)
        return Deformation(F, J, cofactors, energy)

    def _mean_dilatation(self, J: np.ndarray) -> np.ndarray:
        """[E] Jm of J [P]."""
        return self._summed(self.volume * J) / self._element_volume

    def _mean_pressure(self, J: np.ndarray) -> np.ndarray:
        """[P] (lambda - lambda') U'(Jm) at the points of each element."""
        mean = self._mean_dilatation(J)
        return np.tile(self._mean_lam / 2 * (mean - 1 / mean), 4)

    def element_forces(self, deformation: Deformation) -> np.ndarray:
        """Derivative of each element's energy by its nodes [30,E], in newton."""
        J = deformation.J
        cofactors = deformation.cofactor
        P = self.material.first_piola(deformation.F, J, cofactors / J) + self._mean_pressure(J) * cofactors
        at_points = np.einsum("ijp,ajp->aip", P * self.volume, self.gradients)
        return self._summed(at_points).reshape(30, -1)

    def hessian(self, deformation: Deformation, project: bool = False) -> np.ndarray:
        """Second derivative of each element's energy as its 465 upper entries [465 E], entry by entry.

        With g_a = F^-T grad N_a, the pressure p of the mean, P = mu F + c F^-T at each point, and
        b_a = sum_p w_p J g_a, the block of nodes a, b is

            K_ab = sum_p w_p [mu (grad N_a . grad N_b) I + (lambda' J^2 + p J) g_a (x) g_b - (c + p J) g_b (x) g_a]
                   + (lambda - lambda') U''(Jm) / V b_a (x) b_b.

        Args:
            deformation: the deformation at the positions in question.
            project: replace the negative eigenvalues of the sum in brackets, as a function of F, by zero at each point.
        """
        J = deformation.J
        material = self.material
        mean = self._mean_dilatation(deformation.J)
        pressure = self._mean_pressure(J) * J
        spread, c = material.lam * J * J + pressure, material.pressure_factor(J) + pressure
        entries = stiffness(deformation.F, self.gradients, self.volume, material.mu, c, spread, project)
        stiff = self._mean_lam * (1 + 1 / (mean * mean)) / 2 / self._element_volume
        if stiff.any():
            by_point = np.einsum("ijp,ajp->aip", deformation.cofactor * self.volume, self.gradients)
            b = self._summed(by_point).reshape(30, -1)
            first = 0
            for row in range(30):
                entries[first : first + 30 - row] += stiff * b[row] * b[row:]
                first += 30 - row
        return entries.ravel()

    def cauchy(self, deformation: Deformation) -> np.ndarray:
        """True stress of each element [3,3,E] in pascal: the mean over its rest volume."""
        return self._summed(self._cauchy_at_points(deformation) * self.volume) / self._element_volume

    def _cauchy_at_points(self, deformation: Deformation) -> np.ndarray:
        """[3,3,P]"""
        stress = self.material.cauchy(deformation.F, deformation.J)
        stress[range(3), range(3)] += self._mean_pressure(deformation.J)
        return stress

    def von_mises(self, deformation: Deformation, location: str) -> np.ndarray:
        """Von Mises stress in pascal at `location`: "node" [N] or "element" [E]. At a node it is the one of the mean
        stress of the elements around it, each continued linearly from its points."""
        if location == "element":
            return von_mises(self.cauchy(deformation))
        at_points = self._cauchy_at_points(deformation).reshape(3, 3, 4, -1)
        at_nodes = np.einsum("ap,ijpe->ijae", _EXTRAPOLATION, at_points) * self._element_volume
        nodes = self._nodes.ravel()
        weight = np.tile(self._element_volume, 10)
        volume = np.bincount(nodes, weight, minlength=self.num_nodes)
        total = [np.bincount(nodes, one.ravel(), minlength=self.num_nodes) for one in at_nodes.reshape(9, -1)]
        mean = np.divide(total, volume, out=np.zeros((9, self.num_nodes)), where=volume > 0)
        return von_mises(mean.reshape(3, 3, -1))


def elastic_body(rest: np.ndarray, elements: np.ndarray, material: NeoHookean) -> Elasticity:
    """The elastic body of tetrahedra [E,k] with k = 4 or 10 nodes and rest positions [N,3]; errors as its class."""
    return (Elasticity if elements.shape[1] == 4 else SecondOrder)(rest, elements, material)


def deforming_body(scene: Scene, rows: np.ndarray, material: NeoHookean) -> Elasticity:
    """The elastic body of the elements `rows` [E] of a scene. Tetrahedra that are numbered inside out are turned over.

    Args:
        material: of all elements of the scene.

    Raises:
        SimulationError: the mesh folds over itself, an element has no volume, or as the class of the body.
    """
    elements = scene.elements[rows].astype(np.int64)
    wrong = scene.rest_volumes[rows] < 0
    if wrong.any():
        for fold in folds(scene):
            raise SimulationError(str(fold))
        elements = turned_over(elements, wrong)
    return elastic_body(scene.rest_position.astype(np.float64), elements, material.of(rows))

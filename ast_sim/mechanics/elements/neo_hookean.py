"""Compressible neo-Hookean material after Ciarlet, in the form of the CalculiX material CIARLET_EL.

Energy per rest volume, with C = F^T F and J = det F:

    psi = mu/2 (tr C - 3) + lambda/4 (J^2 - 1) - (mu + lambda/2) ln J.

It is zero at rest and grows to infinity as J falls to zero, so no element can collapse.

Arrays carry their components first and the E elements last ([3,3,E] for a tensor): every operation then runs along
contiguous memory. Units: pascal and metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ast_sim.material import ELASTIC, Material
from ast_sim.scene import Scene
from ast_sim.support.errors import SimulationError


def cofactor(F: np.ndarray) -> np.ndarray:
    """Cofactor matrices [3,3,E], J F^-T: row i is the cross product of the two other rows of F [3,3,E]."""
    result = np.empty_like(F)
    for i in range(3):
        a, b = F[(i + 1) % 3], F[(i + 2) % 3]
        for j in range(3):
            k, m = (j + 1) % 3, (j + 2) % 3
            result[i, j] = a[k] * b[m] - a[m] * b[k]
    return result


def determinant(F: np.ndarray, cofactors: np.ndarray) -> np.ndarray:
    """Determinants [E] of F [3,3,E] by the first row of their cofactors."""
    return F[0, 0] * cofactors[0, 0] + F[0, 1] * cofactors[0, 1] + F[0, 2] * cofactors[0, 2]


@dataclass(frozen=True, eq=False)
class NeoHookean:
    """Ciarlet's material with Young's modulus `young` in pascal and Poisson's ratio `poisson`: numbers or [E] arrays.

    Raises:
        SimulationError: the constants are not within 0 < young, 0 <= poisson < 1/2.
    """

    young: float | np.ndarray
    poisson: float | np.ndarray

    def __post_init__(self) -> None:
        young, poisson = np.broadcast_arrays(self.young, self.poisson)
        wrong = ~((young > 0) & (poisson >= 0) & (poisson < 0.5))
        if wrong.any():
            raise SimulationError(
                "Young's modulus must be positive and Poisson's ratio in [0, 0.5):"
                f" got {young[wrong].flat[0]}, {poisson[wrong].flat[0]}"
            )

    @classmethod
    def of_scene(cls, scene: Scene, material: Material) -> NeoHookean:
        """The law of each element of a scene. What rigid elements have is ignored: they get constants that are allowed.

        Raises:
            ConfigError: the law of the material is not known.
            SimulationError: the constants of an element that deforms are not allowed.
        """
        material.require_law()
        young, poisson = (material.numbers(name, scene.material) for name in ELASTIC)
        if np.ndim(young) == np.ndim(poisson) == 0:
            return cls(young, poisson)
        return cls(np.where(scene.rigid_elements, 1.0, young), np.where(scene.rigid_elements, 0.0, poisson))

    @classmethod
    def of_lame(cls, lam: float | np.ndarray, mu: float | np.ndarray) -> NeoHookean:
        """The material with these Lame constants."""
        return cls(mu * (3 * lam + 2 * mu) / (lam + mu), lam / (2 * (lam + mu)))

    def of(self, elements: np.ndarray) -> NeoHookean:
        """The material of some of the elements, given by a mask or by their numbers."""
        if np.ndim(self.young) == np.ndim(self.poisson) == 0:
            return self
        count = max(np.size(self.young), np.size(self.poisson))
        young, poisson = (np.broadcast_to(value, count)[elements] for value in (self.young, self.poisson))
        return NeoHookean(young, poisson)

    @property
    def mu(self) -> float | np.ndarray:
        """Shear modulus, the second Lame constant."""
        return self.young / (2 * (1 + self.poisson))

    @property
    def lam(self) -> float | np.ndarray:
        """First Lame constant."""
        return self.young * self.poisson / ((1 + self.poisson) * (1 - 2 * self.poisson))

    def energy_density(self, F: np.ndarray, J: np.ndarray) -> np.ndarray:
        """psi [E] in J/m^3 for F [3,3,E] and its determinants J [E], all positive."""
        trace = np.einsum("ije,ije->e", F, F)
        return self.mu / 2 * (trace - 3) + self.lam / 4 * (J * J - 1) - (self.mu + self.lam / 2) * np.log(J)

    def pressure_factor(self, J: np.ndarray) -> np.ndarray:
        """c [E] in P = mu F + c F^-T: lambda/2 J^2 - (lambda/2 + mu)."""
        return self.lam / 2 * J * J - (self.lam / 2 + self.mu)

    def first_piola(self, F: np.ndarray, J: np.ndarray, inverse_transpose: np.ndarray) -> np.ndarray:
        """P = d psi / d F [3,3,E], force per rest area, for F, J and F^-T."""
        return self.mu * F + self.pressure_factor(J) * inverse_transpose

    def cauchy(self, F: np.ndarray, J: np.ndarray) -> np.ndarray:
        """sigma = [mu (F F^T - I) + lambda/2 (J^2 - 1) I] / J [3,3,E], true stress."""
        stress = self.mu * np.einsum("ike,jke->ije", F, F)
        stress[range(3), range(3)] += self.lam / 2 * (J * J - 1) - self.mu
        return stress / J


def von_mises(stress: np.ndarray) -> np.ndarray:
    """sqrt(3/2 s:s) [E] with s the deviator of the stress [3,3,E]."""
    deviator = stress.copy()
    deviator[range(3), range(3)] -= np.trace(stress) / 3
    return np.sqrt(1.5 * np.einsum("ije,ije->e", deviator, deviator))

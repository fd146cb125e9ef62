"""Inertia of an implicit step as a potential (backward Euler in its variational form).

    psi(x) = sum_i m_i |x_i - y_i|^2 / (2 step^2)

where y are the predicted positions. The minimum of psi plus other potentials is one step of backward Euler.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ast_sim.mechanics.linear_algebra.sparsity import Entries
from ast_sim.mechanics.solver import Potential


@dataclass(frozen=True, eq=False)
class InertialState:
    """The state of the other potential, the offsets from the predicted positions, and the sum of both energies."""

    inner: object
    offset: np.ndarray
    energy: float


class Inertia:
    """The sum of another potential and the potential of inertia.

    Args:
        potential: the other potential.
        mass: [N] in kg; the values of prescribed nodes do not matter.
        step: length of the time step in seconds.

    Attributes:
        predicted: [N,3] where each node would go without the other potential. Set it before each step.
        weight: [N] mass divided by the square of the step.
    """

    def __init__(self, potential: Potential, mass: np.ndarray, step: float) -> None:
        self.potential = potential
        self.predicted = np.zeros((len(mass), 3))
        self.weight = mass / step**2

    def evaluate(self, position: np.ndarray) -> InertialState:
        """See `Potential`."""
        inner = self.potential.evaluate(position)
        offset = position - self.predicted
        energy = 0.5 * float(self.weight @ np.einsum("ij,ij->i", offset, offset))
        return InertialState(inner, offset, inner.energy + energy)

    def gradient(self, state: InertialState) -> tuple[np.ndarray, float]:
        """See `Potential`."""
        gradient, scale = self.potential.gradient(state.inner)
        return gradient + self.weight[:, None] * state.offset, scale

    def hessian(self, state: InertialState, project: bool = False) -> np.ndarray:
        """See `Potential`."""
        return np.concatenate([self.potential.hessian(state.inner, project), np.tile(self.weight, 3)])

    def entries(self) -> tuple[Entries, ...]:
        """See `Potential`."""
        nodes = np.arange(len(self.weight))[None]
        return (*self.potential.entries(), Entries(nodes, np.arange(3), np.arange(3)))

    @property
    def unit_force(self) -> float:
        """See `Potential`."""
        return self.potential.unit_force

    @property
    def unit_energy(self) -> float:
        """See `Potential`."""
        return self.potential.unit_energy

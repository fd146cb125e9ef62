"""An energy of the positions, with two derivatives. The solver minimises its sum with the energy of contact."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np


class Potential(Protocol):
    """An energy of the positions [N,3] of all nodes, in joule. A state is what `evaluate` returns.

    Every state has `energy`. It is infinite where the positions are impossible (an inverted element).
    """

    @property
    def unit_force(self) -> float:
        """A nodal force in newton under a strain of order one. It is the scale for the rounding of forces."""

    @property
    def unit_energy(self) -> float:
        """An energy in joule under a strain of order one. Energies that differ by its rounding count as equal."""

    def evaluate(self, position: np.ndarray) -> Any:
        """The state at positions [N,3]."""

    def gradient(self, state: Any) -> tuple[np.ndarray, float]:
        """Derivative by the positions [N,3], in newton; and the mean magnitude of the forces of an element."""

    def hessian(self, state: Any, project: bool = False) -> np.ndarray:
        """Values [P] of the second derivative's entries at `entry_dofs`. Several values may belong to one place.

        Args:
            project: make the contribution of each element positive semi-definite.
        """

    def entry_dofs(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns [P] of the entries (3 node + component). An entry (r, c) stands for (c, r), too."""

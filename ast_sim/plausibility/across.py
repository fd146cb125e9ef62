"""What looks wrong between the simulations of a dataset: one that stands in it twice, one in another unit of length or
of stress, one with its axes in another order."""

from __future__ import annotations

import hashlib

import numpy as np

from ast_sim.plausibility.axes import Axes, axes, other_order
from ast_sim.plausibility.findings import Finding
from ast_sim.plausibility.motion import in_trajectory
from ast_sim.plausibility.units import Moduli, Stiffness, moduli, other_moduli, other_stress, stiffness
from ast_sim.scene import Trajectory

# Sizes of scenes that differ by more than this tell of two units, such as mm and m.
_UNITS = 100.0


class AcrossSimulations:
    """Looks at the simulations of a dataset, and compares them; `dynamic`: whether bodies have inertia."""

    def __init__(self, dynamic: bool) -> None:
        self.dynamic = dynamic
        self.names: dict[bytes, str] = {}  # by a digest of the frames
        self.first: tuple[str, float] | None = None  # the name and the size of the first scene
        self.stiffness: list[tuple[str, Stiffness]] = []
        self.moduli: list[tuple[str, Moduli]] = []
        self.axes: list[tuple[str, Axes]] = []

    def look(self, name: str, trajectory: Trajectory) -> list[Finding]:
        """What looks wrong in a simulation, alone and beside the ones before."""
        return [*in_trajectory(trajectory, self.dynamic), *self.beside(name, trajectory)]

    def beside(self, name: str, trajectory: Trajectory) -> list[Finding]:
        """What looks wrong in a simulation beside the ones before."""
        stiff = stiffness(trajectory)
        self.stiffness += [] if stiff is None else [(name, stiff)]
        self.moduli.append((name, moduli(trajectory)))
        self.axes.append((name, axes(trajectory)))
        return [*self._repeats(name, trajectory), *self._other_unit(name, trajectory)]

    def all_together(self) -> list[tuple[str, Finding]]:
        """What looks wrong in some simulations beside all others, by name; after the last look."""
        stresses = other_stress(self.stiffness)
        told = {name for name, _ in stresses}
        units = [(name, one) for name, one in other_moduli(self.moduli) if name not in told]
        return [*stresses, *units, *other_order(self.axes)]

    def _repeats(self, name: str, trajectory: Trajectory) -> list[Finding]:
        content = hashlib.sha256(np.ascontiguousarray(trajectory.scene.elements).data)
        content.update(np.ascontiguousarray(trajectory.position).data)
        for more in (trajectory.scene.material, trajectory.stress):
            content.update(b"" if more is None else np.ascontiguousarray(more).data)
        other = self.names.setdefault(content.digest(), name)
        if other == name:
            return []
        meaning = "errors are measured too small where one is in the training and one in the tests: leave one out"
        return [Finding("simulations that stand in the data twice", 1, f"as {other}", meaning)]

    def _other_unit(self, name: str, trajectory: Trajectory) -> list[Finding]:
        size = float(np.ptp(trajectory.scene.rest_position, axis=0).max())
        first, usual = self.first = self.first or (name, size)
        if usual == 0 or size == 0 or 1 / _UNITS < size / usual < _UNITS:
            return []
        meaning = f"{first} has the size {usual:.3g}: are all in one unit of length?"
        return [Finding("simulations of another size", 1, f"size {size:.3g}", meaning)]

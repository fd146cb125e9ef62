"""What is kept of the frames of a simulation while they are read."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ast_sim.importers.order_of_files.doubts import APART


@dataclass(eq=False)
class KeptFrames:
    """What is kept of each frame: points [n, 3] of the file, displacements [n, 3], stress of its points or cells, its
    time."""

    points: list[np.ndarray] = field(default_factory=list)
    displacements: list[np.ndarray | None] = field(default_factory=list)
    stresses: list[np.ndarray] = field(default_factory=list)
    times: list[float | None] = field(default_factory=list)

    def reorder(self, order: list[int]) -> None:
        for name, values in vars(self).items():
            setattr(self, name, [values[index] for index in order] if values else [])

    def ascending_times(self) -> tuple[float, ...] | None:
        """The times of the frames; None if they are not known or do not ascend."""
        known = [time for time in self.times if time is not None]
        whole = len(known) == len(self.times) > 1 and np.isfinite(known).all() and (np.diff(known) > 0).all()
        return tuple(known) if whole else None

    def without_times(self) -> list[str]:
        """A note if nothing says when each frame is: no time, or the same for several."""
        if len(self.times) < 2 or self.ascending_times() is not None:
            return []
        return [f"no times tell the {len(self.times):,} frames apart: they count 0, 1, 2, ..."]

    def doubts_of_end(self) -> list[str]:
        """A note if the last frame holds zeros alone, though others do not: a run that is stopped while it writes may
        leave them."""
        held = [one for one in self.displacements if one is not None]
        if len(held) < 3 or len(held) < len(self.displacements) or held[-1].any() or not held[-2].any():
            return []
        if self.stresses and self.stresses[-1].any():
            return []
        return ["in the last frame all displacements are 0 again: was the run stopped while it wrote this frame?"]

    def doubts(self) -> list[str]:
        """A note if the times of all frames are known and do not ascend, or ascend by rounding alone."""
        if None in self.times or len(self.times) < 2:
            return []
        known = self.ascending_times()
        if known is not None:
            near = np.flatnonzero(np.diff(known) < APART * np.ptp(known))
            named = ", ".join(str(frame) for frame in near[:3].tolist())
            return [f"the times of frames {named} and the next differ by rounding alone: is one off?"] if named else []
        listed = ", ".join(f"{time:g}" for time in self.times[:6]) + (", ..." if len(self.times) > 6 else "")
        return [f"the times of the frames do not ascend ({listed}): the frames stand as in the file, without times"]

"""The course of the prescribed nodes between the frames of a motion, as a function of time.

Frames say where nodes are, not how they get there: a turn of 270 degrees from one frame to the next ends where a turn
of -90 degrees ends, and a tool that goes down and comes back between two frames seems to stand still. A course knows
both. Load steps follow its legs. Times are counted in frames of the whole motion: 0 is its start, R - 1 its end.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from ast_sim.prescribed_motion import ROUNDING, RigidMotion

# The largest turn of nodes in a leg, in degrees: a load step takes them along the chord of their arc.
LARGEST_TURN = 30.0


@dataclass(frozen=True, eq=False)
class Leg:
    """A part of a course that load steps follow.

    Attributes:
        end: [N,3] float64, where the prescribed nodes are at its end.
        along: where they are at a share in [0, 1] of the leg; None: on straight lines from where they were.
    """

    end: np.ndarray
    along: Callable[[float], np.ndarray] | None = None


@dataclass(frozen=True, eq=False)
class MovedNodes:
    """Nodes that one rigid motion moves.

    Attributes:
        nodes: [n] their numbers.
        start: [n,3] float64, where they stand undeformed, relative to `origin`.
        motion: the motion, in coordinates that are not relative to `origin`.
        origin: [3] float64.
        name: what moves them, for messages.
    """

    nodes: np.ndarray
    start: np.ndarray
    motion: RigidMotion
    origin: np.ndarray
    name: str

    def at(self, s: float) -> np.ndarray:
        """[n,3] float64: where they are at `s` in [0, 1]."""
        return self.motion.at(s, self.start + self.origin) - self.origin


@dataclass(frozen=True, eq=False)
class Course:
    """How prescribed nodes move through a motion of R frames, some of which are stored.

    Attributes:
        position: [R,N,3] float64, where the prescribed nodes are in each frame; rows of other nodes are not read.
        prescribed: [N] bool.
        moved: the rigid motions of all nodes that move. Empty: they are known in the frames only, and go straight from
            one to the next.
        frames: the frames that are stored, by their numbers in the whole motion; the first is 0.
    """

    position: np.ndarray
    prescribed: np.ndarray
    moved: tuple[MovedNodes, ...] = ()
    frames: tuple[int, ...] = field(default=())

    def __post_init__(self) -> None:
        if not self.frames:
            object.__setattr__(self, "frames", tuple(range(len(self.position))))

    @classmethod
    def of(cls, rest: np.ndarray, prescribed: np.ndarray, moved: tuple[MovedNodes, ...], frames: int) -> Course:
        """The course of nodes at `rest` [N,3] float64 that these motions move through `frames` frames."""
        position = np.repeat(rest[None], frames, axis=0)
        for group in moved:
            for frame in range(1, frames):
                position[frame, group.nodes] = group.at(frame / (frames - 1))
        return cls(position, prescribed, moved)

    def storing(self, frames: tuple[int, ...]) -> Course:
        """The same course, of which only these frames are stored; 0 is the first."""
        return replace(self, frames=frames)

    def legs(self, frame: int) -> list[Leg]:
        """The legs from one stored frame to the next one, the `frame`-th. They end wherever a node turns back or turns
        off, and after `LARGEST_TURN` degrees of a rotation."""
        stops = [*self._stops(*self.frames[frame - 1 : frame + 1]), float(self.frames[frame])]
        start = float(self.frames[frame - 1])
        legs = []
        for stop in stops:
            legs += self._cut(start, stop)
            start = stop
        return legs

    def straight(self, frame: int) -> list[Leg]:
        """The legs from the start to the `frame`-th stored frame if nodes need not go where the frames between are.
        They end after `LARGEST_TURN` degrees of a rotation only."""
        return self._cut(0.0, float(self.frames[frame]))

    def direct(self, frame: int) -> Leg:
        """The same as one leg, whatever its rotation."""
        return self._leg(0.0, float(self.frames[frame]))

    def at(self, time: float) -> np.ndarray:
        """[N,3] float64: where the prescribed nodes are at a time from 0 to R - 1."""
        row = min(int(time), len(self.position) - 2)
        if time == int(time):
            return self.position[int(time)]
        result = self.position[row] + (time - row) * (self.position[row + 1] - self.position[row])
        for group in self.moved:
            result[group.nodes] = group.at(time / (len(self.position) - 1))
        return result

    def notes(self) -> Iterator[str]:
        """What the stored frames do not show of the motion, a sentence each.

        A node of which only frames are known turns back where it goes towards the place where it turned back last.
        """
        for group in self.moved:
            yield from group.motion.notes(group.name, self.frames, self._last)
        if not self.moved:
            pairs = zip(self.frames, self.frames[1:], strict=False)
            stops = [f"{time:g}" for pair in pairs for time in self._stops(*pair)]
            if stops:
                yield f"nodes turn back in frame {', '.join(stops)} of the motion: solved, but not stored"

    @property
    def _last(self) -> int:
        return len(self.position) - 1

    def _corners(self, motion: RigidMotion) -> list[float]:
        return [self._last * s for s in motion.corners()]

    def _stops(self, first: int, last: int) -> list[float]:
        """The times between two frames at which a load step must end."""
        if self.moved:
            corners = {corner for group in self.moved for corner in self._corners(group.motion)}
            return sorted(time for time in corners if first + ROUNDING < time < last - ROUNDING)
        stops = []
        stop = self.position[first, self.prescribed]
        for row in range(first + 1, last):
            here, ahead = self.position[row : row + 2, self.prescribed]
            from_stop, step = here - stop, ahead - here
            lengths = np.linalg.norm(from_stop, axis=1) * np.linalg.norm(step, axis=1)
            if (np.einsum("ni,ni->n", from_stop, step) < -ROUNDING * lengths).any():
                stops.append(float(row))
                stop = here
        return stops

    def _cut(self, start: float, end: float) -> list[Leg]:
        """The legs between two times, of equal length, each of at most `LARGEST_TURN` degrees."""
        turn = max((abs(group.motion.rotation) for group in self.moved), default=0.0) * (end - start) / self._last
        count = max(1, math.ceil(turn / LARGEST_TURN * (1 - ROUNDING)))
        times = [start + (end - start) * i / count for i in range(count)] + [end]
        return [self._leg(*pair) for pair in zip(times, times[1:], strict=False)]

    def _leg(self, start: float, end: float) -> Leg:
        begin, finish = self.at(start), self.at(end)
        turning = [group for group in self.moved if group.motion.rotation]
        if not turning:
            return Leg(finish)

        def along(share: float) -> np.ndarray:
            result = begin + share * (finish - begin)
            for group in turning:
                result[group.nodes] = group.at((start + share * (end - start)) / self._last)
            return result

        return Leg(finish, along)

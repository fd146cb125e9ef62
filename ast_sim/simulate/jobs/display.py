"""Progress of scenes that are solved: each of them takes long, too."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Self

from ast_sim.support.progress import SECONDS_BETWEEN_LINES, Progress, duration

SECONDS_OF_SILENCE = 30.0  # after this time without a line, unfinished scenes report how far they are
MOST_INSIDE = 8  # at most this many scenes report at once


@dataclass
class Inside:
    """How far one scene is. An earlier run may have made the first frames; they took no time in this run."""

    started: float
    first: int | None = None
    frame: int = 0
    frames: int = 0
    iterations: int = 0

    def text(self, now: float) -> str:
        """Frames, Newton iterations, time so far, and time to go. The mean time of a frame so far predicts the time to
        go.
        """
        elapsed = now - self.started
        if self.first is None:
            return f"{duration(elapsed)} so far"
        text = f"frame {self.frame} of {self.frames}, {self.iterations} iterations, {duration(elapsed)} so far"
        if self.frame > self.first:
            text += f", about {duration(elapsed * (self.frames - self.frame) / (self.frame - self.first))} to go"
        return text


class SceneProgress(Progress):
    """Counts scenes, and tells how far the unfinished scenes are that have run longest."""

    def __enter__(self) -> Self:
        super().__enter__()
        self._inside: dict[str, Inside] = {}
        if self.shown and self._bar is None and self.done:
            self.print(f"{self.done} of {self.total} {self.unit} are there already")
        return self

    def begin(self, name: str) -> None:
        """A scene begins."""
        self._inside[name] = Inside(time.monotonic())

    def inside(self, name: str, frame: int, frames: int, iterations: int) -> None:
        """A scene has `frame` of `frames` frames after `iterations` Newton iterations."""
        scene = self._inside.setdefault(name, Inside(time.monotonic()))
        scene.first = frame if scene.first is None else scene.first
        scene.frame = frame
        scene.frames = frames
        scene.iterations = iterations

    def end(self, name: str) -> None:
        """A scene is done, or has failed."""
        self._inside.pop(name, None)

    def tick(self) -> None:
        """Show how far the scenes are; a terminal shows only the one that has run longest. Call this about once a
        second."""
        if not self.shown:
            return
        now = time.monotonic()
        longest = sorted(self._inside.items(), key=lambda item: item[1].started)[:MOST_INSIDE]
        if self._bar is None:
            if longest and now - self._last_line >= SECONDS_OF_SILENCE:
                self._last_line = now
                for name, scene in longest:
                    self.print(f"{name}: {scene.text(now)}")
        elif longest and now - longest[0][1].started >= SECONDS_BETWEEN_LINES:
            self._bar.set_postfix_str(f"{longest[0][0]}: {longest[0][1].text(now)}")
        else:
            self._bar.set_postfix_str("")

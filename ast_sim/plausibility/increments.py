"""Displacements that are counted from the frame before, where they must be counted from rest.

Then a tool that moves evenly jumps once, by the way of one frame, and stands there in most frames that follow, while
what it presses goes on moving. Tools that turn, or whose speed changes all the time, are not told, and neither is a
motion to which all nodes answer in proportion.
"""

from __future__ import annotations

import numpy as np

from ast_sim.plausibility.findings import Finding, places
from ast_sim.scene import Scene

_LEAST_FRAMES = 5
_JUMP = 0.05  # of the largest displacement of free nodes: the jump has at least this
_STANDS = 0.05  # of the first jump: prescribed nodes that move by less from frame to frame stand still
_MOST = 0.75  # of the frames after the jump: in as many, prescribed nodes stand still
_GOES_ON = 0.1  # of the largest displacement of free nodes: they move by more while prescribed nodes stand still


def counted_from_frame_before(scene: Scene, position: np.ndarray) -> list[Finding]:
    """Frames [S, N, 3] in which free nodes move on while prescribed nodes stand still after their first jump."""
    tools, free = (np.flatnonzero(mask) for mask in (scene.prescribed, ~scene.prescribed))
    if len(position) < _LEAST_FRAMES or not len(tools) or not len(free):
        return []
    moved = np.concatenate([scene.rest_position[None], position]).astype(np.float64) - scene.rest_position
    if not moved[1].any():
        moved = moved[1:]  # the first frame is at rest
    jump, *steps = _size(np.diff(moved[:, tools], axis=0))
    on = _size(np.diff(moved[:, free], axis=0))[1:]
    stands = np.array(steps) <= _STANDS * jump
    largest = _size(moved[:, free]).max()
    way = on[stands].sum()
    if jump <= _JUMP * largest or stands.mean() < _MOST or way <= _GOES_ON * largest:
        return []
    frames = np.flatnonzero(stands & (on > 0)) + len(position) - len(on)
    meaning = (
        f"prescribed nodes jump once and then stand still, but others go on moving, by {way:.3g}: is the displacement"
        " counted from the frame before? It must be counted from rest: add the frames up. Else loads or creep move"
        " them, which no scene has"
    )
    return [Finding("frames in which only free nodes move", len(frames), places("frames", frames), meaning)]


def _size(vectors: np.ndarray) -> np.ndarray:
    """[frames] the root mean square of the lengths of vectors [frames, nodes, 3]."""
    return np.sqrt((vectors**2).sum(axis=2).mean(axis=1))

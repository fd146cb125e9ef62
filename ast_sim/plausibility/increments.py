"""Displacements that are counted from the frame before, where they must be counted from rest.

Two signs tell, each by itself. A tool that moves evenly jumps once, by the way of one frame, and stands there in most
frames that follow, while what it presses goes on moving. Prescribed nodes that turn together change their shape, and do
not if the frames are added up.

Tools that go straight on with a speed that changes all the time are not told, and neither is a motion to which all
nodes answer in proportion.
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

# Edges between prescribed nodes change by more than this share of the longest one; and by less than this share of the
# change if the frames are added up.
_CHANGED = 1e-3
_KEPT = 0.1

_ADD_UP = "is the displacement counted from the frame before? It must be counted from rest: add the frames up"


def counted_from_frame_before(scene: Scene, position: np.ndarray) -> list[Finding]:
    """A sign in the frames [S, N, 3] that displacements are counted from the frame before."""
    moved = position.astype(np.float64) - scene.rest_position
    if len(moved) < _LEAST_FRAMES or not scene.prescribed.any() or scene.prescribed.all():
        return []
    return _stands_still(scene, moved) or _turns(scene, moved)


def _stands_still(scene: Scene, moved: np.ndarray) -> list[Finding]:
    """Frames in which free nodes move on while prescribed nodes stand still after their first jump."""
    frames_before = len(moved)
    moved = moved[1:] if not moved[0].any() else moved  # the first frame is at rest
    moved = np.concatenate([np.zeros_like(moved[:1]), moved])
    jump, *steps = _size(np.diff(moved[:, scene.prescribed], axis=0))
    on = _size(np.diff(moved[:, ~scene.prescribed], axis=0))[1:]
    stands = np.array(steps) <= _STANDS * jump
    largest = _size(moved[:, ~scene.prescribed]).max()
    travel = on[stands].sum()
    if jump <= _JUMP * largest or stands.mean() < _MOST or travel <= _GOES_ON * largest:
        return []
    frames = np.flatnonzero(stands & (on > 0)) + frames_before - len(on)
    meaning = (
        f"prescribed nodes jump once and then stand still, but others go on moving, by {travel:.3g}: {_ADD_UP}. Else"
        " loads or creep move them, which no scene has"
    )
    return [Finding("frames in which only free nodes move", len(frames), places("frames", frames), meaning)]


def _turns(scene: Scene, moved: np.ndarray) -> list[Finding]:
    """Frames in which prescribed nodes change their shape, and would not if the frames were added up."""
    edges = scene.edges()
    edges = edges[scene.prescribed[edges].all(axis=1)]
    if not len(edges):
        return []
    rest = scene.rest_position.astype(np.float64)
    length = _lengths(rest[None], edges)
    changes = np.abs(_lengths(rest + moved, edges) - length).max(axis=1)
    together = np.abs(_lengths(rest + np.cumsum(moved, axis=0), edges) - length).max(axis=1)
    if changes.max() <= _CHANGED * length.max() or together.max() >= _KEPT * changes.max():
        return []
    frames = np.flatnonzero(changes > _CHANGED * length.max())
    meaning = (
        f"edges between prescribed nodes change by up to {changes.max():.3g}, but by {together.max():.3g} if the"
        f" displacements of the frames are added up: {_ADD_UP}"
    )
    return [
        Finding("frames in which prescribed nodes change their shape", len(frames), places("frames", frames), meaning)
    ]


def _lengths(points: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """[frames, edges] of points [frames, nodes, 3]."""
    return np.linalg.norm(points[:, edges[:, 0]] - points[:, edges[:, 1]], axis=2)


def _size(vectors: np.ndarray) -> np.ndarray:
    """[frames] the root mean square of the lengths of vectors [frames, nodes, 3]."""
    return np.sqrt((vectors**2).sum(axis=2).mean(axis=1))

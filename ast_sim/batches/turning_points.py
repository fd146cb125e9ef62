"""The load path: where the motion of the prescribed nodes turns back.

Metal that yields keeps a set, so a frame depends on the load path, not only on where the prescribed nodes end. On a
path that never turns back, the plastic strain follows from its two ends. So a jump starts from the last frame in which
the motion turned back, not always from the first one, and knows the plastic strain there.
"""

from __future__ import annotations

import numpy as np

from ast_sim.prescribed_motion import ROUNDING


def jump_sources(position: np.ndarray, prescribed: np.ndarray) -> np.ndarray:
    """For each frame of a motion the frame that a jump to it starts from.

    The motion turns back in a frame if the steps before and after it have a negative scalar product, summed over all
    prescribed nodes. Frames in which nothing moves do not count as steps.

    Args:
        position: [S, N, 3], the positions in each frame; only prescribed nodes are read.
        prescribed: [N] bool.

    Returns:
        [S] int64: the last frame before in which the motion turns back; 0 if there is none.
    """
    steps = np.diff(position[:, prescribed].astype(np.float64).reshape(len(position), -1), axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    sources = np.zeros(len(position), np.int64)
    before = np.zeros(steps.shape[1])
    for frame in range(len(steps)):
        sources[frame + 1] = sources[frame]
        if lengths[frame] > ROUNDING * lengths.max():
            if before @ steps[frame] < 0:
                sources[frame + 1] = frame
            before = steps[frame]
    return sources

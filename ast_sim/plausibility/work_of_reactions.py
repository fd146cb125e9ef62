"""Reactions with the other sign: the forces on a tool, where the forces on the body are meant.

From rest, the prescribed nodes do the work of their reactions. What they put in is stored or lost, so they cannot take
out more than they have put in (Clausius and Duhem), unless other loads do work.

Legend: S frames, N nodes, P prescribed nodes.
"""

from __future__ import annotations

import numpy as np

from ast_sim.element_topology import CORNERS_ONLY
from ast_sim.named_field import REACTION
from ast_sim.plausibility.findings import Finding
from ast_sim.scene import Trajectory

# The work that was taken out is at least this share of all that was done in either direction: between frames, work
# is known only roughly.
_SHARE = 0.5

# It is more than this share of the largest force along the whole way of the prescribed nodes: less is rounding.
_NOISE = 1e-3


def negative_work(trajectory: Trajectory) -> list[Finding]:
    """Reactions of a quasi-static simulation that take out more work than they have put in."""
    field = trajectory.fields.get(REACTION)
    scene = trajectory.scene
    # Of reactions at the corners alone, which are not the whole force, nothing follows.
    if field is None or not scene.prescribed.any() or trajectory.attributes.get(CORNERS_ONLY):
        return []
    rest = np.zeros((1, int(scene.prescribed.sum()), 3))
    moved = np.concatenate([rest, (trajectory.position - scene.rest_position.astype(np.float64))[:, scene.prescribed]])
    force = np.concatenate([rest, field.values[:, scene.prescribed]])  # [1 + S, P, 3], from rest
    done = ((force[1:] + force[:-1]) / 2 * np.diff(moved, axis=0)).sum(axis=(1, 2))
    work = np.cumsum(done)
    frame = int(np.argmin(work))
    most = np.linalg.norm(force, axis=2).sum(axis=1).max() * np.linalg.norm(moved, axis=2).max()
    if -work[frame] <= max(_SHARE * np.abs(done[: frame + 1]).sum(), _NOISE * most):
        return []
    meaning = (
        f"up to frame {frame} the prescribed nodes do a work of {work[frame]:.3g} (newton times the unit of length),"
        " though they move what is at rest: are these the forces on the tool? The forces on the body have the other"
        " sign. Else loads or heat that no scene has do the work"
    )
    return [Finding("reactions that take out work", 1, f"frame {frame}", meaning)]

"""Whether nodes move as the deck of a job prescribes: results of another job on the same mesh do not."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ast_sim.importers.solved_jobs.job import Job
from ast_sim.support.errors import DatasetError

# Displacements agree to this share of the largest one.
_AGREEMENT = 1e-3

# Results have six digits of a time.
_SAME_TIME = 1e-5


def require_as_prescribed(job: Job, path: Path, time: float, displacement: np.ndarray) -> None:
    """Check the displacements [n, 3] of the nodes of a job at a time; NaN where the results have none.

    Raises:
        DatasetError: a node is elsewhere than *BOUNDARY puts it; the text names the node.
    """
    expected = _expected(job, time)
    if expected is None:
        return
    off = np.nan_to_num(np.abs(displacement - expected))
    node, axis = np.unravel_index(np.argmax(off), off.shape)
    largest = np.nanmax(np.abs([displacement, expected]), initial=0.0)
    if off[node, axis] > _AGREEMENT * largest and job.mesh.same_point is not None:
        raise DatasetError(
            f"{path}: holds results of another job than {job.mesh.path.name}: its *BOUNDARY gives node"
            f" {job.mesh.same_point[node]} the displacement {expected[node, axis]:g} along {'xyz'[axis]} at the time"
            f" {time:g}, and it has {displacement[node, axis]:g}: take the deck that was solved"
        )


def _expected(job: Job, time: float) -> np.ndarray | None:
    """[n, 3] the displacements that the deck prescribes at a time, NaN where it says none; None if the time is in no
    step. Between two ends of steps only 0 is certain: what is held at both."""
    ends = np.array(job.ends)
    step = int(np.searchsorted(ends, time * (1 - _SAME_TIME)))
    if len(ends) != len(job.prescribed) or (np.diff(ends) <= 0).any() or step == len(ends):
        return None
    at_end = job.prescribed[step]
    if time >= ends[step] * (1 - _SAME_TIME):
        return at_end
    before = job.prescribed[step - 1] if step else np.zeros_like(at_end)
    return np.where((at_end == 0) & (before == 0), 0.0, np.nan)

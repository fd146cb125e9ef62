"""Whether the last increment in an .frd file is the state in which CalculiX gave up: the job did not converge.

Then the displacements are far from an equilibrium, and the "forces" are what is left over. The status file (.sta)
beside the results says so. Without one, the file itself tells: CalculiX gives up without the mark at its end, and
writes displacements and left-over forces alone, which are 0 wherever something is prescribed.
"""

from __future__ import annotations

import mmap
import re
from pathlib import Path

import numpy as np

from ast_sim.importers.formats.frd_results import FrdResult, opened
from ast_sim.support.errors import DatasetError, warn

# A line of the status file: step, increment, attempt (with U: not converged), iterations and the total time.
_STATUS = re.compile(r"^\s*[0-9]+\s+[0-9]+\s+[0-9]+(?P<failed>U?)\s+[0-9]+\s+(?P<time>[-+.0-9E]+)\s", re.MULTILINE)

_END = b" 9999"
_GIVEN_UP = {"DISP", "FORC"}  # the results of an increment that was given up
_CARRIED = 1e-6  # of the largest force; below is rounding


def given_up(path: Path, results: list[FrdResult]) -> bool | None:
    """Whether the last increment was given up; None: that cannot be known."""
    names: dict[float, set[str]] = {}
    for result in results:
        names.setdefault(result.time, set()).add(result.name)
    times = sorted(names)
    failed = _by_status(path, max(times, default=0.0))
    if failed or not times or names[times[-1]] != _GIVEN_UP:
        return failed or False
    with opened(path) as content:
        if content[-2 * len(_END) :].rstrip().endswith(_END):
            return False
        left_over = _left_over(content, [{r.name: r for r in results if r.time == time} for time in times[-2:]])
    if left_over is None and failed is None and len(times) > 1 and names[times[-2]] != _GIVEN_UP:
        return True
    return failed if left_over is None else left_over


def _by_status(path: Path, last: float) -> bool | None:
    """Whether the status file beside the results says that the increment at the time `last` failed; None: there is no
    such file. One that converged may be given up, too: if the next would be shorter than the shortest allowed."""
    status = path.with_suffix(".sta")
    lines = list(_STATUS.finditer(status.read_text(errors="replace"))) if status.is_file() else []
    if not lines:
        return None
    ended = max([0.0, *(float(line["time"]) for line in lines if not line["failed"])])
    return bool(lines[-1]["failed"]) and last > ended * (1 + 1e-6)


def _left_over(content: mmap.mmap, increments: list[dict[str, FrdResult]]) -> bool | None:
    """Whether the forces of the last increment are what is left over: 0 where the displacement is 0, as it is at rows
    that are held. In an equilibrium some of these carry a force. None: nothing is held, or it never carried any."""
    displacement, last = (increments[-1][name].vectors(content) for name in ("DISP", "FORC"))
    held = displacement == 0
    if held.shape != last.shape:
        return None
    if _carries(last, held):
        return False
    before = increments[0].get("FORC") if len(increments) > 1 else None
    return True if last.any() and (before is None or _carries(before.vectors(content), held)) else None


def _carries(forces: np.ndarray, held: np.ndarray) -> bool:
    """Whether some of the held rows carry more than rounding."""
    if held.shape != forces.shape or not held.any():
        return False
    return bool(np.abs(forces[held]).max() > _CARRIED * np.abs(forces).max())


def is_left_out(path: Path, failed: bool | None, increments: int, time: float | None) -> bool:
    """Whether the last increment is left out since it was given up. A warning says so, or that it cannot be known.

    Raises:
        DatasetError: there is no other increment.
    """
    if failed is None:
        warn(
            f"{path}: the job did not end well: whether its last increment, at the time {time or 0:g}, converged or is"
            " the state in which CalculiX gave up cannot be known without the status file: put the .sta file beside it"
        )
    elif failed and increments == 1:
        raise DatasetError(f"{path}: the job did not converge: its only increment is the state in which it gave up")
    elif failed:
        warn(
            f"{path}: the job did not converge: the increment at the time {time or 0:g} is the state in which CalculiX"
            " gave up, and is left out"
        )
    return bool(failed)

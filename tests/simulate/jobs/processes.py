"""Real processes that the tests of generation start, stop at a chosen moment and kill."""

from __future__ import annotations

import os
import pathlib
import time
from collections.abc import Callable

import ast_sim

HERE = pathlib.Path(__file__).parent
ROOT = pathlib.Path(ast_sim.__file__).parent.parent


def environment(pause: str = "", mark: pathlib.Path | None = None, **changes: str) -> dict[str, str]:
    """Variables of a process; with a mark it, or one that it starts, stops at the moment `pause` (sitecustomize.py)."""
    path = os.pathsep.join([str(HERE), str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    marks = {} if mark is None else {"AST_TEST_PAUSE": pause, "AST_TEST_MARK": str(mark)}
    return {**os.environ, "PYTHONPATH": path, **marks, **changes}


def wait_for(condition: Callable[[], object], what: str) -> None:
    """Wait until the condition holds; after a minute `what` is wrong."""
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.01)


def paused_process(mark: pathlib.Path) -> int:
    """The process that came to its moment."""
    wait_for(lambda: mark.exists() and mark.read_text(), "no process came to the moment at which it is to be killed")
    return int(mark.read_text())


def is_running(process: int) -> bool:
    """Whether there is such a process, other than one whose parent has yet to take notice of its end."""
    try:
        return pathlib.Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False

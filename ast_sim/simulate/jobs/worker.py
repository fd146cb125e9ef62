"""A worker process. It makes samples, one at a time.

    python -m ast_sim.simulate.jobs.worker FOLDER CHECKPOINTS RECIPE PARENT

- FOLDER: where finished samples are stored.
- CHECKPOINTS: where unfinished samples are stored.
- RECIPE: the settings that all samples share, as JSON.
- PARENT: the number of the parent process. The worker ends when the parent has ended.

The worker reads lines "split index" from its standard input until the input ends. For each line it makes one sample,
and answers with lines of JSON. From time to time it writes a line with `progress`. The last line about a sample has
`status` if the sample is in its file, or `error` if the sample has failed.

A worker is a new interpreter in which every library uses one thread. It never imports torch, because two OpenMP
runtimes in one process hang or slow each other down.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ast_sim.mechanics.unfinished import Checkpoint
from ast_sim.simulate.jobs.samples import Recipe, checkpoint_path, make_sample, sample_path, save_sample

SECONDS_BETWEEN_REPORTS = 1.0

Reply = Callable[[dict[str, Any]], None]


def main() -> None:
    """Serve until the standard input ends, or the parent process is gone."""
    folder = Path(sys.argv[1])
    checkpoints = Path(sys.argv[2])
    recipe = sys.argv[3]
    parent = int(sys.argv[4])
    answer = answers_for(parent)
    for line in sys.stdin:
        split, index = line.split()
        checkpoint = Checkpoint(checkpoint_path(checkpoints, split, int(index)), _reporter(answer))
        try:
            trajectory = make_sample(Recipe(**json.loads(recipe)), split, int(index), checkpoint)
            _stop_without(parent)  # its folder may belong to another run by now
            save_sample(sample_path(folder, split, int(index)), trajectory)
            checkpoint.remove()
            answer({"status": trajectory.attributes["status"]})
        except Exception as error:
            fatal = isinstance(error, OSError)  # a full or unwritable disk fails all samples alike
            text = f"{type(error).__name__}: {error}"
            answer({"error": text, "fatal": fatal, "traceback": traceback.format_exc()})


def answers_for(parent: int) -> Reply:
    """A function that answers the parent process with a line of JSON. This process ends when the parent has ended."""
    _end_with(parent)
    # Answers go to the real standard output, which nothing else may write to.
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)

    def answer(values: dict[str, Any]) -> None:
        try:
            print(json.dumps(values), file=answers)
        except BrokenPipeError:  # nobody listens any more
            os.killpg(0, signal.SIGKILL)

    return answer


def _reporter(answer: Reply) -> Callable[[int, int, int], None]:
    """The function that a solve calls with (frames done, frames in all, Newton iterations so far), at any rate."""
    last = time.monotonic()

    def report(frame: int, frames: int, iterations: int) -> None:
        nonlocal last
        if time.monotonic() - last >= SECONDS_BETWEEN_REPORTS:
            last = time.monotonic()
            answer({"progress": [frame, frames, iterations]})

    return report


def _end_with(parent: int) -> None:
    """End this process when the parent has ended. Look for the parent once a second.

    A killed parent cannot stop its workers, and they would go on solving for hours for nobody. A timer looks, not a
    thread, because the process is to have one thread only.
    """
    signal.signal(signal.SIGALRM, lambda *_: _stop_without(parent))
    signal.setitimer(signal.ITIMER_REAL, 1.0, 1.0)


def _stop_without(parent: int) -> None:
    """End this process and the programs that it started, if the parent is gone."""
    if os.getppid() != parent:
        os.killpg(0, signal.SIGKILL)


if __name__ == "__main__":
    main()

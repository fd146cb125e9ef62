"""Runs when Python starts with this folder in PYTHONPATH: stops a generator at a chosen moment, to be killed there.

AST_TEST_PAUSE names the moment and AST_TEST_MARK a file. The first process that comes to the moment writes its
number there and sleeps. Checkpoints are written at every frame, and a file "resumed" tells that one was continued.
"""

import contextlib
import os
import time
from pathlib import Path

PAUSE, MARK = os.environ.get("AST_TEST_PAUSE", ""), Path(os.environ.get("AST_TEST_MARK", ""))


def pausing(owner, name: str, moment: str, call: int = 1, after: bool = False) -> None:
    """Let the function `name` of `owner` stop at a call, before or after its work, if the moment is the chosen one."""
    function, calls = getattr(owner, name), []

    def paused(*args, **kwargs):
        calls.append(None)
        found = function(*args, **kwargs) if after else None
        if moment == PAUSE and len(calls) == call:
            with contextlib.suppress(FileExistsError), open(MARK, "x") as file:
                print(os.getpid(), file=file, flush=True)
                time.sleep(600)
        return found if after else function(*args, **kwargs)

    setattr(owner, name, paused)


def remember_resumed(owner) -> None:
    load = owner.load

    def loaded(checkpoint):
        found = load(checkpoint)
        if found is not None:
            MARK.with_name("resumed").touch()
        return found

    owner.load = loaded


if MARK.name:
    from ast_sim.dataset.writer import DatasetWriter
    from ast_sim.mechanics import unfinished as checkpoint
    from ast_sim.simulate.families import deforming_plate
    from ast_sim.simulate.jobs import generate, samples

    checkpoint.SECONDS_BETWEEN_WRITES = 0.0
    pausing(deforming_plate, "draw", "drawing")
    pausing(checkpoint.Checkpoint, "save", "solving", call=4, after=True)
    pausing(samples, "store_sample", "stored", after=True)
    pausing(DatasetWriter, "add", "merging", call=2)
    pausing(generate, "_remove", "merged")
    pausing(generate.shutil, "rmtree", "removing", call=2)
    remember_resumed(checkpoint.Checkpoint)

"""Worker processes that make samples: each has one thread and its own interpreter, and may die without harm."""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, TextIO

import ast_sim
from ast_sim.errors import SimulationError
from ast_sim.simulate.progress import Progress
from ast_sim.simulate.samples import Sample, sample_name

SINGLE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Worker:
    """One worker process and the sample that it is at."""

    def __init__(self, parts: Path, arguments: tuple[str, ...]) -> None:
        # Not multiprocessing: its spawned children import the script of the parent again, and torch with it.
        root = str(Path(ast_sim.__file__).parent.parent)
        path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", "ast_sim.simulate.worker", str(parts), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **dict.fromkeys(SINGLE_THREAD, "1"), "PYTHONPATH": path},
            text=True,
            bufsize=1,
            start_new_session=True,  # an interrupt from the terminal goes to the parent alone
        )
        self.sample: Sample | None = None

    @property
    def answers(self) -> TextIO:
        return self.process.stdout

    def give(self, sample: Sample) -> None:
        self.sample = sample
        with contextlib.suppress(BrokenPipeError):  # a dead worker is noticed by the end of its answers
            self.process.stdin.write(f"{sample[0]} {sample[1]}\n")

    def receive(self) -> dict[str, Any]:
        """The answer to the sample given; how the process ended, as an error, if there is none."""
        line = self.answers.readline()
        if line.endswith("\n"):
            return json.loads(line)
        code = self.process.wait()
        ended = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return {"error": f"its worker process {ended}", "fatal": False, "dead": True}

    def stop(self) -> None:
        self.process.kill()
        self.process.wait()
        self.process.stdout.close()
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.close()


def run_all(
    samples: list[Sample], parts: Path, arguments: tuple[str, ...], workers: int, bar: Progress
) -> dict[Sample, str]:
    """Make the samples; returns those that failed, with the reason.

    A worker that dies costs the sample that it was at and is replaced.

    Raises:
        SimulationError: an error that all samples would meet, such as a full disk.
    """
    waiting, failures = list(reversed(samples)), {}
    selector = selectors.DefaultSelector()
    active: list[Worker] = []

    def start_worker() -> None:
        worker = Worker(parts, arguments)
        active.append(worker)
        selector.register(worker.answers, selectors.EVENT_READ, worker)
        worker.give(waiting.pop())

    def end_worker(worker: Worker) -> None:
        selector.unregister(worker.answers)
        active.remove(worker)
        worker.stop()

    try:
        while waiting and len(active) < workers:
            start_worker()
        while active:
            for key, _ in selector.select():
                worker = key.data
                answer = worker.receive()
                if answer.get("fatal"):
                    raise SimulationError(f"{sample_name(*worker.sample)} cannot be written: {answer['error']}")
                if "error" in answer:
                    failures[worker.sample] = answer["error"]
                    trace = answer.get("traceback", "")
                    bar.note(f"{sample_name(*worker.sample)} failed: {answer['error']}\n{trace}".strip())
                else:
                    bar.advance()
                if waiting and not answer.get("dead"):
                    worker.give(waiting.pop())
                    continue
                end_worker(worker)
                if waiting:
                    start_worker()
    finally:
        for worker in list(active):
            end_worker(worker)
        selector.close()
    return failures

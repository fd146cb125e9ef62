"""Worker processes that make samples. Each has one thread and its own interpreter, and may die without harm."""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import signal
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ast_sim.simulate.jobs.manifest import Watch
from ast_sim.simulate.jobs.samples import Recipe, Sample, sample_name
from ast_sim.support.environment import SINGLE_THREAD, of_child
from ast_sim.support.errors import AstSimError

WORKER_MODULE = "ast_sim.simulate.jobs.worker"

# One thread and the same bits wherever an array lies in memory. Without MKL_CBWR, the alignment of an array changes
# the order in which MKL sums. With a named branch (AVX2), processors with newer instructions give the same bits, too.
SAME_BITS = {"MKL_THREADING_LAYER": "SEQUENTIAL", "MKL_CBWR": "AVX2"}


class Process:
    """A module that runs in a process of its own and answers in lines of JSON.

    Args:
        module: its name.
        arguments: its arguments. The number of this process is added to them.
    """

    def __init__(self, module: str, *arguments: str) -> None:
        # Not multiprocessing: its spawned children import the parent's script again, and torch with it.
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", module, *arguments, str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=of_child(**SINGLE_THREAD, **SAME_BITS),
            bufsize=0,
            start_new_session=True,  # an interrupt from the terminal reaches only the parent
        )
        assert self.process.stdin is not None and self.process.stdout is not None
        self._stdin = self.process.stdin
        self._stdout = self.process.stdout
        self._unfinished = b""  # the beginning of a line whose end has not come yet

    def fileno(self) -> int:
        """The file descriptor that becomes readable when the worker has said something."""
        return self._stdout.fileno()

    def say(self, line: str) -> None:
        """Write a line to its standard input."""
        with contextlib.suppress(BrokenPipeError):  # `receive` reports a dead worker
            self._stdin.write(f"{line}\n".encode())

    def receive(self) -> list[dict[str, Any]]:
        """Wait until the worker says something; return its messages. If it has ended, the message is an error that says
        how.
        """
        data = os.read(self.fileno(), 1 << 16)
        if not data:
            code = self.process.wait()
            ended = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
            return [{"error": f"its worker process {ended}", "dead": True}]
        *lines, self._unfinished = (self._unfinished + data).split(b"\n")
        return [json.loads(line) for line in lines]

    def stop(self) -> None:
        """End the process and the programs that it started."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)  # it leads a session and a process group of its own
        self.process.wait()
        self._stdout.close()
        with contextlib.suppress(BrokenPipeError):
            self._stdin.close()


class Worker(Process):
    """One worker process and the sample that it makes.

    Args:
        folder: where it stores finished samples.
        recipe: the recipe of all its samples.
        checkpoints: where it stores unfinished samples; `folder` if None.

    Attributes:
        sample: the sample that it was given last.
    """

    sample: Sample

    def __init__(self, folder: Path, recipe: Recipe, checkpoints: Path | None = None) -> None:
        super().__init__(WORKER_MODULE, str(folder), str(checkpoints or folder), json.dumps(asdict(recipe)))

    def give(self, sample: Sample) -> None:
        self.sample = sample
        self.say(f"{sample[0]} {sample[1]}")


class WorkerPool:
    """Workers that share a list of samples. If a worker dies, its current sample fails and another worker takes its
    place.
    """

    def __init__(self, samples: list[Sample], parts: Path, recipe: Recipe, watch: Watch) -> None:
        self.waiting = list(reversed(samples))
        self.parts = parts
        self.recipe = recipe
        self.watch = watch
        self.active: list[Worker] = []
        self.selector = selectors.DefaultSelector()

    def start_worker(self) -> None:
        worker = Worker(self.parts, self.recipe)
        self.active.append(worker)
        self.selector.register(worker, selectors.EVENT_READ, worker)
        self.give(worker)

    def give(self, worker: Worker) -> None:
        worker.give(self.waiting.pop())
        self.watch.started(worker.sample, worker.process.pid)

    def end_worker(self, worker: Worker) -> None:
        self.selector.unregister(worker)
        self.active.remove(worker)
        worker.stop()

    def hear(self, worker: Worker, message: dict[str, Any]) -> None:
        """Act on a worker's message: its sample makes progress, is done or has failed. A free worker gets the next
        sample.
        """
        if "progress" in message:
            self.watch.progress(worker.sample, *message["progress"])
            return
        if message.get("fatal"):
            raise AstSimError(f"{sample_name(*worker.sample)} cannot be written: {message['error']}")
        if "error" in message:
            self.watch.failed(worker.sample, message["error"], message.get("traceback", ""))
        else:
            self.watch.done(worker.sample)
        if self.waiting and not message.get("dead"):
            self.give(worker)
            return
        self.end_worker(worker)
        if self.waiting:
            self.start_worker()


def run_all(samples: list[Sample], parts: Path, recipe: Recipe, workers: int, watch: Watch) -> None:
    """Make the samples and store them in `parts`; `watch` is told about each.

    Raises:
        AstSimError: an error that every sample would meet, such as a full disk.
    """
    pool = WorkerPool(samples, parts, recipe, watch)
    try:
        while pool.waiting and len(pool.active) < workers:
            pool.start_worker()
        while pool.active:
            for key, _ in pool.selector.select(timeout=1.0):
                for message in key.data.receive():
                    pool.hear(key.data, message)
            watch.tick()
    finally:
        for worker in list(pool.active):
            pool.end_worker(worker)
        pool.selector.close()

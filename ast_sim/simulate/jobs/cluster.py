"""Have the workers of a Dask cluster make samples, and store the samples here.

A task makes one sample and returns the bytes of its file. It is a pure function. The Dask worker starts a process for
it, with the same environment as a local worker process and without torch. A cluster therefore gives the same bits as
one machine of its kind.
If a Dask worker dies, no sample is lost: the scheduler gives its tasks to other workers, and this process stores each
result once. If the workers see the parts folder too, an interrupted sample goes on from its last stored frame.
Otherwise it begins again.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import platform
import queue
import selectors
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ast_sim.simulate.jobs import pool
from ast_sim.simulate.jobs.manifest import Watch
from ast_sim.simulate.jobs.recipe import difference, recorded
from ast_sim.simulate.jobs.samples import Recipe, Sample, load_sample, sample_name, sample_path, store_sample
from ast_sim.support.errors import AstSimError, ConfigError, SimulationError, require

SECONDS_TO_CONNECT = 10.0
SECONDS_BETWEEN_EVENTS = 5.0


def run_all(samples: list[Sample], parts: Path, recipe: Recipe, scheduler: str, watch: Watch) -> None:
    """Have the cluster make the samples and store them in `parts`; `watch` is told about each.

    Raises:
        AstSimError: the scheduler goes away, or a sample cannot be stored.
        ConfigError: the scheduler cannot be reached.
        MissingExtra: `distributed` is not installed.
    """
    settings = recorded(recipe)
    # This prefix makes task names unique to the dataset: Dask takes tasks of one name for the same task.
    topic = "ast_sim-" + hashlib.sha256(json.dumps([settings, str(parts.resolve())]).encode()).hexdigest()[:16]
    events: queue.Queue[tuple[str, Any]] = queue.Queue()
    with _connected(scheduler) as client:
        client.subscribe_topic(topic, lambda event: events.put(("said", event[1])))
        if not client.scheduler_info()["workers"]:
            watch.bar.line(f"the scheduler at {scheduler} has no workers yet: waiting for them")
        waiting: dict[Any, Sample] = {}
        for sample in samples:
            name = sample_name(*sample)
            arguments = (asdict(recipe), settings, *sample, str(parts.resolve()), topic)
            waiting[client.submit(sample_task, *arguments, key=f"{topic}-{name}", pure=False)] = sample
        for future in waiting:
            future.add_done_callback(lambda future: events.put(("ended", future)))
        while waiting:
            try:
                kind, value = events.get(timeout=1.0)
            except queue.Empty:
                watch.tick()
                continue
            if kind == "ended":
                _end(value, waiting.pop(value), parts, scheduler, watch)
            else:
                _hear(value, set(waiting.values()), watch)
            watch.tick()


@contextlib.contextmanager
def _connected(scheduler: str) -> Iterator[Any]:
    (distributed,) = require("cluster", "distributed")
    with _silent("distributed"):
        try:
            client = distributed.Client(scheduler, timeout=SECONDS_TO_CONNECT, set_as_default=False, name="ast_sim")
        except (OSError, ValueError, TypeError) as error:
            raise ConfigError(
                f"the scheduler at {scheduler} cannot be reached within {SECONDS_TO_CONNECT:g} s ({error}):"
                " is `dask scheduler` running there, and does the address read like tcp://host:8786?"
            ) from error
        try:
            yield client
        finally:
            client.close(timeout=SECONDS_TO_CONNECT)  # this also drops the unfinished tasks


@contextlib.contextmanager
def _silent(library: str) -> Iterator[None]:
    """Keep a library from logging tracebacks: errors are reported in one line instead."""
    names = [name for name in logging.root.manager.loggerDict if name.partition(".")[0] == library]
    levels = {name: logging.getLogger(name).level for name in names}
    for name in names:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)


def _hear(event: dict[str, Any], waiting: set[Sample], watch: Watch) -> None:
    """Act on a message that a task sent about its sample. Ignore it if the sample has ended."""
    sample = (event["split"], event["index"])
    if sample not in waiting:
        return
    if "progress" in event:
        watch.progress(sample, *event["progress"])
    else:
        watch.started(sample, event["process"], event["host"])


def _end(future: Any, sample: Sample, parts: Path, scheduler: str, watch: Watch) -> None:
    """Store the result of a task, or note why it has none."""
    if future.status in ("cancelled", "lost"):
        raise AstSimError(
            f"the scheduler at {scheduler} went away. The finished samples are kept in {parts}: the same command goes"
            " on from there"
        )
    if future.status == "error":
        error = future.exception()
        watch.failed(sample, f"{type(error).__name__} on the cluster: {error}")
        return
    answer = future.result()
    future.release()
    if "error" in answer:
        watch.failed(sample, f"{answer['error']} (on {answer['host']})", answer.get("traceback", ""))
        return
    try:
        store_sample(sample_path(parts, *sample), answer["sample"])
    except OSError as error:
        raise AstSimError(f"{sample_name(*sample)} cannot be written: {error}") from error
    load_sample(sample_path(parts, *sample))
    watch.done(sample)


def sample_task(
    recipe: dict[str, Any], settings: dict[str, Any], split: str, index: int, parts: str, topic: str
) -> dict[str, Any]:
    """Make one sample in a process of its own. This function runs on a Dask worker.

    Args:
        recipe: fields of a `Recipe`.
        settings: what `recorded` returned for the recipe at the client. It must return the same here.
        split, index: which sample.
        parts: the parts folder of the client. If this machine sees the same folder, unfinished samples are kept there.
        topic: the Dask topic of the events that tell the client about the progress.

    Returns:
        `sample`, the bytes of the sample's file; or `error` with `host` and perhaps `traceback`.
    """
    (distributed,) = require("cluster", "distributed")
    host = platform.node()
    made_of = Recipe(**recipe)
    worker = distributed.get_worker()
    try:
        differs = difference(recorded(made_of), settings, "on the worker", "at the client")
    except (ConfigError, SimulationError) as error:
        return {"error": str(error), "host": host}
    if differs:
        return {"error": f"the worker is set up differently: {differs}", "host": host}
    shared = Path(parts) if _is_shared(Path(parts), settings) else None

    def tell(**values: Any) -> None:
        worker.log_event(topic, {"split": split, "index": index, **values})

    with tempfile.TemporaryDirectory(prefix="ast_sim-", dir=worker.local_directory) as folder:
        process = pool.Worker(Path(folder), made_of, shared)
        try:
            process.give((split, index))
            tell(process=process.process.pid, host=host)
            answer = _answer(process, tell, lambda: _is_wanted(worker, f"{topic}-{sample_name(split, index)}"))
        finally:
            process.stop()
        if "error" in answer:
            return {**answer, "host": host}
        return {"sample": sample_path(Path(folder), split, index).read_bytes()}


def _answer(process: pool.Worker, tell: Callable[..., None], wanted: Callable[[], bool]) -> dict[str, Any]:
    """Wait for the last message of a worker process about its sample. Now and then, pass a progress message on."""
    last = 0.0
    with selectors.DefaultSelector() as selector:
        selector.register(process, selectors.EVENT_READ)
        while True:
            ready = selector.select(timeout=1.0)
            if not wanted():
                return {"error": "nobody waits for it any more"}
            for message in process.receive() if ready else ():
                if "progress" not in message:
                    return message
                if time.monotonic() - last >= SECONDS_BETWEEN_EVENTS:
                    last = time.monotonic()
                    tell(**message)


def _is_wanted(worker: Any, key: str) -> bool:
    """Whether the scheduler still wants the task. The client may be gone, and Dask cannot stop a running thread."""
    task = worker.state.tasks.get(key)
    return task is not None and task.state != "cancelled"


def _is_shared(parts: Path, settings: dict[str, Any]) -> bool:
    """Whether this machine sees the client's folder and may write to it."""
    try:
        seen = json.loads((parts / "settings.json").read_text())
    except (OSError, ValueError):
        return False
    return seen == settings and os.access(parts, os.W_OK)

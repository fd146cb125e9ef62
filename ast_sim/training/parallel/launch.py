"""A training in several processes on one machine, as `torchrun` starts it, from the process that the user has.

That process leads: it prints, writes the run and calls the callback. The others call `train_along`.
"""

from __future__ import annotations

import os
import pickle
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any

import torch

from ast_sim.dataset.reader import Dataset
from ast_sim.runs.train_config import RunConfig
from ast_sim.support.environment import of_child
from ast_sim.support.errors import RESUME, ConfigError, TrainingError, counted
from ast_sim.support.toml_settings import require_range

LEAST_NODES = 3000  # of a process in a step; below, two processes are no faster than one (docs/log.md, 2026-11-27)
SMALL = 2e6  # nodes times samples; so small trainings end before other processes are ready
LEAST_MINUTES = 1.0
MOST = 8  # processes, or one for each core: more are no faster, and each takes half a gigabyte
PATIENCE = 60.0  # seconds that a process has for its end
READY = b"ready\n"  # what another process writes before it trains
_HERE = "127.0.0.1"
_ALONG = "from ast_sim.training.start import train_along; train_along()"


def usual_processes(config: RunConfig) -> int:
    """The number of processes of a training whose `train.processes` is unset.

    A step has a part that does not depend on the size of its batch. So each thread of torch (`OMP_NUM_THREADS`; by
    default each core) becomes a process only as far as the batch can be cut into parts of LEAST_NODES nodes. A training
    of about a minute stays in one process.

    Raises:
        DatasetError: the dataset cannot be read.
    """
    options = config.train
    threads = torch.get_num_threads()
    if threads == 1 or options.batch_size == 1 or _is_from_a_script(config):
        return 1
    with Dataset(config.data) as dataset:
        scenes = dataset.count("train")
        nodes = dataset.scene("train", 0).num_nodes if scenes else 0
    if options.steps is None and options.minutes is not None:
        small = options.minutes < LEAST_MINUTES
    else:
        samples = options.epochs * scenes if options.steps is None else options.steps * options.batch_size
        small = samples * nodes < SMALL
    most = 1 if small else min(threads, options.batch_size * nodes // LEAST_NODES)
    return max(count for count in range(1, max(1, most) + 1) if options.batch_size % count == 0)


def require_cut(config: RunConfig, processes: int) -> None:
    """Raise ConfigError unless each process can take an equal part of every batch."""
    if config.train.batch_size % processes:
        raise ConfigError(
            f"train.batch_size = {config.train.batch_size} cannot be cut for"
            f" {counted(processes, 'process', 'processes')}"
        )


def _is_from_a_script(config: RunConfig) -> bool:
    """Whether no other process can import the model."""
    return type(config.model).__module__ == "__main__"


@contextmanager
def together(count: int, config: RunConfig | None, arguments: Mapping[str, Any]) -> Iterator[None]:
    """Within the block, `count` processes train together; 1: only this one.

    Args:
        config: the settings, if there are any.
        arguments: of `start_training`, for the other processes.

    Raises:
        ConfigError: the count is out of range, batches cannot be cut, or another process cannot import the model.
        TrainingError: another process could not start, or ended.
    """
    require_range("train.processes", count, 1, max(MOST, os.cpu_count() or 1))
    if config is not None:
        require_cut(config, count)
    if count == 1:
        yield
        return
    if config is not None and _is_from_a_script(config):
        raise ConfigError(
            f"train.processes is {count}, but other processes cannot import the model {config.model.name} from a"
            " script: put it into a module, or set train.processes to 1"
        )
    threads = torch.get_num_threads()
    environment = _environment(count, max(1, threads // count))
    with ExitStack() as stack:
        helpers = [_Helper({**environment, "RANK": str(rank)}, arguments, stack) for rank in range(1, count)]
        for helper in helpers:
            helper.wait_until_ready()
        stack.enter_context(_set({**environment, "RANK": "0"}))
        stack.callback(torch.set_num_threads, threads)
        torch.set_num_threads(max(1, threads // count))
        try:
            yield
        except RuntimeError as error:  # of gloo, where a connection ends
            for helper in helpers:
                helper.raise_if_ended(error)
            raise
        for helper in helpers:
            helper.process.wait(PATIENCE)


def _environment(count: int, threads: int) -> dict[str, str]:
    """What `torchrun` would set, for processes that talk within this machine."""
    with socket.socket() as free:
        free.bind((_HERE, 0))
        port = free.getsockname()[1]
    return {
        "WORLD_SIZE": str(count),
        "LOCAL_WORLD_SIZE": str(count),
        "MASTER_ADDR": _HERE,
        "MASTER_PORT": str(port),
        "GLOO_SOCKET_IFNAME": os.environ.get("GLOO_SOCKET_IFNAME", "lo"),
        "OMP_NUM_THREADS": str(threads),
    }


@contextmanager
def _set(variables: Mapping[str, str]) -> Iterator[None]:
    """Within the block the environment has these variables."""
    before = {key: os.environ.get(key) for key in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for key, value in before.items():
            if value is None:
                del os.environ[key]
            else:
                os.environ[key] = value


class _Helper:
    """Another process of the training; it is ended when the stack is left."""

    def __init__(self, environment: Mapping[str, str], arguments: Mapping[str, Any], stack: ExitStack) -> None:
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115, the stack closes it
        stack.callback(self._errors.close)
        # In a session of its own, so that Ctrl-C reaches the leading process alone, which tells the others.
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-c", _ALONG],
            env=of_child(**environment),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            start_new_session=True,
        )
        stack.callback(self._end)
        assert self.process.stdin is not None
        try:
            pickle.dump(dict(arguments), self.process.stdin)
            self.process.stdin.close()
        except BrokenPipeError:
            pass  # the process has ended, which `wait_until_ready` tells

    def wait_until_ready(self) -> None:
        assert self.process.stdout is not None
        if self.process.stdout.readline() != READY:
            raise TrainingError(f"a process that should train along could not start: {self._reason()}")

    def raise_if_ended(self, error: BaseException) -> None:
        """Raise a TrainingError if this process has failed, which is then the cause of the error of another one."""
        try:
            failed = self.process.wait(5.0) != 0
        except subprocess.TimeoutExpired:
            return
        if failed:
            raise TrainingError(f"a process that trains along has ended ({self._reason()}): {RESUME}") from error

    def _reason(self) -> str:
        code = self.process.wait(PATIENCE)
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else f"signal {-code}" if code < 0 else f"exit code {code}"

    def _end(self) -> None:
        assert self.process.stdout is not None
        self.process.stdout.close()
        self.process.kill()
        self.process.wait()

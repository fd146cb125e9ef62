"""Batches drawn ahead: the next one is made in a thread while the model trains on the current one."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor, wait

from ast_sim.data.batch import Batch, Target
from ast_sim.data.rollout_pool import RolloutPool
from ast_sim.data.sampling import PairSampler


class Ahead:
    """The batches of a sampler or a pool in rising order, without waiting for them; none depends on the one before it.

    A context manager: its thread ends with it. An error in making a batch is raised when that batch is asked for.
    """

    def __init__(self, sampler: PairSampler | RolloutPool) -> None:
        self._sampler = sampler
        self._thread = ThreadPoolExecutor(1, "sampler")
        self._next: dict[int, Future[tuple[Batch, Target]]] = {}

    def __enter__(self) -> Ahead:
        return self

    def __exit__(self, *_: object) -> None:
        self._thread.shutdown(cancel_futures=True)

    def batch(self, step: int) -> tuple[Batch, Target]:
        """The batch of a step; that of step + 1 is begun."""
        found = self._next.pop(step, None) or self._thread.submit(self._sampler.batch, step)
        batch = found.result()
        self._next = {step + 1: self._thread.submit(self._sampler.batch, step + 1)}
        return batch

    def wait(self) -> None:
        """Return when the batch that was begun is ready, and with it the dataset is free for others to read."""
        wait(self._next.values())

"""Batches prepared ahead: a thread makes the next batch while the model trains on the current one."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait

from ast_sim.batches.batch_builder import Batch, Target
from ast_sim.batches.pairs import PairSampler
from ast_sim.batches.training_pool import TrainingPool


class Ahead:
    """The batches of a sampler or a pool, in ascending order. A thread begins each while the batch before it is used.

    So the making of a batch must not depend on the use of the batch before it. The thread ends with this context
    manager. An error in making a batch is raised when that batch is taken.

    Args:
        prepare: what the thread does to each batch: what a model needs of it that does not depend on its parameters.
    """

    def __init__(
        self, sampler: PairSampler | TrainingPool, prepare: Callable[[Batch], Batch] = lambda batch: batch
    ) -> None:
        self._sampler = sampler
        self._prepare = prepare
        self._thread = ThreadPoolExecutor(1, "sampler")
        self._next: dict[int, Future[tuple[Batch, Target]]] = {}

    def __enter__(self) -> Ahead:
        return self

    def __exit__(self, *_: object) -> None:
        self._thread.shutdown(cancel_futures=True)

    def batch(self, step: int) -> tuple[Batch, Target]:
        """The batch of a step. The batch of step + 1 is begun."""
        future = self._next.pop(step, None) or self._thread.submit(self._made, step)
        batch = future.result()
        self._next = {step + 1: self._thread.submit(self._made, step + 1)}
        return batch

    def _made(self, step: int) -> tuple[Batch, Target]:
        batch, target = self._sampler.batch(step)
        return self._prepare(batch), target

    def wait(self) -> None:
        """Wait until the batch that was begun is ready. Then the thread no longer reads the dataset."""
        wait(self._next.values())

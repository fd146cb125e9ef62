"""Checkpoints of a training: what they hold, and how a training is restored from them."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor, nn

from ast_sim.batches.training_pool import TrainingPool
from ast_sim.dataset.reader import Dataset
from ast_sim.runs import checkpoint
from ast_sim.runs.folder import RunFolder
from ast_sim.runs.run_file import first_weights
from ast_sim.support.errors import TrainingError
from ast_sim.training.optimizer import Optimizer
from ast_sim.training.parallel.processes import Processes


class Saver:
    """Saves and restores a training. Only the leading process uses files; it sends the others what they need. `tell`
    takes lines for the user."""

    def __init__(
        self,
        run: RunFolder,
        dataset: Dataset,
        model: nn.Module,
        optimizer: Optimizer,
        pool: TrainingPool | None,
        processes: Processes,
        tell: Callable[[str], None],
    ) -> None:
        self.run = run
        self.dataset = dataset
        self.model = model
        self.optimizer = optimizer
        self.pool = pool
        self.processes = processes
        self.tell = tell

    def save(self, step: int, sums: dict[str, float], keep: int) -> None:
        """Write the checkpoint of a step; it holds the number of lines in `metrics.jsonl`."""
        rolling = {}
        if self.pool is not None:
            parts = self.processes.gathered([self.pool.state()])
            rolling = {key: value for part in parts for key, value in part.items()}
        if self.processes.leads:
            lines = sum(1 for _ in self.run.metrics)
            checkpoint.save(
                self.run.path,
                step,
                model=self.model.state_dict(),
                training={**_under("optimizer.", self.optimizer.state()), **_under("pool.", rolling)},
                state={"step": step, "sums": sums, "run": self.run.origin["sha256"], "lines": lines},
                keep=keep,
            )

    def restore(self) -> tuple[int, dict[str, float]] | None:
        """Restore the newest checkpoint; returns its step and the sums of the log, or None if there is none."""
        content = self.processes.of_leader(self._newest() if self.processes.leads else None)
        if content is None:
            return None
        weights, training, state = content
        self.model.load_state_dict(weights)
        self.optimizer.restore(_without("optimizer.", training))
        if self.pool is not None:
            self.pool.restore(_without("pool.", training))
        return state["step"], state["sums"]

    def start(self) -> bool:
        """Load the weights of the run that this one starts from; returns whether there is such a run."""
        weights = first_weights(self.run)
        if weights is None:
            return False
        self.model.load_state_dict(weights)
        start = self.run.origin["start"]
        self.tell(f"starts from {start['run']}, step {start['step']:,}")
        return True

    def _newest(self) -> checkpoint.CheckpointContent | None:
        """The content of the newest checkpoint, which must be of this run and of this dataset."""
        path = checkpoint.latest(self.run.path)
        if path is None:
            return None
        origin = self.run.origin
        content = checkpoint.load(path, origin["sha256"])
        if origin["data"] != self.dataset.fingerprint():
            raise TrainingError(
                f"{self.dataset.path} is not the dataset that {self.run.path} was trained on so far: use that dataset,"
                " or train in another folder"
            )
        state = content[2]
        self.run.metrics.require(state["lines"])
        self.tell(f"going on after step {state['step']:,}")
        return content


def _under(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {prefix + key: value for key, value in tensors.items()}


def _without(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}

"""The trained model in a run folder."""

from __future__ import annotations

from pathlib import Path

from ast_sim.models.registry import build_model
from ast_sim.models.simulator import Simulator
from ast_sim.runs import checkpoint
from ast_sim.runs.metrics import Metrics
from ast_sim.runs.origin import read_origin
from ast_sim.runs.train_config import RunConfig, read_config
from ast_sim.support.errors import CheckpointError


def load_model(run: Path) -> tuple[Simulator, RunConfig, int]:
    """The trained model, the settings of the run, and the step of the checkpoint.

    The checkpoint is the best one; the latest one if none was validated.

    Raises:
        CheckpointError: the folder is no run, no checkpoint in it can be read, or the file `best` is missing.
    """
    settings = read_config(run)
    if checkpoint.read_best(run) is None and Metrics(run).best() is not None:
        raise CheckpointError(
            f"{run / 'best'} is missing, but validations were recorded: ast-sim train --resume --out {run} writes it"
            " again from metrics.jsonl"
        )
    newest = checkpoint.latest(run)
    if newest is None:
        raise CheckpointError(f"{run} has no checkpoint yet: train it with ast-sim train --resume --out {run}")
    Metrics(run).require(checkpoint.load(newest)[2]["lines"])
    weights, _, state = checkpoint.load(checkpoint.best(run) or newest, read_origin(run)["sha256"])
    model = build_model(settings.model)
    model.load_state_dict(weights)
    return model.eval(), settings, int(state["step"])

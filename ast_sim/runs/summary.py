"""The description of a run folder that `ast-sim info` prints."""

from __future__ import annotations

import dataclasses
import warnings
from pathlib import Path
from typing import Any

from ast_sim.runs import checkpoint
from ast_sim.runs.config_toml import read_config
from ast_sim.runs.metrics import Metrics
from ast_sim.runs.origin import read_origin


def describe_run(path: Path) -> dict[str, Any]:
    """The settings, the checkpoint that it starts from, its checkpoints and the best validation of a run.

    A warning tells if the record of that validation is lost.
    """
    settings = read_config(path)
    latest, best = checkpoint.latest(path), checkpoint.best(path)
    mark = checkpoint.read_best(path)
    metrics = Metrics(path)
    validation = [record for record in metrics if mark and "valid_rmse" in record and record["step"] == mark[0]]
    if mark and not validation:
        warnings.warn(f"{metrics.path} has lost the validation after step {mark[0]}, the best one", stacklevel=2)
    return {
        "kind": "run",
        "path": str(path),
        **dataclasses.asdict(settings),
        "start": read_origin(path).get("start"),
        "latest_checkpoint": latest.name if latest else None,
        "best_checkpoint": best.name if best else None,
        "best_validation": validation[-1] if validation else None,
    }

"""What is in a dataset or in a run, for `ast-sim info`; a dataset is read whole, so that it is checked on the way."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from ast_sim.data.file import Dataset
from ast_sim.data.scene import NodeType


def describe(path: Path) -> dict[str, Any]:
    """Facts of a dataset file or a run folder, as JSON has them.

    Raises:
        DatasetError, CheckpointError, ConfigError: what is wrong with it, first of all that it is neither.
    """
    return describe_run(path) if path.is_dir() else describe_dataset(path)


def describe_dataset(path: Path) -> dict[str, Any]:
    """Counts, sizes, fields and units of a dataset; every trajectory is read and checked."""
    with Dataset(path) as dataset:
        splits = {split: _describe_split(dataset, split) for split, count in dataset.splits.items() if count}
        return {
            "kind": "dataset",
            "path": str(path),
            "bytes": Path(path).stat().st_size,
            **dataclasses.asdict(dataset.info),
            "splits": splits,
            "checks": "every trajectory has the right shapes, finite numbers and indices in range",
        }


def _describe_split(dataset: Dataset, split: str) -> dict[str, Any]:
    nodes, elements, frames, truncated, outside = [], [], [], [], []
    fields: dict[str, str] = {}
    types = dict.fromkeys((kind.name for kind in NodeType), 0)
    for index in range(dataset.count(split)):
        trajectory = dataset.load(split, index)
        scene = trajectory.scene
        nodes.append(scene.num_nodes)
        elements.append(scene.num_elements)
        frames.append(trajectory.num_frames)
        for kind in NodeType:
            types[kind.name] += int((scene.node_type == kind).sum())
        if trajectory.attributes.get("status", "complete") != "complete":
            truncated.append(index)
        if (abs(trajectory.position - dataset.info.domain_center) > dataset.info.domain_half_width).any():
            outside.append(index)
        for name in ("rest_position", "elements", "node_type", "body", "material"):
            if getattr(scene, name) is not None:
                fields[name] = _field(getattr(scene, name))
        fields["position"] = _field(trajectory.position)
        if trajectory.stress is not None:
            fields["stress"] = _field(trajectory.stress)
        for frame in range(trajectory.num_frames):  # one at a time: it is six numbers an element
            tensor = dataset.cauchy_stress(split, index, frame, frame + 1)
            if tensor is None:
                break
            fields["cauchy_stress"] = _field(tensor)
    return {
        "trajectories": len(nodes),
        "nodes": [min(nodes), max(nodes)],
        "elements": [min(elements), max(elements)],
        "frames": [min(frames), max(frames)],
        "node_types": types,
        "fields": fields,
        "truncated": truncated,
        "outside_domain": outside,
    }


def _field(array: Any) -> str:
    return f"{array.dtype}, {array.shape[-1] if array.ndim > 1 else 1} a row"


def describe_run(path: Path) -> dict[str, Any]:
    """Settings, progress and the best validation of a run."""
    from ast_sim import checkpoint
    from ast_sim.run import Metrics, read_config

    settings = read_config(path)
    latest, best = checkpoint.latest(path), checkpoint.best(path)
    validations = [record for record in Metrics(path) if record.get("valid_rmse") is not None]
    chosen = min(validations, key=lambda record: record["valid_rmse"], default=None)
    return {
        "kind": "run",
        "path": str(path),
        **dataclasses.asdict(settings),
        "latest_checkpoint": latest.name if latest else None,
        "best_checkpoint": best.name if best else None,
        "best_validation": chosen,
    }


def text(facts: dict[str, Any], indent: str = "") -> str:
    """The facts as lines of text, nested ones indented."""
    lines = []
    width = max((len(key) for key, value in facts.items() if not isinstance(value, dict)), default=0)
    for key, value in facts.items():
        if isinstance(value, dict):
            lines += [f"{indent}{key}", text(value, indent + "  ")] if value else []
        else:
            shown = ", ".join(map(str, value)) if isinstance(value, list | tuple) else value
            lines.append(f"{indent}{key:{width}}  {'none' if shown in (None, '') else shown}")
    return "\n".join(lines)

"""The description of a dataset that `ast-sim info` prints. The whole dataset is read, and so it is checked as well."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim.dataset.reader import Dataset
from ast_sim.plausibility.across import AcrossSimulations
from ast_sim.plausibility.findings import Finding, told
from ast_sim.scene import NodeType
from ast_sim.support.errors import printable


def describe_dataset(path: Path) -> dict[str, Any]:
    """Counts, sizes, fields and units of a dataset; every trajectory is read and checked."""
    findings: list[tuple[str, Finding]] = []
    with Dataset(path) as dataset:
        across = AcrossSimulations(dynamic=dataset.info.integration == "dynamic")
        filled = [split for split, count in dataset.splits.items() if count]
        splits = {split: _describe_split(dataset, split, findings, across) for split in filled}
        findings += across.all_together()
        return {
            "kind": "dataset",
            "path": str(path),
            "bytes": Path(path).stat().st_size,
            **dataclasses.asdict(dataset.info),
            "splits": splits,
            "checks": "every trajectory has the right shapes, finite numbers and indices in range",
            "looks_wrong": [{"trajectory": name, **dataclasses.asdict(finding)} for name, finding in findings],
        }


def _describe_split(
    dataset: Dataset, split: str, findings: list[tuple[str, Finding]], across: AcrossSimulations
) -> dict[str, Any]:
    """What a split holds; what looks wrong in it is added to the findings."""
    sizes, truncated, outside = [], [], []
    lowest = np.full(3, np.inf)
    highest = np.full(3, -np.inf)
    largest = 0.0
    fields: dict[str, str] = {}
    types = dict.fromkeys((kind.name for kind in NodeType), 0)
    for index in range(dataset.count(split)):
        trajectory = dataset.load(split, index)
        scene = trajectory.scene
        name = f"{split}/{index:06d}"
        findings += [(name, one) for one in across.look(name, trajectory)]
        sizes.append((scene.num_nodes, scene.num_elements, trajectory.num_frames))
        for kind in NodeType:
            types[kind.name] += int((scene.node_type == kind).sum())
        if trajectory.attributes.get("status", "complete") != "complete":
            truncated.append(index)
        if (abs(trajectory.position - dataset.info.domain_center) > dataset.info.domain_half_width).any():
            outside.append(index)
        for position in trajectory.position:
            lowest = np.minimum(lowest, position.min(axis=0))
            highest = np.maximum(highest, position.max(axis=0))
            moved = position.astype(np.float64) - scene.rest_position
            largest = max(largest, float(np.linalg.norm(moved, axis=1).max()))
        for name, one in dataset.fields(split, index).items():
            fields[name] = f"{_field(one.values)} at each {one.location}, {one.unit or 'no unit'}"
        arrays = {one.name: getattr(scene, one.name) for one in dataclasses.fields(scene)}
        arrays |= {"position": trajectory.position, "stress": trajectory.stress}
        fields |= {name: _field(array) for name, array in arrays.items() if array is not None}
        for frame in range(trajectory.num_frames):  # one frame at a time saves memory: six numbers per element
            tensor = dataset.cauchy_stress(split, index, frame, frame + 1)
            if tensor is None:
                break
            fields["cauchy_stress"] = _field(tensor)
    nodes, elements, frames = ([min(counts), max(counts)] for counts in zip(*sizes, strict=True))
    return {
        "trajectories": len(sizes),
        "nodes": nodes,
        "elements": elements,
        "frames": frames,
        "bounding_box": [[float(f"{x:.6g}") for x in corner] for corner in (lowest, highest)],
        "largest_displacement": float(f"{largest:.6g}"),
        "node_types": types,
        "fields": fields,
        "truncated": truncated,
        "outside_domain": outside,
    }


def _field(array: Any) -> str:
    return f"{array.dtype}, {array.shape[-1] if array.ndim > 1 else 1} in a row"


def text(facts: dict[str, Any], indent: str = "") -> str:
    """The facts as lines of text; the facts of a nested dictionary are indented. Control characters are escaped."""
    facts = dict(facts)
    findings = [(one["trajectory"], Finding(*list(one.values())[1:])) for one in facts.pop("looks_wrong", ())]
    lines = []
    width = max((len(key) for key, value in facts.items() if not isinstance(value, dict)), default=0)
    for key, value in facts.items():
        if isinstance(value, dict):
            lines += [printable(f"{indent}{key}"), text(value, indent + "  ")] if value else []
        else:
            shown = ", ".join(map(str, value)) if isinstance(value, list | tuple) else value
            lines.append(printable(f"{indent}{key:{width}}  {'none' if shown in (None, '') else shown}"))
    lines += map(printable, told(findings))
    return "\n".join(lines)

"""Generates 40 samples of a family and checks them again, by other means than the generator's own checks.

`python -m benchmarks.simulation.generation FAMILY --json FILE` keeps the dataset in `build/generation`. A run that was
stopped goes on. For each sample the file says its size, its status, its seconds on one thread, the effort of the
solver, and the smallest gap and volume. The gap and the volume are computed again from the positions in the file.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.solver_seconds import read_seconds
from ast_sim.mechanics.contact_and_friction import Contact, ContactSettings
from ast_sim.scene import Trajectory
from ast_sim.simulate.jobs.generate import generate
from ast_sim.support.provenance import provenance

COUNT = 40
FOLDER = Path("build/generation")
EFFORT = ("newton_iterations", "factorizations", "halvings")
RECORDED = ("max_residual", "max_imbalance", "work_balance", "stopped_by")


def measure(family: str, workers: int) -> dict[str, Any]:
    """The records of all samples and what they say together."""
    made = generate(family, FOLDER / f"{family}.h5", train=COUNT, valid=0, test=0, seed=0, workers=workers)
    with Dataset(made.path) as dataset:
        seconds = read_seconds(dataset).samples
        samples = [
            sample(dataset.load("train", index), seconds[f"train/{index:06d}"])
            for index in range(dataset.count("train"))
        ]
        generator = dataset.info.generator
    return {"family": family, "generator": generator, "summary": summary(samples), "samples": samples}


def sample(trajectory: Trajectory, seconds: list[float]) -> dict[str, Any]:
    """What is found in one trajectory, and what its attributes say."""
    attributes = trajectory.attributes
    return {
        "nodes": trajectory.scene.num_nodes,
        "elements": trajectory.scene.num_elements,
        "frames": trajectory.num_frames,
        "status": attributes["status"],
        "seconds": sum(seconds),
        **{key: int(sum(attributes[key])) for key in EFFORT if key in attributes},
        **{key: attributes[key] for key in RECORDED if key in attributes},
        **geometry(trajectory),
    }


def geometry(trajectory: Trajectory) -> dict[str, Any]:
    """Smallest gap in metres, smallest volume ratio (None for cloth), frames that intersect, finiteness."""
    scene, attributes = trajectory.scene, trajectory.attributes
    settings = ContactSettings(attributes["dhat"], attributes["kappa"], self_contact=scene.elements.shape[1] == 3)
    position = trajectory.position.astype(np.float64)
    contact = Contact(position[0], scene.surface(), scene.body, settings)
    jacobian = None
    if scene.elements.shape[1] == 4:
        deforming = scene.deforming_nodes[scene.elements].any(axis=1)  # as for the solver
        volumes = np.stack([volume(frame[scene.elements[deforming]]) for frame in position])
        jacobian = float((volumes / volumes[0]).min())
    stored = [trajectory.position, trajectory.stress]
    return {
        "min_gap": min(contact.gap(frame) for frame in position),
        "min_jacobian": jacobian,
        "intersecting_frames": sum(contact.intersects(frame) for frame in position),
        "finite": all(np.isfinite(array).all() for array in stored if array is not None),
    }


def volume(corners: np.ndarray) -> np.ndarray:
    """Volumes [E] of tetrahedra [E,4,3]."""
    return np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6


def summary(samples: list[dict[str, Any]]) -> dict[str, Any]:
    """What the samples say together."""
    seconds = [one["seconds"] for one in samples]
    faulty = [
        index
        for index, one in enumerate(samples)
        if not one["finite"]
        or one["intersecting_frames"]
        or one["min_gap"] <= 0
        or (one["min_jacobian"] is not None and one["min_jacobian"] <= 0)
        or one["max_residual"] > 1
    ]
    return {
        "samples": len(samples),
        "complete": sum(one["status"] == "complete" for one in samples),
        "faulty": faulty,
        "seconds": {"median": statistics.median(seconds), "worst": max(seconds), "sum": sum(seconds)},
        "nodes": {"least": min(one["nodes"] for one in samples), "most": max(one["nodes"] for one in samples)},
        "min_gap": min(one["min_gap"] for one in samples),
        "min_jacobian": min((one["min_jacobian"] for one in samples if one["min_jacobian"] is not None), default=None),
        "max_residual": max(one["max_residual"] for one in samples),
    }


def main() -> None:
    """Generate, check, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("family")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    FOLDER.mkdir(parents=True, exist_ok=True)
    record = {
        **provenance(" ".join(["python -m benchmarks.simulation.generation", *sys.argv[1:]])),
        **measure(args.family, args.workers),
    }
    print(json.dumps(record["summary"], indent=1))
    if args.json is not None:
        args.json.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()

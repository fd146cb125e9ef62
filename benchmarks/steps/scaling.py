"""Time and memory of a training step of every model, by the size of the mesh (paper, section Scalability).

`python -m benchmarks.steps.scaling --json benchmarks/results/scaling.json`. A scene is two solid blocks of tetrahedra,
and a step takes one scene. Each model is as the AST paper has it. A model is given up at the size where a step fails or
takes longer than a limit; the reason is recorded.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim.dataset.layout import DatasetInfo
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.scene import NodeType, Scene, Trajectory
from ast_sim.simulate.shapes.mesh import hexahedral_grid
from ast_sim.support.disk import write_json
from ast_sim.support.provenance import provenance
from benchmarks.steps.step_worker import Setup
from benchmarks.steps.training_step import MEMORY, Worker

SIZES = (1_000, 2_000, 4_000, 8_000, 16_000, 32_000, 64_000, 100_000)  # nodes, about
PRESETS = {"ast": "deforming_plate", "mgn": "paper", "bsms": "paper", "hcmt": "paper", "transolver": "original"}
REPEATS = 3


def write_blocks(path: Path, nodes: int) -> tuple[int, int]:
    """A dataset of two blocks, the upper one pressed onto the lower; its nodes and tetrahedra.

    Blocks are 1.8 wide, with about half the nodes each; world edges are as long as the edges of the hexahedra.
    """
    side = max(3, round((nodes / 2) ** (1 / 3)))
    step = 1.8 / (2 * side)
    coordinates, tetrahedra = hexahedral_grid((side - 1,) * 3)
    lower = coordinates * step - (0.9, 0.9, 0.9)
    rest = np.concatenate([lower, lower + (0, 0, (side - 0.5) * step)])
    travel = np.zeros((3, len(rest), 3))
    height = (lower[:, 2] - lower[:, 2].min()) / np.ptp(lower[:, 2])
    travel[1:, len(lower) :, 2] = -0.2 * step * np.array([[1.0], [2.0]]) * height
    scene = Scene(
        rest.astype(np.float32),
        np.concatenate([tetrahedra, tetrahedra + len(lower)]).astype(np.int32),
        np.where(np.tile(height, 2) == np.repeat([0, 1], len(lower)), NodeType.HANDLE, NodeType.NORMAL).astype(
            np.uint8
        ),
        np.repeat([0, 1], len(lower)).astype(np.int32),
    )
    position = (rest + travel).astype(np.float32)
    info = DatasetInfo("blocks", "quasi_static", "none", (0.0, 0.0, 0.0), 1.0, step, 0.0)
    with DatasetWriter(path, info) as writer:
        for split in ("train", "test"):
            writer.add(split, Trajectory(scene, position, None, {}))
    return scene.num_nodes, scene.num_elements


def measure(model: str, data: Path, threads: int, folder: Path) -> dict[str, Any]:
    """Seconds of a training step and peak resident bytes; `failed` says why there are none."""
    settings = ["train.batch_size=1", "train.statistics_pairs=1", "train.steps=100"]
    worker = Worker("c", threads, Setup(str(data), model, PRESETS[model], settings, str(folder)), folder / "worker.log")
    try:
        worker.ask("step")  # fills caches
        samples = [worker.ask("step") for _ in range(REPEATS)]
        return {
            "seconds": {"min": min(samples), "median": statistics.median(samples), "samples": samples},
            "peak_resident_bytes": worker.ask("resident"),
        }
    except RuntimeError as error:
        return {"failed": str(error)}
    finally:
        worker.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True, metavar="FILE", help="write all records here")
    parser.add_argument("--models", nargs="+", choices=PRESETS, default=list(PRESETS), help="only these")
    parser.add_argument("--sizes", nargs="+", type=int, default=list(SIZES), help="nodes, about")
    parser.add_argument("--threads", type=int, default=2, help="(%(default)s)")
    parser.add_argument("--longest", type=float, default=120.0, help="seconds of a step at most (%(default)s)")
    arguments = parser.parse_args()
    made = provenance(" ".join(["python -m benchmarks.steps.scaling", *sys.argv[1:]]))
    records: list[dict[str, Any]] = []
    running = list(arguments.models)
    with tempfile.TemporaryDirectory() as folder:
        for size in arguments.sizes:
            data = Path(folder) / f"{size}.h5"
            nodes, elements = write_blocks(data, size)
            for model in list(running):
                figures = measure(model, data, arguments.threads, Path(folder))
                record = {"model": model, "preset": PRESETS[model], "nodes": nodes, "elements": elements, **figures}
                if "failed" in figures or figures["seconds"]["min"] > arguments.longest:
                    running.remove(model)
                records.append(record)
                print(json.dumps(record), flush=True)
                # After each, so that a run that is cut off leaves what it found.
                header = {**made, "threads": arguments.threads, "memory_limit_bytes": MEMORY}
                write_json(arguments.json, {**header, "records": records})


if __name__ == "__main__":
    main()

"""What each increment of an unfinished sample has cost so far, from the file that keeps its frames.

`python -m benchmarks.simulation.increments FILE.h5.parts/train-000000.checkpoint --json FILE`. It is meant for large
samples, whose cost is worth knowing before they are finished.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from ast_sim.mechanics.unfinished import Checkpoint
from ast_sim.support.disk import write_json
from ast_sim.support.provenance import provenance


def measure(path: Path) -> dict[str, Any]:
    """Size of the sample, and seconds of the processor, effort and checks of each increment that has converged."""
    arrays = Checkpoint(path).load()
    if arrays is None:
        sys.exit(f"{path}: there are no frames to be read")
    increments = json.loads(str(arrays["records"]))[1:]  # the first frame is the rest state
    return {
        "nodes": arrays["position"].shape[1],
        "elements": arrays["stress"].shape[1],
        "seconds": sum(increment["solve_seconds"] for increment in increments),
        "increments": increments,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--json", type=Path, required=True, metavar="FILE", help="write what is found here")
    arguments = parser.parse_args()
    record = measure(arguments.checkpoint)
    write_json(
        arguments.json,
        {**provenance(" ".join(["python -m benchmarks.simulation.increments", *sys.argv[1:]])), **record},
    )
    print(f"{len(record['increments'])} increments in {record['seconds']:,.0f} s")


if __name__ == "__main__":
    main()

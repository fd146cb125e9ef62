"""The runs that come with the package, calibrated.

`python -m benchmarks.studies.shipped NAME RUN DATA` takes a trained run, its folder or a file, calibrates it on scenes
that are new to it, and writes ast_sim/example_runs/NAME.ast. The runs and their scenes:

    plates: the row plates400 of benchmarks.studies.jumps; calibration.h5 of benchmarks.studies.coverage (split test)
    clip: benchmarks.studies.clip; its 40 scenes of the split calibration
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from pathlib import Path

import ast_sim
from ast_sim.dataset.layout import SPLITS

SHIPPED = Path(ast_sim.__file__).parent / "example_runs"
LICENCE = "CC0 1.0: do with it what you like."


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", metavar="NAME", help="by which `ast_sim.example_run` knows it")
    parser.add_argument("run", type=Path, metavar="RUN", help="folder or file of the run")
    parser.add_argument("data", type=Path, metavar="DATA", help="dataset with scenes that are new to the run")
    parser.add_argument("--split", choices=SPLITS, default="calibration", help="whose scenes (default: calibration)")
    args = parser.parse_args(arguments)
    run = ast_sim.Run(args.run)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # scenes outside the training do not count
        calibration = ast_sim.calibrate(run, args.data, args.split)
    run.save(SHIPPED / f"{args.name}.ast", LICENCE)
    print(calibration.text)


if __name__ == "__main__":
    main()

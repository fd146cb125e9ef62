"""The run of plates that comes with the package, calibrated.

`python -m benchmarks.studies.shipped RUN` takes the run of the row `plates400` of the study of jumps, its folder or a
file, calibrates it on the hundred plates of the study of coverage, and writes ast_sim/example_runs/plates.ast.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from pathlib import Path

import ast_sim
from benchmarks.studies.coverage import plates

SHIPPED = Path(ast_sim.__file__).parent / "example_runs" / "plates.ast"
LICENCE = "CC0 1.0: do with it what you like."


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, metavar="RUN", help="folder or file of the run")
    parser.add_argument("--folder", type=Path, default=Path("build/coverage"), help="scenes (default: build/coverage)")
    args = parser.parse_args(arguments)
    run = ast_sim.Run(args.run)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # scenes outside the training do not count
        calibration = ast_sim.calibrate(run, plates(args.folder, "calibration"), "test")
    run.save(SHIPPED, LICENCE)
    print(calibration.text)


if __name__ == "__main__":
    main()

"""The runs that come with the package, from nothing: simulated, trained, calibrated and saved.

`python -m benchmarks.studies.shipped [NAME ...]` (or `make shipped`, both) writes ast_sim/example_runs/NAME.ast. Data
and runs lie in `--folder`; a second call goes on with what is there. On one thread plates take about 100
minutes (Zen 5), the clip about 270 (Xeon, beside other work), of which CalculiX takes 185.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from pathlib import Path

import ast_sim
from benchmarks.studies import clip, coverage, jumps

SHIPPED = Path(ast_sim.__file__).parent / "example_runs"
LICENCE = "CC0 1.0: do with it what you like."


def plates_run(folder: Path) -> tuple[ast_sim.Run, Path, str]:
    """The run, and the dataset and the split whose scenes calibrate it."""
    run, _ = jumps.trained("plates400_long", folder)
    return run, coverage.scenes("plates", folder, "calibration"), "test"


def clip_run(folder: Path) -> tuple[ast_sim.Run, Path, str]:
    """As `plates_run`."""
    return *clip.trained(clip.Plan(), folder), "calibration"


RUNS = {"plates": plates_run, "clip": clip_run}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"{' or '.join(RUNS)} (default: both)")
    parser.add_argument(
        "--folder", type=Path, default=Path("build/shipped"), help="data, runs (default: build/shipped)"
    )
    options = parser.parse_args(arguments)
    unknown = set(options.names) - set(RUNS)
    if unknown:
        parser.error(f"there is no run {sorted(unknown)}: choose from {list(RUNS)}")
    for name in options.names or RUNS:
        run, data, split = RUNS[name](options.folder)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # scenes outside the training do not count
            calibration = ast_sim.calibrate(run, data, split)
        run.save(SHIPPED / f"{name}.ast", LICENCE)
        print(f"{name}: {calibration.text}")


if __name__ == "__main__":
    main()

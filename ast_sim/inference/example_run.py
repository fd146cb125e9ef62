"""Trained runs that come with the package."""

from __future__ import annotations

from importlib.resources import as_file, files

from ast_sim.inference.trained_run import Run
from ast_sim.runs.run_file import SUFFIX
from ast_sim.support.errors import ConfigError, nearest_name


def example_run(name: str) -> Run:
    """A trained run that comes with the package; nothing is fetched.

    "plates": clamped plates of about 400 nodes that a rigid obstacle presses in (the family "deforming_plate"), lengths
    in metres. It is the row `plates400_long` of the study of jumps: `docs/results/jumps.md` has its errors and times.
    "clip": the metal clip of `examples/clip`, which keeps a permanent set, with about 3,600 nodes; lengths in
    millimetres. `docs/results/clip.md` has its errors and times.

    Raises:
        ConfigError: there is no such run; the text names the nearest.
    """
    folder = files("ast_sim") / "example_runs"
    names = sorted(file.name.removesuffix(SUFFIX) for file in folder.iterdir() if file.name.endswith(SUFFIX))
    if name not in names:
        raise ConfigError(f"there is no example run {name!r}{nearest_name(name, names)}")
    with as_file(folder / f"{name}{SUFFIX}") as path:
        return Run(path)

"""The clip of `clip.py` with two round holes side by side in its arm, which no scene of `SPEC.toml` has.

A script of its own: runs know `clip.py` by its contents, and tell a question in which it has changed.
"""

import runpy
from pathlib import Path

CLIP = runpy.run_path(str(Path(__file__).with_name("clip.py")))


def two_holes(gmsh, length, thickness, place):
    """The clip with two round holes across the arm."""
    holes = [CLIP["_drill"](gmsh, thickness, side, place * length, 0.7) for side in (-1.2, 1.2)]
    CLIP["_cut"](gmsh, CLIP["_strip"](gmsh, length, thickness), holes)

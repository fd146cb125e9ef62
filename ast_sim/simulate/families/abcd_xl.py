"""Scene family `abcd_xl`: the pairs of `abcd` with 100,000 nodes. Elements are about a third as long."""

from __future__ import annotations

from dataclasses import replace

from ast_sim.simulate.families import abcd
from ast_sim.simulate.families.abcd import FRAMES, SETTINGS, draw, draw_geometry, solve

__all__ = ["DEFAULT_NODES", "FRAMES", "INFO", "MINIMUM_NODES", "SETTINGS", "draw", "draw_geometry", "solve"]

DEFAULT_NODES = 100_000
MINIMUM_NODES = 10_000
INFO = replace(abcd.INFO, family="abcd_xl")

"""Scene family `abcd_xl`: the pairs of `abcd` with 100,000 nodes, about a third of their element size."""

from __future__ import annotations

from dataclasses import replace

from ast_sim.simulate import abcd
from ast_sim.simulate.abcd import draw, solve

__all__ = ["DEFAULT_NODES", "INFO", "MINIMUM_NODES", "draw", "solve"]

DEFAULT_NODES = 100_000
MINIMUM_NODES = 10_000
INFO = replace(abcd.INFO, family="abcd_xl")

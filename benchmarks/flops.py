"""Useful floating point operations of our ops, for torch's FlopCounterMode: those of the formulas, no recomputation."""

from __future__ import annotations

FORMULAS: dict = {}

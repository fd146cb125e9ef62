"""Findings: what looks wrong, how often and where, and what it would mean."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ast_sim.number_arrays import point

_PLACES = 3  # places that are named, at most


@dataclass(frozen=True)
class Finding:
    """Something that looks wrong.

    Attributes:
        what: what it is, a noun in the plural: "elements that stand twice".
        count: how often.
        places: the first places, as text.
        meaning: what follows from it.
        may_be_meant: whether it may well be as it should: `--strict` lets it pass.
    """

    what: str
    count: int
    places: str
    meaning: str
    may_be_meant: bool = False

    def __str__(self) -> str:
        return f"{_counted(self.count, self.what)} ({self.places}): {self.meaning}"


Findings = Sequence[tuple[str, Finding]]  # the name of a scene or simulation, and what looks wrong in it


def told(findings: Findings) -> list[str]:
    """A table as lines of text: how often, what, where, and what it means; no line if nothing looks wrong."""
    rows = [("what looks wrong", "where", "what it means"), *_rows(findings)]
    widths = [max(len(row[column]) for row in rows) for column in (0, 1)]
    lines = [f"{one:{widths[0]}}  {where:{widths[1]}}  {meaning}" for one, where, meaning in rows]
    return lines if findings else []


def wrong(findings: Findings) -> Findings:
    """The findings that cannot be meant."""
    return [(name, finding) for name, finding in findings if not finding.may_be_meant]


def refusal(findings: Findings) -> str:
    """One line for an error: all that looks wrong."""
    return "; ".join(f"{what} ({where}): {meaning}" for what, where, meaning in _rows(findings))


def _rows(findings: Findings) -> list[tuple[str, str, str]]:
    """What, where and what it means; findings of one kind stand in one row."""
    kinds: dict[str, list[tuple[str, Finding]]] = {}
    for name, finding in findings:
        kinds.setdefault(finding.what, []).append((name, finding))
    rows = []
    for what, of_kind in kinds.items():
        name, first = of_kind[0]
        names = list(dict.fromkeys(name for name, _ in of_kind))
        listed = ", ".join(names[:_PLACES]) + (", ..." if len(names) > _PLACES else "")
        several = f"in {len(names)} simulations ({listed}); " if len(names) > 1 else ""
        total = sum(finding.count for _, finding in of_kind)
        rows.append((_counted(total, what), f"{several}{name}: {first.places}", first.meaning))
    return rows


def _counted(number: int, what: str) -> str:
    return f"{number:,} {what}" if number > 1 else f"{what}: {number}"  # the noun is a plural


def places(kind: str, rows: np.ndarray, points: np.ndarray | None = None) -> str:
    """The first rows [n] as text: places("elements", rows) is "elements 3, 5, 8, ...", of one row "element 3"; with
    `points` [n, 3] the place of the first."""
    shown = ", ".join(str(row) for row in rows[:_PLACES].tolist()) + (", ..." if len(rows) > _PLACES else "")
    at = f", the first at {point(points[0])}" if points is not None and len(points) else ""
    return f"{kind.removesuffix('s') if len(rows) == 1 else kind} {shown}{at}"

"""Places: a short text that selects nodes of a body, by its ends, by planes and boxes, by a field or by a named group.

all                        all nodes
xmin, xmax, ymin, ...      the nodes at this end of the body
x>0.3, z<=0.01, y=2        the nodes for which this holds
0.1<x<0.3, 0<=z<=2         the nodes between two planes
field=NAME                 the nodes at which this point field is not zero
group=NAME                 the nodes of this named group of the mesh
A and B                    the nodes in both places; three of them make a box
A,B                        the nodes in either place
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

# Two coordinates count as equal if they differ by less than this share of the size of their body.
_SAME = 1e-6

_NUMBER = r"[^\s<>=xyz]+"
_TERM = re.compile(
    rf"(?P<all>all)|(?P<kind>field|group)=(?P<name>.+)|(?P<end>[xyz])(?P<side>min|max)"
    rf"|(?P<axis>[xyz])(?P<rule><=|>=|<|>|=)(?P<limit>{_NUMBER})"
    rf"|(?P<low>{_NUMBER})(?P<above><=|<)(?P<between>[xyz])(?P<below><=|<)(?P<high>{_NUMBER})"
)

Mask = Callable[[str], np.ndarray]


class Rule(NamedTuple):
    """What holds for the nodes of a place: a `kind` ("all", "field", "group", "min", "max", "<=", ...), the name of the
    field or the group, the axis, and the limit."""

    kind: str
    name: str = ""
    axis: int = 0
    limit: float = 0.0

    def holds(self, points: np.ndarray, field: Mask, group: Mask) -> np.ndarray:
        """[k] bool: for which of the points [k, 3] of a body this holds; see `Place.inside`."""
        if self.kind in ("field", "group"):
            return {"field": field, "group": group}[self.kind](self.name)
        if self.kind == "all":
            return np.ones(len(points), bool)
        x, tolerance, limit = points[:, self.axis], _SAME * np.ptp(points, axis=0).max(), self.limit
        return {
            "min": x <= x.min() + tolerance,
            "max": x >= x.max() - tolerance,
            "<=": x <= limit + tolerance,
            ">=": x >= limit - tolerance,
            "<": x < limit - tolerance,
            ">": x > limit + tolerance,
            "=": np.abs(x - limit) <= tolerance,
        }[self.kind]


class Place(NamedTuple):
    """A part of a body: the nodes for which all of the rules hold, and the text that says so."""

    text: str
    rules: tuple[Rule, ...]

    def inside(self, points: np.ndarray, field: Mask, group: Mask) -> np.ndarray:
        """[k] bool: which nodes of a body lie in the place.

        Args:
            points: [k, 3] where the nodes are.
            field, group: functions of a name: at which of the nodes the field is not zero, which belong to the group.
        """
        return np.all([rule.holds(points, field, group) for rule in self.rules], axis=0)


def parse_places(text: str) -> list[Place]:
    """The places of `PLACE[,PLACE...]`; a node in any of them is selected.

    Raises:
        ValueError: the text has another form.
    """
    return [_place(part.strip()) for part in text.split(",")]


def _place(text: str) -> Place:
    return Place(text, tuple(rule for part in re.split(r"\s+and\s+", text) for rule in _rules(part)))


def _rules(text: str) -> list[Rule]:
    found = _TERM.fullmatch(text if "=" in text and text[:5] in ("field", "group") else re.sub(r"\s+", "", text))
    if found is None:
        raise ValueError(text)
    if found["all"]:
        return [Rule("all")]
    if found["kind"]:
        return [Rule(found["kind"], name=found["name"])]
    if found["end"]:
        return [Rule(found["side"], axis="xyz".index(found["end"]))]
    if found["axis"]:
        return [_limit(found["rule"], found["axis"], found["limit"])]
    above = _limit(found["above"].replace("<", ">"), found["between"], found["low"])
    return [above, _limit(found["below"], found["between"], found["high"])]


def _limit(rule: str, axis: str, number: str) -> Rule:
    limit = float(number)
    if not np.isfinite(limit):
        raise ValueError(number)
    return Rule(rule, axis="xyz".index(axis), limit=limit)

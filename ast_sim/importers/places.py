"""Places: a short text that selects nodes of a body, by its ends, by planes and boxes, by a field or by a named group.

all                        all nodes
xmin, xmax, ymin, ...      the nodes at this end of the body
x>0.3, z<=0.01, y=2        the nodes for which this holds
0.1<x<0.3, 0<=z<=2         the nodes between two planes
field=NAME                 the nodes at which this point field is not zero
group=NAME                 the nodes of this named group of the mesh
A and B                    the nodes in both places; three of them make a box
A,B                        the nodes in either place

A name that holds "and" or a comma stands in quotes, group="left, right", unless the mesh is known and has this name.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np

# Two coordinates count as equal if they differ by less than this share of the size of their body.
_SAME = 1e-6

_NUMBER = r"[^\s<>=xyz]+"
_TERM = re.compile(
    rf"(?P<all>all)|(?P<end>[xyz])(?P<side>min|max)"
    rf"|(?P<axis>[xyz])(?P<rule><=|>=|<|>|=)(?P<limit>{_NUMBER})"
    rf"|(?P<low>{_NUMBER})(?P<above><=|<)(?P<between>[xyz])(?P<below><=|<)(?P<high>{_NUMBER})"
)

_NAMED = re.compile(r"\s*(field|group)\s*=\s*")
_BETWEEN = re.compile(r"\s*(,\s*|\s+and\s+|$)")

# An end is flat to this share of the shortest edge of its body: a conversion rounds to five digits or fewer.
_FLAT_END = 0.01

Mask = Callable[[str], np.ndarray]


class Rule(NamedTuple):
    """What holds for the nodes of a place: a `kind` ("all", "field", "group", "min", "max", "<=", ...), the name of the
    field or the group, the axis, and the limit."""

    kind: str
    name: str = ""
    axis: int = 0
    limit: float = 0.0

    def holds(self, points: np.ndarray, field: Mask, group: Mask, shortest: float = 0.0) -> np.ndarray:
        """[k] bool: for which of the points [k, 3] of a body this holds; see `Place.inside`."""
        if self.kind in ("field", "group"):
            return {"field": field, "group": group}[self.kind](self.name)
        if self.kind == "all":
            return np.ones(len(points), bool)
        x = points[:, self.axis]
        tolerance = _SAME * np.ptp(points, axis=0).max()
        limit = self.limit
        at_end = max(tolerance, _FLAT_END * shortest)
        return {
            "min": x <= x.min() + at_end,
            "max": x >= x.max() - at_end,
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

    def inside(self, points: np.ndarray, field: Mask, group: Mask, shortest: float = 0.0) -> np.ndarray:
        """[k] bool: which nodes of a body lie in the place.

        Args:
            points: [k, 3] where the nodes are.
            field, group: functions of a name: at which of the nodes the field is not zero, which belong to the group.
            shortest: the shortest edge of the body. Nodes that are off the end by less than a hundredth of it belong
                to the end. 0: only nodes that are off by rounding.
        """
        return np.all([rule.holds(points, field, group, shortest) for rule in self.rules], axis=0)


def marked(values: np.ndarray) -> np.ndarray:
    """Which values of a field are a mark: all but zero. NaN is no mark: it stands where there is no value."""
    return ~np.isnan(values) & (values != 0)


def parse_places(text: str, known: Iterable[str] = ()) -> list[Place]:
    """The places of `PLACE[,PLACE...]`; a node in any of them is selected.

    Args:
        known: names of fields and groups, which may hold commas and the word "and".

    Raises:
        ValueError: the text has another form.
    """
    places: list[Place] = []
    rules: list[Rule] = []
    start = 0
    for place, rule, ends in _terms(text, sorted(known, key=len, reverse=True)):
        rules += rule
        if ends:
            places.append(Place(text[start:place].strip().removesuffix(",").strip(), tuple(rules)))
            rules = []
            start = place
    return places


def _terms(text: str, known: list[str]) -> Iterator[tuple[int, list[Rule], bool]]:
    """(where the next term begins, the rules of a term, whether its place ends with it)."""
    place = 0
    while True:
        named = _NAMED.match(text, place)
        if named is None:
            end = re.compile(r",|\s+and\s+|$").search(text, place)
            assert end is not None
            rules = _rules(text[place : end.start()])
            place = end.start()
        else:
            name, place = _name(text, named.end(), known)
            rules = [Rule(named[1], name=name)]
        between = _BETWEEN.match(text, place)
        if between is None:
            raise ValueError(text[place:])
        place = between.end()
        last = not between[1]
        yield place, rules, last or "," in between[1]
        if last:
            return


def _name(text: str, start: int, known: list[str]) -> tuple[str, int]:
    """The name that begins there, and where it ends."""
    if text[start : start + 1] == '"':
        end = text.index('"', start + 1)
        return text[start + 1 : end], end + 1
    for name in known:
        if text.startswith(name, start) and _BETWEEN.match(text, start + len(name)):
            return name, start + len(name)
    end = re.compile(r"\s*(,|\s+and\s+|$)").search(text, start)
    assert end is not None
    if end.start() == start:
        raise ValueError(text)
    return text[start : end.start()], end.start()


def _rules(text: str) -> list[Rule]:
    term = _TERM.fullmatch(re.sub(r"\s+", "", text))
    if term is None:
        raise ValueError(text)
    if term["all"]:
        return [Rule("all")]
    if term["end"]:
        return [Rule(term["side"], axis="xyz".index(term["end"]))]
    if term["axis"]:
        return [_limit(term["rule"], term["axis"], term["limit"])]
    above = _limit(term["above"].replace("<", ">"), term["between"], term["low"])
    return [above, _limit(term["below"], term["between"], term["high"])]


def _limit(rule: str, axis: str, number: str) -> Rule:
    limit = float(number)
    if not np.isfinite(limit):
        raise ValueError(number)
    return Rule(rule, axis="xyz".index(axis), limit=limit)

"""Which nodes and values a line of a deck means, and the one temperature that a node has during the whole job."""

from __future__ import annotations

import numpy as np

from ast_sim.importers.decks.deck_numbers import real, refuse_decimal_commas, tokens
from ast_sim.importers.decks.deck_parts import Deck
from ast_sim.importers.decks.keyword_lines import Keyword, known_key
from ast_sim.importers.formats.source_mesh import SourceMesh

# In steps of these the temperatures are computed.
_COMPUTED = {"HEATTRANSFER", "COUPLEDTEMPERATURE-DISPLACEMENT", "UNCOUPLEDTEMPERATURE-DISPLACEMENT"}

# With these options the values are no numbers of the lines, or not these alone.
_ELSEWHERE = {"FILE", "USER", "SUBMODEL", "AMPLITUDE", "INTERPOLATE"}


def rows_of_target(keyword: Keyword, target: str, mesh: SourceMesh) -> np.ndarray:
    """The points of a node or of a set of nodes, by the number or the name in a line of a keyword.

    Raises:
        DatasetError: there is no such set.
    """
    if target.isdigit():
        assert mesh.same_point is not None
        return np.flatnonzero(mesh.same_point == int(target))
    groups = {name.upper(): nodes for name, nodes in mesh.groups.items()}
    key = known_key(target, groups)
    if key not in groups:
        raise keyword.error(f"there is no set of nodes {target!r}")
    return groups[key]


def node_temperatures(deck: Deck, mesh: SourceMesh) -> np.ndarray:
    """[n] the temperature that each node has at rest and keeps; NaN where the deck says none, or several.

    Raises:
        DatasetError: a line cannot be read, or names a set that there is not.
    """
    first, later = np.full((2, len(mesh.points)), np.nan)
    changes = np.zeros(len(mesh.points), bool)
    for keyword in deck.keywords:
        initial = keyword.name == "INITIALCONDITIONS" and keyword.options.get("TYPE", "").upper() == "TEMPERATURE"
        changes |= keyword.name in _COMPUTED
        if not initial and keyword.name != "TEMPERATURE":
            continue
        changes |= bool(keyword.options.keys() & _ELSEWHERE)
        for line in keyword.data:
            refuse_decimal_commas(line, 2, "a target and a temperature")
            target, value = [*tokens(line), "", ""][:2]
            rows = rows_of_target(keyword, target, mesh)
            given = first if initial else later
            given[rows] = real(value, line)
            if not initial:
                changes[rows] |= later[rows] != first[rows]
    return np.where(changes, np.nan, first)

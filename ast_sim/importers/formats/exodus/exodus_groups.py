"""The groups of nodes of an Exodus file: its sets of nodes, the nodes of its sets of sides, the nodes of its blocks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from ast_sim.support.errors import DatasetError

_Parts = Sequence[dict[str, np.ndarray]]


def groups_in(path: Path, parts: _Parts, nodes: int) -> tuple[dict[str, np.ndarray], list[str]]:
    """The numbers of the nodes of each group in the whole file, from 0, and notes.

    Sets of one kind and name are one group. If kinds share a name, a set of nodes goes before a set of sides, and this
    before a block.

    Args:
        parts: what the process that reads files has sent of the blocks and sets.
        nodes: how many nodes the file has.

    Raises:
        DatasetError: a set of nodes has a node that is not there.
    """
    groups: dict[str, np.ndarray] = {}
    notes = []
    kinds = {"set of nodes": _sets(parts, "nodes "), "set of sides": _sets(parts, "sides "), "block": _blocks(parts)}
    for kind, held in kinds.items():
        of_kind: dict[str, list[np.ndarray]] = {}
        for name, ids in held:
            of_kind.setdefault(name, []).append(ids)
        for name, lists in of_kind.items():
            together = np.unique(np.concatenate(lists))
            wrong = together[(together < 0) | (together >= nodes)]
            if len(wrong) and kind != "block":  # VTK's elements are checked where they are read
                raise DatasetError(
                    f"{path}: the {kind} {name!r} has the node {wrong[0] + 1}, but the nodes are 1 to {nodes}: write"
                    " the file again with the nodes that there are"
                )
            if name not in groups:
                groups[name] = together
                if len(lists) > 1 and kind != "block":
                    notes.append(f"{len(lists)} sets have the name {name!r}: they are taken together")
            elif not np.array_equal(groups[name], together):
                notes.append(f"the {kind} {name!r} is no group: a set with this name has other nodes")
    return groups, notes


def _sets(parts: _Parts, kind: str) -> Iterator[tuple[str, np.ndarray]]:
    start = f"group {kind}"
    for part in parts:
        yield from ((name.removeprefix(start), ids) for name, ids in part.items() if name.startswith(start))


def _blocks(parts: _Parts) -> Iterator[tuple[str, np.ndarray]]:
    for part in parts:
        if "block" in part and "global" in part:
            yield part["block"].item().decode(errors="replace").rpartition("/")[2], part["global"]

"""What a deck is made of: the nodes, elements and sets of its parts, and the instances of the parts."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ast_sim.importers.decks.keyword_lines import Keyword


class Members(NamedTuple):
    """Nodes or elements of a set: the instance that they belong to ("" for the scope itself), and their numbers. A set
    of nodes may have the nodes of elements."""

    instance: str
    numbers: np.ndarray
    of_elements: bool = False


Sets = dict[str, list[Members]]


class Numbered:
    """Where numbers stand in blocks of numbers that are added one by one: the last place counts."""

    def __init__(self) -> None:
        self.places: dict[int, tuple[int, int]] = {}
        self.taken = 0

    def find(self, blocks: list[np.ndarray], wanted: np.ndarray, what: str) -> list[tuple[int, int]]:
        """The block and the row of each number.

        Raises:
            LookupError: there is none; the text names it.
        """
        for block, numbers in enumerate(blocks[self.taken :], self.taken):
            self.places.update(zip(numbers.tolist(), ((block, row) for row in range(len(numbers))), strict=True))
        self.taken = len(blocks)
        missing = next((number for number in wanted.tolist() if number not in self.places), None)
        if missing is not None:
            raise LookupError(f"there is no {what} {missing} before this line")
        return [self.places[number] for number in wanted.tolist()]


@dataclass(frozen=True, eq=False)
class ElementBlock:
    """Elements of one type: `numbers` [c]; `nodes` [c, k] numbers of nodes, or names "instance.number" in an
    assembly."""

    type_name: str
    kind: str
    numbers: np.ndarray
    nodes: np.ndarray | list[list[str]]
    keyword: Keyword


class UsersOwn(NamedTuple):
    """Elements of a type whose shape is not known (*USER ELEMENT): how many, and the numbers [n] of all their nodes."""

    type_name: str
    how_many: int
    nodes: np.ndarray
    keyword: Keyword


@dataclass(eq=False)
class Content:
    """Nodes, elements and sets of the deck, of a part, of an instance or of the assembly. Names are in upper case.

    Attributes:
        unsorted: the sets of nodes that keep the order in which the deck lists them.
        left_out: the types of elements that are left out, by their numbers.
    """

    name: str = ""
    nodes: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    blocks: list[ElementBlock] = field(default_factory=list)
    users_own: list[UsersOwn] = field(default_factory=list)
    node_sets: Sets = field(default_factory=dict)
    element_sets: Sets = field(default_factory=dict)
    unsorted: set[str] = field(default_factory=set)
    left_out: dict[int, str] = field(default_factory=dict)
    node_places: Numbered = field(default_factory=Numbered)
    element_places: Numbered = field(default_factory=Numbered)


@dataclass(frozen=True, eq=False)
class Instance:
    """A part that is placed: `rotation` [3, 3] and `shift` [3] say where, x -> rotation x + shift."""

    part: Content
    own: Content
    rotation: np.ndarray
    shift: np.ndarray


@dataclass(eq=False)
class Deck:
    """A deck: all keywords in order, and what they say of the mesh. `written` has names as they were first written;
    `formulas` are the names of analytical rigid surfaces."""

    path: Path
    keywords: list[Keyword]
    root: Content = field(default_factory=Content)
    parts: dict[str, Content] = field(default_factory=dict)
    instances: dict[str, Instance] = field(default_factory=dict)
    written: dict[str, str] = field(default_factory=dict)
    ignored: Counter[str] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)
    formulas: list[str] = field(default_factory=list)

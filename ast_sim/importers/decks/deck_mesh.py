"""The mesh of a deck: all instances of its parts in their places, with the named sets of their nodes."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ast_sim.importers.decks.deck_content import read_deck
from ast_sim.importers.decks.deck_parts import Content, Deck, ElementBlock, Members
from ast_sim.importers.decks.element_types import REVOLVED
from ast_sim.importers.formats.source_mesh import CellBlock, SourceMesh
from ast_sim.support.errors import DatasetError, counted


@dataclass(frozen=True, eq=False)
class _Scope:
    """The nodes and elements of an instance, or of the deck itself. `start` is where its nodes begin in the mesh.

    The nodes of element i of all blocks together are `element_nodes[element_start[i] : element_start[i + 1]]`.
    """

    name: str
    numbers: np.ndarray
    points: np.ndarray
    start: int
    contents: tuple[Content, ...]


def deck_mesh(path: Path) -> SourceMesh:
    """The mesh of a deck of Abaqus or CalculiX.

    Groups are the sets of nodes and the nodes of the sets of elements. A set of an instance is called INSTANCE.SET,
    and SET as well if no other set has this name. An instance is a group, too.

    Raises:
        DatasetError: a line cannot be read, something that changes the mesh is not understood, or an element refers to
            a node that there is not; the text names the file and the line.
    """
    return mesh_of_deck(read_deck(path))


def mesh_of_deck(deck: Deck, understood: Collection[str] = ()) -> SourceMesh:
    """As `deck_mesh`. The keywords that are `understood` are not listed as ignored. The points of a deck without parts
    have the numbers of its nodes."""
    return _Assembly(deck).mesh(understood)


class _Assembly:
    """The parts of a deck as they are put together."""

    def __init__(self, deck: Deck) -> None:
        self.deck = deck
        self.notes: list[str] = []
        self.scopes: dict[str, _Scope] = {}
        self._add("", (deck.root,), np.eye(3), np.zeros(3))
        for name, one in deck.instances.items():
            self._add(name, (one.part, one.own), one.rotation, one.shift)
        if not deck.instances and deck.parts:
            self._parts_without_instances()
        placed = {one.part.name for one in deck.instances.values()}
        for name, part in deck.parts.items() if placed else ():
            if name not in placed and part.blocks:
                count = sum(len(block.numbers) for block in part.blocks)
                self.notes.append(
                    f"the part {deck.written[name]} has no instance: its {counted(count, 'element is', 'elements are')}"
                    " left out"
                )
        self.blocks: list[CellBlock] = []
        self.elements: dict[str, tuple[np.ndarray, list[np.ndarray]]] = {}

    def _add(self, name: str, contents: tuple[Content, ...], rotation: np.ndarray, shift: np.ndarray) -> None:
        given = [block for content in contents for block in content.nodes]
        numbers = np.concatenate([np.zeros(0, np.int64), *(block[0] for block in given)])
        points = np.concatenate([np.zeros((0, 3)), *(block[1] for block in given)])
        unique, first = np.unique(numbers[::-1], return_index=True)  # the last definition of a node counts
        last = len(numbers) - 1 - first
        if len(unique) < len(numbers):
            same = points[last[np.searchsorted(unique, numbers)]] == points
            changed = len(np.unique(numbers[~same.all(axis=1)]))
            if changed:
                self.notes.append(
                    f"{counted(changed, 'node stands', 'nodes stand')} in the deck more than once: the last place"
                    " counts"
                )
        start = sum(len(scope.numbers) for scope in self.scopes.values())
        self.scopes[name] = _Scope(name, unique, points[last] @ rotation.T + shift, start, contents)

    def _parts_without_instances(self) -> None:
        """A deck of parts alone, without an assembly: each stands where it was made."""
        for name, part in self.deck.parts.items():
            self._add(name, (part,), np.eye(3), np.zeros(3))
        self.notes.append("the deck has parts and no instances: each part is taken once")

    def mesh(self, understood: Collection[str]) -> SourceMesh:
        for name, scope in self.scopes.items():
            self._take_elements(name, scope)
        for scope in self.scopes.values():
            self._leave_out_users_own(scope)
        if not self.blocks:
            held = ", ".join(f"{count} {name}" for name, count in self.deck.left_out.items()) or "no elements"
            if any(one.name == "RESTART" and "READ" in one.options for one in self.deck.keywords):
                held += ", and continues another job (*RESTART, READ), whose deck has the mesh"
            raise DatasetError(f"{self.deck.path}: holds {held}: a scene needs elements of a volume")
        groups = self._groups()
        notes = [*self.notes]
        for name, count in self.deck.left_out.items():
            kind = f"of the type {name}"
            notes.append(f"{counted(count, f'element {kind} is', f'elements {kind} are')} left out")
        if self.deck.formulas:
            are = counted(
                len(self.deck.formulas), "rigid surface without elements is", "rigid surfaces without elements are"
            )
            notes.append(f"{are} left out: {', '.join(self.deck.formulas)}; a tool needs a mesh, for example of R3D4")
        turned = sum(len(block.nodes) for block in self.blocks if block.label.startswith(REVOLVED))
        if turned:
            are = counted(turned, "element is a section", "elements are sections")
            notes.append(f"{are} of a body of revolution: taken as a plane")
        ignored = self.deck.ignored.keys() - set(understood)
        if ignored:
            notes.append(f"ignored keywords: {', '.join(sorted(ignored))}")
        points = np.concatenate([scope.points for scope in self.scopes.values()])
        numbers = self.scopes[""].numbers if len(self.scopes) == 1 else np.arange(len(points))
        return SourceMesh(self.deck.path, points, self.blocks, groups=groups, notes=notes, same_point=numbers)

    def _take_elements(self, name: str, scope: _Scope) -> None:
        numbers, nodes = [np.zeros(0, np.int64)], []
        for block in (block for content in scope.contents for block in content.blocks):
            if not len(block.numbers):
                continue
            places = self._places(scope, block)
            self.blocks.append(CellBlock(block.kind, places, block.type_name))
            numbers.append(block.numbers)
            nodes.extend(places)
        together = np.concatenate(numbers)
        unique, first, which = np.unique(together, return_index=True, return_inverse=True)
        for row in np.setdiff1d(np.arange(len(together)), first):
            if not np.array_equal(nodes[row], nodes[first[which[row]]]):
                where = f" of {self.deck.written[name]}" if name else ""
                raise DatasetError(
                    f"{self.deck.path}: element {together[row]}{where} stands in the deck twice, with different nodes"
                )
        self.elements[name] = (unique, [nodes[row] for row in first])

    def _leave_out_users_own(self, scope: _Scope) -> None:
        """Leave out elements whose shape only the user knows, if others have all of their nodes: a mesh that is drawn
        in their place, or the faces of bodies.

        Raises:
            DatasetError: some of their nodes belong to no other element.
        """
        users_own = [one for content in scope.contents for one in content.users_own]
        if not users_own:
            return
        used = np.concatenate([np.zeros(0, np.int64), *(block.nodes.ravel() for block in self.blocks)])
        for one in users_own:
            places = scope.start + np.flatnonzero(np.isin(scope.numbers, one.nodes))
            alone = len(one.nodes) - np.isin(places, used).sum()
            if alone:
                raise one.keyword.error(
                    f"elements of the type {one.type_name} are the user's own, so their shape is not known, and {alone}"
                    f" of their {counted(len(one.nodes), 'node belongs', 'nodes belong')} to no other element: write"
                    " them as C3D8, C3D4 or alike"
                )
            kind = f"of the user's own type {one.type_name}"
            left_out = counted(one.how_many, f"element {kind} is", f"elements {kind} are")
            self.notes.append(f"{left_out} left out: others have their nodes")

    def _places(self, scope: _Scope, block: ElementBlock) -> np.ndarray:
        """[c, k]: where the nodes of elements are in the mesh."""
        if isinstance(block.nodes, np.ndarray):
            return self._find(scope, block.nodes, block)
        places = np.zeros((len(block.nodes), len(block.nodes[0])), np.int64)
        for row, names in enumerate(block.nodes):
            for corner, text in enumerate(names):
                instance, _, number = text.upper().rpartition(".")
                if instance not in self.scopes or not number.isdigit():
                    raise block.keyword.error(f"there is no node {text}")
                places[row, corner] = self._find(self.scopes[instance], np.array([[int(number)]]), block)[0, 0]
        return places

    def _find(self, scope: _Scope, nodes: np.ndarray, block: ElementBlock) -> np.ndarray:
        row = np.minimum(np.searchsorted(scope.numbers, nodes), max(len(scope.numbers) - 1, 0))
        known = scope.numbers[row] == nodes if len(scope.numbers) else np.zeros(nodes.shape, bool)
        if not known.all():
            element, corner = np.argwhere(~known)[0]
            number = block.numbers[element]
            raise block.keyword.error(f"element {number} refers to node {nodes[element, corner]}, which there is not")
        return row + scope.start

    def _groups(self) -> dict[str, np.ndarray]:
        groups: dict[str, np.ndarray] = {}
        short: dict[str, list[np.ndarray]] = {}
        for name, scope in self.scopes.items():
            of_scope: dict[str, np.ndarray] = {}
            for content in scope.contents:
                for key, nodes in self._sets_of(name, content).items():
                    of_scope[key] = np.union1d(of_scope.get(key, np.zeros(0, np.int64)), nodes)
            if not name:
                groups |= {self.deck.written[key]: nodes for key, nodes in of_scope.items()}
                continue
            shown = self.deck.written[name]
            everyone = scope.start + np.arange(len(scope.numbers))
            if not np.array_equal(groups.setdefault(shown, everyone), everyone):
                self.notes.append(f"the set {shown!r} is taken, not the instance of this name")
            groups |= {f"{shown}.{self.deck.written[key]}": nodes for key, nodes in of_scope.items()}
            for key, nodes in of_scope.items():
                short.setdefault(self.deck.written[key], []).append(nodes)
        return {**{key: nodes[0] for key, nodes in short.items() if len(nodes) == 1}, **groups}

    def _sets_of(self, name: str, content: Content) -> dict[str, np.ndarray]:
        """The nodes of each set. Of a set of nodes and one of elements with the same name, the set of nodes counts."""
        sets = {key: self._nodes_of(name, members) for key, members in content.element_sets.items()}
        own = {key: self._nodes_of(name, members) for key, members in content.node_sets.items()}
        for key in sets.keys() & own.keys():
            if not np.array_equal(sets[key], own[key]):
                self.notes.append(f"the set {self.deck.written[key]!r} of nodes is taken, not the one of elements")
        return {**sets, **own}

    def _nodes_of(self, name: str, members: list[Members]) -> np.ndarray:
        """The places of the members of a set that there are; a deck may list others, as Abaqus and CalculiX allow."""
        groups = [np.zeros(0, np.int64)]
        for instance, numbers, of_elements in members:
            scope = self.scopes[instance or name]
            known, nodes = self.elements[instance or name] if of_elements else (scope.numbers, [])
            row = np.searchsorted(known, numbers)
            row = (
                row[(row < len(known)) & (known[np.minimum(row, len(known) - 1)] == numbers)] if len(known) else row[:0]
            )
            groups.append(
                np.concatenate([groups[0], *(nodes[one] for one in row)]) if of_elements else row + scope.start
            )
        return np.unique(np.concatenate(groups))

"""What a deck says of its mesh: nodes, elements and sets of each part, and the instances of the parts.

Nothing that changes the mesh is passed over: a keyword, an option or a type of element that is not understood is an
error that names it. Keywords that say something else (materials, loads, steps) are counted and listed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ast_sim.importers.decks.comment_lines import is_keyword, require_keyword
from ast_sim.importers.decks.deck_numbers import elements_of, nodes_of, real, tokens, whole
from ast_sim.importers.decks.element_types import kind_of
from ast_sim.importers.decks.keyword_lines import Keyword, read_keywords
from ast_sim.importers.formats.source_mesh import node_count
from ast_sim.support.errors import DatasetError

# Keywords that make, move or remove nodes or elements, and that are not understood here.
_CHANGE_THE_MESH = {
    *("NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "IMPORT", "PARAMETER", "IMPERFECTION", "REFINEMESH"),
    *("SYMMETRICMODELGENERATION", "SYMMETRICRESULTSTRANSFER", "PARAMETERSHAPEVARIATION", "PARAMETERDEPENDENCE"),
    *("ADAPTIVEMESH", "MESHREFINEMENT", "NODALTRANSLATION", "IMPORTNSET", "IMPORTELSET"),
}

_OPTIONS = {
    "NODE": {"NSET", "SYSTEM", "INPUT"},
    "ELEMENT": {"TYPE", "ELSET", "INPUT"},
    "NSET": {"NSET", "GENERATE", "ELSET", "INSTANCE", "INTERNAL", "UNSORTED", "INPUT"},
    "ELSET": {"ELSET", "GENERATE", "INSTANCE", "INTERNAL", "UNSORTED", "INPUT"},
    "PART": {"NAME"},
    "ASSEMBLY": {"NAME"},
    "INSTANCE": {"NAME", "PART"},
    "SYSTEM": set(),
    **dict.fromkeys(("ENDPART", "ENDASSEMBLY", "ENDINSTANCE"), set()),
}


class Members(NamedTuple):
    """Nodes or elements of a set: the instance that they belong to ("" for the scope itself), and their numbers. A set
    of nodes may have the nodes of elements."""

    instance: str
    numbers: np.ndarray
    of_elements: bool = False


Sets = dict[str, list[Members]]


@dataclass(frozen=True, eq=False)
class ElementBlock:
    """Elements of one type: `numbers` [c]; `nodes` [c, k] numbers of nodes, or names "instance.number" in an
    assembly."""

    type_name: str
    kind: str
    numbers: np.ndarray
    nodes: np.ndarray | list[list[str]]
    keyword: Keyword


@dataclass(eq=False)
class Content:
    """Nodes, elements and sets of the deck, of a part, of an instance or of the assembly. Names are in upper case."""

    name: str = ""
    nodes: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    blocks: list[ElementBlock] = field(default_factory=list)
    node_sets: Sets = field(default_factory=dict)
    element_sets: Sets = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Instance:
    """A part that is placed: `rotation` [3, 3] and `shift` [3] say where, x -> rotation x + shift."""

    part: Content
    own: Content
    rotation: np.ndarray
    shift: np.ndarray


@dataclass(eq=False)
class Deck:
    """A deck: all keywords in order, and what they say of the mesh. `written` has names as they were first written."""

    path: Path
    keywords: list[Keyword]
    root: Content = field(default_factory=Content)
    parts: dict[str, Content] = field(default_factory=dict)
    instances: dict[str, Instance] = field(default_factory=dict)
    written: dict[str, str] = field(default_factory=dict)
    ignored: Counter[str] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)


def read_deck(path: Path) -> Deck:
    """A deck of Abaqus or CalculiX.

    Raises:
        DatasetError: a line cannot be read, or a keyword that changes the mesh is not understood; the text names the
            file and the line.
    """
    deck = Deck(path, read_keywords(path))
    reader = _Reader(deck)
    for keyword in deck.keywords:
        reader.take(keyword)
    return deck


class _Reader:
    """Goes through the keywords of a deck; `content` is what the next ones add to."""

    def __init__(self, deck: Deck) -> None:
        self.deck = deck
        self.content = deck.root
        self.system: np.ndarray | None = None
        self.before: Keyword | None = None
        self.handlers: dict[str, Callable[[Keyword], None]] = {
            "NODE": self._node,
            "ELEMENT": self._element,
            "NSET": self._set,
            "ELSET": self._set,
            "SYSTEM": self._system,
            "PART": self._part,
            "INSTANCE": self._instance,
            "ASSEMBLY": self._leave,
            **dict.fromkeys(("ENDPART", "ENDASSEMBLY", "ENDINSTANCE"), self._leave),
        }

    def take(self, keyword: Keyword) -> None:
        name = keyword.name
        if name in _CHANGE_THE_MESH:
            raise keyword.error("this keyword changes the mesh and is not understood here: write the mesh out")
        if name == "MODELCHANGE" and keyword.options.get("TYPE", "").upper() == "ELEMENT":
            self.deck.ignored["MODELCHANGE, TYPE=ELEMENT (all elements are kept)"] += 1
        elif name in self.handlers:
            unknown = keyword.options.keys() - _OPTIONS[name]
            if unknown:
                raise keyword.error(f"the option {min(unknown)} is not understood here")
            self.handlers[name](keyword)
        elif len(name) > 2 and any(known.startswith(name) for known in (*_OPTIONS, *_CHANGE_THE_MESH)):
            raise keyword.error("is this a short form? Write the whole keyword")
        else:
            self._ignore(keyword)
        if keyword.data or is_keyword(keyword.name) or keyword.name in self.handlers:
            self.before = keyword

    def _ignore(self, keyword: Keyword) -> None:
        """Pass over a keyword, unless its data lines seem to belong to the mesh."""
        sets = (*self.content.node_sets, *self.content.element_sets, *self.deck.root.node_sets)
        require_keyword(keyword, self.before, _OPTIONS, sets)
        if keyword.name:
            self.deck.ignored[keyword.name] += 1

    def _key(self, name: str) -> str:
        key = name.upper()
        self.deck.written.setdefault(key, name)
        return key

    def _node(self, keyword: Keyword) -> None:
        numbers, points = nodes_of(keyword)
        if (numbers < 1).any():
            wrong = keyword.data[int(np.argmin(numbers))]  # a node has one line: coordinates in the next are no node
            raise DatasetError(f"{wrong.place}: the number of a node is {numbers.min()}; must be at least 1")
        kind = (keyword.options.get("SYSTEM") or "R").upper()
        if kind not in ("R", "C", "S"):
            raise keyword.error(f"SYSTEM={kind} is not known; must be R, C or S")
        if kind != "R":
            points = _from_angles(points, kind == "S")
        if self.system is not None:
            points = points @ self.system[:3] + self.system[3]
        self.content.nodes.append((numbers, points))
        if keyword.options.get("NSET"):
            self.content.node_sets.setdefault(self._key(keyword.options["NSET"]), []).append(Members("", numbers))

    def _element(self, keyword: Keyword) -> None:
        type_name = keyword.required("TYPE").upper()
        kind = kind_of(type_name)
        if kind is None:
            raise keyword.error(f"elements of the type {type_name} are not known here")
        name = keyword.options.get("ELSET")
        if not kind:
            self.deck.left_out[type_name] += len(keyword.data)
            if name:
                self.content.element_sets.setdefault(self._key(name), [])
            return
        numbers, nodes = elements_of(keyword, node_count(kind))
        self.content.blocks.append(ElementBlock(type_name, kind, numbers, nodes, keyword))
        if name:
            self.content.element_sets.setdefault(self._key(name), []).append(Members("", numbers, True))

    def _set(self, keyword: Keyword) -> None:
        name = self._key(keyword.required(keyword.name))
        instance = keyword.options.get("INSTANCE", "").upper()
        if instance and instance not in self.deck.instances:
            raise keyword.error(f"there is no instance {keyword.options['INSTANCE']!r}")
        of_elements = keyword.name == "ELSET"
        members = self._sets(self.content, of_elements).setdefault(name, [])
        if not of_elements and keyword.options.get("ELSET"):
            members.extend(self._named(keyword, True, instance, keyword.options["ELSET"]))
        elif "GENERATE" in keyword.options:
            members.append(Members(instance, _generated(keyword), of_elements))
        else:
            members.extend(self._listed(keyword, of_elements, instance))

    @staticmethod
    def _sets(content: Content, of_elements: bool) -> Sets:
        return content.element_sets if of_elements else content.node_sets

    def _listed(self, keyword: Keyword, of_elements: bool, instance: str) -> list[Members]:
        """The members that the data lines list: numbers, names of sets, and both of an instance."""
        members: list[Members] = []
        numbers: list[int] = []
        for line in keyword.data:
            for text in tokens(line):
                if text.lstrip("+-").isdigit():
                    numbers.append(whole(text, line))
                elif text:
                    members.extend(self._named(keyword, of_elements, instance, text.strip('"')))
        return [Members(instance, np.array(numbers, np.int64), of_elements), *members]

    def _named(self, keyword: Keyword, of_elements: bool, instance: str, text: str) -> list[Members]:
        """The members of a set, or a node or an element of an instance; all with the ones that sets have now."""
        key = text.upper()
        sets = self._sets(self.content, of_elements)
        if not instance and key in sets:
            return list(sets[key])
        if not instance:
            instance, _, key = key.rpartition(".")
        if instance in self.deck.instances:
            if key.isdigit():
                return [Members(instance, np.array([int(key)]), of_elements)]
            one = self.deck.instances[instance]
            of_parts = [self._sets(content, of_elements) for content in (one.part, one.own)]
            parts = [sets[key] for sets in of_parts if key in sets]
            if parts:
                return [some._replace(instance=instance) for members in parts for some in members]
        kind = "elements" if of_elements else "nodes"
        raise keyword.error(f"there is no set of {kind} {text!r} before this line")

    def _system(self, keyword: Keyword) -> None:
        """An origin, a point on the x axis and one in the plane of x and y. The origin alone: the axes stay; without
        the third point z stays, and the x axis is projected onto the plane of x and y."""
        values = [real(text, line) for line in keyword.data for text in (*tokens(line), *[""] * 6)[:6]]
        if not values:
            self.system = None
            return
        if len(values) > 12:
            raise keyword.error("has more than two data lines")
        origin = np.array(values[:3])
        alone = len(values) == 6 and len(tokens(keyword.data[0])) <= 3
        x = np.array([1.0, 0, 0]) if alone else np.array(values[3:6]) - origin
        if len(values) == 6:
            x[2] = 0
        z = np.cross(x, np.array(values[6:9]) - origin) if len(values) > 6 else np.array([0.0, 0, 1])
        axes = np.stack([x, np.cross(z, x), z])
        lengths = np.linalg.norm(axes, axis=1, keepdims=True)
        if not (lengths > 0).all():
            raise keyword.error("its points lie on a line")
        self.system = np.concatenate([axes / lengths, origin[None]])

    def _part(self, keyword: Keyword) -> None:
        name = self._key(keyword.required("NAME"))
        if name in self.deck.parts:
            raise keyword.error(f"there are two parts {keyword.options['NAME']!r}")
        self.system = None
        self.content = self.deck.parts[name] = Content(name)

    def _instance(self, keyword: Keyword) -> None:
        name = self._key(keyword.required("NAME"))
        part = keyword.required("PART").upper()
        if part not in self.deck.parts:
            raise keyword.error(f"there is no part {keyword.options['PART']!r} before this line")
        if name in self.deck.instances:
            raise keyword.error(f"there are two instances {keyword.options['NAME']!r}")
        rotation, shift = _placement(keyword)
        self.content = Content(name)
        self.deck.instances[name] = Instance(self.deck.parts[part], self.content, rotation, shift)

    def _leave(self, keyword: Keyword) -> None:
        if keyword.data:
            raise DatasetError(f"{keyword.data[0].place}: a data line that belongs to no keyword")
        self.system = None
        self.content = self.deck.root


def _generated(keyword: Keyword) -> np.ndarray:
    """The numbers of lines `first, last, step`."""
    parts = [np.zeros(0, np.int64)]
    for line in keyword.data:
        numbers = [whole(text, line) for text in tokens(line)]
        if len(numbers) not in (2, 3):
            raise DatasetError(f"{line.place}: has {len(numbers)} numbers; must be the first, the last and the step")
        first, last, step = [*numbers, 1][:3]
        if step < 1 or last < first or (last - first) // step > 10**9:
            raise DatasetError(f"{line.place}: cannot count from {first} to {last} in steps of {step}")
        parts.append(np.arange(first, last + 1, step))
    return np.concatenate(parts)


def _from_angles(points: np.ndarray, spherical: bool) -> np.ndarray:
    """Points of cylindrical (radius, angle, z) or spherical (radius, angle, angle from the plane) coordinates; angles
    are in degrees."""
    radius, angle, third = points.T
    angle = np.radians(angle)
    flat = radius * np.cos(np.radians(third)) if spherical else radius
    height = radius * np.sin(np.radians(third)) if spherical else third
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), height], axis=1)


def _placement(keyword: Keyword) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and shift of an instance: it is first moved, then turned about the axis from one point to another."""
    from scipy.spatial.transform import Rotation

    rows = [[real(text, line) for text in (*tokens(line), *[""] * 7)[:7]] for line in keyword.data]
    if len(rows) > 2:
        raise keyword.error("has more than two data lines")
    if rows and len(tokens(keyword.data[0])) > 3:  # an empty line for no shift is no data line here
        raise DatasetError(
            f"{keyword.data[0].place}: the first line of an instance is its shift, three numbers: write 0, 0, 0 before"
            " the line of a rotation"
        )
    if len(rows) == 2 and len(tokens(keyword.data[1])) != 7:
        raise DatasetError(
            f"{keyword.data[1].place}: a rotation has two points of its axis and an angle, seven numbers"
        )
    shift = np.array(rows[0][:3]) if rows else np.zeros(3)
    if len(rows) < 2:
        return np.eye(3), shift
    start = np.array(rows[1][:3])
    end = np.array(rows[1][3:6])
    angle = np.radians(rows[1][6])
    length = np.linalg.norm(end - start)
    if not length > 0:
        raise keyword.error("the axis of the rotation has no length")
    rotation = Rotation.from_rotvec(angle * (end - start) / length).as_matrix()
    return rotation, rotation @ (shift - start) + start

"""What a deck says of its mesh: nodes, elements and sets of each part, and the instances of the parts.

Nothing that changes the mesh is passed over: a keyword, an option or a type of element that is not understood is an
error that names it. Keywords that say something else (materials, loads, steps) are counted and listed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ast_sim.importers.decks.comment_lines import is_keyword, require_keyword
from ast_sim.importers.decks.deck_axes import from_angles, placement_of, system_of
from ast_sim.importers.decks.deck_numbers import elements_of, nodes_in, nodes_of, tokens, whole
from ast_sim.importers.decks.deck_parts import Content, Deck, ElementBlock, Instance, Members, Sets, UsersOwn
from ast_sim.importers.decks.element_types import is_users_own, kind_of
from ast_sim.importers.decks.keyword_lines import Keyword, known_key, read_keywords
from ast_sim.importers.decks.made_from_others import elements_made, nodes_made
from ast_sim.importers.formats.source_mesh import node_count
from ast_sim.support.errors import DatasetError, counted

# Keywords that make, move or remove nodes or elements, and that are not understood here.
_CHANGE_THE_MESH = {
    *("NMAP", "IMPORT", "IMPERFECTION", "REFINEMESH"),
    *("SYMMETRICMODELGENERATION", "SYMMETRICRESULTSTRANSFER", "PARAMETERSHAPEVARIATION", "PARAMETERDEPENDENCE"),
    *("ADAPTIVEMESH", "MESHREFINEMENT", "NODALTRANSLATION", "IMPORTNSET", "IMPORTELSET"),
}

_OPTIONS = {
    "NODE": {"NSET", "SYSTEM", "INPUT"},
    "ELEMENT": {"TYPE", "ELSET", "INPUT"},
    "NSET": {"NSET", "GENERATE", "GEN", "ELSET", "INSTANCE", "INTERNAL", "UNSORTED", "INPUT"},
    "ELSET": {"ELSET", "GENERATE", "GEN", "INSTANCE", "INTERNAL", "UNSORTED", "INPUT"},
    "PART": {"NAME"},
    "ASSEMBLY": {"NAME"},
    "INSTANCE": {"NAME", "PART"},
    "SYSTEM": set(),
    "NGEN": {"LINE", "NSET", "SYSTEM"},
    "NFILL": {"NSET", "BIAS", "TWOSTEP"},
    "NCOPY": {"CHANGENUMBER", "OLDSET", "NEWSET", "SHIFT", "MULTIPLE", "REFLECT", "POLE"},
    "ELGEN": {"ELSET", "ALLNODES"},
    "ELCOPY": {"ELEMENTSHIFT", "SHIFTNODES", "OLDSET", "NEWSET", "REFLECT"},
    **dict.fromkeys(("ENDPART", "ENDASSEMBLY", "ENDINSTANCE"), set()),
}

# Surfaces of rigid tools that a formula describes: no element belongs to them.
_FORMULAS = {"SEGMENTS", "CYLINDER", "REVOLUTION", "USER"}


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
            **dict.fromkeys(("NGEN", "NFILL", "NCOPY"), self._make_nodes),
            **dict.fromkeys(("ELGEN", "ELCOPY"), self._make_elements),
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
            if name == "NSET" and "FREQUENCY" in unknown:  # of results; it stands there in a deck of CalculiX's own
                self.deck.ignored["NSET (its FREQUENCY)"] += 1
                unknown.remove("FREQUENCY")
            if unknown:
                raise keyword.error(f"the option {min(unknown)} is not understood here")
            self.handlers[name](keyword)
        elif name == "END" and not keyword.data and self.content is self.deck.root:
            pass  # some programs write it as the last line
        elif (
            len(name) > 2
            and not is_keyword(name)
            and any(one.startswith(name) for one in (*_OPTIONS, *_CHANGE_THE_MESH))
        ):
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
        of_formula = keyword.name == "SURFACE" and keyword.options.get("TYPE", "").replace(" ", "").upper() in _FORMULAS
        if of_formula or keyword.name == "RIGIDSURFACE":
            self.deck.formulas.append(keyword.options.get("NAME", f"of line {keyword.line.number}"))

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
            points = from_angles(points, kind == "S")
        if self.system is not None:
            points = points @ self.system[:3] + self.system[3]
        self.content.nodes.append((numbers, points))
        if keyword.options.get("NSET"):
            self.content.node_sets.setdefault(self._key(keyword.options["NSET"]), []).append(Members("", numbers))

    def _element(self, keyword: Keyword) -> None:
        type_name = keyword.required("TYPE").upper()
        kind = kind_of(type_name)
        name = keyword.options.get("ELSET")
        if kind is None and is_users_own(type_name):
            self.content.users_own.append(UsersOwn(type_name, *nodes_in(keyword), keyword))
            if name:
                self.content.element_sets.setdefault(self._key(name), [])
            return
        if kind is None:
            raise keyword.error(f"elements of the type {type_name} are not known here")
        if not kind:
            self.deck.left_out[type_name] += len(keyword.data)
            firsts = [next(iter(tokens(line)), "") for line in keyword.data]
            self.content.left_out |= {int(text): type_name for text in firsts if text.isdigit()}
            if name:
                self.content.element_sets.setdefault(self._key(name), [])
            return
        numbers, nodes = elements_of(self._without_surplus(keyword, type_name, kind), node_count(kind))
        self.content.blocks.append(ElementBlock(type_name, kind, numbers, nodes, keyword))
        if name:
            self.content.element_sets.setdefault(self._key(name), []).append(Members("", numbers, True))

    def _without_surplus(self, keyword: Keyword, type_name: str, kind: str) -> Keyword:
        """Some decks have two numbers behind the eight nodes of each hexahedron, which CalculiX does not read."""
        if kind != "hexahedron" or {len(tokens(line)) for line in keyword.data} != {11}:
            return keyword
        self.deck.ignored[f"ELEMENT (two numbers behind the nodes of each {type_name})"] += 1
        return replace(keyword, data=[replace(line, text=",".join(tokens(line)[:9])) for line in keyword.data])

    def _make_nodes(self, keyword: Keyword) -> None:
        if self.system is not None and (keyword.name == "NCOPY" or "LINE" in keyword.options):
            raise keyword.error("beside *SYSTEM it is not understood here: write the nodes out")
        numbers = nodes_made(keyword, self.content, lambda name: self._numbers_of(keyword, name, False))
        name = keyword.options.get("NEWSET" if keyword.name == "NCOPY" else "NSET")
        if name:
            if keyword.options.get("OLDSET", "").upper() in self.content.unsorted:
                self.content.unsorted.add(self._key(name))
            self.content.node_sets.setdefault(self._key(name), []).append(Members("", numbers))

    def _make_elements(self, keyword: Keyword) -> None:
        name = keyword.options.get("NEWSET" if keyword.name == "ELCOPY" else "ELSET")
        numbers, left_out = elements_made(keyword, self.content, lambda name: self._numbers_of(keyword, name, True))
        self.deck.left_out.update(left_out)
        if name:
            self.content.element_sets.setdefault(self._key(name), []).append(Members("", numbers, True))

    def _numbers_of(self, keyword: Keyword, name: str, of_elements: bool) -> np.ndarray:
        """The nodes or elements of a set so far, in its order."""
        parts = [np.zeros(0, np.int64)]
        for instance, numbers, are_elements in self._named(keyword, of_elements, "", name):
            if instance:
                raise keyword.error(f"the set {name} is of an instance: write the mesh out")
            if are_elements == of_elements:
                parts.append(numbers)
                continue
            blocks = [block for block in self.content.blocks if isinstance(block.nodes, np.ndarray)]
            parts += [np.asarray(block.nodes)[np.isin(block.numbers, numbers)].ravel() for block in blocks]
        together = np.concatenate(parts)
        return together if name.upper() in self.content.unsorted else np.unique(together)

    def _set(self, keyword: Keyword) -> None:
        name = self._key(keyword.required(keyword.name))
        instance = known_key(keyword.options.get("INSTANCE", ""), self.deck.instances)
        if instance and instance not in self.deck.instances:
            raise keyword.error(f"there is no instance {keyword.options['INSTANCE']!r}")
        of_elements = keyword.name == "ELSET"
        if "UNSORTED" in keyword.options and not of_elements:
            self.content.unsorted.add(name)
        members = self._sets(self.content, of_elements).setdefault(name, [])
        if not of_elements and keyword.options.get("ELSET"):
            if keyword.data:
                raise keyword.error("has ELSET= and lines of data, and one of them would be lost: write two sets")
            members.extend(self._named(keyword, True, instance, keyword.options["ELSET"]))
        elif keyword.options.keys() & {"GENERATE", "GEN"}:  # Abaqus reads names that are cut short
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
                    members.append(Members(instance, np.array(numbers, np.int64), of_elements))
                    numbers = []
                    members.extend(self._named(keyword, of_elements, instance, text.strip('"')))
        return [*members, Members(instance, np.array(numbers, np.int64), of_elements)]

    def _named(self, keyword: Keyword, of_elements: bool, instance: str, text: str) -> list[Members]:
        """The members of a set, or a node or an element of an instance; all with the ones that sets have now."""
        sets = self._sets(self.content, of_elements)
        key = known_key(text, sets)
        if not instance and key in sets:
            return list(sets[key])
        if not instance:
            instance, _, key = key.rpartition(".")
        if instance in self.deck.instances:
            if key.isdigit():
                return [Members(instance, np.array([int(key)]), of_elements)]
            one = self.deck.instances[instance]
            of_parts = [self._sets(content, of_elements) for content in (one.part, one.own)]
            parts = [sets[known_key(key, sets)] for sets in of_parts if known_key(key, sets) in sets]
            if parts:
                return [some._replace(instance=instance) for members in parts for some in members]
        kind = "elements" if of_elements else "nodes"
        raise keyword.error(f"there is no set of {kind} {text!r} before this line")

    def _system(self, keyword: Keyword) -> None:
        self.system = system_of(keyword)

    def _part(self, keyword: Keyword) -> None:
        name = self._key(keyword.required("NAME"))
        if name in self.deck.parts:
            raise keyword.error(f"there are two parts {keyword.options['NAME']!r}")
        self.system = None
        self.content = self.deck.parts[name] = Content(name)

    def _instance(self, keyword: Keyword) -> None:
        name = self._key(keyword.required("NAME"))
        part = known_key(keyword.required("PART"), self.deck.parts)
        if part not in self.deck.parts:
            raise keyword.error(f"there is no part {keyword.options['PART']!r} before this line")
        if name in self.deck.instances:
            raise keyword.error(f"there are two instances {keyword.options['NAME']!r}")
        rotation, shift = placement_of(keyword)
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
            raise DatasetError(
                f"{line.place}: has {counted(len(numbers), 'number')}; must be the first, the last and the step"
            )
        first, last, step = [*numbers, 1][:3]
        if step == 0 or not 0 <= (last - first) // step <= 10**9:
            raise DatasetError(f"{line.place}: cannot count from {first} to {last} in steps of {step}")
        parts.append(first + step * np.arange((last - first) // step + 1))
    return np.concatenate(parts)

"""Decks of Abaqus and CalculiX in random spellings: parts and instances, sets of sets, includes, comments, spaces."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.robustness.dialects.comparison import Case
from benchmarks.robustness.dialects.file_content import FileContent, content_of
from benchmarks.robustness.dialects.random_simulation import Simulation

TYPES = {
    "tetra": ["C3D4", "C3D4H", "C3D4T"],
    "tetra10": ["C3D10", "C3D10M", "C3D10H", "C3D10T"],
    "hexahedron": ["C3D8", "C3D8R", "C3D8I", "C3D8RH"],
    "hexahedron20": ["C3D20", "C3D20R", "C3D20RH"],
    "wedge": ["C3D6", "C3D6H"],
    "wedge15": ["C3D15"],
    "pyramid": ["C3D5"],
}


class _Speller:
    """Writes lines in a spelling of its own."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng, self.lines = rng, []
        self.case = [str.upper, str.lower, str.capitalize, lambda text: text][rng.integers(0, 4)]
        self.gap = str(rng.choice(["", " ", "  "]))
        self.comments = float(rng.choice([0, 0.05]))
        self.number = str(rng.choice(["{:.9g}", "{:.8E}", "{:.8e}", "{:22.9f}", "{:.8E}D"]))
        self.tail = str(rng.choice(["", ",", " ", " ,"]))

    def keyword(self, name: str, /, **options: str | None) -> None:
        text = f"*{self.gap if self.rng.random() < 0.2 else ''}{self.case(name)}"
        for option, value in options.items():
            shown = f"{self.gap}={self.gap}{value}" if value is not None else ""
            text += f",{self.gap}{self.case(option)}{shown}"
        self.lines.append(text)

    def data(self, *entries: str, most: int = 16) -> None:
        if self.rng.random() < self.comments:
            self.lines.append("** a remark, with = and *NODE in it")
        while len(entries) > most:
            self.lines.append(f",{self.gap}".join(entries[:most]) + ",")
            entries = entries[most:]
        self.lines.append(self.gap + f",{self.gap}".join(entries) + self.tail)

    def real(self, value: float) -> str:
        text = self.number.removesuffix("D").format(value)
        return text.replace("E", "D") if self.number.endswith("D") else text

    def numbers(self, values: list[int], most: int = 16) -> None:
        for start in range(0, len(values), most):
            self.data(*map(str, values[start : start + most]))


def deck_mesh(rng: np.random.Generator, simulation: Simulation, folder: Path) -> Case:
    """A deck without parts, or with a part for each body, some of them moved and turned by their instances."""
    content, spell = content_of(rng, simulation), _Speller(rng)
    spell.keyword("heading")
    spell.data("a deck of a person, who says = and , in it")
    groups = _flat(rng, spell, content, simulation) if rng.random() < 0.5 else _parts(rng, spell, content, simulation)
    spell.keyword("material", name="rubber")
    spell.keyword("elastic")
    spell.data("1000.", "0.3")
    spell.keyword("step", nlgeom=None)
    spell.keyword("static")
    spell.data("0.1", "1.")
    spell.keyword("end step")
    ignored = "ignored keywords: ELASTIC, ENDSTEP, HEADING, MATERIAL, STATIC, STEP"
    return Case(_save(rng, spell.lines, folder), groups=groups, told=(ignored,))


def _save(rng: np.random.Generator, lines: list[str], folder: Path) -> Path:
    """The file, with another end of lines and encoding; the lines of some blocks go into a file that is included."""
    if rng.random() < 0.3:
        start = next(row for row, line in enumerate(lines) if line.replace(" ", "").lower().startswith("*element"))
        stop = start + 1
        while stop < len(lines) and (not lines[stop].startswith("*") or lines[stop].startswith("**")):
            stop += 1
        inner, deeper = lines[start:stop], folder / "more"
        deeper.mkdir()
        (deeper / "elements.inc").write_text("\n".join(inner) + "\n")
        lines = [*lines[:start], "*INCLUDE, INPUT=more/elements.inc", *lines[stop:]]
    end, encoding = str(rng.choice(["\n", "\r\n", "\r"])), str(rng.choice(["utf-8", "latin-1", "utf-8-sig", "utf-16"]))
    text = end.join(["** Größe in mm", *lines]) + (end if rng.random() < 0.8 else "")
    path = folder / str(rng.choice(["mesh.inp", "MESH.INP"]))
    path.write_bytes(text.encode(encoding))
    return path


def _node_block(spell: _Speller, numbers: np.ndarray, points: np.ndarray, rows: np.ndarray) -> None:
    spell.keyword("node", **({"nset": "everyone"} if spell.rng.random() < 0.3 else {}))
    short = spell.rng.random() < 0.3
    for row in rows:
        entries = [spell.real(value) for value in points[row]]
        while short and len(entries) > 1 and points[row][len(entries) - 1] == 0:
            entries.pop()
        spell.data(str(numbers[row]), *entries)


def _element_block(spell: _Speller, kind: str, numbers: np.ndarray, nodes: np.ndarray, name: str | None) -> None:
    options = {"type": str(spell.rng.choice(TYPES[kind])), **({"elset": name} if name else {})}
    for key in spell.rng.permutation(list(options)).tolist():
        options[key] = options.pop(key)
    spell.keyword("element", **options)
    for number, row in zip(numbers, nodes, strict=True):
        spell.data(str(number), *map(str, row), most=int(spell.rng.choice([8, 11, 16])))


def _numbered(rng: np.random.Generator, count: int) -> np.ndarray:
    """Numbers with gaps, in ascending order or not."""
    numbers = np.sort(rng.choice(np.arange(1, 3 * count + 9), count, replace=False))
    return rng.permutation(numbers) if rng.random() < 0.5 else numbers


def _flat(
    rng: np.random.Generator, spell: _Speller, content: FileContent, simulation: Simulation
) -> dict[str, np.ndarray]:
    """All nodes and elements at the top level; a set of elements for each body, sets of nodes."""
    numbers = _numbered(rng, len(content.points))
    halves = np.array_split(np.arange(len(numbers)), int(rng.integers(1, 3)))
    for rows in halves[:1]:
        _node_block(spell, numbers, content.points, rows)
    late = rng.random() < 0.5
    if not late:
        for rows in halves[1:]:
            _node_block(spell, numbers, content.points, rows)
    groups: dict[str, np.ndarray] = {}
    first = 1
    for body, kind, cells in content.blocks:
        name = f"Body-{body}"
        elements, where = first + np.arange(len(cells)), rng.integers(0, 3)
        _element_block(spell, kind, elements, numbers[cells], name if where == 0 else None)
        if where:
            _set(spell, "elset", name, elements.tolist())
        first += len(cells) + int(rng.integers(0, 20))
        groups[name] = np.unique(content.point_of[cells])
    if late:
        for rows in halves[1:]:
            _node_block(spell, numbers, content.points, rows)
    fixed = np.flatnonzero((content.point_of >= 0) & content.values(simulation.fixed))
    half = len(fixed) // 2
    if half:
        _set(spell, "nset", "left", numbers[fixed[:half]].tolist())
        _set(spell, "nset", "right", numbers[fixed[half:]].tolist())
        spell.keyword("nset", nset="both")
        spell.data("left", str(rng.choice(["right", "RIGHT"])))
        groups["both"] = content.point_of[fixed]
    return groups


def _set(spell: _Speller, keyword: str, name: str, members: list[int]) -> None:
    """A set, listed or generated, in one block or two."""
    spaced = np.diff(members)
    if len(members) > 2 and (spaced == spaced[0]).all() and spaced[0] > 0 and spell.rng.random() < 0.7:
        spell.keyword(keyword, **{keyword: name, "generate": None})
        cut = int(spell.rng.integers(1, len(members)))
        step = int(spaced[0])
        for part in (members[:cut], members[cut:]):
            spell.data(str(part[0]), str(part[-1]), *([str(step)] if step > 1 or spell.rng.random() < 0.5 else []))
        return
    cut = int(spell.rng.integers(0, len(members)))
    for part in (members[:cut], members[cut:]) if spell.rng.random() < 0.3 else (members,):
        if part:
            spell.keyword(keyword, **{keyword: name})
            spell.numbers(part, most=int(spell.rng.choice([1, 8, 16])))


def _parts(
    rng: np.random.Generator, spell: _Speller, content: FileContent, simulation: Simulation
) -> dict[str, np.ndarray]:
    """A part for each body, with numbers of its own, and an assembly of instances."""
    bodies = sorted({body for body, _, _ in content.blocks})
    placements = {body: _placement(rng, simulation.size) for body in bodies}
    for body in rng.permutation(bodies).tolist():
        spell.keyword("part", name=f"Part-{body}")
        part = content.part(
            [np.arange(len(c)) * (b == body) if b == body else np.zeros(0, int) for b, _, c in content.blocks]
        )
        turn, shift, _ = placements[body]
        numbers = _numbered(rng, len(part.points))
        _node_block(spell, numbers, (part.points - shift) @ turn, np.arange(len(numbers)))
        for index, (_, kind, cells) in enumerate(part.blocks):
            _element_block(spell, kind, 1 + 1000 * index + np.arange(len(cells)), numbers[cells], "all")
        spell.keyword("end part")
    spell.keyword("assembly", name="Assembly")
    groups = {}
    for body in bodies:
        spell.keyword("instance", name=f"Part-{body}-1", part=f"Part-{body}")
        for line in placements[body][2]:
            spell.data(*(f"{value:.15g}" for value in line), most=99)
        spell.keyword("end instance")
        own = [cells for b, _, cells in content.blocks if b == body]
        groups[f"Part-{body}-1.all"] = np.unique(content.point_of[np.concatenate([c.ravel() for c in own])])
    spell.keyword("end assembly")
    simulation.defects.discard("unused")
    return groups


def _placement(rng: np.random.Generator, size: float) -> tuple[np.ndarray, np.ndarray, list[list[float]]]:
    """x -> turn x + shift, and the data lines that say so: a shift, then a turn about an axis through two points."""
    kind = rng.integers(0, 3)
    moved = rng.normal(0, size, 3)
    if kind == 0:
        return np.eye(3), np.zeros(3), []
    if kind == 1:
        return np.eye(3), moved, [moved.tolist()]
    start, axis, angle = rng.normal(0, size, 3), rng.normal(size=3), float(rng.uniform(-180, 180))
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = np.eye(3) + np.sin(np.radians(angle)) * cross + (1 - np.cos(np.radians(angle))) * cross @ cross
    return turn, turn @ (moved - start) + start, [moved.tolist(), [*start, *(start + size * axis), angle]]

"""The materials of the elements of a deck: *MATERIAL with *ELASTIC and *PLASTIC, *SOLID SECTION."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ast_sim.importers.decks.deck_numbers import real, refuse_decimal_commas, tokens
from ast_sim.importers.decks.deck_parts import Deck
from ast_sim.importers.decks.keyword_lines import Keyword, Line, known_key
from ast_sim.importers.formats.source_mesh import SourceMesh
from ast_sim.importers.solved_jobs.job_temperatures import node_temperatures
from ast_sim.material import ELASTIC, YIELD_STRESS
from ast_sim.support.errors import counted

MATERIAL_KEYWORDS = (
    "MATERIAL",
    "ELASTIC",
    "PLASTIC",
    "SOLIDSECTION",
    "DENSITY",
    "CHANGEMATERIAL",
    "CHANGESOLIDSECTION",
)

# With these beside *ELASTIC and *PLASTIC, the material has another law.
_OTHER_LAWS = {
    *("CREEP", "VISCOELASTIC", "VISCOUS", "HYPERELASTIC", "HYPERFOAM", "HYPOELASTIC", "MULLINSEFFECT", "USERMATERIAL"),
    *("DEFORMATIONPLASTICITY", "CAPPLASTICITY", "CASTIRONPLASTICITY", "CLAYPLASTICITY", "CRUSHABLEFOAM", "CONCRETE"),
    *("CONCRETEDAMAGEDPLASTICITY", "DRUCKERPRAGER", "MOHRCOULOMB", "MOHRCOULOMBPLASTICITY", "MODIFIEDMOHRCOULOMB"),
    *("POROUSELASTIC", "POROUSMETALPLASTICITY", "DAMAGEINITIATION", "BRITTLECRACKING", "NOCOMPRESSION", "NOTENSION"),
    *("POTENTIAL", "CYCLICHARDENING", "RATEDEPENDENT", "SWELLING", "SUPERELASTIC", "CHANGEPLASTIC", "JOINTEDMATERIAL"),
}

COLUMNS = (*ELASTIC, YIELD_STRESS)

# The laws of *PLASTIC whose first number is the stress at which it yields, and the kind of its data if nothing is said.
_HARDENING = ("ISOTROPIC", "KINEMATIC", "COMBINED")
_HALF_CYCLE = "HALFCYCLE"

# Options that leave the first numbers of the lines what they are.
_OPTIONS = {
    "ELASTIC": {"TYPE", "DEPENDENCIES", "MODULI"},
    "PLASTIC": {"HARDENING", "DEPENDENCIES", "DATATYPE", "NUMBERBACKSTRESSES", "EXTRAPOLATION"},
}


@dataclass(frozen=True, eq=False)
class _ByTemperature:
    """Numbers [t] of a material at temperatures [t] that ascend; between these it is linear, beyond them constant. A
    single one holds at all temperatures."""

    temperatures: np.ndarray
    values: np.ndarray

    def at(self, temperatures: np.ndarray) -> np.ndarray:
        """[c] the numbers at temperatures [c]; NaN where the number depends on one that is NaN."""
        if len(self.values) == 1:
            return np.full(len(temperatures), self.values[0])
        return np.interp(temperatures, self.temperatures, self.values)

    def __str__(self) -> str:
        pairs = zip(self.values, self.temperatures, strict=True)
        return ", ".join(f"{value:g} at {temperature:g}" for value, temperature in pairs)


_NEVER, _UNKNOWN = (_ByTemperature(np.zeros(1), np.array([value])) for value in (0.0, np.nan))


@dataclass(eq=False)
class _Material:
    """Young's modulus and Poisson's ratio, and the first yield stress, by the names of their columns: isotropic and
    elastic if the first two are there. `other_law`: the material has another law."""

    name: str
    numbers: dict[str, _ByTemperature] = field(default_factory=dict)
    other_law: bool = False

    def columns(self, temperatures: np.ndarray) -> dict[str, np.ndarray]:
        """[c] each column at temperatures [c]; NaN where it is not known."""
        lacks = self.other_law or not self.numbers.keys() >= {*ELASTIC}
        numbers = {YIELD_STRESS: _NEVER, **self.numbers}
        return {name: _UNKNOWN.at(temperatures) if lacks else numbers[name].at(temperatures) for name in COLUMNS}

    @property
    def depends(self) -> bool:
        """Whether a column depends on the temperature."""
        return not self.other_law and any(len(number.values) > 1 for number in self.numbers.values())

    def told(self, temperatures: np.ndarray) -> list[str]:
        """A note on what depends on the temperature in elements of temperatures [c]."""
        if not self.depends:
            return []
        listed = "; ".join(f"{name} is {one}" for name, one in self.numbers.items() if len(one.values) > 1)
        unknown = np.isnan(temperatures)
        if unknown.any():
            have = counted(unknown.sum(), "of its elements has", "of its elements have")
            return [
                f"the material {self.name} depends on the temperature ({listed}), and {have} none that the"
                " deck says and keeps: say it for all nodes by *INITIAL CONDITIONS,"
                " TYPE=TEMPERATURE, or leave the lines of one temperature only"
            ]
        low, high = temperatures.min(), temperatures.max()
        at = f"{low:g}" if low == high else f"{low:g} to {high:g}"
        return [f"the material {self.name} depends on the temperature ({listed}): taken at {at}"]


def material_columns(deck: Deck, mesh: SourceMesh) -> tuple[dict[str, list[np.ndarray]], list[str]]:
    """Columns by name, [c] for each block of elements, and notes; no columns if an element has no such material.

    Raises:
        DatasetError: a section names a material or elements that there are not; a number cannot be read.
    """
    materials, notes = _materials(deck)
    blocks = [block for block in deck.root.blocks if len(block.numbers)]
    tables = [{name: np.full(len(block.numbers), np.nan) for name in COLUMNS} for block in blocks]
    depends = any(material.depends for material in materials.values())
    at_nodes = node_temperatures(deck, mesh) if depends else np.zeros(len(mesh.points))
    corners = [at_nodes[block.nodes] for block in mesh.blocks]
    temperatures = [np.where((at == at[:, :1]).all(axis=1), at[:, 0], np.nan) for at in corners]
    for keyword in deck.keywords:
        if keyword.name in ("SOLIDSECTION", "CHANGESOLIDSECTION"):
            one, numbers = _of_section(keyword, deck, materials)
            if keyword.name == "CHANGESOLIDSECTION":
                one = _Material(one.name, other_law=True)
                notes.append(
                    f"line {keyword.line.number} changes the material of {counted(len(numbers), 'element')} in a later"
                    " step"
                )
            here = [np.isin(block.numbers, numbers) for block in blocks]
            for rows, table, at in zip(here, tables, temperatures, strict=True):
                for column, values in one.columns(at[rows]).items():
                    table[column][rows] = values
            notes += one.told(np.concatenate([at[rows] for at, rows in zip(temperatures, here, strict=True)]))
    lacking = sum(int(np.isnan(list(table.values())).any(axis=0).sum()) for table in tables)
    if lacking:
        return {}, [
            *notes,
            f"{counted(lacking, 'element has', 'elements have')} no isotropic *ELASTIC: no material is taken",
        ]
    plastic = any(table[YIELD_STRESS].any() for table in tables)
    used = COLUMNS if plastic else ELASTIC
    notes.append(f"the columns of the material are {', '.join(used)}")
    return {name: [table[name] for table in tables] for name in used}, notes


def _of_section(keyword: Keyword, deck: Deck, materials: dict[str, _Material]) -> tuple[_Material, np.ndarray]:
    """The material of a section, and the numbers of its elements."""
    name = known_key(keyword.required("MATERIAL"), materials)
    elements = known_key(keyword.required("ELSET"), deck.root.element_sets)
    if name not in materials:
        raise keyword.error(f"there is no material {keyword.options['MATERIAL']!r}")
    if elements not in deck.root.element_sets:
        raise keyword.error(f"there is no set of elements {keyword.options['ELSET']!r}")
    members = deck.root.element_sets[elements]
    return materials[name], np.concatenate([np.zeros(0, np.int64), *(some.numbers for some in members)])


def _materials(deck: Deck) -> tuple[dict[str, _Material], list[str]]:
    """The materials by name in upper case."""
    materials: dict[str, _Material] = {}
    notes: list[str] = []
    current = _Material("")
    for keyword in deck.keywords:
        if keyword.name == "MATERIAL":
            name = keyword.required("NAME")
            if name.upper() in materials:
                raise keyword.error(f"there are two materials {name!r}")
            current = materials[name.upper()] = _Material(name)
        elif keyword.name == "CHANGEMATERIAL":
            name = keyword.required("NAME")
            current = materials.get(known_key(name, materials), _Material(name))
        elif keyword.name in ("ELASTIC", "PLASTIC") or keyword.name in _OTHER_LAWS:
            other = _not_understood(keyword)
            current.other_law |= bool(other)
            if other:
                notes.append(f"the material of line {keyword.line.number} has {other}")
                continue
            numbers = (_elastic if keyword.name == "ELASTIC" else _plastic)(keyword)
            if numbers.keys() & current.numbers.keys():
                raise keyword.error(f"stands twice in the material {current.name}")
            current.numbers |= numbers
    return materials, notes


def _not_understood(keyword: Keyword) -> str:
    """What of a law is neither isotropic elasticity nor a stress at which this ends; empty if nothing."""
    options = {name: value.replace(" ", "").upper() for name, value in keyword.options.items()}
    more = sorted(options.keys() - _OPTIONS.get(keyword.name, set()))
    several = len(keyword.data) > 1
    if keyword.name in _OTHER_LAWS:
        return f"*{keyword.name}"
    if options.get("TYPE", "ISO") not in ("ISO", "ISOTROPIC"):
        return f"*ELASTIC, TYPE={options['TYPE']}"
    if options.get("HARDENING", "ISOTROPIC") not in _HARDENING:
        return f"*PLASTIC, HARDENING={options['HARDENING']}"
    if several and options.get("DEPENDENCIES", "0") != "0":
        return f"*{keyword.name} that depends on field variables (DEPENDENCIES={options['DEPENDENCIES']})"
    if several and options.get("DATATYPE", _HALF_CYCLE) != _HALF_CYCLE:
        return f"*PLASTIC with several lines of DATA TYPE={options['DATATYPE']}"
    return f"*{keyword.name}, {more[0]}=" if more else ""


def _elastic(keyword: Keyword) -> dict[str, _ByTemperature]:
    """Lines of Young's modulus, Poisson's ratio and a temperature."""
    rows: dict[float, tuple[float, ...]] = {}
    for line in _lines(keyword, 2):
        young, poisson, temperature = _entries(line, 3)
        if poisson == 0:  # 0,3
            refuse_decimal_commas(line, 2, "Young's modulus and a Poisson's ratio of 0")
        if rows.setdefault(temperature, (young, poisson)) != (young, poisson):
            raise keyword.error(f"has two lines of the temperature {temperature:g}")
    temperatures = np.array(sorted(rows))
    columns = np.array([rows[temperature] for temperature in temperatures]).T
    return {name: _ByTemperature(temperatures, column) for name, column in zip(ELASTIC, columns, strict=True)}


def _plastic(keyword: Keyword) -> dict[str, _ByTemperature]:
    """Lines of a stress, a plastic strain and a temperature. The table of each temperature begins at the strain 0. A
    single one may begin above it: CalculiX takes its first stress from 0 on. Without a point, 30,5 was one number."""
    rows: dict[float, float] = {}
    for line in _lines(keyword, 1):
        stress, strain, temperature = _entries(line, 3)
        if "DATATYPE" in keyword.options:  # one line of other numbers
            strain = temperature = 0.0
        if temperature not in rows and strain and (rows or "." not in line.text):
            where = f" at the temperature {temperature:g}" if rows else ""
            raise keyword.error(f"its first plastic strain{where} is {strain:g}, and it must be 0: write 4.2, not 4,2")
        rows.setdefault(temperature, stress)
    temperatures = np.array(sorted(rows))
    return {YIELD_STRESS: _ByTemperature(temperatures, np.array([rows[temperature] for temperature in temperatures]))}


def _lines(keyword: Keyword, least: int) -> list[Line]:
    """The data lines, which have `least` numbers or more."""
    short = [line for line in keyword.data if len(tokens(line)) < least]
    if short or not keyword.data:
        raise keyword.error(f"its {'data' if short else 'first data'} line has fewer than {least} numbers")
    return keyword.data


def _entries(line: Line, count: int) -> list[float]:
    """The first numbers of a line; what is left out is 0."""
    return [real(text, line) for text in [*tokens(line), *[""] * count][:count]]

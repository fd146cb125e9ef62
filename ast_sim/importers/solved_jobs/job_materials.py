"""The materials of the elements of a deck: *MATERIAL with *ELASTIC and *PLASTIC, *SOLID SECTION."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ast_sim.importers.decks.deck_content import Deck
from ast_sim.importers.decks.deck_numbers import real, refuse_decimal_commas, tokens
from ast_sim.importers.decks.keyword_lines import Keyword
from ast_sim.material import ELASTIC, YIELD_STRESS

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

COLUMNS = (*ELASTIC, YIELD_STRESS)  # each an attribute of `_Material`


@dataclass(eq=False)
class _Material:
    """Young's modulus, Poisson's ratio and the first yield stress, 0 if it never yields; NaN: not isotropic elastic.
    `other_law`: the material has another law."""

    young: float = np.nan
    poisson: float = np.nan
    yield_stress: float = 0.0
    other_law: bool = False


def material_columns(deck: Deck) -> tuple[dict[str, list[np.ndarray]], list[str]]:
    """Columns by name, [c] for each block of elements, and notes; no columns if an element has no such material.

    Raises:
        DatasetError: a section names a material or elements that there are not; a number cannot be read.
    """
    materials, notes = _materials(deck)
    blocks = [block for block in deck.root.blocks if len(block.numbers)]
    tables = [{name: np.full(len(block.numbers), np.nan) for name in COLUMNS} for block in blocks]
    for keyword in deck.keywords:
        if keyword.name in ("SOLIDSECTION", "CHANGESOLIDSECTION"):
            name, elements = keyword.required("MATERIAL").upper(), keyword.required("ELSET").upper()
            if name not in materials:
                raise keyword.error(f"there is no material {keyword.options['MATERIAL']!r}")
            if elements not in deck.root.element_sets:
                raise keyword.error(f"there is no set of elements {keyword.options['ELSET']!r}")
            numbers = np.concatenate([members.numbers for members in deck.root.element_sets[elements]])
            one = materials[name]
            if keyword.name == "CHANGESOLIDSECTION":
                one = _Material(other_law=True)
                notes.append(
                    f"line {keyword.line.number} changes the material of {len(numbers)} elements in a later step"
                )
            for block, table in zip(blocks, tables, strict=True):
                here = np.isin(block.numbers, numbers)
                for column in COLUMNS:
                    table[column][here] = np.nan if one.other_law else getattr(one, column)
    lacking = sum(int(np.isnan(list(table.values())).any(axis=0).sum()) for table in tables)
    if lacking:
        return {}, [*notes, f"{lacking} elements have no isotropic *ELASTIC: no material is taken"]
    plastic = any(table[YIELD_STRESS].any() for table in tables)
    used = COLUMNS if plastic else ELASTIC
    notes.append(f"the columns of the material are {', '.join(used)}")
    return {name: [table[name] for table in tables] for name in used}, notes


def _materials(deck: Deck) -> tuple[dict[str, _Material], list[str]]:
    """The materials by name in upper case."""
    materials: dict[str, _Material] = {}
    notes: list[str] = []
    current = _Material()
    for keyword in deck.keywords:
        if keyword.name == "MATERIAL":
            current = materials[keyword.required("NAME").upper()] = _Material()
        elif keyword.name == "CHANGEMATERIAL":
            current = materials.get(keyword.required("NAME").upper(), _Material())
        elif keyword.name == "ELASTIC" and keyword.options.get("TYPE", "ISO").upper() in ("ISO", "ISOTROPIC"):
            current.young, current.poisson = _first(keyword, 2)
            if current.poisson == 0:  # 0,3
                refuse_decimal_commas(keyword.data[0], 2, "Young's modulus and a Poisson's ratio of 0")
            if len(keyword.data) > 1:
                notes.append("*ELASTIC depends on the temperature: its first line is taken")
        elif keyword.name in _OTHER_LAWS:
            current.other_law = True
            notes.append(f"the material of line {keyword.line.number} has *{keyword.name}")
        elif keyword.name == "PLASTIC":
            (current.yield_stress,) = _first(keyword, 1)
            _require_no_strain(keyword)
            if any(len(tokens(line)) > 2 for line in keyword.data):
                notes.append("*PLASTIC depends on the temperature: its first line is taken")
    return materials, notes


def _require_no_strain(keyword: Keyword) -> None:
    """A table of stress and plastic strain begins at the strain 0; else 30,5 was meant as one number."""
    if keyword.options.get("HARDENING", "ISOTROPIC").upper() in ("ISOTROPIC", "KINEMATIC"):
        line = keyword.data[0]
        strain = real([*tokens(line), ""][1], line)
        if strain:
            raise keyword.error(f"its first plastic strain is {strain:g}, and it must be 0: write 4.2, not 4,2")


def _first(keyword: Keyword, count: int) -> Sequence[float]:
    """The first numbers of the first data line."""
    if not keyword.data or len(tokens(keyword.data[0])) < count:
        raise keyword.error(f"its first data line has fewer than {count} numbers")
    return [real(text, keyword.data[0]) for text in tokens(keyword.data[0])[:count]]

"""The points and elements of decks of Nastran, in one form for all spellings, which meshio reads.

meshio itself loses lines of elements where editors strip blanks, stops at decks without BEGIN BULK or ENDDATA and at
fields behind the nodes, and knows no included files.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path

from ast_sim.importers.decks.nastran_axes import NastranPoints
from ast_sim.importers.formats.source_mesh import INSTEAD
from ast_sim.support.errors import DatasetError, counted

# Elements of Nastran: the numbers of nodes that they may have, the corners first, and what meshio calls them.
_ELEMENTS = {
    "CTETRA": (4, 10),
    "CPYRAM": (5, 13),
    "CPYRA": (5, 13),  # as meshio writes it
    "CPENTA": (6, 15),
    "CHEXA": (8, 20),
    "CTRIA3": (3,),
    "CTRIAR": (3,),
    "CTRIA6": (3, 6),
    "CQUAD4": (4,),
    "CQUADR": (4,),
    "CQUAD": (4,),
    "CQUAD8": (4, 8),
    "CBAR": (2,),
    "CBEAM": (2,),
    "CROD": (2,),
}
_NAMES = {"CPYRAM": "CPYRA", "CTRIAR": "CTRIA3", "CQUADR": "CQUAD4", "CQUAD": "CQUAD4", "CBAR": "CROD", "CBEAM": "CROD"}
_OF_CORNERS = {"CTRIA6": "CTRIA3", "CQUAD8": "CQUAD4"}

# Cards that say where points are.
_OF_POINTS = re.compile("GRID|GRDSET|CORD[12][RCS]")

# Cards of Nastran with the same first letter that are no elements of a volume or a surface.
_NO_ELEMENTS = re.compile(
    r"CORD|CONM|CMASS|CELAS|CDAMP|CVISC|CTUBE|CONROD|CFAST|CWELD|CSEAM|CBEND|CBEAM3|CHBDY|CLOAD|CREEP|CAERO|CSUP|CYJOIN"
    r"|CBUSH|CGAP|CSHEAR|CEND$|CONV|CSET|CLOAD|CSSCHD|CONTACT"
)

# Cards that tie points to each other or add to them; they are told where a mesh is read without them.
_TOLD = re.compile(
    r"(CONM[12]|CMASS[1-4]|CELAS[1-4]|CDAMP[1-5]|CVISC|CTUBE|CONROD|CFAST|CWELD|CSEAM|CBEND|CBEAM3|CBUSH(?:1D|2D|T)?"
    r"|CGAP|CSHEAR|RBE[123]|RBAR1?|RROD|RSPLINE|RSSCON|RTRPLT1?|MPC|SPOINT)\s"
)

# By name and number: what a card says, and its place.
_Seen = dict[tuple[str, str], tuple[list[str], str]]


def plain_nastran(path: Path) -> tuple[bytes, list[str]]:
    """A deck of Nastran with the points and elements of a deck, and of the files that it includes, alone. A note on the
    elements without a surface and on the constraints, which no mesh has, with their counts.

    Raises:
        DatasetError: it holds elements that are not known, lacks something, or has two unlike points, or elements of a
            kind, of one number; the text names the file and the line.
    """
    points = NastranPoints(path)
    cells: list[str] = []
    left_out: Counter[str] = Counter()
    seen: _Seen = {}
    whole: list[tuple[str, list[str]]] = []  # GRIDs whose coordinates lack points
    for place, (card, *fields) in _cards_of_nastran(path):
        name = card.rstrip("_")
        if name.startswith("C") and name not in _ELEMENTS and not _NO_ELEMENTS.match(name):
            raise DatasetError(f"{path}: holds {name} elements, which are not read ({place}): {INSTEAD}")
        if name == "GRID":
            fields[0] = fields[0].lstrip("0")
            if all(text.lstrip("-+").isdigit() for text in fields[2:5]):
                whole.append((place, fields))
            _require_alike(path, seen, place, name, fields[0], fields[1:5])
        if _OF_POINTS.fullmatch(name):
            points.take(place, name, fields)
        elif name in _ELEMENTS:
            fields[:2] = [text.lstrip("0") for text in fields[:2]]
            rows = _plain_element(path, place, name, fields)
            _require_alike(path, seen, place, name, fields[0], rows)
            cells += rows
        elif told := _TOLD.match(f"{name} "):
            left_out[told[1]] += 1
    _require_reals(path, whole, points.systems)
    if not points.grids:
        raise DatasetError(f"{path}: cannot be read as a mesh: holds no GRID, so it is no deck of Nastran; {INSTEAD}")
    missing = {node for row in cells for node in row.split(",")[1 if row[0] == "+" else 3 :]} - points.grids.keys()
    if missing:
        raise DatasetError(f"{path}: an element has the node {min(missing)}, and there is no GRID of this number")
    rows = [",".join(["GRID", number, "", *points.texts(number)]) for number in points.grids]
    listed = ", ".join(f"{count} {name}" for name, count in sorted(left_out.items()))
    are = counted(left_out.total(), "card that is no part of a mesh is", "cards that are no part of a mesh are")
    notes = [f"{are} left out: {listed}"] if listed else []
    return "\n".join(["BEGIN BULK", *rows, *cells, "ENDDATA\n"]).encode(), notes


def _require_alike(path: Path, seen: _Seen, place: str, name: str, number: str, content: list[str]) -> None:
    """Raise DatasetError if a card of this name and number has been seen with another content. Nastran stops at all
    such cards (its message 311), but a file may be included twice. Cards of two names may share a number there, though
    its manual says that all elements have numbers of their own."""
    before, where = seen.setdefault((name, number), (content, place))
    if before != content:
        raise DatasetError(
            f"{path}: {name} {number} stands twice, with different fields ({where} and {place}): leave one out, or give"
            " it another number"
        )


def _plain_element(path: Path, place: str, name: str, fields: list[str]) -> list[str]:
    """The lines of an element: its number, its property, its nodes. Surfaces may lack nodes within their edges."""
    *_, most = _ELEMENTS[name]
    nodes = [text.lstrip("0") for text in fields[2 : 2 + most] if text.strip("0")]
    least = _ELEMENTS[name][0]
    if name in _OF_CORNERS and len(nodes) < most:
        nodes = [text.lstrip("0") for text in fields[2 : 2 + least] if text]
        name = _OF_CORNERS[name]
    if len(nodes) not in (least, most) or not all(text.isdigit() for text in nodes):
        raise DatasetError(
            f"{path}: {name} {fields[0]} ({place}) has the nodes {', '.join(nodes)}; must have"
            f" {' or '.join(map(str, _ELEMENTS[name]))}: are lines of the file missing or cut short?"
        )
    if not fields[0].isdigit():
        raise DatasetError(f"{path}: {name} ({place}) has the number {fields[0]!r}; must be a whole number above 0")
    entries = [fields[0], fields[1] or fields[0], *nodes]
    rows = [entries[at : at + 8] for at in range(0, len(entries), 8)]
    return [",".join([_NAMES.get(name, name), *rows[0]]), *(",".join(["+", *row]) for row in rows[1:])]


def _cards_of_nastran(path: Path) -> Iterator[tuple[str, list[str]]]:
    """The cards of the bulk data of a deck: the place, the name and its fields, at least eight.

    A line holds fields of 8 or 16 characters, or between commas. It goes on in the next one, which begins with a blank
    field, + or *.
    """
    card: list[str] = []
    first, mark = "", ""
    for place, row in _bulk_data(path):
        if row.lstrip().startswith("="):
            raise DatasetError(
                f"{path}: {place} repeats the card before it ('='), which is not read: write each card out"
            )
        _require_no_decimal_comma(path, place, row, card[0] if card else "")
        wide = "*" in row.partition(",")[0][:8]
        size, width = (16, 4) if wide else (8, 8)
        texts = row.split(",") if "," in row else [row[:8], *(row[at : at + size] for at in range(8, 80, size))]
        name, *fields = (text.strip() for text in texts)
        if card and (not name or name[0] in "+*"):
            if len(name) > 1 and len(mark) > 1 and name[1:] != mark[1:]:
                raise DatasetError(f"{path}: {place} does not go on with the line before it: sort its lines")
            card += fields[:width]
        else:
            if card:
                yield first, card + 8 * [""]
            first = place
            card = [name.upper().rstrip("* "), *fields[:width]]
        mark = fields[width] if len(fields) > width else ""
        card += [""] * (-(len(card) - 1) % width)
    if card:
        yield first, card + 8 * [""]


def _require_no_decimal_comma(path: Path, place: str, row: str, before: str) -> None:
    """Raise DatasetError if a line in fields of 8 or 16 characters has a comma in one: it would be taken for a line
    between commas. `before` is the name of the card that it may go on with."""
    start, comma, _ = row.partition(",")
    if not comma or not (len(start.split()) > 1 or re.match(r"\s{8,}[-+.\d]", start)):
        return
    name = before if row[0] in " +*" else start.split()[0].upper().rstrip("*")
    if name in _ELEMENTS or _OF_POINTS.fullmatch(name):
        raise DatasetError(f"{path}: {place} has a comma in a field of 8 or 16 characters: write decimal points")


def _require_reals(path: Path, whole: list[tuple[str, list[str]]], systems: Collection[str]) -> None:
    """Raise DatasetError if the fields of a GRID may be coordinates with decimal commas, as in GRID,1,,1,5,0,2,3,1: the
    coordinates are whole numbers, and behind them stand a second system that the deck lacks, or a superelement."""
    for place, fields in whole:
        system, _, superelement = (text if text.isdigit() and int(text) else "" for text in fields[5:8])
        if superelement or (system and system not in systems):
            raise DatasetError(
                f"{path}: the coordinates {', '.join(fields[2:5])} of GRID {fields[0]} ({place}) are whole numbers,"
                f" followed by {', '.join(filter(None, fields[5:8]))}: are the commas decimal ones? Write points"
            )


def _bulk_data(path: Path) -> Iterator[tuple[str, str]]:
    """The lines between BEGIN and ENDDATA, one or both of which may be missing."""
    rows = list(_rows_of_nastran(path, ()))
    start = next((number for number, (_, row) in enumerate(rows) if re.match(r"(?i)\s*BEGIN\b", row)), -1)
    return itertools.takewhile(lambda one: not re.match(r"(?i)\s*ENDDATA\b", one[1]), rows[start + 1 :])


def _rows_of_nastran(path: Path, within: tuple[Path, ...]) -> Iterator[tuple[str, str]]:
    """The lines of a deck and of the files that it includes, with their places, without comments and empty lines."""
    for number, line in enumerate(path.read_text("latin-1").expandtabs(8).splitlines(), 1):
        row = line.partition("$")[0].rstrip()
        place = f"line {number} of {path.name}" if within else f"line {number}"
        include = re.fullmatch(r"(?i)\s*INCLUDE\s*[=\s]\s*['\"]?([^'\"]+)['\"]?", row)
        if include:
            other = path.parent / include[1].strip().replace("\\", "/")
            if not other.is_file() or other in (path, *within):
                raise DatasetError(
                    f"{[path, *within][-1]}: includes {include[1]} ({place}), which there is not: copy it there"
                )
            yield from _rows_of_nastran(other, (path, *within))
        elif row:
            yield place, row

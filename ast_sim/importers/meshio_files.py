"""Files that are read by meshio: the kinds whose readers there take all of a file, and what they read over in these."""

from __future__ import annotations

import contextlib
import io
import re
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py

from ast_sim.importers.formats.source_mesh import SourceMesh, from_meshio
from ast_sim.support.errors import DatasetError

_INSTEAD = "write it as .vtu, .vtk, .msh or .inp"

# Of meshio's other kinds, some readers take the first part of a file alone (Tecplot, CGNS, SU2), elements that are cut
# off in the middle (SU2, PERMAS); the rest was never tried.
_KINDS = (".xdmf", ".xmf", ".mesh", ".meshb", ".med", ".vol", ".node", ".ele", ".ply", ".off", ".obj", ".avs")
_NASTRAN = (".bdf", ".fem", ".nas")
_OTHER_KINDS = (".f3grid", ".ugrid", ".xml", ".msh")  # the last as meshio writes it itself, if nobody names a format
BY_MESHIO = (*_KINDS, *_NASTRAN, *_OTHER_KINDS)

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

# Cards of Nastran with the same first letter that are no elements of a volume or a surface.
_NO_ELEMENTS = re.compile(
    r"CORD|CONM|CMASS|CELAS|CDAMP|CVISC|CTUBE|CONROD|CFAST|CWELD|CSEAM|CBEND|CBEAM3|CHBDY|CLOAD|CREEP|CAERO|CSUP|CYJOIN"
    r"|CBUSH|CGAP|CSHEAR|CEND$|CONV|CSET|CLOAD|CSSCHD|CONTACT"
)

# Lines of OBJ files that make curves and curved surfaces.
_CURVED_OBJ = ("cstype", "curv", "curv2", "surf")


def by_meshio(path: Path, copy: Path | None = None) -> SourceMesh:
    """Read a file, or its copy, by meshio. On a damaged file meshio may raise any error, print, or raise SystemExit.

    Raises:
        DatasetError: it is of a kind that is not read, is damaged, or holds what meshio reads over.
    """
    ending = path.suffix.lower()
    if ending not in BY_MESHIO:
        raise DatasetError(
            f"{path}: cannot be read as a mesh: files of the kind {path.suffix} are not read; {_INSTEAD}"
        )
    _CHECKS.get(ending, lambda _: None)(path)
    import meshio

    printed = io.StringIO()
    file = copy
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed), _plain(path, copy) as file:
            mesh = meshio.read(file)
    except DatasetError:
        raise
    except (Exception, SystemExit) as error:
        told = what_meshio_says(error, printed.getvalue()).replace(str(file), str(path))
        raise DatasetError(f"{path}: cannot be read as a mesh: {told}; if it is whole, {_INSTEAD}") from error
    return from_meshio(mesh, path)


@contextlib.contextmanager
def _plain(path: Path, copy: Path | None) -> Iterator[Path]:
    """What meshio shall read: the file, its copy, or a copy without what it cannot read."""
    make = _PLAIN.get(path.suffix.lower())
    if copy is not None or make is None:
        yield copy or path
        return
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / path.name
        plain.write_bytes(make(path))
        yield plain


def _plain_ply(path: Path) -> bytes:
    """A PLY file that calls the corners of its faces as meshio does; other programs leave out the plural."""
    return re.sub(rb"\bvertex_index\b", b"vertex_indices", path.read_bytes(), count=1)


def _plain_obj(path: Path) -> bytes:
    return "\n".join(_lines_of_obj(path)).encode()


def _lines_of_obj(path: Path) -> Iterator[str]:
    """The corners and faces of an OBJ file, without textures, normals and colours, and without numbers that count from
    the end."""
    corners = 0
    for line in path.read_text("latin-1").replace("\\\n", " ").splitlines():
        key, *entries = line.partition("#")[0].split() or [""]
        if key in _CURVED_OBJ or (key == "v" and len(entries) == 4 and float(entries[3]) != 1):
            raise DatasetError(f"{path}: holds curves or curved surfaces, and those are not read; {_INSTEAD}")
        if key == "v":
            corners += 1
            yield " ".join(["v", *entries[:3]])
        elif key == "f":
            numbers = [int(entry.partition("/")[0]) for entry in entries]
            yield " ".join(["f", *(str(number if number > 0 else corners + 1 + number) for number in numbers)])


def what_meshio_says(error: BaseException, printed: str = "") -> str:
    """What meshio says on a file that it cannot read, in one line."""
    from meshio import ReadError

    if isinstance(error, SystemExit | OSError | ReadError):
        told = " ".join(f"{printed} {error if str(error) != '1' else ''}".split())
        return told or "meshio cannot read it"
    key = error.args[0] if isinstance(error, KeyError) and error.args else None
    lacking = re.search(r"object '([^']*)' doesn't exist", str(key))
    if lacking:
        return f"meshio looks for {lacking[1]!r} in it, which it does not hold"
    return f"meshio does not know {key}" if key is not None else f"meshio stopped: {' '.join(str(error).split())}"


def _require_cartesian(path: Path) -> None:
    """Raise DatasetError if the coordinates of a MED file are cylindrical or spherical."""
    with contextlib.suppress(OSError, KeyError, AttributeError), h5py.File(path, "r") as file:
        meshes: Any = file["ENS_MAA"]
        for name, mesh in meshes.items():
            if mesh.attrs.get("REP", 0) != 0:
                raise DatasetError(f"{path}: the coordinates of {name} are not along x, y and z: write Cartesian ones")


def _require_entries_of_dolfin(path: Path) -> None:
    """Raise DatasetError unless an XML file of DOLFIN has each vertex and each cell that it counts: meshio takes what
    stands in the memory for the others."""
    content = path.read_bytes()
    for plural, single in ((b"vertices", rb"vertex"), (b"cells", rb"(?:triangle|tetrahedron|interval)")):
        size = re.search(rb"<%s\b[^>]*?\bsize\s*=\s*[\"'](\d+)" % plural, content)
        entries = {*re.findall(rb"<%s\b[^>]*?\bindex\s*=\s*[\"']0*(\d+)" % single, content)}
        if size and len(entries) != int(size[1]):
            raise DatasetError(
                f"{path}: says that it holds {int(size[1])} {plural.decode()}, but has {len(entries)} of them: it is"
                " damaged"
            )


def _require_cells_of_ansys(path: Path) -> None:
    """Raise DatasetError if a .msh file is none that meshio has written: Fluent lists the faces of cells, which meshio
    takes for triangles."""
    content = path.read_bytes()
    if not content.lstrip().startswith(b"("):
        raise DatasetError(f"{path}: cannot be read as a mesh: is no .msh file of Gmsh's format 4.1 or 2.2, or damaged")
    if re.search(rb"\(\s*(?:20|30)?13\s*\(", content):
        raise DatasetError(f"{path}: lists the faces of its cells, as Fluent does, and those are not read; {_INSTEAD}")


def _plain_nastran(path: Path) -> bytes:
    """The points and elements of a deck of Nastran, one form for all fields: meshio loses lines of elements where
    editors strip blanks, and stops at decks without BEGIN BULK or ENDDATA and at fields behind the nodes."""
    points, cells = {}, []
    for place, (card, *fields) in _cards_of_nastran(path):
        name = card.rstrip("_")
        wrong = ""
        if name in ("GRID", "GRDSET") and fields[1] not in ("", "0"):
            wrong = f"a {name} with a coordinate system of its own, and those are not read"
        elif name.startswith("C") and name not in _ELEMENTS and not _NO_ELEMENTS.match(name):
            wrong = f"{name} elements, which are not read"
        if wrong:
            raise DatasetError(f"{path}: holds {wrong} ({place}): {_INSTEAD}")
        if name == "GRID":
            points[fields[0]] = ",".join(["GRID", fields[0], "", *(text or "0." for text in fields[2:5])])
        elif name in _ELEMENTS:
            cells += _plain_element(path, place, name, fields)
    if not points:
        raise DatasetError(f"{path}: cannot be read as a mesh: holds no GRID, so it is no deck of Nastran; {_INSTEAD}")
    lost = {node for row in cells for node in row.split(",")[1 if row[0] == "+" else 3 :]} - points.keys()
    if lost:
        raise DatasetError(f"{path}: an element has the node {min(lost)}, and there is no GRID of this number")
    return "\n".join(["BEGIN BULK", *points.values(), *cells, "ENDDATA\n"]).encode()


def _plain_element(path: Path, place: str, name: str, fields: list[str]) -> list[str]:
    """The lines of an element: its number, its property, its nodes. Surfaces may lack nodes within their edges."""
    *_, most = _ELEMENTS[name]
    nodes = [text for text in fields[2 : 2 + most] if text not in ("", "0")]
    least = _ELEMENTS[name][0]
    if name in _OF_CORNERS and len(nodes) < most:
        nodes = [text for text in fields[2 : 2 + least] if text]
        name = _OF_CORNERS[name]
    if len(nodes) not in (least, most) or not all(text.isdigit() for text in nodes):
        raise DatasetError(
            f"{path}: {name} {fields[0]} ({place}) has the nodes {', '.join(nodes)}; must have"
            f" {' or '.join(map(str, _ELEMENTS[name]))}: are lines of the file missing or cut short?"
        )
    entries = [fields[0], fields[1] or fields[0], *nodes]
    rows = [entries[at : at + 8] for at in range(0, len(entries), 8)]
    return [",".join([_NAMES.get(name, name), *rows[0]]), *(",".join(["+", *row]) for row in rows[1:])]


def _cards_of_nastran(path: Path) -> Iterator[tuple[str, list[str]]]:
    """The cards of the bulk data of a deck: the place, the name and its fields, at least eight.

    A line holds fields of 8 or 16 characters, or between commas. It goes on in the next one, which begins with a blank
    field, + or *.
    """
    rows = list(_rows_of_nastran(path, ()))
    start = next((number for number, (_, row) in enumerate(rows) if re.match(r"(?i)\s*BEGIN\b", row)), -1)
    card: list[str] = []
    first, mark = "", ""
    for place, row in rows[start + 1 :]:
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
            first, card = place, [name.upper().rstrip("* "), *fields[:width]]
        if card[0] == "ENDDATA":
            return
        mark = fields[width] if len(fields) > width else ""
        card += [""] * (-(len(card) - 1) % width)
    if card:
        yield first, card + 8 * [""]


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


def _require_header_of_ply(path: Path) -> None:
    """Raise DatasetError unless the points of a PLY file begin with x, y and z: meshio takes other columns for them; or
    if its faces have columns behind which meshio looks for the next face."""
    header, end, _ = path.read_bytes().partition(b"end_header")
    vertex = re.search(rb"element\s+vertex\s[^\n]*\n((?:\s*(?:property|comment)\b[^\n]*\n)*)", header)
    names = re.findall(rb"property\s+\S+\s+(\S+)", vertex[1]) if vertex else []
    _, _, faces = header.partition(b"element face")
    columns = re.findall(rb"property\s+(list)?.*?(\S+)\s*$", faces.partition(b"element")[0], re.MULTILINE)
    further = [name.decode() for _, name in columns[1:]]
    wrong = "" if columns[:1] and columns[0][0] else "its faces do not begin with their corners"
    if not wrong and further and (b"format ascii" not in header or any(kind for kind, _ in columns[1:])):
        wrong = f"its faces have further columns: write it without {', '.join(further)}"
    if not end or names[:3] != [b"x", b"y", b"z"]:
        wrong = "is cut off within its header" if not end else "its points do not begin with x, y and z"
    if wrong:
        raise DatasetError(f"{path}: cannot be read as a mesh: {wrong}; {_INSTEAD}")


def _require_first_line(path: Path) -> None:
    """Raise DatasetError if an OFF file, or a file of TetGen, has no numbers: meshio looks for them without end."""
    names = [path.with_suffix(ending) for ending in (".node", ".ele")] if path.suffix.lower() != ".off" else [path]
    for name in names:
        lines = name.read_text("latin-1").splitlines() if name.is_file() else ["0"]  # meshio says that it is missing
        if not any(line.strip() and line.strip() != "OFF" and line.strip()[0] != "#" for line in lines):
            raise DatasetError(f"{name}: cannot be read as a mesh: it is empty; {_INSTEAD}")


_CHECKS: dict[str, Callable[[Path], None]] = {
    ".med": _require_cartesian,
    ".msh": _require_cells_of_ansys,
    ".ply": _require_header_of_ply,
    ".xml": _require_entries_of_dolfin,
    **dict.fromkeys((".off", ".node", ".ele"), _require_first_line),
}
_PLAIN: dict[str, Callable[[Path], bytes]] = {
    ".obj": _plain_obj,
    ".ply": _plain_ply,
    **dict.fromkeys(_NASTRAN, _plain_nastran),
}

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

# Cards of Nastran: elements that meshio reads, and cards with the same first letter that are no elements of a volume or
# a surface.
_ELEMENTS = {
    *("CTETRA", "CPYRAM", "CPYRA", "CPENTA", "CHEXA", "CTRIA3", "CTRIAR", "CTRIA6", "CQUAD4", "CQUADR", "CQUAD8"),
    *("CQUAD9", "CSHEAR", "CTRAX6", "CTRIAX6", "CELAS1", "CBEAM", "CBUSH", "CBUSH1D", "CROD", "CGAP", "CBAR"),
    *("CTETRA_", "CPYRA_", "CPENTA_", "CHEXA_"),  # second order, as meshio writes it
}
_NO_ELEMENTS = re.compile(
    r"CORD|CONM|CMASS|CELAS|CDAMP|CVISC|CTUBE|CONROD|CFAST|CWELD|CSEAM|CBEND|CBEAM3|CHBDY|CLOAD|CREEP|CAERO|CSUP|CYJOIN"
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
    make = {".obj": _plain_obj, ".ply": _plain_ply}.get(path.suffix.lower())
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


def _require_plain_cards(path: Path) -> None:
    """Raise DatasetError if a deck of Nastran holds elements that meshio leaves out, nodes in a system of their own, or
    other files."""
    for number, line in enumerate(path.read_text("latin-1").partition("BEGIN BULK")[2].splitlines()):
        name = re.split(r"[,*\s]", line, maxsplit=1)[0].upper()
        if name == "ENDDATA":
            return
        wrong = "an INCLUDE, which is not read" if name == "INCLUDE" else ""
        if name == "GRDSET" or (name == "GRID" and _system_of(line) not in ("", "0")):
            wrong = f"a {name} with a coordinate system of its own, and those are not read"
        elif name.startswith("C") and name not in _ELEMENTS and not _NO_ELEMENTS.match(name):
            wrong = f"{name} elements, which are not read"
        if wrong:
            raise DatasetError(f"{path}: holds {wrong} (line {number} behind BEGIN BULK): {_INSTEAD}")


def _system_of(line: str) -> str:
    """The coordinate system of a GRID card, in fields of 8 or 16 characters, or between commas."""
    if "," in line:
        return [*line.split(","), "", ""][2].strip()
    return (line[24:40] if "*" in line[:8] else line[16:24]).strip()


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
    **dict.fromkeys(_NASTRAN, _require_plain_cards),
}

"""Files that are read by meshio: the kinds whose readers there take all of a file, and what they read over in these."""

from __future__ import annotations

import contextlib
import io
import re
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from ast_sim.importers.decks.nastran_cards import plain_nastran
from ast_sim.importers.formats.source_mesh import INSTEAD, SourceMesh, from_meshio
from ast_sim.importers.meshio_kinds.med_files import plain_med
from ast_sim.importers.meshio_kinds.text_surfaces import plain_obj, plain_off, plain_ply, require_header_of_ply
from ast_sim.support.errors import DatasetError

# Of meshio's other kinds, some readers take the first part of a file alone (Tecplot, CGNS, SU2), elements that are cut
# off in the middle (SU2, PERMAS); the rest was never tried.
_KINDS = (".xdmf", ".xmf", ".mesh", ".meshb", ".med", ".vol", ".node", ".ele", ".ply", ".off", ".obj", ".avs")
_NASTRAN = (".bdf", ".fem", ".nas")
_OTHER_KINDS = (".f3grid", ".ugrid", ".xml", ".msh")  # the last as meshio writes it itself, if nobody names a format

BY_MESHIO = (*_KINDS, *_NASTRAN, *_OTHER_KINDS)


def by_meshio(path: Path, copy: Path | None = None) -> SourceMesh:
    """Read a file, or its copy, by meshio. On a damaged file meshio may raise any error, print, or raise SystemExit.

    Raises:
        DatasetError: it is of a kind that is not read, is damaged, or holds what meshio reads over.
    """
    ending = path.suffix.lower()
    if ending not in BY_MESHIO:
        raise DatasetError(f"{path}: cannot be read as a mesh: files of the kind {path.suffix} are not read; {INSTEAD}")
    _CHECKS.get(ending, lambda _: None)(path)
    import meshio

    printed = io.StringIO()
    file = copy
    notes: list[str] = []
    try:
        with (
            contextlib.redirect_stdout(printed),
            contextlib.redirect_stderr(printed),
            _plain(path, copy) as (file, notes),
        ):
            mesh = meshio.read(file)
    except DatasetError:
        raise
    except (Exception, SystemExit) as error:
        told = what_meshio_says(error, printed.getvalue()).replace(str(file), str(path))
        raise DatasetError(f"{path}: cannot be read as a mesh: {told}; if it is whole, {INSTEAD}") from error
    return replace(from_meshio(mesh, path), notes=notes, other_way=ending == ".med")


@contextlib.contextmanager
def _plain(path: Path, copy: Path | None) -> Iterator[tuple[Path, list[str]]]:
    """What meshio shall read, the file, its copy, or a copy without what it cannot read; notes on what this lacks."""
    make = _PLAIN.get(path.suffix.lower())
    if copy is not None or make is None:
        yield copy or path, []
        return
    content, notes = make(path)
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / (path.stem + path.suffix.lower().replace(".off", ".obj"))
        plain.write_bytes(content)
        yield plain, notes


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
        raise DatasetError(f"{path}: lists the faces of its cells, as Fluent does, and those are not read; {INSTEAD}")


def _require_first_line(path: Path) -> None:
    """Raise DatasetError if an OFF file, or a file of TetGen, has no numbers: meshio looks for them without end."""
    names = [path.with_suffix(ending) for ending in (".node", ".ele")] if path.suffix.lower() != ".off" else [path]
    for name in names:
        if not name.is_file():
            raise DatasetError(f"{path}: cannot be read as a mesh: {name.name} is not beside it: copy it there")
        lines = name.read_text("latin-1").splitlines()
        if not any(line.strip() and line.strip() != "OFF" and line.strip()[0] != "#" for line in lines):
            raise DatasetError(f"{name}: cannot be read as a mesh: it is empty; {INSTEAD}")


def _require_medit(path: Path) -> None:
    """Raise DatasetError if a .mesh file is of another program than Medit: MFEM, GetFEM and others use the ending."""
    with path.open("rb") as file:
        head = file.read(1 << 16).decode("latin-1")
    if "MeshVersionFormatted" not in head:
        first = next((line.strip() for line in head.splitlines() if line.strip()), "")
        raise DatasetError(
            f"{path}: cannot be read as a mesh: is no .mesh file of Medit, but begins with {first[:40]!r}; {INSTEAD}"
        )


_CHECKS: dict[str, Callable[[Path], None]] = {
    ".mesh": _require_medit,
    ".msh": _require_cells_of_ansys,
    ".ply": require_header_of_ply,
    ".xml": _require_entries_of_dolfin,
    **dict.fromkeys((".off", ".node", ".ele"), _require_first_line),
}


def _without_notes(make: Callable[[Path], bytes]) -> Callable[[Path], tuple[bytes, list[str]]]:
    return lambda path: (make(path), [])


_PLAIN: dict[str, Callable[[Path], tuple[bytes, list[str]]]] = {
    ".med": plain_med,
    ".obj": _without_notes(plain_obj),
    ".off": _without_notes(plain_off),
    ".ply": _without_notes(plain_ply),
    **dict.fromkeys(_NASTRAN, plain_nastran),
}

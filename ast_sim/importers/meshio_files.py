"""Files that are read by meshio: the kinds whose readers there take all of a file, and what they read over in these."""

from __future__ import annotations

import contextlib
import io
import re
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ast_sim.importers.decks.nastran_cards import left_out_of_nastran, plain_nastran
from ast_sim.importers.formats.source_mesh import INSTEAD, SourceMesh, from_meshio
from ast_sim.importers.formats.text_surfaces import plain_obj, plain_off, plain_ply, require_header_of_ply
from ast_sim.support.errors import DatasetError

# Of meshio's other kinds, some readers take the first part of a file alone (Tecplot, CGNS, SU2), elements that are cut
# off in the middle (SU2, PERMAS); the rest was never tried.
_KINDS = (".xdmf", ".xmf", ".mesh", ".meshb", ".med", ".vol", ".node", ".ele", ".ply", ".off", ".obj", ".avs")
_NASTRAN = (".bdf", ".fem", ".nas")
_OTHER_KINDS = (".f3grid", ".ugrid", ".xml", ".msh")  # the last as meshio writes it itself, if nobody names a format

# What MED calls the place of a field that is on all nodes, or on all cells of a kind.
_ON_ALL = "MED_NO_PROFILE_INTERNAL"
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
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed), _plain(path, copy) as file:
            mesh = meshio.read(file)
    except DatasetError:
        raise
    except (Exception, SystemExit) as error:
        told = what_meshio_says(error, printed.getvalue()).replace(str(file), str(path))
        raise DatasetError(f"{path}: cannot be read as a mesh: {told}; if it is whole, {INSTEAD}") from error
    notes = _TOLD.get(ending, lambda _: [])(path)
    return replace(from_meshio(mesh, path), notes=notes, other_way=ending == ".med")


@contextlib.contextmanager
def _plain(path: Path, copy: Path | None) -> Iterator[Path]:
    """What meshio shall read: the file, its copy, or a copy without what it cannot read."""
    make = _PLAIN.get(path.suffix.lower())
    if copy is not None or make is None:
        yield copy or path
        return
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / (path.stem + path.suffix.lower().replace(".off", ".obj"))
        plain.write_bytes(make(path))
        yield plain


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
    ".med": _require_cartesian,
    ".mesh": _require_medit,
    ".msh": _require_cells_of_ansys,
    ".ply": require_header_of_ply,
    ".xml": _require_entries_of_dolfin,
    **dict.fromkeys((".off", ".node", ".ele"), _require_first_line),
}


def _plain_med(path: Path) -> bytes:
    """A MED file without the families that have no groups, for whose names meshio looks; the others have letters in
    place of bytes. Its fields have a value for each node or cell."""
    copy = io.BytesIO(path.read_bytes())
    with contextlib.suppress(OSError, KeyError, AttributeError, TypeError, ValueError), h5py.File(copy, "r+") as file:
        _complete_fields(file)
    with contextlib.suppress(OSError, KeyError, AttributeError, TypeError), h5py.File(copy, "r+") as file:
        families: Any = file["FAS"]
        for place in [one[part] for one in families.values() for part in ("ELEME", "NOEUD") if part in one]:
            for name, family in list(place.items()):
                if "GRO" in family:
                    _spell(family["GRO"])
                else:
                    del place[name]
    return copy.getvalue()


def _complete_fields(file: Any) -> None:
    """Write the fields of a MED file with a value for each node or cell, NaN where there is none: meshio stops at
    fields on a part of the mesh. Fields with several values in a cell are left out."""
    (mesh,) = file["ENS_MAA"].values()
    (mesh,) = (mesh,) if "NOE" in mesh else mesh.values()
    nodes = {"NOE": mesh["NOE"]["COO"].attrs["NBR"]}
    cells = {f"MAI.{kind}": one["NOD"].attrs["NBR"] for kind, one in mesh["MAI"].items()}
    for name, steps in list(file["CHA"].items()):
        if _is_within_cells(steps):
            del file["CHA"][name]
            continue
        for step in steps.values():
            for sizes in (nodes, cells):
                for place, size in sizes.items() if sizes.keys() & step.keys() else ():
                    values = np.full((size, steps.attrs["NCO"]), np.nan)
                    for profile, part in step.get(place, {}).items():
                        rows = slice(None) if profile == _ON_ALL else file["PROFILS"][profile]["PFL"][()] - 1
                        values[rows] = part["CO"][()].reshape(values.shape[1], -1).T
                    _write_on_all(step, place, values)


def _write_on_all(step: Any, place: str, values: np.ndarray) -> None:
    if place in step:
        del step[place]
    part = step.create_group(f"{place}/{_ON_ALL}")
    part.parent.attrs["PFL"] = np.bytes_(_ON_ALL)
    part.attrs.update(NBR=len(values), NGA=1)
    part["CO"] = values.T.ravel()


def _is_within_cells(steps: Any) -> bool:
    """Whether a field of a MED file has values at the nodes of each element, or at several points in it."""
    parts = [(place, one) for step in steps.values() for place, held in step.items() for one in held.values()]
    return any(place.startswith("NOE.") or one.attrs.get("NGA", 1) > 1 for place, one in parts)


def _left_out_of_med(path: Path) -> list[str]:
    """A note on the fields of a MED file that are left out."""
    names: list[str] = []
    with contextlib.suppress(OSError, KeyError, AttributeError), h5py.File(path, "r") as file:
        fields: Any = file["CHA"]
        names += [repr(name) for name, steps in fields.items() if _is_within_cells(steps)]
    return [f"fields with several values in a cell are left out: {', '.join(names)}"] if names else []


def _spell(groups: Any) -> None:
    """Store the letters of the names of MED groups, which are bytes of UTF-8, or of Latin-1 in old files: meshio takes
    each byte for a letter, and fails on those that are not ASCII."""
    names = [_letters(row.tobytes()).rstrip("\0 ") for row in groups["NOM"][()]]
    width = max(1, *map(len, names))
    del groups["NOM"]
    groups.create_dataset("NOM", data=[[ord(letter) for letter in name.ljust(width)] for name in names])


def _letters(name: bytes) -> str:
    try:
        return name.decode("utf-8")
    except UnicodeDecodeError:
        return name.decode("latin-1")


_PLAIN: dict[str, Callable[[Path], bytes]] = {
    ".med": _plain_med,
    ".obj": plain_obj,
    ".off": plain_off,
    ".ply": plain_ply,
    **dict.fromkeys(_NASTRAN, plain_nastran),
}

_TOLD: dict[str, Callable[[Path], list[str]]] = {
    ".med": _left_out_of_med,
    **dict.fromkeys(_NASTRAN, left_out_of_nastran),
}

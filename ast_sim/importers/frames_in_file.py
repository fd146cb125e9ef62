"""The frames of one file, read by the reader of its format."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ast_sim.element_topology import is_closed
from ast_sim.importers.decks.deck_mesh import deck_mesh
from ast_sim.importers.formats.exodus.exodus_files import exodus_facts
from ast_sim.importers.formats.exodus.exodus_pieces import is_first_piece, is_piece, piece_frames
from ast_sim.importers.formats.pieces_apart import copy_of
from ast_sim.importers.formats.source_mesh import CellBlock, SourceMesh
from ast_sim.importers.formats.stl_file import BadSurface, read_stl
from ast_sim.importers.formats.text_meshes import reader_of
from ast_sim.importers.formats.vtk_files import BLOCKS, ENDINGS, XML, is_dyna, vtk_frames
from ast_sim.importers.meshio_kinds.meshio_files import BY_MESHIO, by_meshio
from ast_sim.importers.meshio_kinds.xdmf.xdmf_frames import xdmf_frames
from ast_sim.importers.msh.gmsh_fields import has_steps
from ast_sim.importers.msh.gmsh_files import gmsh_frames
from ast_sim.support.errors import DatasetError

# Formats whose files hold all frames of a simulation.
WITH_FRAMES = (".vtkhdf", ".frd", ".e", ".ex2", ".exo", ".exoii", ".exii")

# Exodus files that hold a mesh by their names; some programs write results into them.
MESHES_OF_EXODUS = (".g", ".gen")

# Formats in which each frame is a file of its own; files of the last ones may hold all frames.
XDMF = (".xdmf", ".xmf")
ONE_FRAME = (".vtu", ".pvtu", ".vtk", ".vtp", ".pvtp", ".vts", ".pvts", *BLOCKS, *XDMF, ".msh")

# The mark of UTF-8, with which some editors of Windows begin a text. The readers of some formats know it; TetGen's
# second file stands beside the first one.
_MARK = b"\xef\xbb\xbf"
_WITH_MARK = (".inp", ".stl", ".ele", ".node", *XML, *XDMF)

# The marks of UTF-16, and the formats whose readers know them.
_MARKS_OF_UTF_16 = (b"\xff\xfe", b"\xfe\xff")
_IN_UTF_16 = (".inp", *XDMF)

# What packed files begin with, and what packs them.
_PACKED = {
    b"\x1f\x8b": "gzip",
    b"BZh": "bzip2",
    b"\xfd7zXZ": "xz",
    b"PK\3\4": "zip",
    b"7z\xbc\xaf": "7-Zip",
    b"(\xb5/\xfd": "zstd",
}


def is_of_known_kind(path: Path) -> bool:
    """Whether the kind of a file, by its name, is one that `frames_in` reads."""
    return path.suffix.lower() in (*ENDINGS, ".inp", ".stl", *BY_MESHIO) or is_dyna(path) or is_piece(path)


def holds_frames(path: Path) -> bool:
    """Whether a file holds all frames of a simulation. The first of the pieces of a parallel run stands for all."""
    ending = path.suffix.lower()
    if ending in XDMF:
        return re.search(rb"(?i)GridType\s*=\s*[\"']Collection", path.read_bytes()) is not None
    if ending in MESHES_OF_EXODUS:
        facts = exodus_facts(path)
        return facts is not None and facts.steps > 0
    return ending in WITH_FRAMES or is_dyna(path) or is_first_piece(path) or (ending == ".msh" and has_steps(path))


def require_unpacked(path: Path) -> None:
    """Raise DatasetError if a file is packed, or a text in UTF-16 of a format whose reader does not know it."""
    with path.open("rb") as file:
        head = file.read(8)
    packed = next((name for mark, name in _PACKED.items() if head.startswith(mark)), None)
    if packed is not None:
        raise DatasetError(f"{path}: is packed by {packed}: unpack it first")
    if head.startswith(_MARKS_OF_UTF_16) and path.suffix.lower() not in _IN_UTF_16:
        raise DatasetError(f"{path}: is a text in UTF-16: save it as UTF-8")


def only_frame(path: Path) -> SourceMesh:
    """The frame of a file that is one frame of a simulation.

    Raises:
        DatasetError: it holds several frames; else as in `frames_in`.
    """
    frames = frames_in(path)
    frame = next(frames)
    if next(frames, None) is not None:
        raise DatasetError(
            f"{path}: holds several frames, and a file of a series must be one: convert it alone, or write a file for"
            " each frame"
        )
    return frame


def frames_in(path: Path) -> Iterator[SourceMesh]:
    """The frames of a file, one after the other.

    Raises:
        DatasetError: the file is missing, damaged or of an unknown kind; the text names it.
        MissingExtra: the reader of the format is not installed.
    """
    if not path.is_file():
        what = "is a folder: name a file in it" if path.is_dir() else "there is no such file"
        raise DatasetError(f"{path}: {what}")
    require_unpacked(path)
    ending = path.suffix.lower()
    is_deck = ending == ".inp" or (ending == ".msh" and _beginning(path).startswith(b"*"))  # cgx calls a deck so
    if not is_deck and ending not in _WITH_MARK and _is_marked(path):
        with copy_of(path, path.read_bytes()[len(_MARK) :]) as copy:
            yield from _named(path, copy, frames_in(copy))
        return
    true = _ending_of_vtk(path) if ending in (".vtk", ".vtu", ".vtp", ".vts") else ending
    if true != ending:
        with tempfile.TemporaryDirectory() as folder:
            link = Path(folder) / (path.stem + true)
            link.symlink_to(path.resolve())
            yield from _named(path, link, vtk_frames(link))
    elif ending in ENDINGS or is_dyna(path):
        yield from vtk_frames(path)
    elif is_piece(path):
        yield from piece_frames(path, vtk_frames)
    elif is_deck:
        yield deck_mesh(path)
    elif ending == ".msh" and re.search(rb"(?m)^\$(MeshFormat|NOD)\s*$", _beginning(path)):
        yield from gmsh_frames(path)
    elif ending == ".stl":
        yield _surface(path)
    elif ending in XDMF:
        yield from xdmf_frames(path)
    else:
        read = reader_of(ending, _beginning(path)) or by_meshio
        yield read(path)


def _ending_of_vtk(path: Path) -> str:
    """The ending that a file of VTK must have by its first bytes: some programs write legacy files as .vtu, or XML as
    .vtk."""
    head = _beginning(path)
    kind = re.search(rb"<VTKFile\b[^>]*\btype\s*=\s*[\"'](UnstructuredGrid|PolyData|StructuredGrid)[\"']", head)
    if kind:
        return {b"U": ".vtu", b"P": ".vtp", b"S": ".vts"}[kind[1][:1]]
    return ".vtk" if head.startswith(b"# vtk DataFile") else path.suffix.lower()


def _named(path: Path, read: Path, frames: Iterator[SourceMesh]) -> Iterator[SourceMesh]:
    """Frames and errors that name the file, though they come from a link to it or from a copy."""
    try:
        yield from (replace(frame, path=path) for frame in frames)
    except DatasetError as error:
        raise DatasetError(str(error).replace(str(read), str(path))) from error


def _beginning(path: Path) -> bytes:
    """The first bytes of a file, behind the mark of UTF-8 if it has one."""
    with path.open("rb") as file:
        return file.read(1 << 16).removeprefix(_MARK)


def _is_marked(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(_MARK)) == _MARK


def _surface(path: Path) -> SourceMesh:
    """The triangles of all solids of an STL file; corners at the same place are one point, but corners of two solids
    only if some solid is open: then they are patches of one surface."""
    try:
        stl = read_stl(path)
    except BadSurface as error:
        raise DatasetError(f"{path}: cannot be read as a mesh: {error}") from error
    rows = stl.corners.reshape(-1, 3)
    points, nodes = np.unique(rows, axis=0, return_inverse=True)
    if all(is_closed(nodes.reshape(-1, 3)[stl.solid == solid]) for solid in np.unique(stl.solid)):
        points, nodes = np.unique(np.column_stack([rows, np.repeat(stl.solid, 3)]), axis=0, return_inverse=True)
    return SourceMesh(path, points[:, :3], [CellBlock("triangle", nodes.reshape(-1, 3), "triangle")])

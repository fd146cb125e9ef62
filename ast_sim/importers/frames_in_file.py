"""The frames of one file, read by the reader of its format."""

from __future__ import annotations

import contextlib
import io
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim.importers.decks.deck_mesh import deck_mesh
from ast_sim.importers.formats.gmsh_files import gmsh_mesh
from ast_sim.importers.formats.source_mesh import SourceMesh, from_meshio
from ast_sim.importers.formats.vtk_files import ENDINGS, is_dyna, vtk_frames
from ast_sim.support.errors import DatasetError

# Formats whose files hold all frames of a simulation.
WITH_FRAMES = (".vtkhdf", ".frd", ".xdmf", ".xmf", ".e", ".ex2", ".exo", ".exoii", ".exii")

# Formats in which each frame is a file of its own.
ONE_FRAME = (".vtu", ".pvtu", ".vtk", ".vtp", ".pvtp", ".vtm")


def holds_frames(path: Path) -> bool:
    """Whether a file holds all frames of a simulation."""
    return path.suffix.lower() in WITH_FRAMES or is_dyna(path)


def frames_in(path: Path) -> Iterator[SourceMesh]:
    """The frames of a file, one after the other.

    Raises:
        DatasetError: the file is missing, damaged or of an unknown kind; the text names it.
        MissingExtra: the reader of the format is not installed.
    """
    if not path.is_file():
        raise DatasetError(f"{path}: there is no such file")
    ending = path.suffix.lower()
    if ending in ENDINGS or is_dyna(path):
        yield from vtk_frames(path)
    elif ending == ".inp":
        yield deck_mesh(path)
    elif ending == ".msh" and b"$MeshFormat" in _beginning(path):
        yield gmsh_mesh(path)
    elif ending in (".xdmf", ".xmf"):
        with _beside(path) as copy:
            yield from _xdmf_frames(path, copy)
    else:
        yield _by_meshio(path)


def _beginning(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(1 << 16)


def _by_meshio(path: Path, copy: Path | None = None) -> SourceMesh:
    """Read a file, or its copy, by meshio. On a damaged file meshio may raise any error, print, or raise SystemExit."""
    import meshio

    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            mesh = meshio.read(copy or path)
    except (Exception, SystemExit) as error:
        raise DatasetError(f"{path}: cannot be read as a mesh: {_told(error, printed.getvalue())}") from error
    return from_meshio(mesh, path)


def _told(error: BaseException, printed: str = "") -> str:
    """What meshio says on a file that it cannot read, in one line."""
    from meshio import ReadError

    if isinstance(error, SystemExit | OSError | ReadError):
        told = " ".join(f"{printed} {error if str(error) != '1' else ''}".split())
        return told or "meshio cannot read it"
    key = error.args[0] if isinstance(error, KeyError) and error.args else None
    return f"meshio does not know {key}" if key is not None else f"meshio stopped: {' '.join(str(error).split())}"


@contextlib.contextmanager
def _beside(path: Path) -> Iterator[Path]:
    """An XDMF file; or a copy, if numbers stand in binary files beside it, which meshio looks for in the folder in
    which the process runs: the copy names them in full."""
    try:
        tree = ET.parse(path)
    except (ET.ParseError, OSError, ValueError, LookupError) as error:
        raise DatasetError(f"{path}: cannot be read as a mesh: it is no XML: {error}") from error
    binary = [item for item in tree.iter("DataItem") if item.get("Format") == "Binary" and item.text]
    for item in binary:
        item.text = str(path.parent.resolve() / str(item.text).strip())
    if not binary:
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        for item in tree.iter("DataItem"):
            if item.get("Format") == "HDF" and item.text:
                item.text = str(path.parent.resolve() / item.text.strip())
        tree.write(copy)
        yield copy


def _xdmf_frames(path: Path, copy: Path) -> Iterator[SourceMesh]:
    """The frames of a series that meshio or FEniCS has written; a file without a series is one frame."""
    import meshio

    if b"CollectionType" not in _beginning(path):
        yield _by_meshio(path, copy)
        return
    try:
        with meshio.xdmf.TimeSeriesReader(copy) as reader:
            points, cells = reader.read_points_cells()
            for step in range(reader.num_steps):
                time, point_data, cell_data = reader.read_data(step)
                values: Any = cell_data
                frame = meshio.Mesh(np.asarray(points), cells, point_data, values)
                yield replace(from_meshio(frame, path), time=float(time))
    except DatasetError:
        raise
    except (Exception, SystemExit) as error:
        raise DatasetError(f"{path}: cannot be read as a mesh: {_told(error)}") from error

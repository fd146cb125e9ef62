"""The frames of one file, read by the reader of its format."""

from __future__ import annotations

import contextlib
import io
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
        yield from _xdmf_frames(path)
    else:
        yield _by_meshio(path)


def _beginning(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(1 << 16)


def _by_meshio(path: Path) -> SourceMesh:
    """Read a file by meshio. On a damaged file meshio may raise any error, print, or raise SystemExit."""
    import meshio

    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            mesh = meshio.read(path)
    except (Exception, SystemExit) as error:
        told = " ".join(f"{printed.getvalue()} {error if str(error) != '1' else ''}".split())
        raise DatasetError(f"{path}: cannot be read as a mesh: {told or type(error).__name__}") from error
    return from_meshio(mesh, path)


def _xdmf_frames(path: Path) -> Iterator[SourceMesh]:
    """The frames of a series that meshio or FEniCS has written; a file without a series is one frame."""
    import meshio

    if b"CollectionType" not in _beginning(path):
        yield _by_meshio(path)
        return
    try:
        with meshio.xdmf.TimeSeriesReader(path) as reader:
            points, cells = reader.read_points_cells()
            for step in range(reader.num_steps):
                time, point_data, cell_data = reader.read_data(step)
                values: Any = cell_data
                frame = meshio.Mesh(np.asarray(points), cells, point_data, values)
                yield replace(from_meshio(frame, path), time=float(time))
    except DatasetError:
        raise
    except (Exception, SystemExit) as error:
        told = " ".join(str(error).split()) or type(error).__name__
        raise DatasetError(f"{path}: cannot be read as a mesh: {told}") from error

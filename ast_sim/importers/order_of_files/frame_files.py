"""The files of a simulation, grouped by frame."""

from __future__ import annotations

from pathlib import Path

from ast_sim.importers.formats.exodus.exodus_pieces import is_piece
from ast_sim.importers.formats.vtk_files import BLOCKS
from ast_sim.importers.frames_in_file import ONE_FRAME, XDMF, holds_frames, require_unpacked
from ast_sim.importers.order_of_files.by_name import natural_order
from ast_sim.importers.order_of_files.left_out import left_out
from ast_sim.importers.order_of_files.listed import SERIES, FrameFiles, in_collection, in_series
from ast_sim.support.errors import DatasetError


def frame_files(source: Path) -> FrameFiles:
    """The files of a simulation, without a look into them.

    Raises:
        DatasetError: the source is no simulation, it is damaged, or it lists a file that does not exist.
    """
    if source.is_dir():
        files = files_of_frames(source)
        if not files:
            raise DatasetError(f"{source}: the folder holds no .vtu file or other file of a frame")
        return FrameFiles([[file] for file in sorted(files, key=natural_order)], notes=left_out(source, files))
    if not source.is_file():
        raise DatasetError(f"{source}: there is no such file or folder")
    if source.suffix.lower() == ".pvd":
        return in_collection(source)
    if source.suffix.lower() == SERIES:
        return in_series(source)
    if source.suffix.lower() in ONE_FRAME or holds_frames(source) or is_piece(source):
        return FrameFiles([[source]])
    require_unpacked(source)
    raise DatasetError(
        f"{source}: must be a .pvd or .series file, a folder of files of frames ({', '.join(ONE_FRAME)}), or one file"
        " with all frames, such as .vtkhdf, .frd, .xdmf or .exo"
    )


def files_of_frames(folder: Path) -> list[Path]:
    """The files of a folder that are a frame each. Pieces that a .pvtu or .vtm file lists are not counted."""
    entries = [entry for entry in folder.iterdir() if entry.is_file() and not entry.name.startswith(".")]
    kinds = ((".pvtu",), (".pvts",), BLOCKS, (".vtu",), (".vts",), (".vtk",), (".pvtp",), (".vtp",), XDMF, (".msh",))
    for endings in kinds:
        files = [entry for entry in entries if entry.suffix.lower() in endings]
        if files:
            return files
    return []

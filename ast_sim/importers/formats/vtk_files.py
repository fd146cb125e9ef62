"""Meshes in the files that VTK reads: its own formats, Exodus and the d3plot files of LS-DYNA; and CalculiX's .frd.

They are read in a process of its own (`reading_worker`). Blocks and pieces become one mesh; ghost cells are left out.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from ast_sim.importers.formats.declared_sizes import (
    declared_in_vtkhdf,
    declared_in_xml,
    needed_bytes,
    require_linked_files,
    stored_in_hdf,
)
from ast_sim.importers.formats.dyna_files import require_no_deleted, require_whole, with_nodes
from ast_sim.importers.formats.exodus import EXODUS
from ast_sim.importers.formats.exodus.exodus_files import is_hdf, require_whole_exodus
from ast_sim.importers.formats.exodus.exodus_groups import groups_in
from ast_sim.importers.formats.exodus.unwritten import with_nan, written_time
from ast_sim.importers.formats.frd_given_up import is_left_out
from ast_sim.importers.formats.frd_results import read_frd_headers
from ast_sim.importers.formats.pieces_apart import are_unlike, copy_of, files_apart, read_apart, with_pieces_only
from ast_sim.importers.formats.source_mesh import SourceMesh
from ast_sim.importers.formats.together import labels_of, together
from ast_sim.importers.formats.vtk_cells import blocks_of
from ast_sim.support.environment import of_child
from ast_sim.support.errors import DatasetError, counted, require

READING_MODULE = "ast_sim.importers.formats.reading_worker"
BLOCKS = (".vtm", ".vtmb", ".vtpc", ".vtpd")  # list the files of blocks
XML = (".vtu", ".pvtu", ".vtp", ".pvtp", ".vts", ".pvts", *BLOCKS)
ENDINGS = (*XML, ".vtk", ".vtkhdf", *EXODUS, ".frd")

# Memory for a file: that for what it declares, for VTK's copies of it, and for what VTK needs itself.
_COPIES = 8
_OWN_BYTES = 1 << 29
_LARGEST_RATIO = 40  # of memory to file, where the file does not say what it declares

_CAUSES = "it is damaged, needs too much memory, or holds what VTK cannot read: then write it in another format"

_SECONDS = 120
_SECONDS_PER_MEGABYTE = 2

# Bits of VTK's array of ghosts: copies of the cells of another piece, cells that finer ones replace, hidden cells.
_GHOST_CELL = 1 | 8 | 32

ReadFrames = tuple[dict[str, Any], list[dict[str, np.ndarray]]]


def is_dyna(path: Path) -> bool:
    return path.name.lower() == "d3plot" or path.suffix.lower() == ".d3plot"


def vtk_frames(path: Path) -> Iterator[SourceMesh]:
    """The frames of a file, one after the other.

    Raises:
        DatasetError: VTK refuses the file, crashes on it, or makes something else of it than the file says it holds.
        MissingExtra: VTK is not installed.
    """
    pieces, budget, apart, files, timed = _checked(path)
    if path.suffix.lower() == ".vtk" and _ends_in_a_number(path):
        with copy_of(path, path.read_bytes() + b"\n") as copy:
            told = "the file ends without a line end: is its last number cut off?"
            yield from (replace(frame, path=path, notes=[*frame.notes, told]) for frame in vtk_frames(copy))
        return
    if apart:
        with contextlib.ExitStack() as stack:
            copies = [stack.enter_context(copy_of(path, with_pieces_only(path, kept))) for kept in apart]
            for parts in zip(*map(vtk_frames, copies), strict=True):
                yield replace(together(parts), path=path, piece_names=())
        return
    if files:
        readings = [vtk_frames(path.parent / file) for file in files]
        labels = labels_of(files)
        for parts in zip(*readings, strict=True):
            named = [replace(one, pieces=None, piece_names=(name,)) for one, name in zip(parts, labels, strict=True)]
            yield replace(together(named), path=path)
        return
    of_steps = declared_in_vtkhdf(path) if path.suffix.lower() == ".vtkhdf" else []
    step, steps = 0, 1
    while step < steps:
        head, parts = _worker.ask(path, step, budget)
        steps = head["steps"]
        head["time"] = head["time"] if timed else None
        parts = with_nodes(path, parts) if is_dyna(path) else parts
        mesh = _mesh(path, parts, head)
        declared = of_steps[step] if step < len(of_steps) else head.get("declared")
        declared = declared or ([sum(column) for column in zip(*pieces, strict=True)] if pieces else None)
        more = sum(int(part["more"][0]) for part in parts if "more" in part)
        mesh.notes.extend([f"polygons and strips are cut into triangles: {counted(more, 'more cell')}"] if more else [])
        _require_counts(mesh, declared and [declared[0], declared[1] + more])
        if is_dyna(path):
            require_no_deleted(mesh)
        step += 1
        if step == steps and is_left_out(path, head.get("given_up", False), steps, head["time"]):
            return
        yield _without_ghosts(_with_pieces(mesh, pieces, _piece_names(path)))


def _ends_in_a_number(path: Path) -> bool:
    """Whether a legacy file as text ends without a space or line end: then VTK takes garbage for missing numbers."""
    content = path.read_bytes()
    lines = content[:512].split(b"\n")
    return len(lines) > 2 and lines[2].strip().upper() == b"ASCII" and not content[-1:].isspace()


def _require_counts(mesh: SourceMesh, declared: list[int] | None) -> None:
    """Check that the points and cells are as many as the file says; a note says if VTK leaves out points of no cell."""
    if declared is None:
        return
    points = len(mesh.points)
    cells = sum(len(block.nodes) for block in mesh.blocks)
    if mesh.path.suffix.lower() in EXODUS and mesh.same_point is not None:
        points = len(np.unique(mesh.same_point))  # each block has its own copies of the points that it uses
        if points < declared[0]:
            mesh.notes.append(
                f"{counted(declared[0] - points, 'point of no element is', 'points of no element are')} left out"
            )
            points = declared[0]
    if declared != [points, cells]:
        raise DatasetError(
            f"{mesh.path}: says that it holds {counted(declared[0], 'point')} and {counted(declared[1], 'cell')}, but"
            f" VTK reads {points:,} and {cells}"
        )


class _Checked(NamedTuple):
    """What a file says of itself before VTK reads it."""

    pieces: list[tuple[int, int]]  # the points and cells of each, if the file says them
    budget: int  # bytes of memory that VTK may take
    apart: Sequence[list[int]] = ()  # which pieces are to be read apart
    files: Sequence[str] = ()  # of pieces, if each is to be read by itself
    timed: bool = True  # whether the frames have times


def _checked(path: Path) -> _Checked:
    ending = path.suffix.lower()
    size = path.stat().st_size
    exodus = require_whole_exodus(path) if ending in EXODUS else None
    timed = exodus is None or exodus.timed  # else VTK counts the frames 0, 1, 2, ...
    if ending in (".vtu", ".vtp", ".vts"):
        declared = declared_in_xml(path)
        budget = _OWN_BYTES + _COPIES * (needed_bytes(declared) + size)
        return _Checked(declared.pieces, budget, read_apart(declared)) if ending != ".vts" else _Checked([], budget)
    if ending in (".pvtu", ".pvtp", ".pvts", *BLOCKS):
        return _of_pieces(path)
    if ending == ".vtkhdf" or (ending in EXODUS and is_hdf(path)):
        require_linked_files(path)
        budget = _OWN_BYTES + _COPIES * stored_in_hdf(path, "VTKHDF" if ending == ".vtkhdf" else "/")
        return _Checked([], budget, timed=timed)
    if ending == ".frd":
        (nodes, elements), _ = read_frd_headers(path)
        return _Checked([(nodes, elements)], _OWN_BYTES + _LARGEST_RATIO * size)
    if is_dyna(path):
        require_whole(path)
        size = sum(part.stat().st_size for part in path.parent.glob(f"{path.name}*"))
    return _Checked([], _OWN_BYTES + _LARGEST_RATIO * size, timed=timed)


def _of_pieces(path: Path) -> _Checked:
    """As `_checked`, of a file that lists the files of its pieces or blocks."""
    listed = declared_in_xml(path).sources
    if path.suffix.lower() in BLOCKS:
        listed = [entry.attrib["file"] for entry in ElementTree.parse(path).iter("DataSet") if entry.get("file")]
    pieces = []
    budget = _OWN_BYTES
    told = {}
    for name in listed:
        file = path.parent / name
        if not file.is_file():
            raise DatasetError(f"{path}: lists {name}, which does not exist")
        if file.suffix.lower() in (".vtu", ".vtp", ".vts"):
            told[name] = declared = declared_in_xml(file)
            if are_unlike(declared):
                raise DatasetError(
                    f"{file}: its pieces have different fields, or the same in another order, and VTK mixes them up:"
                    " write each piece into a file of its own"
                )
            pieces += declared.pieces
            budget += _COPIES * (needed_bytes(declared) + file.stat().st_size)
    files = files_apart(path, told) if path.suffix.lower() in (".pvtu", ".pvtp") else ()
    return _Checked(pieces if path.suffix.lower() == ".pvtu" else [], budget, files=files)


class _Worker:
    """The process in which VTK reads; it is started when it is needed, and again after a crash."""

    def __init__(self) -> None:
        self.process: subprocess.Popen[bytes] | None = None
        self.owner = 0

    def ask(self, path: Path, step: int, budget: int) -> ReadFrames:
        seconds = _SECONDS + _SECONDS_PER_MEGABYTE * (path.stat().st_size >> 20)
        request = {"path": str(path.absolute()), "step": step, "bytes": budget, "seconds": seconds}
        process = self._running(path)
        assert process.stdin is not None and process.stdout is not None
        try:
            process.stdin.write(json.dumps(request).encode() + b"\n")
            process.stdin.flush()
            line = process.stdout.readline()
            head = json.loads(line) if line else None
            parts = _received(process.stdout, head["pieces"]) if head else []
        except BaseException as error:
            self.stop()
            if isinstance(error, OSError | ValueError):
                raise DatasetError(f"{path}: cannot be read as a mesh: VTK stopped") from error
            raise
        if head is None:
            raise DatasetError(f"{path}: cannot be read as a mesh: {self._cause_of_death(seconds)}")
        if "missing" in head:
            require("read", head["missing"])
        if "error" in head:
            raise DatasetError(f"{path}: cannot be read as a mesh: {' '.join(head['error'].split())}")
        return head, parts

    def _running(self, path: Path) -> subprocess.Popen[bytes]:
        if self.process is None or self.owner != os.getpid() or self.process.poll() is not None:
            require("read", "vtkmodules")
            self.process = subprocess.Popen(
                [sys.executable, "-P", "-m", READING_MODULE],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env=of_child(),
                start_new_session=True,  # Ctrl-C is for this process alone
            )
            self.owner = os.getpid()
        return self.process

    def _cause_of_death(self, seconds: int) -> str:
        assert self.process is not None
        code = self.process.wait()
        self.stop()
        if code == -signal.SIGALRM:
            return f"VTK did not finish within {seconds} s"
        if code < 0:
            return f"VTK crashed on it ({signal.Signals(-code).name}); {_CAUSES}"
        return f"VTK stopped; {_CAUSES}"

    def stop(self) -> None:
        if self.process is not None and self.owner == os.getpid():
            for pipe in (self.process.stdin, self.process.stdout):
                with contextlib.suppress(OSError):
                    if pipe is not None:
                        pipe.close()
            with contextlib.suppress(OSError):
                self.process.kill()
            self.process.wait()
        self.process = None


_worker = _Worker()
atexit.register(_worker.stop)


def _received(stream: Any, listed: list[dict[str, tuple[str, list[int]]]]) -> list[dict[str, np.ndarray]]:
    pieces = []
    for names in listed:
        piece = {}
        for name, (dtype, shape) in names.items():
            kind = np.dtype(dtype)
            count = int(np.prod(shape))
            data = stream.read(kind.itemsize * count)
            piece[name] = np.frombuffer(data, kind, count).reshape(shape)
        pieces.append(piece)
    return pieces


def _mesh(path: Path, parts: list[dict[str, np.ndarray]], head: dict[str, Any]) -> SourceMesh:
    """One mesh of all parts; the groups are given by the numbers of points in the whole file."""
    of_exodus = path.suffix.lower() in EXODUS
    parts, unwritten = with_nan(parts) if of_exodus else (parts, [])
    time = written_time(head["time"]) if of_exodus else head["time"]
    meshes = [_part(path, part, time) for part in parts if "points" in part and len(part["points"])]
    if not meshes:
        raise DatasetError(f"{path}: holds no points")
    mesh = together(meshes)
    mesh.notes.extend(unwritten)
    if of_exodus and mesh.same_point is not None:
        groups, notes = groups_in(path, parts, head["declared"][0])
        mesh.notes.extend(notes)
        for name, ids in groups.items():
            mesh.groups[name] = np.flatnonzero(np.isin(mesh.same_point, ids))
    return mesh


def _part(path: Path, part: dict[str, np.ndarray], time: float | None) -> SourceMesh:
    blocks = blocks_of(path, part["types"], part["offsets"], part["connectivity"])
    names = {**_named(part, "point-columns "), **_named(part, "cell-columns ")}
    return SourceMesh(
        path,
        part["points"].astype(np.float64),
        [block for block, _ in blocks],
        _named(part, "point "),
        {name: [values[rows] for _, rows in blocks] for name, values in _named(part, "cell ").items()},
        time=time,
        columns={n: tuple(one.decode(errors="replace") for one in v.tolist()) for n, v in names.items()},
        same_point=part["global"].astype(np.int64) if "global" in part else None,
        piece_names=(part["block"].item().decode(errors="replace"),),
    )


def _named(part: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {name.removeprefix(prefix): values for name, values in part.items() if name.startswith(prefix)}


def _piece_names(path: Path) -> tuple[str, ...]:
    """What the names of the files of a .pvtu file tell of its pieces, if each file is one."""
    return tuple(labels_of(declared_in_xml(path).sources)) if path.suffix.lower() == ".pvtu" else ()


def _with_pieces(mesh: SourceMesh, pieces: list[tuple[int, int]], names: tuple[str, ...]) -> SourceMesh:
    """VTK has joined the pieces of a file in their order; their sizes say which point belongs to which."""
    if mesh.pieces is not None or sum(count > 0 for count, _ in pieces) < 2:
        return mesh
    of_points = np.repeat(np.arange(len(pieces)), [count for count, _ in pieces])
    return replace(mesh, pieces=of_points, piece_names=names if len(names) == len(pieces) else ())


def _without_ghosts(mesh: SourceMesh) -> SourceMesh:
    """The mesh without its ghost cells. A point of a ghost stands for the same point of another piece."""
    ghosts = mesh.cell_fields.pop("vtkGhostType", None)
    mesh.point_fields.pop("vtkGhostType", None)
    if ghosts is None:
        return mesh
    kept = [(np.nan_to_num(np.asarray(g, float)).astype(int) & _GHOST_CELL) == 0 for g in ghosts]
    left_out = sum(int((~rows).sum()) for rows in kept)
    blocks = [block.rows(rows) for block, rows in zip(mesh.blocks, kept, strict=True)]
    fields = {
        name: [v[rows] for v, rows in zip(values, kept, strict=True)] for name, values in mesh.cell_fields.items()
    }
    notes = [*mesh.notes, *([f"{counted(left_out, 'ghost cell is', 'ghost cells are')} left out"] if left_out else [])]
    return replace(mesh, blocks=blocks, cell_fields=fields, notes=notes)

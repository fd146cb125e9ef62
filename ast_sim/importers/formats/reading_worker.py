"""A process that reads files by the readers of VTK, and CalculiX's .frd files by pyvista-frd-reader. Their C++ code may
crash on a damaged file, so no other process of this package loads it.

`python -m ast_sim.importers.formats.reading_worker` reads requests, a line of JSON each, from its standard input:
{"path": ..., "step": number of the frame within the file, "bytes": limit on the memory, "seconds": limit on the time}.
Its answer on the standard output is a line of JSON and then the bytes of the arrays that the line lists. {"error":
text} is the answer if the file is refused, with "missing" if a package is not installed.

The answer: "steps" (how many frames the file holds), "time", and "pieces". Each piece has the arrays `points` [n, 3],
`types` [c], `offsets` [c + 1], `connectivity` (VTK's types and order of nodes), `point NAME`, `cell NAME`, `global`,
`block` (the name of the block that it is), `more` (how many more cells it has than the file, where polygons and strips
are cut), and the nodes of the sets of Exodus as `group nodes NAME` and `group sides NAME`.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import signal
import sys
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim.importers.formats.exodus import EXODUS
from ast_sim.importers.formats.frd_given_up import given_up
from ast_sim.importers.formats.frd_results import partly_given, read_frd_headers
from ast_sim.importers.formats.vtk_data import Block, Refused, arrays_of, blocks_of, of_used_points, time_of


def main() -> None:
    """Answer requests until there are no more."""
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what VTK prints must not mix with the answers
    import_vtk()
    for line in sys.stdin:
        request = json.loads(line)
        if request["path"].lower().endswith(".frd"):
            with contextlib.suppress(ImportError):
                import pyvista_frd  # noqa: F401
        base = _address_space()
        _, hard = resource.getrlimit(resource.RLIMIT_AS)
        limit = base + request["bytes"]
        resource.setrlimit(resource.RLIMIT_AS, (limit if hard < 0 else min(limit, hard), hard))
        signal.alarm(request["seconds"])
        head, arrays = _answer(request)
        signal.alarm(0)
        answer.write(json.dumps(head).encode() + b"\n")
        for array in arrays:
            answer.write(np.ascontiguousarray(array).data)
        answer.flush()


def _answer(request: dict[str, Any]) -> tuple[dict[str, Any], list[np.ndarray]]:
    window = _silent_window()
    pieces: list[dict[str, np.ndarray]] = []
    try:
        head, pieces = _read(Path(request["path"]), request["step"])
    except MemoryError:
        head = {"error": "needs more memory than a file of its size can"}
    except ImportError as error:
        head = {"error": str(error), "missing": error.name}
    except Refused as error:
        head = {"error": str(error)}
    except Exception as error:  # also what VTK's Python layer raises, and arrays that VTK has left as they were
        head = {"failed": str(error) or type(error).__name__}
    told = [line for line in window.GetOutput().splitlines() if line.strip()]
    if told and "error" not in head:
        head = {"error": _first_error(told)}
        pieces = []
    head = {"error": head["failed"]} if "failed" in head else head
    listed = [{name: (array.dtype.str, array.shape) for name, array in piece.items()} for piece in pieces]
    return {**head, "pieces": listed}, [array for piece in pieces for array in piece.values()]


def _first_error(lines: list[str]) -> str:
    """The first sentence of what VTK has told, without the places in its code and the addresses of its objects."""
    sentences = [
        line.split("): ", 1)[-1].strip() for line in lines if not line.startswith(("ERROR: In", "Warning: In"))
    ]
    told = (sentences or lines)[0]
    unknown = told.removeprefix("Unsupported element type:").strip() if told.startswith("Unsupported element") else None
    return told if unknown is None else f"VTK does not know its elements of the kind {unknown!r}: leave their block out"


def _silent_window() -> Any:
    """Let VTK tell its errors to a string instead of the screen."""
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow

    window = vtkStringOutputWindow()
    vtkOutputWindow.SetInstance(window)
    return window


def import_vtk() -> None:
    """Load the readers, so that the memory that they take themselves is known."""
    import vtkmodules.vtkFiltersCore
    import vtkmodules.vtkIOExodus
    import vtkmodules.vtkIOHDF
    import vtkmodules.vtkIOLegacy
    import vtkmodules.vtkIOLSDyna
    import vtkmodules.vtkIOXML  # noqa: F401


def _address_space() -> int:
    """The bytes of addresses that this process uses."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[0]) * resource.getpagesize()


def _read(path: Path, step: int) -> tuple[dict[str, Any], list[dict[str, np.ndarray]]]:
    """The facts on a file, and the arrays of each mesh in one of its frames."""
    state = path.stat()
    file = _opened(path, state.st_mtime_ns, state.st_size)
    if not 0 <= step < len(file.times):
        raise Refused(f"has no frame {step}; it has {len(file.times)}")
    if isinstance(file, _Results):
        return {"steps": len(file.times), "time": file.times[step], **file.facts}, [file.frame(step)]
    if file.set_step is not None:
        file.set_step(step)  # by its number: times may stand in a file twice
    file.reader.Update()
    data = file.reader.GetOutputDataObject(0)
    blocks = blocks_of(data)
    time = time_of(data, blocks) if file.set_step is None else file.times[step]
    pieces = [arrays_of(block) for block in blocks]
    if path.suffix.lower() in EXODUS:  # each block has all points of the file
        pieces = [of_used_points(piece) if "connectivity" in piece else piece for piece in pieces]
    return {"steps": len(file.times), "time": time, **file.facts}, pieces


@dataclass
class _Opened:
    """A reader of VTK with a file, the times of its frames, how a frame is chosen, and what the file says it holds."""

    reader: Any
    times: list[float | None]
    set_step: Callable[[int], None] | None = None
    facts: dict[str, Any] = field(default_factory=dict)


@dataclass
class _Results:
    """An .frd file of CalculiX, the times of its frames, of each time the results that only some nodes have (their
    names and these nodes), whether its last increment was given up, and the folder of a copy that is read instead."""

    reader: Any
    times: list[float | None]
    partial: dict[float, list[tuple[str, np.ndarray]]]
    facts: dict[str, Any]
    copy: tempfile.TemporaryDirectory[str] | None

    def frame(self, step: int) -> dict[str, np.ndarray]:
        if self.times[step] is not None:
            self.reader.set_active_time_point(step)
        arrays = arrays_of(Block(self.reader.read()))
        arrays["global"] = arrays.pop("point original_node_ids")
        for result, nodes in self.partial.get(self.times[step] or 0.0, []):
            for name in arrays:  # also STRESS_Mises, which the reader computes; it fills with zeros
                if name == f"point {result}" or name.startswith(f"point {result}_"):
                    values = arrays[name].astype(np.float64)
                    values[~np.isin(arrays["global"], nodes)] = np.nan
                    arrays[name] = values
        return arrays


@lru_cache(maxsize=1)
def _opened(path: Path, changed: int, size: int) -> _Opened | _Results:
    """The reader of a file. It is kept for the next frame: to open a file of results again means to read all of it."""
    ending = path.suffix.lower()
    if ending == ".frd":
        import pyvista_frd

        with warnings.catch_warnings():
            warnings.simplefilter("error")  # elements that it skips
            folder, plain = _plain_frd(path)
            reader = pyvista_frd.FRDReader(plain)
        (declared, _), results = read_frd_headers(path)
        unseen = [one.time for one in results if not np.isclose(reader.time_values, one.time, rtol=1e-5).any()]
        if unseen:
            raise Refused(
                f"the reader of .frd files does not see its results at the time {unseen[0]:g}: their headers must be as"
                " CalculiX writes them (100CL)"
            )
        partial: dict[float, list[tuple[str, np.ndarray]]] = {}
        for result, nodes in partly_given(path, results, declared):
            partial.setdefault(result.time, []).append((result.name, nodes))
        return _Results(reader, [*reader.time_values] or [None], partial, {"given_up": given_up(path, results)}, folder)
    if ending in EXODUS:
        return _exodus(path)
    if path.name.lower().startswith("d3plot") or ending == ".d3plot":
        return _dyna(path)
    if ending in (".vtkhdf", ".hdf"):
        return _hdf(path)
    return _Opened(_xml_or_legacy(path, ending), [None])


def _plain_frd(path: Path) -> tuple[tempfile.TemporaryDirectory[str] | None, Path]:
    """An .frd file, or a copy if its exponents have three digits, as programs for Windows write them: then negative
    numbers are a column wider than the format says."""
    content = path.read_bytes()
    if not re.search(rb"(?m)^ -1[ \d]{10}(-?\d\.\d{5}E[+-]\d{3}){3}\s*$", content):
        return None, path
    folder = tempfile.TemporaryDirectory()
    copy = Path(folder.name) / path.name
    number = re.compile(rb"(-?)(\d\.\d+E[+-])0(\d\d)")
    copy.write_bytes(number.sub(lambda match: (match[1] or b" ") + match[2] + match[3], content))
    return folder, copy


def _xml_or_legacy(path: Path, ending: str) -> Any:
    from vtkmodules import vtkIOLegacy, vtkIOXML

    if ending == ".vtk":
        reader = vtkIOLegacy.vtkGenericDataObjectReader()
        for what in ("Scalars", "Vectors", "Normals", "Tensors", "TCoords", "ColorScalars", "Fields"):
            getattr(reader, f"ReadAll{what}On")()
    else:
        name = {
            ".vtu": "UnstructuredGrid",
            ".pvtu": "PUnstructuredGrid",
            ".vtp": "PolyData",
            ".pvtp": "PPolyData",
            ".vts": "StructuredGrid",
            ".pvts": "PStructuredGrid",
            ".vtm": "MultiBlockData",
            ".vtmb": "MultiBlockData",
            ".vtpc": "PartitionedDataSetCollection",
            ".vtpd": "PartitionedDataSet",
        }[ending]
        reader = getattr(vtkIOXML, f"vtkXML{name}Reader")()
    reader.SetFileName(_name(path))
    return reader


def _name(path: Path) -> Any:
    """The bytes of a path, which need not be UTF-8; VTK takes them, though its types say text."""
    return os.fsencode(path)


def _times(reader: Any) -> list[float | None]:
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline as Pipeline

    reader.UpdateInformation()
    facts = reader.GetOutputInformation(0)
    return list(facts.Get(Pipeline.TIME_STEPS()) or []) or [None]


def _hdf(path: Path) -> _Opened:
    from vtkmodules.vtkIOHDF import vtkHDFReader

    reader = vtkHDFReader()
    if not reader.CanReadFile(_name(path)):
        raise Refused("is no VTKHDF file")
    reader.SetFileName(_name(path))
    times = _times(reader)
    return _Opened(reader, times, None if times == [None] else reader.SetStep)


def _exodus(path: Path) -> _Opened:
    from vtkmodules.vtkIOExodus import vtkExodusIIReader as Reader

    reader = Reader()
    if not reader.CanReadFile(_name(path)):
        raise Refused("is no Exodus file")
    reader.SetFileName(_name(path))
    reader.UpdateInformation()
    reader.ApplyDisplacementsOff()
    reader.SetSqueezePoints(False)  # VTK would round the points of each block to single precision
    times = _times(reader)
    for kind in (Reader.NODAL, Reader.ELEM_BLOCK):
        reader.SetAllArrayStatus(kind, int(times != [None]))  # without a time there are no values, maybe only names
    for kind in (Reader.NODE_SET, Reader.SIDE_SET):
        for index in range(reader.GetNumberOfObjects(kind)):
            reader.SetObjectStatus(kind, index, 1)  # VTK leaves sets out unless they are enabled
    facts = {"declared": [reader.GetTotalNumberOfNodes(), reader.GetTotalNumberOfElements()]}
    return _Opened(reader, times, reader.SetTimeStep, facts)


def _dyna(path: Path) -> _Opened:
    from vtkmodules.vtkIOLSDyna import vtkLSDynaReader

    reader = vtkLSDynaReader()
    if not reader.CanReadFile(_name(path)):
        raise Refused("is no d3plot file")
    reader.SetFileName(_name(path))
    reader.UpdateInformation()
    reader.SetDeformedMesh(0)
    reader.SetRemoveDeletedCells(1)  # they stay as ghosts; without this, they are not known
    reader.SetDeletedCellsAsGhostArray(1)
    for kind in ("Point", "Solid", "ThickShell", "Shell"):
        for index in range(getattr(reader, f"GetNumberOf{kind}Arrays")()):
            getattr(reader, f"Set{kind}ArrayStatus")(index, 1)
    return _Opened(reader, _times(reader), reader.SetTimeStep)


if __name__ == "__main__":
    main()

"""Series and meshes that VTK's own writers write: VTU in all of its encodings, pieces, PVD, legacy files, blocks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
from vtkmodules.util.vtkAlgorithm import VTKPythonAlgorithmBase
from vtkmodules.vtkCommonCore import vtkBitArray, vtkDoubleArray, vtkPoints, vtkStringArray
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkMultiBlockDataSet, vtkUnstructuredGrid
from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline as Pipeline
from vtkmodules.vtkIOExodus import vtkExodusIIWriter
from vtkmodules.vtkIOHDF import vtkHDFWriter
from vtkmodules.vtkIOLegacy import vtkUnstructuredGridWriter
from vtkmodules.vtkIOXML import vtkXMLMultiBlockDataWriter, vtkXMLUnstructuredGridWriter

from ast_sim.importers.series import FieldNames
from benchmarks.robustness.dialects.comparison import Case
from benchmarks.robustness.dialects.file_content import FileContent, content_of, cut_into_pieces
from benchmarks.robustness.dialects.random_simulation import Simulation
from benchmarks.robustness.dialects.told import told_of_order

TYPES = {
    "tetra": 10, "hexahedron": 12, "wedge": 13, "pyramid": 14,
    "tetra10": 24, "hexahedron20": 25, "wedge15": 26, "pyramid13": 27,
}  # fmt: skip
NAMES = FieldNames("U", "S", None, "tool", "fixed")


def grid(
    rng: np.random.Generator, content: FileContent, simulation: Simulation, frame: int, moved: bool, bits: bool = True
) -> Any:
    """An unstructured grid of a frame, with fields that nobody needs beside the fields that are read."""
    data = vtkUnstructuredGrid()
    at, real = vtkPoints(), np.float64 if rng.random() < 0.7 else np.float32
    shift = content.values(simulation.displacement[frame])
    at.SetData(numpy_to_vtk((content.points + (shift if moved else 0)).astype(np.float64), deep=True))
    data.SetPoints(at)
    nodes = [cells for _, _, cells in content.blocks]
    offsets = np.cumsum([0, *(cells.shape[1] for cells in nodes for _ in range(len(cells)))])
    links = vtkCellArray()
    links.SetData(
        numpy_to_vtkIdTypeArray(offsets.astype(np.int64), deep=True),
        numpy_to_vtkIdTypeArray(np.concatenate([c.ravel() for c in nodes]).astype(np.int64), deep=True),
    )
    types = np.concatenate([np.full(len(c), TYPES[kind], np.uint8) for _, kind, c in content.blocks])
    data.SetCells(numpy_to_vtk(types, deep=True), links)
    _add(data.GetPointData(), "U", shift.astype(real))
    _add(data.GetPointData(), "S", content.values(simulation.stress[frame]).astype(real))
    for name, marks in (("tool", simulation.tool), ("fixed", simulation.fixed)):
        values = content.values(marks)
        if bits and rng.random() < 0.2:
            array = vtkBitArray()
            array.SetName(name)
            for value in values:
                array.InsertNextValue(int(value))
            data.GetPointData().AddArray(array)
        else:
            _add(data.GetPointData(), name, values.astype(rng.choice(["u1", "i4", "i8", "f4", "f8"])))
    if rng.random() < 0.3:
        text = vtkStringArray()
        text.SetName("about")
        text.InsertNextValue("written by a program")
        data.GetFieldData().AddArray(text)
    if rng.random() < 0.3:
        empty = vtkDoubleArray()
        empty.SetName("nothing")
        data.GetFieldData().AddArray(empty)
    if rng.random() < 0.3:
        _add(data.GetCellData(), "part", np.concatenate([np.full(len(c), b) for b, _, c in content.blocks]))
    return data


def _told_of_parts(grids: list[Any]) -> tuple[str, ...]:
    """A pattern of the note on cells that lack a field that the cells of other grids have."""
    lacking = [data.GetNumberOfCells() for data in grids if not data.GetCellData().HasArray("part")]
    if len(lacking) in (0, len(grids)):
        return ()
    return (f"the field 'part' is missing in some blocks: it is NaN in {sum(lacking)} rows?",)


def add_time(data: Any, time: float) -> None:
    _add(data.GetFieldData(), "TimeValue", np.array([time]))


def _add(fields: Any, name: str, values: np.ndarray) -> None:
    array = numpy_to_vtk(np.ascontiguousarray(values), deep=True)
    array.SetName(name)
    fields.AddArray(array)


def write_xml(rng: np.random.Generator, path: Path, data: Any) -> None:
    """A file in one of the encodings of the XML formats."""
    writer = vtkXMLMultiBlockDataWriter() if data.IsA("vtkMultiBlockDataSet") else vtkXMLUnstructuredGridWriter()
    mode = rng.integers(0, 4)
    (writer.SetDataModeToAscii, writer.SetDataModeToBinary, writer.SetDataModeToAppended)[min(mode, 2)]()
    writer.SetEncodeAppendedData(int(mode == 3))
    kind = rng.integers(0, 4)
    (
        writer.SetCompressorTypeToNone,
        writer.SetCompressorTypeToZLib,
        writer.SetCompressorTypeToLZ4,
        writer.SetCompressorTypeToLZMA,
    )[kind]()
    writer.SetHeaderType(64 if rng.random() < 0.5 else 32)
    writer.SetByteOrder(int(rng.random() < 0.3))
    if rng.random() < 0.3:
        writer.SetBlockSize(int(rng.choice([64, 800, 4096])))
    writer.SetFileName(str(path))
    writer.SetInputData(data)
    assert writer.Write() == 1


def frame_names(rng: np.random.Generator, simulation: Simulation, ending: str) -> list[str]:
    """Names of the files of the frames, in order of time, which their numbers say."""
    frames = len(simulation.times)
    style = rng.integers(0, 4)
    if style == 0:
        return [f"f{number}{ending}" for number in range(frames)]
    if style == 1:
        first = int(rng.integers(0, 12))
        return [f"case_{first + number}{ending}" for number in range(frames)]
    if style == 2:
        return [f"Result-{time:.4f}".rstrip("0").rstrip(".") + ending for time in simulation.times]
    return [f"t{time:.3e}{ending}" for time in simulation.times]


def vtu_series(rng: np.random.Generator, simulation: Simulation, folder: Path) -> Case:
    """A folder of VTU files; some hold their times, and then their names may say nothing."""
    content, moved = content_of(rng, simulation), bool(rng.random() < 0.3)
    names, timed = frame_names(rng, simulation, ".vtu"), bool(rng.random() < 0.5)
    if timed and rng.random() < 0.3:
        names = [f"{name}.vtu" for name in rng.permutation(["u", "a", "zz", "k7", "b"])[: len(names)]]
    upper = rng.random() < 0.1
    (folder / "series").mkdir()
    for frame, name in enumerate(names):
        shown = content.in_order(rng) if "order" in simulation.defects and frame else content
        data = grid(rng, shown, simulation, frame, moved)
        if timed:
            add_time(data, simulation.times[frame])
        write_xml(rng, folder / "series" / (name[:-4] + ".VTU" if upper else name), data)
    return Case(folder / "series", NAMES, times=timed, told=told_of_order(names, timed))


def pvd_series(rng: np.random.Generator, simulation: Simulation, folder: Path) -> Case:
    """A PVD file, as Windows or others write it; frames in one file or in one for each body."""
    content, by_part = content_of(rng, simulation), bool(rng.random() < 0.5)
    pieces = [content.part(rows) for rows in cut_into_pieces(rng, content, True)] if by_part else [content]
    slash = "\\" if rng.random() < 0.5 else "/"
    (folder / "frames").mkdir()
    entries, first = [], []
    for frame, time in enumerate(simulation.times.tolist()):
        for part, piece in enumerate(pieces):
            name = f"f{frame}_{part}.vtu"
            data = grid(rng, piece, simulation, frame, False)
            first += [data] if frame == 0 else []
            write_xml(rng, folder / "frames" / name, data)
            entries.append(f'<DataSet timestep="{time!r}" part="{part}" file="frames{slash}{name}"/>')
    listed = "\n".join(entries[row] for row in rng.permutation(len(entries))) if not by_part else "\n".join(entries)
    ending = ".PVD" if rng.random() < 0.1 else ".pvd"
    head = '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1"><Collection>'
    text = f"{head}\n{listed}\n</Collection></VTKFile>\n"
    (folder / f"all{ending}").write_text(text.replace("\n", "\r\n" if slash == "\\" else "\n"), newline="")
    return Case(folder / f"all{ending}", NAMES, times=True, told=_told_of_parts(first))


def pieces_series(rng: np.random.Generator, simulation: Simulation, folder: Path) -> Case:
    """A folder of VTU files of several pieces each, or of PVTU files and their pieces."""
    content, by_body = content_of(rng, simulation), bool(rng.random() < 0.5)
    rows = cut_into_pieces(rng, content, by_body)
    parts = [content.part(one) for one in rows]
    if len(parts) > 1 and not by_body:
        simulation.defects.add("unstitched")
    series = folder / "series"
    series.mkdir()
    apart, empty = rng.random() < 0.5, rng.integers(0, 6)
    for frame in range(len(simulation.times)):
        grids = [grid(np.random.default_rng(7), part, simulation, frame, False) for part in parts]
        if apart:
            for number, data in enumerate(grids):
                write_xml(rng, series / f"f{frame}_{number}.vtu", data)
            _write_pvtu(series / f"f{frame}.pvtu", [f"f{frame}_{number}.vtu" for number in range(len(grids))])
        else:
            if empty < 2:  # a process that has no part of the mesh
                grids.insert(empty * len(grids), vtkUnstructuredGrid())
            _write_pieces(series / f"f{frame}.vtu", grids)
    return Case(series, NAMES)


def _write_pvtu(path: Path, files: list[str]) -> None:
    arrays = "".join(
        f'<PDataArray type="Float64" Name="{name}" NumberOfComponents="{columns}"/>'
        for name, columns in (("U", 3), ("S", 1), ("tool", 1), ("fixed", 1))
    )
    sources = "".join(f'<Piece Source="{name}"/>' for name in files)
    path.write_text(
        '<?xml version="1.0"?>\n<VTKFile type="PUnstructuredGrid" version="0.1" byte_order="LittleEndian">'
        f'<PUnstructuredGrid GhostLevel="0"><PPointData>{arrays}</PPointData><PPoints><PDataArray type="Float64"'
        f' NumberOfComponents="3"/></PPoints>{sources}</PUnstructuredGrid></VTKFile>\n'
    )


def _write_pieces(path: Path, grids: list[Any]) -> None:
    """One file of several pieces: the pieces that VTK writes for each grid alone."""
    texts = []
    for data in grids:
        writer = vtkXMLUnstructuredGridWriter()
        writer.SetDataModeToAscii()
        writer.WriteToOutputStringOn()
        writer.SetInputData(data)
        assert writer.Write() == 1
        texts.append(writer.GetOutputString())
    head, tail = texts[0].split("<Piece", 1)[0], texts[0].rsplit("</Piece>", 1)[1]
    pieces = ["<Piece" + text.split("<Piece", 1)[1].rsplit("</Piece>", 1)[0] + "</Piece>\n" for text in texts]
    path.write_text(head + "".join(pieces) + tail)


def legacy_series(rng: np.random.Generator, simulation: Simulation, folder: Path) -> Case:
    """A folder of legacy files of the versions 4.2 and 5.1, as text or binary."""
    content = content_of(rng, simulation)
    (folder / "series").mkdir()
    names = frame_names(rng, simulation, ".vtk")
    for frame, name in enumerate(names):
        writer = vtkUnstructuredGridWriter()
        writer.SetFileVersion(42 if rng.random() < 0.5 else 51)
        (writer.SetFileTypeToBinary if rng.random() < 0.5 else writer.SetFileTypeToASCII)()
        writer.SetFileName(str(folder / "series" / name))
        writer.SetInputData(grid(rng, content, simulation, frame, False))
        assert writer.Write() == 1
    return Case(folder / "series", NAMES, told=told_of_order(names, False))


class _Frames(VTKPythonAlgorithmBase):
    """A source of all frames."""

    def __init__(self, grids: list[Any], times: np.ndarray) -> None:
        super().__init__(nInputPorts=0, nOutputPorts=1, outputType="vtkUnstructuredGrid")
        self.grids, self.times = grids, times.tolist()

    def RequestInformation(self, request: Any, inputs: Any, outputs: Any) -> int:
        facts = outputs.GetInformationObject(0)
        facts.Set(Pipeline.TIME_STEPS(), self.times, len(self.times))
        facts.Set(Pipeline.TIME_RANGE(), [self.times[0], self.times[-1]], 2)
        return 1

    def RequestData(self, request: Any, inputs: Any, outputs: Any) -> int:
        facts = outputs.GetInformationObject(0)
        time = facts.Get(Pipeline.UPDATE_TIME_STEP()) if facts.Has(Pipeline.UPDATE_TIME_STEP()) else self.times[0]
        frame = int(np.argmin(np.abs(np.array(self.times) - time)))
        data = vtkUnstructuredGrid.GetData(outputs)
        data.ShallowCopy(self.grids[frame])
        data.GetInformation().Set(data.DATA_TIME_STEP(), self.times[frame])
        return 1


def all_frames(rng: np.random.Generator, simulation: Simulation, folder: Path) -> Case:
    """A file with all frames, Exodus or VTKHDF."""
    content = content_of(rng, simulation)
    grids = [
        grid(np.random.default_rng(3), content, simulation, f, False, bits=False) for f in range(len(simulation.times))
    ]
    source = _Frames(grids, simulation.times)
    exodus = rng.random() < 0.5
    writer = vtkExodusIIWriter() if exodus else vtkHDFWriter()
    writer.SetFileName(str(folder / ("all.exo" if exodus else "all.vtkhdf")))
    writer.SetInputConnection(source.GetOutputPort())
    writer.SetWriteAllTimeSteps(True)
    assert writer.Write() == 1
    return Case(folder / ("all.exo" if exodus else "all.vtkhdf"), NAMES, times=True)


def blocks_mesh(rng: np.random.Generator, simulation: Simulation, folder: Path) -> Case:
    """A file of blocks, one for each body, or a VTKHDF file of one frame."""
    content = content_of(rng, simulation)
    if rng.random() < 0.5:
        writer = vtkHDFWriter()
        writer.SetFileName(str(folder / "mesh.vtkhdf"))
        writer.SetInputData(grid(rng, content, simulation, 0, False, bits=False))
        assert writer.Write() == 1
        return Case(folder / "mesh.vtkhdf")
    blocks = vtkMultiBlockDataSet()
    grids = [grid(rng, content.part(rows), simulation, 0, False) for rows in cut_into_pieces(rng, content, True)]
    for number, data in enumerate(grids):
        blocks.SetBlock(number, data)
    write_xml(rng, folder / "mesh.vtm", blocks)
    return Case(folder / "mesh.vtm", told=_told_of_parts(grids))

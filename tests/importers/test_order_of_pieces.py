"""Pieces of a frame without names that stand in another order than before: their meshes and places tell which is which,
or the simulation is refused."""

import re

import h5py
import numpy as np
import pytest
import pyvista
from data_samples import block
from vtkmodules.util.numpy_support import numpy_to_vtkIdTypeArray
from vtkmodules.vtkCommonDataModel import vtkCompositeDataSet, vtkMultiBlockDataSet
from vtkmodules.vtkIOXML import vtkXMLMultiBlockDataWriter, vtkXMLUnstructuredGridWriter

from ast_sim.importers.series import FieldNames, read_series
from ast_sim.plausibility.motion import in_trajectory
from ast_sim.support.errors import DatasetError

CUBE = block(1, 1, 1)
PLATE = block(2, 2, 1)
NAMES = FieldNames(handle="0:zmin")
REORDERED = "stand in another order, as their meshes and places tell: they are reordered as in the first"


def cubes(frame, fall=0.1, shift=0.0):
    """[8, 3], [8, 3]: a cube that is pressed, and an equal one that comes down on it."""
    low = CUBE.rest_position * (1, 1, 1 - 0.05 * frame)
    return low + (shift * frame, 0, 0), CUBE.rest_position + (shift * frame, 0, 1.5 - fall * frame)


def grid(points, elements=CUBE.elements, ids=None):
    cells = np.column_stack([np.full(len(elements), 4), elements])
    mesh = pyvista.UnstructuredGrid(cells, np.full(len(elements), 10), np.asarray(points, float))
    if ids is not None:
        numbers = numpy_to_vtkIdTypeArray(np.asarray(ids, np.int64), deep=1)
        numbers.SetName("GlobalNodeId")
        mesh.GetPointData().SetGlobalIds(numbers)
    return mesh


def write_vtm(path, parts, names=()):
    blocks = vtkMultiBlockDataSet()
    for index, part in enumerate(parts):
        blocks.SetBlock(index, part)
    for index, name in enumerate(names):
        blocks.GetMetaData(index).Set(vtkCompositeDataSet.NAME(), name)
    writer = vtkXMLMultiBlockDataWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(blocks)
    writer.Write()


def write_vtu(path, parts):
    """The pieces of one file, as programs with several processes write them."""
    texts = []
    for part in parts:
        writer = vtkXMLUnstructuredGridWriter()
        writer.SetInputData(part)
        writer.SetDataModeToAscii()
        writer.SetWriteToOutputString(True)
        writer.Write()
        texts.append(re.fullmatch(r"(.*)(<Piece.*</Piece>)(.*)", writer.GetOutputString(), re.DOTALL))
    path.write_text(texts[0][1] + "".join(text[2] for text in texts) + texts[0][3])


def write_pvtu(path, parts, order):
    for index, part in enumerate(parts):
        part.save(path.with_name(f"{path.stem}_{index}.vtu"))
    sources = "".join(f'<Piece Source="{path.stem}_{index}.vtu"/>' for index in order)
    points = '<PPoints><PDataArray type="Float64" NumberOfComponents="3"/></PPoints>'
    path.write_text(
        '<VTKFile type="PUnstructuredGrid" version="0.1" byte_order="LittleEndian">'
        f'<PUnstructuredGrid GhostLevel="0">{points}{sources}</PUnstructuredGrid></VTKFile>'
    )


def write_pvd(path, entries):
    listed = "".join(f'<DataSet timestep="{time}" {tell} file="{file}"/>' for time, tell, file in entries)
    path.write_text(f'<VTKFile type="Collection"><Collection>{listed}</Collection></VTKFile>')


def turned(parts, frame):
    return parts[::-1] if frame == 1 else parts


def require_motion(read, of_frame, frames=3):
    assert len(read.position) == frames
    for frame in range(frames):
        np.testing.assert_allclose(read.position[frame], np.concatenate(of_frame(frame)), atol=1e-6)


@pytest.mark.parametrize("write", [write_vtm, write_vtu])
@pytest.mark.parametrize("shift", [0, 50])
def test_equal_pieces_are_where_they_were_a_frame_before(tmp_path, write, shift):
    """Also if both of them move far, side by side."""
    for frame in range(3):
        write(
            tmp_path / f"f{frame}{write.__name__.replace('write_', '.')}",
            turned(list(map(grid, cubes(frame, shift=shift))), frame),
        )
    read = read_series(tmp_path, NAMES)
    require_motion(read, lambda frame: cubes(frame, shift=shift))
    assert REORDERED in read.attributes["notes"]


@pytest.mark.parametrize("write", [write_vtm, write_vtu])
def test_pieces_of_other_meshes_are_told_by_their_meshes(tmp_path, write):
    def of_frame(frame):
        return PLATE.rest_position * (1, 1, 1 - 0.05 * frame), CUBE.rest_position + (0.5, 0.5, 1.5 - 0.1 * frame)

    for frame in range(3):
        plate, cube = of_frame(frame)
        parts = [grid(plate, PLATE.elements), grid(cube)]
        write(tmp_path / f"f{frame}{write.__name__.replace('write_', '.')}", turned(parts, frame))
    read = read_series(tmp_path, NAMES)
    require_motion(read, of_frame)
    assert REORDERED in read.attributes["notes"]


def test_points_at_rest_with_displacements_tell_the_pieces_apart(tmp_path):
    for frame in range(3):
        parts = list(map(grid, cubes(0)))
        for part, at, rest in zip(parts, cubes(frame), cubes(0), strict=True):
            part.point_data["displacement"] = at - rest
        write_vtm(tmp_path / f"f{frame}.vtm", turned(parts, frame))
    require_motion(read_series(tmp_path, NAMES), cubes)


@pytest.mark.parametrize("write", [write_vtm, write_vtu])
def test_pieces_that_share_numbered_points_may_change_places(tmp_path, write):
    """The numbers of points are not unique then: four of them stand in both pieces."""
    for frame in range(3):
        low = CUBE.rest_position * (1, 1, 1 - 0.05 * frame)
        both = np.concatenate([low, low + (0, 0, low[:, 2].max())])
        _, ids = np.unique(both.round(6), axis=0, return_inverse=True)
        ids = ids.ravel() + 1
        parts = [grid(both[:8], ids=ids[:8]), grid(both[8:], ids=ids[8:])]
        write(tmp_path / f"f{frame}{write.__name__.replace('write_', '.')}", turned(parts, frame))
    read = read_series(tmp_path, NAMES)
    assert read.scene.rest_position.shape == (12, 3)
    np.testing.assert_allclose(read.position[1], read.position[0] * (1, 1, 0.95), atol=1e-6)


def test_equal_pieces_that_jump_past_each_other_are_refused(tmp_path):
    for frame in range(3):
        write_vtm(tmp_path / f"f{frame}.vtm", list(map(grid, cubes(frame, fall=1.55))))
    with pytest.raises(
        DatasetError, match=r"f1.vtm: 2 blocks or pieces have equal meshes and no names, and they moved"
    ):
        read_series(tmp_path, NAMES)


def test_equal_pieces_that_move_far_in_one_order_keep_it(tmp_path):
    for frame in range(3):
        write_vtm(tmp_path / f"f{frame}.vtm", list(map(grid, cubes(frame, fall=0.5))))
    require_motion(read_series(tmp_path, NAMES), lambda frame: cubes(frame, fall=0.5))


def test_names_tell_pieces_apart_however_far_they_move(tmp_path):
    for frame in range(3):
        write_vtm(tmp_path / f"f{frame}.vtm", list(map(grid, cubes(frame, fall=1.55))), ("low", "high"))
    require_motion(read_series(tmp_path, NAMES), lambda frame: cubes(frame, fall=1.55))


def test_names_that_count_the_pieces_are_refused_where_places_say_otherwise(tmp_path):
    """PyVista calls the blocks of a list Block-00 and Block-01, as they stand in each list."""
    for frame in range(3):
        pyvista.MultiBlock(turned(list(map(grid, cubes(frame))), frame)).save(tmp_path / f"f{frame}.vtm")
    with pytest.raises(DatasetError, match=r"f1.vtm: the block 'Block-01' lies where 'Block-00' lay in another frame"):
        read_series(tmp_path, NAMES)


def test_names_that_count_the_pieces_are_taken_where_places_do_not_tell(tmp_path):
    for frame in range(3):
        pyvista.MultiBlock(list(map(grid, cubes(frame, fall=1.55)))).save(tmp_path / f"f{frame}.vtm")
    require_motion(read_series(tmp_path, NAMES), lambda frame: cubes(frame, fall=1.55))


def test_names_of_files_tell_the_pieces_of_a_pvtu_file_apart(tmp_path):
    for frame in range(3):
        write_pvtu(
            tmp_path / f"f{frame}.pvtu", list(map(grid, cubes(frame, fall=1.55))), (1, 0) if frame == 1 else (0, 1)
        )
    read = read_series(tmp_path, NAMES)
    require_motion(read, lambda frame: cubes(frame, fall=1.55))
    notes = read.attributes["notes"]
    assert notes.startswith(
        "the blocks of f1.pvtu stand in another order: they are reordered as in the first; no times"
    )


def test_a_pvtu_file_whose_pieces_change_places_is_refused(tmp_path):
    for frame in range(3):
        write_pvtu(tmp_path / f"f{frame}.pvtu", turned(list(map(grid, cubes(frame))), frame), (0, 1))
    with pytest.raises(DatasetError, match=r"f1.pvtu: the block '1' lies where '0' lay in another frame"):
        read_series(tmp_path, NAMES)


@pytest.mark.parametrize("form", ["body_{part}_{frame}.vtu", "part{part}/t{frame}.vtu"])
def test_files_of_a_pvd_file_that_differ_in_a_number_are_parts(tmp_path, form):
    entries = []
    for frame in range(3):
        for part in (1, 0) if frame == 1 else (0, 1):
            file = tmp_path / form.format(part=part, frame=frame)
            file.parent.mkdir(exist_ok=True)
            grid(cubes(frame, fall=1.55)[part]).save(file)
            entries.append((frame, "", form.format(part=part, frame=frame)))
    write_pvd(tmp_path / "all.pvd", entries)
    require_motion(read_series(tmp_path / "all.pvd", NAMES), lambda frame: cubes(frame, fall=1.55))


def test_files_of_a_pvd_file_with_running_numbers_are_told_by_places(tmp_path):
    entries = []
    for frame in range(3):
        for part in (1, 0) if frame == 1 else (0, 1):
            entries.append((frame, "", f"r{len(entries)}.vtu"))
            grid(cubes(frame)[part]).save(tmp_path / entries[-1][2])
    write_pvd(tmp_path / "all.pvd", entries)
    read = read_series(tmp_path / "all.pvd", NAMES)
    require_motion(read, cubes)
    assert REORDERED in read.attributes["notes"]


def test_numbers_of_parts_in_a_pvd_file_that_count_the_files_are_refused(tmp_path):
    entries = []
    for frame in range(3):
        for part, points in enumerate(turned(cubes(frame), frame)):
            entries.append((frame, f'part="{part}"', f"r{part}_{frame}.vtu"))
            grid(points).save(tmp_path / entries[-1][2])
    write_pvd(tmp_path / "all.pvd", entries)
    with pytest.raises(DatasetError, match=r"r0_1.vtu: the block '1' lies where '0' lay in another frame"):
        read_series(tmp_path / "all.pvd", NAMES)


def test_partitions_of_a_vtkhdf_file_may_change_places(tmp_path):
    cells = len(CUBE.elements)
    with h5py.File(tmp_path / "a.vtkhdf", "w") as file:
        root = file.create_group("VTKHDF")
        root.attrs["Version"] = (2, 0)
        root.attrs.create("Type", b"UnstructuredGrid", dtype="S16")
        root["Points"] = np.concatenate([points for frame in range(3) for points in turned(cubes(frame), frame)])
        for name, count in (("Points", 8), ("Cells", cells), ("ConnectivityIds", 4 * cells)):
            root[f"NumberOf{name}"] = [count] * 6
        root["Types"] = np.full(6 * cells, 10, np.uint8)
        root["Connectivity"] = np.tile(CUBE.elements.ravel(), 6).astype(np.int64)
        root["Offsets"] = np.tile(4 * np.arange(cells + 1), 6)
        steps = root.create_group("Steps")
        steps.attrs["NSteps"] = 3
        steps["Values"] = [0.0, 1, 2]
        steps["PartOffsets"] = [0, 2, 4]
        steps["NumberOfParts"] = [2, 2, 2]
        steps["PointOffsets"] = [0, 16, 32]
        steps["CellOffsets"] = [[0], [2 * cells], [4 * cells]]
        steps["ConnectivityIdOffsets"] = [[0], [8 * cells], [16 * cells]]
    read = read_series(tmp_path / "a.vtkhdf", NAMES)
    require_motion(read, cubes)
    assert REORDERED in read.attributes["notes"]


def write_grid(path, parts):
    """All bodies in one grid."""
    points = np.concatenate(parts)
    elements = np.concatenate([CUBE.elements + 8 * index for index in range(len(parts))])
    grid(points, elements).save(path)


def told_frames(folder, parts_of_frame, frames=4):
    for frame in range(frames):
        write_grid(folder / f"f{frame}.vtu", parts_of_frame(frame))
    findings = in_trajectory(read_series(folder, NAMES))
    return [one.places for one in findings if one.what == "frames in which bodies change their places"]


def test_equal_bodies_of_one_grid_that_change_places_are_told(tmp_path):
    """Nothing but their places tells: the grid has no blocks, the elements of both numberings are the same."""
    assert told_frames(tmp_path, lambda frame: turned(cubes(frame), frame)) == ["frames 1, 2"]


def test_bodies_that_move_apart_together_or_around_are_not_told(tmp_path):
    def apart(frame):
        return CUBE.rest_position - (0.3 * frame, 0, 0), CUBE.rest_position + (1.2 + 0.3 * frame, 0, 0)

    def together(frame):  # each cube where the next one was
        return [CUBE.rest_position + (1.5 * (index + frame), 0, 0) for index in range(3)]

    def around(frame):  # an eighth of a turn in each frame
        angle = np.pi / 4 * frame
        turn = np.array([(np.cos(angle), np.sin(angle), 0), (-np.sin(angle), np.cos(angle), 0), (0, 0, 1)])
        return [(CUBE.rest_position + shift) @ turn for shift in ((2, 0, 0), (-3, -1, 0))]

    for name, motion in (("apart", apart), ("together", together), ("around", around)):
        (tmp_path / name).mkdir()
        assert told_frames(tmp_path / name, motion) == [], name

"""Importing the results of other programs: PVD collections and folders of VTU files, as meshio writes them."""

import os
import random
import re
import subprocess
import sys
from dataclasses import replace

import h5py
import meshio
import numpy as np
import pytest
import pyvista
from data_samples import block, trajectory
from vtkmodules.vtkIOHDF import vtkHDFWriter

from ast_sim.dataset.reader import Dataset
from ast_sim.importers.convert import convert, find_series
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.importers.solids.positions import far_origin
from ast_sim.scene import NodeType, Scene, Trajectory
from ast_sim.support.errors import DatasetError
from ast_sim.view import export

KIND = {3: "triangle", 4: "tetra"}


def write_vtu(path, points, elements, point=None, cell=None, extra=(), **options):
    """One frame; `extra` are further blocks of cells."""
    cells = [(KIND[elements.shape[1]], elements), *extra]
    cell_data = {name: [values, *(np.zeros(len(c)) for _, c in extra)] for name, values in (cell or {}).items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    meshio.write(path, meshio.Mesh(points, cells, point or {}, cell_data), file_format="vtu", **options)


def write_pvd(path, files: list[str], times=None):
    times = range(len(files)) if times is None else times
    entries = "".join(f'<DataSet timestep="{t}" part="0" file="{f}"/>' for t, f in zip(times, files, strict=True))
    path.write_text(f'<?xml version="1.0"?><VTKFile type="Collection"><Collection>{entries}</Collection></VTKFile>')
    return path


def write_series(folder, given: Trajectory, moving: bool, displacement="displacement", **fields):
    """Frames frame_0.vtu, frame_1.vtu, ... of a trajectory: points that move, or rest points with a displacement."""
    rest = given.scene.rest_position
    for frame, position in enumerate(given.position):
        point = {} if moving else {displacement: position - rest}
        cell = {}
        for name, value in fields.items():
            value = value[frame] if value.ndim == 2 else value
            (point if len(value) == len(rest) else cell)[name] = value
        write_vtu(folder / f"frame_{frame}.vtu", position if moving else rest, given.scene.elements, point, cell)
    return folder


def starting_at_rest(scene: Scene, frames: int) -> Trajectory:
    moving = trajectory(scene, frames)
    return Trajectory(scene, np.concatenate([scene.rest_position[None], moving.position[1:]]))


def read(source, **names) -> Trajectory:
    return read_series(source, FieldNames(**names))


@pytest.mark.parametrize("moving", [True, False])
def test_points_that_move_and_displacements_give_the_same(tmp_path, moving):
    given = starting_at_rest(block(2, 1, 1), 12)  # frame_10 and frame_11 come after frame_9
    found = read(write_series(tmp_path / "run", given, moving))
    assert np.array_equal(found.scene.elements, given.scene.elements)
    np.testing.assert_allclose(found.scene.rest_position, given.scene.rest_position, rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.position, given.position, rtol=0, atol=3e-7)
    assert found.stress is None and (found.scene.node_type == NodeType.NORMAL).all() and found.scene.material is None
    told = "no times tell the 12 frames apart: they count 0, 1, 2, ..."
    assert (found.scene.body == 0).all()
    assert found.attributes == {"status": "complete", "source": "run", "notes": told}


@pytest.mark.parametrize("stress", ["node", "element"])
def test_what_we_export_is_read_back(tmp_path, stress):
    """The export writes the moved points beside the displacement, node types, bodies and von Mises stress."""
    given = trajectory(block(2, 2, 1), 5, stress=stress)
    export.write(tmp_path / "run.pvd", given)
    found = read_series(tmp_path / "run.pvd", FieldNames())
    assert found.stress_location == stress
    np.testing.assert_allclose(found.position, given.position, rtol=0, atol=3e-7)
    np.testing.assert_allclose(found.scene.rest_position, given.scene.rest_position, rtol=0, atol=3e-7)
    for name in ("elements", "node_type", "body"):
        assert np.array_equal(getattr(found.scene, name), getattr(given.scene, name))
    assert np.array_equal(found.stress, given.stress)


def test_fields_by_other_names(tmp_path):
    scene = block(1, 1, 1)
    given = starting_at_rest(scene, 3)
    generator = np.random.default_rng(0)
    mises, modulus = generator.random((3, 6)), generator.random(6)
    is_tool, held = np.array([0, 0, 0, 0, 0, 0, 1, 0.5]), np.array([1, 1, 0, 0, 0, 0, 1, 0])
    fields = {"S_Mises": mises, "E": modulus, "nu": 2 * modulus, "tool": is_tool, "held": held}
    write_series(tmp_path / "run", given, False, displacement="U", **fields)
    found = read_series(
        tmp_path / "run",
        FieldNames(displacement="U", stress="S_Mises", obstacle="tool", handle="held", material=("poisson=nu", "E")),
    )
    assert found.attributes["material"] == "poisson, E"
    assert found.stress_location == "element"
    assert np.array_equal(found.stress, mises.astype(np.float32)[:, :, None])
    assert np.array_equal(found.scene.material, np.stack([2 * modulus, modulus], 1).astype(np.float32))
    assert found.scene.node_type.tolist() == [3, 3, 0, 0, 0, 0, 1, 1]  # a held node of the tool belongs to the tool
    np.testing.assert_allclose(found.position, given.position, rtol=0, atol=3e-7)


def test_a_collection_orders_by_time_and_finds_files_in_folders(tmp_path):
    given = starting_at_rest(block(1, 1, 1), 3)
    write_series(tmp_path / "parts", given, True)
    path = write_pvd(tmp_path / "run.pvd", [f"parts/frame_{i}.vtu" for i in (2, 0, 1)], times=[10.0, -1.0, 9.5])
    assert np.array_equal(read(path).position, given.position)


@pytest.mark.parametrize(
    ("names", "note"),
    [
        ("f0 f1 f2 f3 f4", None),
        ("f10 f20 f30 f40 f50", None),
        ("f0 f1 f3 f4 f5", "f3.vtu follows f1.vtu: is a frame missing between them?"),
        ("f0 f10 f30 f40 f50", "f30.vtu follows f10.vtu: is a frame missing between them?"),
        (
            "press1_0 press1_1 press2_0 press2_1 press2_2",
            "the frames stand in the order of 2 numbers in their names: press1_0.vtu, press1_1.vtu, press2_0.vtu, ...;"
            " if these are several simulations, give each a folder of its own",
        ),
    ],
)
def test_names_that_may_mean_something_else_are_told(tmp_path, names, note):
    given = starting_at_rest(block(1, 1, 1), 5)
    write_series(tmp_path / "run", given, True)
    for frame, name in enumerate(names.split()):
        (tmp_path / "run" / f"frame_{frame}.vtu").rename(tmp_path / "run" / f"{name}.vtu")
    found = read(tmp_path / "run")
    told = "no times tell the 5 frames apart: they count 0, 1, 2, ..."
    assert np.array_equal(found.position, given.position)
    assert found.attributes["notes"] == (f"{note}; {told}" if note else told)


def test_with_inertia_all_time_steps_are_equal(tmp_path):
    given = starting_at_rest(block(1, 1, 1), 4)
    write_series(tmp_path / "frames", given, True, node_type=given.scene.node_type)
    files = [f"frames/frame_{frame}.vtu" for frame in range(4)]
    options = {"splits": {"train": 1}, "integration": "dynamic", "time_step": 0.1}
    path = write_pvd(tmp_path / "run.pvd", files, [0, 0.1, 0.2005, 0.3])  # as an explicit solver writes them
    assert convert(path, tmp_path / "a.h5", **options)["train"] == 1
    write_pvd(path, files, [0, 0.1, 0.2, 0.4])
    with pytest.raises(DatasetError, match="from frame 2 to 3 0.2 s pass, from most frames to the next 0.1 s"):
        convert(path, tmp_path / "b.h5", **options)
    assert convert(path, tmp_path / "b.h5", splits={"train": 1})["train"] == 1  # without inertia any times will do


@pytest.mark.parametrize("options", [{"binary": False}, {"compression": None}, {"compression": "lzma"}, {}])
def test_every_encoding_of_vtu(tmp_path, options):
    given = starting_at_rest(block(1, 1, 1), 1)
    write_vtu(tmp_path / "one.vtu", given.position[0], given.scene.elements, **options)
    np.testing.assert_allclose(read(tmp_path / "one.vtu").position, given.position, rtol=0, atol=1e-7)


def test_unused_points_and_lower_cells_are_left_out_and_bodies_are_found(tmp_path):
    one = block(1, 1, 1)
    n = one.num_nodes
    points = np.concatenate([[[9, 9, 9]], one.rest_position, [[8, 8, 8]], one.rest_position + 5]).astype(np.float32)
    elements = np.concatenate([one.elements + 1, one.elements + n + 2])
    extra = [("triangle", np.array([[1, 2, 3]])), ("line", np.array([[0, 1]])), ("vertex", np.array([[0]]))]
    mark, mises = np.arange(len(points)) % 2, np.arange(12.0)
    write_vtu(tmp_path / "a.vtu", points, elements, {"mark": mark}, {"von_mises": mises}, extra)
    found = read(tmp_path / "a.vtu", obstacle="mark")
    assert found.scene.num_nodes == 2 * n and found.scene.body.tolist() == [0] * n + [1] * n
    assert np.array_equal(found.position[0], np.delete(points, [0, n + 1], axis=0))
    assert np.array_equal(found.position[0][found.scene.elements], points[elements])
    assert found.scene.node_type.tolist() == np.delete(mark, [0, n + 1]).tolist()
    assert found.stress[0, :, 0].tolist() == mises.tolist()


def test_plane_triangles_with_two_components(tmp_path):
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    elements = np.array([[0, 1, 2]])
    for frame in range(2):
        write_vtu(tmp_path / "run" / f"{frame}.vtu", points, elements, {"displacement": frame * np.full((3, 2), 0.5)})
    found = read(tmp_path / "run")
    assert found.scene.elements.tolist() == [[0, 1, 2]]
    assert np.array_equal(found.position[1] - found.position[0], np.tile(np.float32([0.5, 0.5, 0]), (3, 1)))


def many(folder, count=10):
    given = [starting_at_rest(block(1, 1, 1), 2 + index % 3) for index in range(count)]
    for index, one in enumerate(given):
        write_series(folder / f"run_{index}", one, True, node_type=one.scene.node_type)
    return given


def test_many_simulations_become_a_dataset(tmp_path):
    given = many(tmp_path / "results")
    told = []
    counts = convert(
        tmp_path / "results",
        tmp_path / "d.h5",
        integration="dynamic",
        contact_radius=0.02,
        time_step=0.25,
        length_unit="mm",
        progress=lambda done, total, line: told.append(line),
    )
    assert counts == counted(8, 1, 1) and len(told) == 10
    with Dataset(tmp_path / "d.h5") as dataset:
        info = dataset.info
        assert (info.family, info.integration, info.stress_location) == ("results", "dynamic", "none")
        assert (info.contact_radius, info.time_step, info.length_unit) == (0.02, 0.25, "mm")
        sources, points = [], []
        for split, count in counts.items():
            for index in range(count):
                found = dataset.load(split, index)
                number = int(found.attributes["source"].removeprefix("run_"))
                assert np.array_equal(found.position, given[number].position)
                sources.append(number)
                points.append(found.position.reshape(-1, 3))
        assert sorted(sources) == list(range(10))
        points = np.concatenate(points)
        # The cube: the middle of all positions, 0.6 of the largest extent each way.
        assert info.domain_center == pytest.approx((points.min(0) + points.max(0)) / 2, abs=1e-6)
        assert info.domain_half_width == pytest.approx(0.6 * np.ptp(points, axis=0).max(), rel=1e-6)


def counted(train=0, valid=0, test=0, calibration=0) -> dict[str, int]:
    return {"train": train, "valid": valid, "test": test, "calibration": calibration}


def sources_of(path) -> dict[str, list[str]]:
    with Dataset(path) as dataset:
        return {
            split: [dataset.attributes(split, index)["source"] for index in range(count)]
            for split, count in dataset.splits.items()
        }


def test_splits_by_list_and_by_share(tmp_path):
    many(tmp_path / "r", 5)
    lists = {"test": ["run_4"], "train": ["run_3", "run_0"]}
    assert convert(tmp_path / "r", tmp_path / "d.h5", splits=lists) == counted(2, 0, 1)
    assert sources_of(tmp_path / "d.h5") == {
        "train": ["run_3", "run_0"],
        "valid": [],
        "test": ["run_4"],
        "calibration": [],
    }
    shares = {"train": 0.4, "test": 0.6}
    assert convert(tmp_path / "r", tmp_path / "d.h5", splits=shares) == counted(2, 0, 3)
    first = sources_of(tmp_path / "d.h5")
    convert(tmp_path / "r", tmp_path / "d.h5", splits=shares)
    assert sources_of(tmp_path / "d.h5") == first
    drawn = {tuple(first["train"])}
    for seed in range(1, 6):
        convert(tmp_path / "r", tmp_path / "d.h5", splits=shares, seed=seed)
        drawn.add(tuple(sources_of(tmp_path / "d.h5")["train"]))
    assert len(drawn) > 2
    assert convert(tmp_path / "r" / "run_0", tmp_path / "d.h5", splits={"test": 1}) == counted(0, 0, 1)


def test_simulations_for_calibration_take_no_part_in_the_other_splits(tmp_path):
    many(tmp_path / "r", 9)
    convert(tmp_path / "r", tmp_path / "without.h5")
    found = convert(tmp_path / "r", tmp_path / "d.h5", calibration=3)
    assert found == counted(4, 1, 1, 3)
    sources = sources_of(tmp_path / "d.h5")
    assert sorted(sum(sources.values(), [])) == [f"run_{number}" for number in range(9)]
    assert sources["test"] == sources_of(tmp_path / "without.h5")["test"]  # the same draw
    with Dataset(tmp_path / "d.h5") as dataset:
        assert [one.attributes["source"] for one in dataset.calibration] == sources["calibration"]
    lists = {"train": ["run_1"], "calibration": ["run_8", "run_2"]}
    assert convert(tmp_path / "r", tmp_path / "d.h5", splits=lists) == counted(1, 0, 0, 2)
    assert sources_of(tmp_path / "d.h5")["calibration"] == ["run_8", "run_2"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"calibration": 5, "splits": {"train": 1}},
            "calibration is 5; must be at least 0 and leave a simulation of 5",
        ),
        ({"calibration": -1, "splits": {"train": 1}}, "calibration is -1; must be at least 0"),
        ({"calibration": 3}, "need three simulations beside 3 for calibration, found: 5"),
        ({"splits": {"train": 0.5, "calibration": 0.5}}, "calibration is a number of simulations, no share"),
        ({"calibration": 1, "splits": {"train": ["run_0"]}}, "leave calibration out"),
    ],
)
def test_a_calibration_that_cannot_be_drawn_is_refused(tmp_path, options, message):
    many(tmp_path / "r", 5)
    with pytest.raises(DatasetError, match=message):
        convert(tmp_path / "r", tmp_path / "d.h5", **options)
    assert not (tmp_path / "d.h5").exists()


@pytest.mark.parametrize(
    ("count", "shares", "expected"),
    [
        (3, None, (1, 1, 1)),
        (4, None, (2, 1, 1)),
        (9, None, (7, 1, 1)),
        (20, None, (16, 2, 2)),
        (2, {"train": 0.9, "test": 0.1}, (1, 0, 1)),
        (3, {"train": 0.02, "valid": 0.49, "test": 0.49}, (1, 1, 1)),
        (1, {"train": 1}, (1, 0, 0)),
    ],
)
def test_every_split_gets_a_simulation_if_there_are_enough(tmp_path, count, shares, expected):
    many(tmp_path / "r", count)
    found = convert(tmp_path / "r", tmp_path / "d.h5", splits=shares)
    assert found == counted(*expected)


@pytest.mark.parametrize("count", [1, 2])
def test_fewer_than_three_simulations_need_shares(tmp_path, count):
    many(tmp_path / "r", count)
    with pytest.raises(DatasetError, match=f"need three simulations, found: {count}; say where they go"):
        convert(tmp_path / "r", tmp_path / "d.h5")
    assert not (tmp_path / "d.h5").exists()


@pytest.mark.parametrize(
    ("splits", "message"),
    [
        ({"train": ["run_0", "run1"]}, "there is no simulation 'run1' for train; did you mean 'run_1'"),
        ({"train": ["run_0"], "test": ["run_0"]}, "'run_0' is listed for train and again for test"),
        ({"training": ["run_0"]}, "there is no split 'training'"),
        ({"train": []}, "no simulation is listed for any split"),
        ({"train": 0.8, "test": 0.1}, "add up to 1"),
        ({"train": 1.5, "test": -0.5}, "at least 0"),
    ],
)
def test_wrong_splits_are_named(tmp_path, splits, message):
    many(tmp_path / "r", 2)
    with pytest.raises(DatasetError, match=message):
        convert(tmp_path / "r", tmp_path / "d.h5", splits=splits)
    assert not (tmp_path / "d.h5").exists()


def test_where_simulations_are_found(tmp_path):
    one = starting_at_rest(block(1, 1, 1), 1)
    for folder in ("b/run_10", "b/run_9", "a"):
        write_series(tmp_path / folder, one, True)
    (tmp_path / "c" / ".hidden").mkdir(parents=True)
    write_pvd(tmp_path / "c" / "x.pvd", ["x/f.vtu"])
    write_series(tmp_path / "c" / "x", one, True)  # belongs to x.pvd
    assert list(find_series(tmp_path)) == ["a", "b/run_9", "b/run_10", "c/x"]
    assert list(find_series(tmp_path / "a")) == ["a"] and list(find_series(tmp_path / "c" / "x.pvd")) == ["x"]


ONE = block(1, 1, 1)


def frame(**changes):
    """write_vtu of the unit cube with changes."""
    values = {"points": ONE.rest_position, "elements": ONE.elements, **changes}
    return lambda path: write_vtu(path, **values)


WRONG = {
    "damaged": (
        lambda path: path.write_bytes(b"<VTKFile type='UnstructuredGrid'"),
        {},
        "1.vtu: cannot be read as a mesh",
    ),
    "empty": (lambda path: path.write_bytes(b""), {}, "1.vtu: cannot be read as a mesh"),
    "another format": (lambda path: path.write_text("<a/>"), {}, "1.vtu: cannot be read as a mesh: [A-Za-z]+"),
    "fewer points": (
        frame(points=ONE.rest_position[:7]),
        {},
        "1.vtu: tetra [0-9] refers to node 7, but the nodes are 0 to 6",
    ),
    "another mesh": (frame(elements=ONE.elements[:5]), {}, "1.vtu: its elements differ from 0.vtu"),
    "more points": (frame(points=np.ones((9, 3), np.float32)), {}, "1.vtu: has 9 points, 0.vtu 8"),
    "no stress": (frame(), {"stress": "s"}, "1.vtu: there is no point field 's'; there are: none"),
    "no displacement": (frame(point={"s": np.ones(8)}), {}, "frame 1 has no displacement, others have"),
    "not finite": (
        frame(point={"displacement": np.full((8, 3), np.nan)}),
        {},
        "the displacement of frame 1 is no number at 8 nodes: was the run stopped",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_frame_is_named(tmp_path, case, capfd):
    make, names, message = WRONG[case]
    folder = tmp_path / "run"
    write_vtu(folder / "0.vtu", ONE.rest_position, ONE.elements, {"displacement": np.zeros((8, 3)), "s": np.ones(8)})
    make(folder / "1.vtu")
    with pytest.raises(DatasetError, match=message) as error:
        convert(folder, tmp_path / "d.h5", names=FieldNames(**names), splits={"train": 1})
    assert "\n" not in str(error.value) and os.listdir(tmp_path) == ["run"]
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("make", "names", "message"),
    [
        (frame(), {"displacement": "U"}, "there is no point field 'U'; there are: none"),
        (frame(point={"a": np.ones(8)}), {"stress": "S"}, "there is no field 'S'; there are: a"),
        (frame(point={"S": np.ones((8, 5))}), {"stress": "S"}, "field 'S' has 5 components; must have one"),
        (frame(point={"U": np.ones((8, 1))}), {"displacement": "U"}, "displacement has 1 component; must have 2 or 3"),
        (frame(point={"node_type": np.full(8, 2)}), {}, "node 0 has the type 2"),
        (frame(point={"node_type": np.full(8, 300)}), {}, "node_type at node 0 is 300; must be a whole number"),
        (frame(point={"b": np.full(8, 0.5)}), {"body": "b"}, "b at node 0 is 0.5; must be a whole number"),
        (frame(), {"material": ("E",)}, "there is no cell field 'E'"),
        (
            lambda path: meshio.write(path, meshio.Mesh(np.eye(3), [("line", [[0, 1]])])),
            {},
            "holds line; the elements must be tetrahedra, hexahedra, prisms or pyramids, or triangles and",
        ),
        (frame(elements=np.array([[0, 1, 1, 2]])), {}, "element 0 refers to a node twice"),
    ],
)
def test_what_a_frame_lacks_is_named(tmp_path, make, names, message):
    make(tmp_path / "a.vtu")
    with pytest.raises(DatasetError, match=f"{tmp_path}/a.vtu: .*{message}"):
        read(tmp_path / "a.vtu", **names)


@pytest.mark.parametrize("options", [{"binary": False}, {"compression": None}, {}])
def test_a_damaged_frame_is_an_error_or_other_numbers_but_nothing_else(tmp_path, options, capfd):
    """VTU has no checksums: a flipped bit may change a number, but never raises anything but a DatasetError."""
    path = tmp_path / "a.vtu"
    frame(point={"von_mises": np.arange(8.0)}, **options)(path)
    capfd.readouterr()  # what meshio prints of writing text
    data, refused = path.read_bytes(), 0
    generator = random.Random(0)
    for attempt in range(60):
        changed = bytearray(data[: generator.randrange(len(data))] if attempt % 3 == 0 else data)
        if attempt % 3:
            changed[generator.randrange(len(data))] ^= 1 << generator.randrange(8)
        path.write_bytes(changed)
        try:
            read(path).check()
        except DatasetError as error:
            assert str(path) in str(error) and "\n" not in str(error)
            refused += 1
    assert refused > 20
    assert capfd.readouterr() == ("", "")


def test_a_displacement_that_does_not_fit_is_named(tmp_path):
    given = starting_at_rest(block(1, 1, 1), 3)
    folder = write_series(tmp_path / "run", given, True)
    for index in range(3):
        mesh = meshio.read(folder / f"frame_{index}.vtu")
        mesh.point_data["displacement"] = index * np.ones((8, 3))
        meshio.write(folder / f"frame_{index}.vtu", mesh)
    with pytest.raises(DatasetError, match="the displacement does not fit the points"):
        read(folder)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "is damaged or no PVD file"),
        ("<VTKFile><Collection></Collection></VTKFile>", "lists no frames"),
        ('<VTKFile><Collection><DataSet timestep="x" file="a.vtu"/></Collection></VTKFile>', "is damaged"),
        ('<VTKFile><Collection><DataSet timestep="1"/></Collection></VTKFile>', "is damaged"),
        (
            '<VTKFile><Collection><DataSet timestep="1" part="0" file="a.vtu"/>'
            '<DataSet timestep="1" part="1" file="b.vtu"/></Collection></VTKFile>',
            "a.vtu, which does not exist",
        ),
        ('<VTKFile><Collection><DataSet timestep="1" file="a.stl"/></Collection></VTKFile>', "a.stl, which is no .vtu"),
        (
            '<VTKFile><Collection><DataSet timestep="1" file="a.vtu"/></Collection></VTKFile>',
            "a.vtu, which does not exist",
        ),
    ],
)
def test_a_wrong_collection_is_named(tmp_path, content, message):
    path = tmp_path / "run.pvd"
    path.write_text(content)
    with pytest.raises(DatasetError, match=f"{path}: .*{message}"):
        convert(path, tmp_path / "d.h5", splits={"train": 1})


def test_a_source_that_is_none_is_named(tmp_path):
    (tmp_path / "empty" / "deeper").mkdir(parents=True)
    (tmp_path / "x.stl").write_text("")
    for name, message in [
        ("empty", "neither the folder nor a folder in it holds files of results: .pvd, .vtkhdf"),
        ("absent", "there is no such file or folder"),
        ("x.stl", "must be a .pvd or .series file, a folder of files of frames .*, or one file with all frames"),
    ]:
        with pytest.raises(DatasetError, match=f"{tmp_path / name}: .*{message}"):
            convert(tmp_path / name, tmp_path / "d.h5", splits={"train": 1})


def test_simulations_that_do_not_fit_each_other_are_named(tmp_path):
    write_series(tmp_path / "r" / "a", starting_at_rest(block(1, 1, 1), 2), True, von_mises=np.ones((2, 8)))
    write_series(tmp_path / "r" / "b", starting_at_rest(block(1, 1, 1), 2), True)
    with pytest.raises(DatasetError, match="r/b: the place of its stress is 'none', in the simulations before 'node'"):
        convert(tmp_path / "r", tmp_path / "d.h5", splits={"train": ["a", "b"]}, incomplete=True)
    assert os.listdir(tmp_path) == ["r"]


def unnamed_fields(folder, tool_moves=False, **fields):
    """Three simulations with the fields of a program that uses other names; the points are at rest in all frames."""
    scene = block(3, 1, 1)
    held, tool = scene.rest_position[:, 0] == 0, scene.rest_position[:, 0] == 3
    marks = {"tool": tool.astype(int), "fixed": held.astype(int)}
    for index in range(3):
        given = starting_at_rest(scene, 4)
        if tool_moves:
            moved = np.where(tool[:, None], given.position, scene.rest_position)
            given = Trajectory(scene, moved.astype(np.float32))
        mises = np.random.default_rng(index).random((4, scene.num_elements))
        chosen = {**marks} if tool_moves else {**marks, "S_Mises": mises, **fields}
        write_series(folder / f"run_{index}", given, tool_moves, displacement="U", **chosen)
    return folder


def test_fields_that_were_not_used_are_named_with_their_options(tmp_path):
    source = unnamed_fields(tmp_path / "r", thickness=np.full(16, 0.5), temperature=np.full(16, 300.0))
    with pytest.raises(DatasetError) as error:
        convert(source, tmp_path / "d.h5")
    assert re.search(
        r"r/run_\d: nothing moves and nothing is prescribed; these fields were not used: U", str(error.value)
    )
    options = "--displacement U --stress S_Mises --obstacle tool --handle fixed"
    arguments = "displacement='U', stress='S_Mises', obstacle='tool', handle='fixed'"
    assert f"; try {options}, in Python names=FieldNames({arguments}); " in str(error.value)
    assert "temperature (--stress|--body)" in str(error.value)
    assert not (tmp_path / "d.h5").exists()
    names = FieldNames(displacement="U", stress="S_Mises", obstacle="tool", handle="fixed")
    assert convert(source, tmp_path / "d.h5", names=names) == counted(1, 1, 1)
    with Dataset(tmp_path / "d.h5") as dataset:
        found = dataset.load("test", 0)
        assert np.bincount(found.scene.node_type, minlength=4).tolist() == [8, 4, 0, 4]
        assert np.ptp(found.position, axis=0).min() > 0 and dataset.info.stress_location == "element"
    with pytest.raises(DatasetError, match="run_.: nothing is prescribed; these fields were not used: tool"):
        convert(source, tmp_path / "e.h5", names=FieldNames(displacement="U", stress="S_Mises"))
    assert convert(source, tmp_path / "e.h5", incomplete=True) == counted(1, 1, 1)


def test_of_several_fields_for_an_option_the_likeliest_one_is_proposed(tmp_path):
    scene = block(3, 1, 1)
    count = scene.num_nodes
    fields = {"FORC": np.ones((count, 3)), "DISP": np.ones((count, 3)), "STRAIN": np.ones((count, 6))}
    fields |= {"STRESS_PS1": np.full(count, 0.5), "STRESS": np.ones((count, 6)), "STRESS_Mises": np.full(count, 0.5)}
    for index in range(2):
        write_vtu(tmp_path / f"r/{index}.vtu", scene.rest_position, scene.elements, fields)
    with pytest.raises(DatasetError) as error:
        convert(tmp_path / "r", tmp_path / "d.h5", splits={"train": ["r"]})
    assert "; try --displacement DISP --stress STRESS_Mises, in Python names=FieldNames(" in str(error.value)
    for told in ("FORC (--displacement)", "STRESS (--stress)", "STRAIN (no option: several components)"):
        assert told in str(error.value)


def test_the_motion_of_the_tool_alone_is_nothing_to_learn_from(tmp_path):
    source = unnamed_fields(tmp_path / "r", tool_moves=True)
    names = FieldNames(obstacle="tool", handle="fixed")
    message = "no free node moves and there is no stress, so there is nothing to learn from; .* `ast-sim predict RUN"
    with pytest.raises(DatasetError, match=message):
        convert(source, tmp_path / "d.h5", names=names)
    assert convert(source, tmp_path / "d.h5", names=names, incomplete=True)["train"] == 1


def far_series(folder, place, size=1.0, motion=1e-3):
    """Displacements at a far place: each node moves by up to `motion`."""
    scene = block(2, 1, 1)
    rest = scene.rest_position.astype(np.float64) * size + place
    steps = motion * np.random.default_rng(0).random((3, scene.num_nodes, 3)) * np.arange(3)[:, None, None]
    for frame, step in enumerate(steps):
        types = scene.node_type
        write_vtu(folder / f"{frame}.vtu", rest, scene.elements, {"displacement": step, "node_type": types})
    return rest, steps


def test_motion_far_from_the_origin_is_kept(tmp_path):
    rest, steps = far_series(tmp_path / "r", np.array([5e6, -3e6, 0.25]))
    convert(tmp_path / "r", tmp_path / "d.h5", splits={"train": 1})
    with Dataset(tmp_path / "d.h5") as dataset:
        found, origin = dataset.load("train", 0), np.array(dataset.info.generator["origin"])
        assert origin.tolist() == [5e6, -3e6, 0] and found.attributes["origin"] == origin.tolist()
        assert np.abs(dataset.info.domain_center).max() < 2
    moved = found.position.astype(np.float64) - found.scene.rest_position
    np.testing.assert_allclose(moved, steps, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.position + origin, rest + steps, rtol=0, atol=1e-6)


def test_all_simulations_of_a_dataset_have_one_origin(tmp_path):
    first, _ = far_series(tmp_path / "r" / "a", np.array([5e6, 0, 0]))
    second, _ = far_series(tmp_path / "r" / "b", np.array([5e6 + 300, 0, 0]))
    convert(tmp_path / "r", tmp_path / "d.h5", splits={"train": ["a", "b"]})
    with Dataset(tmp_path / "d.h5") as dataset:
        places = [dataset.load("train", i).scene.rest_position for i in (0, 1)]
    assert np.array_equal(places[1] - places[0], np.tile(np.float32([300, 0, 0]), (len(first), 1)))


def test_a_mesh_near_zero_stays_where_it_is():
    for place in (0, 4, -4):
        assert not far_origin(block(2, 1, 1).rest_position + place).any()
    assert not far_origin(np.zeros((3, 3))).any()


def test_motion_that_is_lost_nevertheless_is_told(tmp_path):
    far_series(tmp_path / "r", np.zeros(3), motion=3e-7)
    with pytest.warns(UserWarning, match="the largest displacement is .*e-07, and rounding to float32 changes"):
        read(tmp_path / "r")


@pytest.mark.parametrize("suffix", [".vtkhdf", ".pvd"])
@pytest.mark.parametrize("stress", ["none", "node", "element"])
def test_our_own_files_are_read_back(tmp_path, stress, suffix):
    """With what an answer knows of itself, too: its notes and its bands."""
    own = {"notes": "the scene has 18 nodes", "displacement_band": [0.0, 1.0, 2.0, 3.0, 4.0]}
    given = replace(trajectory(block(2, 2, 1), 5, stress=stress), attributes=own)
    (tmp_path / "r").mkdir()
    export.write(tmp_path / "r" / f"run{suffix}", given)
    found = read(tmp_path / "r" / f"run{suffix}")
    assert found.stress_location == stress
    np.testing.assert_allclose(found.position, given.position, rtol=0, atol=3e-7)
    np.testing.assert_allclose(found.scene.rest_position, given.scene.rest_position, rtol=0, atol=3e-7)
    for name in ("elements", "node_type", "body"):
        assert np.array_equal(getattr(found.scene, name), getattr(given.scene, name))
    assert (found.stress is None) == (stress == "none")
    assert found.stress is None or np.array_equal(found.stress, given.stress)
    assert list(find_series(tmp_path / "r")) == ["run"]
    assert convert(tmp_path / "r", tmp_path / "d.h5", splits={"test": 1})["test"] == 1


def test_a_vtkhdf_file_that_vtk_wrote(tmp_path):
    """One step, without the group Steps; VTK stores triangles before tetrahedra or after as the mesh has them."""
    scene = block(2, 1, 1)
    cells = np.hstack([np.full((scene.num_elements, 1), 4), scene.elements]).ravel()
    grid = pyvista.UnstructuredGrid(cells, np.full(scene.num_elements, 10, np.uint8), scene.rest_position)
    grid.cell_data["von_mises"] = np.arange(scene.num_elements, dtype=float)
    writer = vtkHDFWriter()
    writer.SetInputData(grid)
    writer.SetFileName(str(tmp_path / "a.vtkhdf"))
    writer.Write()
    found = read(tmp_path / "a.vtkhdf")
    assert np.array_equal(found.scene.elements, scene.elements)
    assert np.array_equal(found.position[0], scene.rest_position)
    assert found.stress[0, :, 0].tolist() == list(range(scene.num_elements))


def test_a_damaged_vtkhdf_file_is_named(tmp_path):
    path = tmp_path / "run.vtkhdf"
    export.write(path, trajectory(block(1, 1, 1), 3))
    with h5py.File(path, "a") as file:
        steps = file["VTKHDF/Steps"]
        steps["PointOffsets"][2] = 17
    with pytest.raises(DatasetError, match=f"{path}: cannot be read as a mesh: Error H5Dread start: 17"):
        read(path)
    with h5py.File(path, "a") as file:
        file["VTKHDF/Steps/PointOffsets"][2] = 16
        file["VTKHDF/Steps/NumberOfParts"][0] = 2
    with pytest.raises(DatasetError, match=f"{path}: cannot be read as a mesh|has 16 points"):
        read(path)
    with h5py.File(path, "a") as file:
        file["VTKHDF/Steps/NumberOfParts"][0] = 1
        del file["VTKHDF/Points"]
        file["VTKHDF"].create_dataset("Points", (1 << 36, 3), np.float32, chunks=(1 << 16, 3))
    with pytest.raises(DatasetError, match="/VTKHDF/Points declares 824633720832 bytes, but the file does not hold"):
        read(path)
    for content in (b"", b"text", path.read_bytes()[:2000]):
        path.write_bytes(content)
        with pytest.raises(DatasetError, match=f"{path}: is damaged or no HDF5 file of a mesh"):
            read(path)


def test_importing_needs_no_torch():
    program = (
        "import ast_sim.importers.convert, sys; sys.exit(bool({'torch', 'meshio', 'vtkmodules'} & sys.modules.keys()))"
    )
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0

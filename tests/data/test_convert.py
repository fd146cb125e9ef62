"""Importing the results of other programs: PVD collections and folders of VTU files, as meshio writes them."""

import os
import random
import subprocess
import sys

import meshio
import numpy as np
import pytest
from data_samples import block, trajectory

from ast_sim.data.convert import convert, find_series
from ast_sim.data.file import Dataset
from ast_sim.data.scene import NodeType, Scene, Trajectory
from ast_sim.data.series import FieldNames, read_series
from ast_sim.errors import DatasetError
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
    return read_series(source, FieldNames(**names))[0]


@pytest.mark.parametrize("moving", [True, False])
def test_points_that_move_and_displacements_give_the_same(tmp_path, moving):
    given = starting_at_rest(block(2, 1, 1), 12)  # frame_10 and frame_11 come after frame_9
    found = read(write_series(tmp_path / "run", given, moving))
    assert np.array_equal(found.scene.elements, given.scene.elements)
    np.testing.assert_allclose(found.scene.rest_position, given.scene.rest_position, rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.position, given.position, rtol=0, atol=3e-7)
    assert found.stress is None and (found.scene.node_type == NodeType.NORMAL).all() and found.scene.material is None
    assert (found.scene.body == 0).all() and found.attributes == {"status": "complete", "source": "run"}


@pytest.mark.parametrize("stress", ["node", "element"])
def test_what_we_export_is_read_back(tmp_path, stress):
    """The export writes the moved points beside the displacement, node types, bodies and von Mises stress."""
    given = trajectory(block(2, 2, 1), 5, stress=stress)
    export.write(tmp_path / "run.pvd", given, time_step=0.1)
    found, place = read_series(tmp_path / "run.pvd", FieldNames())
    assert place == stress
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
    found, place = read_series(
        tmp_path / "run",
        FieldNames(displacement="U", stress="S_Mises", obstacle="tool", handle="held", material=("nu", "E")),
    )
    assert place == "element"
    assert np.array_equal(found.stress, mises.astype(np.float32)[:, :, None])
    assert np.array_equal(found.scene.material, np.stack([2 * modulus, modulus], 1).astype(np.float32))
    assert found.scene.node_type.tolist() == [3, 3, 0, 0, 0, 0, 1, 1]  # a held node of the tool belongs to the tool
    np.testing.assert_allclose(found.position, given.position, rtol=0, atol=3e-7)


def test_a_collection_orders_by_time_and_finds_files_in_folders(tmp_path):
    given = starting_at_rest(block(1, 1, 1), 3)
    write_series(tmp_path / "parts", given, True)
    path = write_pvd(tmp_path / "run.pvd", [f"parts/frame_{i}.vtu" for i in (2, 0, 1)], times=[10.0, -1.0, 9.5])
    assert np.array_equal(read(path).position, given.position)


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
        write_series(folder / f"run_{index}", one, True)
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
        progress=told.append,
    )
    assert counts == {"train": 8, "valid": 1, "test": 1} and len(told) == 10
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


def sources_of(path) -> dict[str, list[str]]:
    with Dataset(path) as dataset:
        return {
            split: [dataset.attributes(split, index)["source"] for index in range(count)]
            for split, count in dataset.splits.items()
        }


def test_splits_by_list_and_by_share(tmp_path):
    many(tmp_path / "r", 5)
    lists = {"test": ["run_4"], "train": ["run_3", "run_0"]}
    assert convert(tmp_path / "r", tmp_path / "d.h5", splits=lists) == {"train": 2, "valid": 0, "test": 1}
    assert sources_of(tmp_path / "d.h5") == {"train": ["run_3", "run_0"], "valid": [], "test": ["run_4"]}
    shares = {"train": 0.4, "test": 0.6}
    assert convert(tmp_path / "r", tmp_path / "d.h5", splits=shares) == {"train": 2, "valid": 0, "test": 3}
    first = sources_of(tmp_path / "d.h5")
    convert(tmp_path / "r", tmp_path / "d.h5", splits=shares)
    assert sources_of(tmp_path / "d.h5") == first
    drawn = {tuple(first["train"])}
    for seed in range(1, 6):
        convert(tmp_path / "r", tmp_path / "d.h5", splits=shares, seed=seed)
        drawn.add(tuple(sources_of(tmp_path / "d.h5")["train"]))
    assert len(drawn) > 2
    assert convert(tmp_path / "r" / "run_0", tmp_path / "d.h5") == {"train": 1, "valid": 0, "test": 0}


@pytest.mark.parametrize(
    ("splits", "message"),
    [
        ({"train": ["run_0", "run1"]}, "there is no simulation 'run1' for train; the nearest is 'run_1'"),
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
    "damaged": (lambda path: path.write_bytes(b"<VTKFile type='UnstructuredGrid'"), {}, "1.vtu: cannot be read as VTU"),
    "empty": (lambda path: path.write_bytes(b""), {}, "1.vtu: cannot be read as VTU"),
    "another format": (lambda path: path.write_text("<a/>"), {}, "1.vtu: cannot be read as VTU: .*Expected tag"),
    "fewer points": (
        frame(points=ONE.rest_position[:7]),
        {},
        "1.vtu: tetra 0 refers to the nodes .*; the points are 0 to 6",
    ),
    "another mesh": (frame(elements=ONE.elements[::-1]), {}, "1.vtu: its elements are not those of 0.vtu"),
    "more points": (frame(points=np.ones((9, 3), np.float32)), {}, "1.vtu: has 9 points, 0.vtu 8"),
    "no stress": (frame(), {"stress": "s"}, "1.vtu: there is no point field 's'; there are: none"),
    "no displacement": (frame(point={"s": np.ones(8)}), {}, "frame 1 has no displacement, others have"),
    "not finite": (
        frame(point={"displacement": np.full((8, 3), np.nan)}),
        {},
        "position in frame 1 at node 0 is not finite",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_frame_is_named(tmp_path, case, capfd):
    make, names, message = WRONG[case]
    folder = tmp_path / "run"
    write_vtu(folder / "0.vtu", ONE.rest_position, ONE.elements, {"displacement": np.zeros((8, 3)), "s": np.ones(8)})
    make(folder / "1.vtu")
    with pytest.raises(DatasetError, match=message) as error:
        convert(folder, tmp_path / "d.h5", names=FieldNames(**names))
    assert "\n" not in str(error.value) and os.listdir(tmp_path) == ["run"]
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("make", "names", "message"),
    [
        (frame(), {"displacement": "U"}, "there is no point field 'U'; there are: none"),
        (frame(point={"a": np.ones(8)}), {"stress": "S"}, "there is no field 'S'; there are: a"),
        (frame(point={"S": np.ones((8, 6))}), {"stress": "S"}, "point field 'S' has 6 components; must have one"),
        (frame(point={"U": np.ones((8, 1))}), {"displacement": "U"}, "displacement has 1 components; must have 2 or 3"),
        (frame(point={"node_type": np.full(8, 2)}), {}, "node 0 has the type 2"),
        (frame(point={"node_type": np.full(8, 300)}), {}, "node_type at node 0 is 300; must be a whole number"),
        (frame(point={"b": np.full(8, 0.5)}), {"body": "b"}, "b at node 0 is 0.5; must be a whole number"),
        (frame(), {"material": ("E",)}, "there is no cell field 'E'"),
        (
            frame(extra=[("hexahedron", np.arange(8)[None])]),
            {},
            "holds tetra, hexahedron; the elements must be tetra or triangle",
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
            "files in several parts must be merged",
        ),
        ('<VTKFile><Collection><DataSet timestep="1" file="a.vtp"/></Collection></VTKFile>', "a.vtp, which is no .vtu"),
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
        convert(path, tmp_path / "d.h5")


def test_a_source_that_is_none_is_named(tmp_path):
    (tmp_path / "empty" / "deeper").mkdir(parents=True)
    (tmp_path / "x.stl").write_text("")
    for name, message in [
        ("empty", "neither it nor a folder in it holds .pvd or .vtu files"),
        ("absent", "there is no such file or folder"),
        ("x.stl", "must be a .pvd file, a folder of .vtu files, or a .vtu file"),
    ]:
        with pytest.raises(DatasetError, match=f"{tmp_path / name}: .*{message}"):
            convert(tmp_path / name, tmp_path / "d.h5")


def test_simulations_that_do_not_fit_each_other_are_named(tmp_path):
    write_series(tmp_path / "r" / "a", starting_at_rest(block(1, 1, 1), 2), True, von_mises=np.ones((2, 8)))
    write_series(tmp_path / "r" / "b", starting_at_rest(block(1, 1, 1), 2), True)
    with pytest.raises(DatasetError, match="has no stress, but stress_location is 'node'"):
        convert(tmp_path / "r", tmp_path / "d.h5", splits={"train": ["a", "b"]})
    assert os.listdir(tmp_path) == ["r"]


def test_importing_needs_no_torch():
    program = "import ast_sim.data.convert, sys; sys.exit('torch' in sys.modules or 'meshio' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0

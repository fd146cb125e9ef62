"""Exodus files as programs write them and as they get damaged: right, refused by name, or told."""

import h5py
import numpy as np
import pytest
from exodus_made import ELEMENTS, LOW, PAD_NODES, POINTS, SIDES, TOOL_NODES, UNWRITTEN, exodus, nodal, pressed

from ast_sim.importers.convert import convert
from ast_sim.importers.formats.exodus.exodus_files import exodus_facts
from ast_sim.importers.formats.exodus.netcdf_head import read_netcdf_head
from ast_sim.importers.formats.vtk_files import _checked
from ast_sim.importers.mesh_file import read_mesh
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.scene import NodeType
from ast_sim.support.errors import DatasetError

NAMES = FieldNames("disp", handle="low", obstacle="punch")


def require_right(read, handles=LOW, obstacles=TOOL_NODES, times=(0.0, 0.5, 1.0)):
    """The simulation of `exodus()`, its nodes in any order."""
    order = np.lexsort(POINTS.T)
    own = np.lexsort(read.scene.rest_position.T)
    np.testing.assert_allclose(read.scene.rest_position[own], POINTS[order], rtol=1e-6)
    for frame, position in enumerate(read.position):
        np.testing.assert_allclose(position[own], (POINTS + pressed(frame))[order], rtol=1e-5, atol=1e-6)
    types = np.zeros(len(POINTS), int)
    types[handles] = NodeType.HANDLE
    types[obstacles] = NodeType.OBSTACLE
    assert read.scene.node_type[own].tolist() == types[order].tolist()
    assert read.times == times


@pytest.mark.parametrize("version", [1, 2, 5])
def test_each_kind_of_classic_netcdf_is_read(tmp_path, version):
    exodus().write(tmp_path / "a.e", version)
    require_right(read_series(tmp_path / "a.e", NAMES))
    head = read_netcdf_head(tmp_path / "a.e")
    assert head.needed == (tmp_path / "a.e").stat().st_size and head.records == 3
    assert head.variables["connect1"].attrs["elem_type"] == b"TETRA4" and head.dimensions["num_nodes"] == len(POINTS)
    assert (head.values(tmp_path / "a.e", "connect2") == ELEMENTS[1] + 1).all()


@pytest.mark.parametrize("version", [1, 2, 5])
def test_each_kind_of_classic_netcdf_is_refused_where_it_is_cut_off(tmp_path, version):
    path = tmp_path / "a.e"
    exodus().write(path, version)
    content = path.read_bytes()
    size = len(content)
    for kept in (20, 300, 2000, size // 2, size - 900, size - 8, size - 1):
        path.write_bytes(content[:kept])
        with pytest.raises(DatasetError, match="a.e: is cut off or damaged: the file is shorter than it says"):
            read_series(path, NAMES)


def test_heads_that_are_damaged_are_refused_or_read(tmp_path):
    """Whatever byte of the head is another one: no crash, no memory for what the file cannot hold, no endless loop."""
    path = tmp_path / "a.e"
    refused = 0
    for version in (1, 2, 5):
        exodus().write(path, version)
        content = path.read_bytes()
        for place in range(4, 2600, 5):
            path.write_bytes(content[:place] + b"\xee" + content[place + 1 :])
            try:
                exodus_facts(path)
            except DatasetError as error:
                assert "a.e: is cut off or damaged" in str(error)
                refused += 1
    assert refused > 400


def test_elements_that_vtk_mistakes_are_refused_in_netcdf_5_as_well(tmp_path):
    nodes = np.arange(14)[None]
    exodus(np.random.default_rng(0).random((14, 3)), [("TETRA14", 1, "a", nodes)], {}, node_sets=()).write(
        tmp_path / "a.e", 5
    )
    with pytest.raises(DatasetError, match="a.e: holds TETRA14 elements of 14 nodes, and VTK mistakes"):
        read_mesh(tmp_path / "a.e")


@pytest.mark.parametrize("words", ["disp_{}", "disp{}", "DISP_{}", "displ_{}", "u {}", "U_{}"])
@pytest.mark.parametrize("axes", ["xyz", "XYZ", "123", "zyx"])
def test_a_vector_is_named_by_what_its_components_have_in_common(tmp_path, words, axes):
    """VTK calls disp_x, disp_y and disp_z `disp_`, with the separator, but only in this order."""
    own = nodal(3, tuple(words.format(axis) for axis in sorted(axes)))
    reactions = {f"rf_{axis}": 7 * one for axis, one in zip("xyz", own.values(), strict=True)}
    values = {words.format(axis): own[words.format(axis)] for axis in axes}
    exodus(values={**values, **reactions}).write(tmp_path / "a.e")
    bare = words.format("").rstrip("_ ")
    read = read_series(tmp_path / "a.e", FieldNames(bare, handle="low", obstacle="punch", reaction="rf"))
    require_right(read)
    np.testing.assert_allclose(
        read.fields["reaction"].values, 7 * (read.position - read.scene.rest_position), atol=1e-5
    )


def test_the_displacement_is_known_by_its_name(tmp_path):
    for words in ("displacement_{}", "displacement{}", "displacement_{}"):
        exodus(values=nodal(3, tuple(words.format(axis) for axis in "xyz"))).write(tmp_path / "a.e")
        require_right(read_series(tmp_path / "a.e", FieldNames(handle="low", obstacle="punch")))


def test_a_field_and_a_vector_of_one_name_are_kept_apart(tmp_path):
    """ux, uy and uz are `u` for VTK, and so is a field u, such as a potential."""
    vector = nodal(3, ("ux", "uy", "uz"))
    for values in ({**vector, "u": 0 * vector["ux"] + 3}, {"u": 0 * vector["ux"] + 3, **vector}):
        exodus(values=values).write(tmp_path / "a.e")
        fields = read_mesh(tmp_path / "a.e").source.point_fields
        assert sorted(one.shape[1:] for one in fields.values()) == [(), (3,)]


def test_a_whole_tensor_is_named_by_what_its_components_have_in_common(tmp_path):
    parts = {"xx": 3.0, "yy": 5.0, "zz": 11.0, "xy": 2.0, "xz": 1.0, "yz": 7.0}  # in this order VTK makes `stress_`
    frames = np.arange(3.0)[:, None]
    of_elements = {
        f"stress_{part}": {0: frames * value + np.zeros((3, len(ELEMENTS[0])))} for part, value in parts.items()
    }
    exodus(of_elements=of_elements).write(tmp_path / "a.e")
    read = read_series(tmp_path / "a.e", FieldNames("disp", stress="stress", handle="low", obstacle="punch"))
    pad = read.scene.deforming("element")
    right = np.sqrt((4 + 36 + 64) / 2 + 3 * (4 + 1 + 49))
    np.testing.assert_allclose(read.stress[:, pad, 0], frames * right + np.zeros((3, pad.sum())), rtol=1e-6)
    assert "the stress is NaN at 6 rows of obstacles: it is 0 there" in read.attributes["notes"]


def low_sides():
    """The elements of the pad that have a side at z = 0, and these sides."""
    pairs = [
        (row, side)
        for row, nodes in enumerate(ELEMENTS[0])
        for side, of in enumerate(SIDES, 1)
        if not POINTS[nodes[[*of]], 2].any()
    ]
    return tuple(np.array(pairs).T)


def test_sets_of_sides_and_blocks_are_groups(tmp_path):
    exodus(node_sets=(), side_sets=[("low", *low_sides())]).write(tmp_path / "a.e")
    require_right(read_series(tmp_path / "a.e", FieldNames("disp", handle="low", obstacle="tool")))


def test_sets_of_one_name_are_taken_together_and_kinds_are_not(tmp_path):
    sets = [("low", LOW[:3]), ("low", LOW[3:]), ("pad", LOW[:2]), ("punch", TOOL_NODES)]
    exodus(node_sets=sets, side_sets=[("low", *low_sides()), ("punch", [0], [1])]).write(tmp_path / "a.e")
    read = read_series(tmp_path / "a.e", NAMES)
    require_right(read)
    notes = read.attributes["notes"]
    assert "2 sets have the name 'low': they are taken together" in notes
    assert "the set of sides 'punch' is no group: a set with this name has other nodes" in notes
    assert "the block 'pad' is no group: a set with this name has other nodes" in notes
    assert "sides 'low'" not in notes  # the same nodes


@pytest.mark.parametrize("node", [-1, len(POINTS)])
def test_nodes_that_are_not_there_are_refused(tmp_path, node):
    """VTK takes what lies in its memory."""
    exodus(node_sets=[("low", [*LOW, node]), ("punch", TOOL_NODES)]).write(tmp_path / "a.e")
    with pytest.raises(DatasetError, match=f"set of nodes 'low' has the node {node + 1}, but the nodes are 1 to 35"):
        read_series(tmp_path / "a.e", NAMES)
    wrong = ELEMENTS[0].copy()
    wrong[3, 1] = node
    exodus(blocks=[("TETRA4", 1, "pad", wrong), ("TETRA4", 2, "tool", ELEMENTS[1])]).write(tmp_path / "b.e")
    with pytest.raises(DatasetError, match=f"an element has the node {node + 1}, but the nodes are 1 to 35"):
        read_series(tmp_path / "b.e", NAMES)


def test_a_file_that_names_values_but_has_no_frame_is_a_mesh(tmp_path):
    exodus(times=(), values=nodal(0)).write(tmp_path / "a.e")
    mesh = read_mesh(tmp_path / "a.e")
    assert len(np.unique(mesh.elements)) == len(POINTS) and not mesh.source.point_fields
    with pytest.raises(DatasetError, match="a.e: nothing moves"):
        convert(
            tmp_path / "a.e",
            tmp_path / "d.h5",
            splits={"train": 1, "valid": 0, "test": 0},
            names=FieldNames(handle="low"),
        )


def test_values_that_were_never_written_are_none(tmp_path):
    """A run that is stopped leaves them in its last frame: NetCDF's number 9.97e36, or zeros."""
    values = nodal(4)
    values["disp_y"][3] = UNWRITTEN
    exodus(values=values, times=(0.0, 0.5, 1.0, 1.5)).write(tmp_path / "a.e")
    told = "the displacement of frame 3 is no number at 35 nodes: was the run stopped while it wrote this frame"
    with pytest.raises(DatasetError, match=told):
        read_series(tmp_path / "a.e", NAMES)
    zeros = {name: np.concatenate([rows, 0 * rows[:1]]) for name, rows in nodal().items()}
    exodus(values=zeros, times=(0.0, 0.5, 1.0, 1.5)).write(tmp_path / "b.e")
    told = "in the last frame all displacements are 0 again: was the run stopped while it wrote this frame?"
    assert told in read_series(tmp_path / "b.e", NAMES).attributes["notes"]
    stress = np.ones((3, len(POINTS)))
    stress[:, TOOL_NODES] = UNWRITTEN
    exodus(values={**nodal(), "von_mises": stress}, times=(0.0, 1.0, UNWRITTEN)).write(tmp_path / "c.e")
    read = read_series(tmp_path / "c.e", NAMES)
    notes = read.attributes["notes"]
    assert "the field 'von_mises' was never written at 8 rows: it is NaN there" in notes and read.times is None
    assert not read.stress[:, read.scene.node_type == NodeType.OBSTACLE].any() and "do not ascend" in notes


def without(name):
    file = exodus()
    del file.variables[name]
    return file


WRONG = {
    "two blocks of one number": (
        lambda: exodus(blocks=[("TETRA4", 1, "pad", ELEMENTS[0]), ("TETRA4", 1, "tool", ELEMENTS[1])]),
        "has two blocks of the number 1: give each block a number of its own",
    ),
    "no kind": (
        lambda: exodus(blocks=[("TETRA4", 1, "pad", ELEMENTS[0]), ("", 2, "tool", ELEMENTS[1])]),
        "does not say of which kind a block is: write its elem_type, such as TETRA4",
    ),
    "no values": (lambda: without("vals_nod_var3"), "lacks vals_nod_var3, for which VTK takes zeros"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_vtk_takes_for_something_else_is_refused(tmp_path, case):
    make, message = WRONG[case]
    make().write(tmp_path / "a.e")
    with pytest.raises(DatasetError, match=message):
        read_series(tmp_path / "a.e", NAMES)


def test_texts_that_vtk_does_not_read_are_named(tmp_path):
    """Python's netCDF4 writes a title with an umlaut so."""
    with h5py.File(tmp_path / "a.e", "w") as file:
        file.attrs["title"] = "Prüfung"
        file["connect1"] = np.ones((2, 4), np.int32)
        file["connect1"].attrs["elem_type"] = np.bytes_("TETRA4")
    with pytest.raises(
        DatasetError, match=r"a.e: its title is a text of any length \(NC_STRING\), .* letters of ASCII$"
    ):
        read_mesh(tmp_path / "a.e")


def test_a_mesh_by_its_name_may_hold_results(tmp_path):
    exodus().write(tmp_path / "a.g")
    require_right(read_series(tmp_path / "a.g", NAMES))
    exodus(times=(), values={}).write(tmp_path / "mesh.g")
    counts = convert(tmp_path, tmp_path / "d.h5", splits={"train": 1, "valid": 0, "test": 0}, names=NAMES)
    assert counts["train"] == 1
    with pytest.raises(DatasetError, match="mesh.g: must be a .pvd"):
        read_series(tmp_path / "mesh.g", NAMES)


def test_the_memory_for_a_packed_file_follows_its_arrays_not_its_length(tmp_path):
    """Else a long series that packs well would be refused: VTK needs memory for what it unpacks."""
    path = tmp_path / "packed.e"
    exodus().write_hdf(path)
    before = _checked(path).budget
    with h5py.File(path, "r+") as file:
        file.create_dataset("packed", data=np.zeros((100, 20_000)), chunks=(1, 20_000), compression="gzip")
    assert path.stat().st_size < 1_000_000
    assert _checked(path).budget - before == 8 * 100 * 20_000 * 8  # bytes, for eight copies


def write_pieces(folder, parts, numbers=PAD_NODES, times=(0.0, 0.5, 1.0)):
    """The block in pieces: each has some elements of both blocks, and the nodes of these."""
    numbers = np.arange(len(POINTS)) if numbers is PAD_NODES else numbers
    width = len(str(len(parts)))
    for rank, rows in enumerate(parts):
        chosen = [elements[part] for elements, part in zip(ELEMENTS, rows, strict=True)]
        used = np.unique(np.concatenate([one.ravel() for one in chosen]))
        place = np.full(len(POINTS), -1)
        place[used] = np.arange(len(used))
        blocks = [
            ("TETRA4", n, name, place[one])
            for n, name, one in zip((1, 2), ("pad", "tool"), chosen, strict=True)
            if len(one)
        ]
        sets = [(name, place[nodes][place[nodes] >= 0]) for name, nodes in (("low", LOW), ("punch", TOOL_NODES))]
        values = {name: one[:, used] for name, one in nodal(len(times)).items()}
        made = exodus(
            POINTS[used],
            blocks,
            values,
            times=times,
            node_sets=[one for one in sets if len(one[1])],
            numbers=1 + numbers[used],
        )
        made.write(folder / f"job.e.{len(parts)}.{rank:0{width}d}")


HALVES = [(slice(0, 20), slice(0, 6)), (slice(20, None), slice(0, 0))]
TWELVE = [(slice(4 * n, 4 * n + 4), slice(n, n + 1) if n < 6 else slice(0, 0)) for n in range(12)]


@pytest.mark.parametrize("parts", [HALVES, TWELVE])
@pytest.mark.parametrize("seed", [None, 0])
def test_pieces_of_a_parallel_run_are_one_mesh(tmp_path, parts, seed):
    numbers = np.arange(len(POINTS)) if seed is None else np.random.default_rng(seed).permutation(len(POINTS)) * 3
    write_pieces(tmp_path, parts, numbers)
    for name in (
        f"job.e.{len(parts)}.{0:0{len(str(len(parts)))}d}",
        f"job.e.{len(parts)}.{1:0{len(str(len(parts)))}d}",
    ):
        read = read_series(tmp_path / name, NAMES)
        require_right(read)
        assert len(np.unique(read.scene.body)) == 2 and read.scene.num_elements == sum(map(len, ELEMENTS))


def test_a_folder_of_pieces_is_one_simulation(tmp_path):
    (tmp_path / "runs").mkdir()
    write_pieces(tmp_path / "runs", TWELVE)
    counts = convert(tmp_path / "runs", tmp_path / "d.h5", splits={"train": 1, "valid": 0, "test": 0}, names=NAMES)
    assert counts["train"] == 1


def test_pieces_that_do_not_belong_together_are_refused(tmp_path):
    write_pieces(tmp_path, HALVES)
    first = tmp_path / "job.e.2.0"
    second = tmp_path / "job.e.2.1"
    kept = second.read_bytes()
    second.unlink()
    with pytest.raises(DatasetError, match=r"job.e.2.0: is a piece of a parallel run, but job.e.2.1 is missing"):
        read_series(first, NAMES)
    second.write_bytes(kept[:-40])
    with pytest.raises(DatasetError, match=r"job.e.2.1: is cut off or damaged"):
        read_series(first, NAMES)
    write_pieces(tmp_path, HALVES, times=(0.0, 0.5))
    second.write_bytes(kept)
    with pytest.raises(DatasetError, match=r"its piece job.e.2.0 has fewer frames than others"):
        read_series(first, NAMES)
    write_pieces(tmp_path, HALVES, times=(0.0, 0.25, 0.5))
    second.write_bytes(kept)
    with pytest.raises(DatasetError, match="is a part of a frame at the time"):
        read_series(first, NAMES)
    exodus().write(second)
    with pytest.raises(DatasetError, match=r"job.e.2.1: gives its nodes no numbers \(node_num_map\)"):
        read_series(first, NAMES)

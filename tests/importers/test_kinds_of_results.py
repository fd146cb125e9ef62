"""Kinds of result files that once came in wrong or without a word: sets of nodes, parts in another order, moving
geometry, results of some nodes only."""

import h5py
import meshio
import numpy as np
import pytest
import pyvista
from data_samples import block
from scipy.io import netcdf_file

from ast_sim.importers.mesh_file import read_mesh
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.scene import NodeType
from ast_sim.support.errors import DatasetError

PAD = block(2, 2, 2)
LOW = np.flatnonzero(PAD.rest_position[:, 2] == 0)
TOP = np.flatnonzero(PAD.rest_position[:, 2] == 2)
N = PAD.num_nodes


def pressed(frame):
    """[n, 3]: displacements of the pad; its height shrinks by 5 % a frame."""
    return PAD.rest_position * np.array((0, 0, -0.05 * frame))


def write_exodus(path, numbers, further=None):
    """Three frames of the pad, whose nodes have these numbers, with the sets of nodes LOW and TOP; `further` fields
    have one number in each frame."""
    fields = {f"displ{axis}": [pressed(frame)[:, index] for frame in range(3)] for index, axis in enumerate("xyz")}
    fields |= {name: [np.full(N, frame * value) for frame in range(3)] for name, value in (further or {}).items()}
    with netcdf_file(path, "w", version=2) as file:
        file.version = file.api_version = np.float32(5.1)
        file.floating_point_word_size = np.int32(8)
        file.file_size = np.int32(1)
        sizes = {"time_step": None, "len_string": 33, "num_dim": 3, "num_nodes": N, "num_elem": len(PAD.elements)}
        sizes |= {
            "num_el_blk": 1,
            "num_el_in_blk1": len(PAD.elements),
            "num_nod_per_el1": 4,
            "num_nod_var": len(fields),
        }
        sizes |= {"num_node_sets": 2, "num_nod_ns1": len(LOW), "num_nod_ns2": len(TOP)}
        for name, size in sizes.items():
            file.createDimension(name, size)

        def put(name, *dimensions, values, kind="i"):
            variable = file.createVariable(name, kind, dimensions)
            variable[:] = values
            return variable

        for axis, name in enumerate(("coordx", "coordy", "coordz")):
            put(name, "num_nodes", values=PAD.rest_position[:, axis], kind="d")
        put("connect1", "num_el_in_blk1", "num_nod_per_el1", values=PAD.elements + 1).elem_type = "TETRA4"
        put("node_num_map", "num_nodes", values=numbers)
        for of, count in (("eb", "num_el_blk"), ("ns", "num_node_sets")):
            put(f"{of}_status", count, values=1)
            put(f"{of}_prop1", count, values=1 + np.arange(sizes[count])).name = "ID"
        put("ns_names", "num_node_sets", "len_string", values=characters("low", "top"), kind="c")
        for number, nodes in enumerate((LOW, TOP), 1):
            put(f"node_ns{number}", f"num_nod_ns{number}", values=nodes + 1)
        put("time_whole", "time_step", values=[0.0, 0.5, 1.0], kind="d")
        put("name_nod_var", "num_nod_var", "len_string", values=characters(*fields), kind="c")
        for number, values in enumerate(fields.values(), 1):
            put(f"vals_nod_var{number}", "time_step", "num_nodes", values=np.stack(values), kind="d")


def characters(*texts):
    return np.array([list(text.ljust(33, "\0")) for text in texts], "S1")


def test_sets_of_nodes_of_exodus_are_groups(tmp_path):
    """Whatever numbers the file gives its nodes: sets hold places in the file."""
    for numbers in (1 + np.arange(N), 1 + np.random.default_rng(0).permutation(N), 1000 - 7 * np.arange(N)):
        write_exodus(tmp_path / "job.exo", numbers)
        read = read_series(tmp_path / "job.exo", FieldNames("displ", handle="low", obstacle="top"))
        at = {tuple(place) for place in read.scene.rest_position[read.scene.node_type == NodeType.HANDLE].tolist()}
        assert at == {tuple(place) for place in PAD.rest_position[LOW].tolist()}
        assert (read.scene.rest_position[read.scene.node_type == NodeType.OBSTACLE][:, 2] == 2).all()
        assert (read.scene.node_type == NodeType.OBSTACLE).sum() == len(TOP)
        np.testing.assert_allclose(read.position[2, :, 2], 0.9 * read.scene.rest_position[:, 2], rtol=1e-6)


@pytest.mark.parametrize("order", [(0, 1, 2, 3, 4, 5), (0, 3, 4, 1, 5, 2), (5, 4, 3, 2, 1, 0), (3, 0, 5, 2, 4, 1)])
@pytest.mark.parametrize("names", ["stress_{}", "S{}"])
def test_the_stress_of_exodus_is_put_together(tmp_path, order, names):
    """VTK joins fields whose names end in x, y and z to vectors, and six to a tensor: in MOOSE's order (xx, xy, xz, yy,
    yz, zz) the first three alone."""
    parts = dict(zip(("xx", "yy", "zz", "xy", "yz", "xz"), (1.0, 2.0, 4.0, 8.0, 16.0, 32.0), strict=True))
    named = {names.format(list(parts)[index]): list(parts.values())[index] for index in order}
    write_exodus(tmp_path / "job.exo", 1 + np.arange(N), named)
    read = read_series(tmp_path / "job.exo", FieldNames("displ", stress=names.format(""), handle="low"))
    right = np.sqrt(7 + 3 * (8**2 + 16**2 + 32**2))
    np.testing.assert_allclose(read.stress[:, :, 0], np.full((3, N), right) * [[0], [1], [2]], rtol=1e-6)


@pytest.mark.parametrize("lost", [8, 200, 656, 2000])
def test_exodus_files_that_are_cut_off_are_refused(tmp_path, lost):
    """VTK takes zeros for the numbers that are missing."""
    path = tmp_path / "job.exo"
    write_exodus(path, 1 + np.arange(N))
    path.write_bytes(path.read_bytes()[:-lost])
    with pytest.raises(DatasetError, match="job.exo: is cut off or damaged: the file is shorter than it says"):
        read_series(path, FieldNames("displ", handle="low"))


def test_exodus_files_that_go_on_elsewhere_are_refused(tmp_path):
    """As Sierra and MOOSE write them after a restart or with a new mesh."""
    for name in ("job.e", "job.e-s002"):
        write_exodus(tmp_path / name, 1 + np.arange(N))
    with pytest.raises(DatasetError, match="job.e: goes on in job.e-s002 with another mesh"):
        read_series(tmp_path / "job.e", FieldNames("displ", handle="low"))


def test_families_of_med_are_groups(tmp_path):
    """A family may belong to several groups, and a group may have several families."""
    tags = np.where(np.arange(len(PAD.elements)) < 6, -6, -7)
    families = np.zeros(N, int)
    families[LOW], families[TOP] = 2, 3
    mesh = meshio.Mesh(PAD.rest_position, [("tetra", PAD.elements)], {"point_tags": families}, {"cell_tags": [tags]})
    mesh.cell_tags = {-6: ["some", "all"], -7: ["all"]}
    mesh.point_tags = {2: ["low"], 3: ["top"]}
    mesh.write(tmp_path / "mesh.med")
    groups = read_mesh(tmp_path / "mesh.med").groups
    expected = {"low": LOW, "top": TOP, "some": np.unique(PAD.elements[:6]), "all": np.arange(N)}
    assert {name: nodes.tolist() for name, nodes in groups.items()} == {k: v.tolist() for k, v in expected.items()}


def write_xdmf(path, orders, collections=1):
    """A series in which each frame has points, which move, and cells of its own, in these orders."""
    text = '<Xdmf Version="3.0"><Domain>'
    for _ in range(collections):
        text += '<Grid GridType="Collection" CollectionType="Temporal">'
        for frame, order in enumerate(orders):
            text += f'<Grid GridType="Uniform"><Time Value="{frame}.5"/><Topology TopologyType="Tetrahedron">'
            text += item(PAD.elements[order], "Int") + '</Topology><Geometry GeometryType="XYZ">'
            text += item(PAD.rest_position + pressed(frame)) + "</Geometry>"
            for name, values in {"von_mises": 1000.0 * frame + np.arange(len(PAD.elements))[order]}.items():
                text += f'<Attribute Name="{name}" Center="Cell">{item(values)}</Attribute>'
            text += "</Grid>"
        text += "</Grid>"
    path.write_text(text + "</Domain></Xdmf>")


def item(values, kind="Float"):
    size = " ".join(map(str, np.shape(values)))
    numbers = " ".join(map(str, np.ravel(values).tolist()))
    return f'<DataItem Dimensions="{size}" NumberType="{kind}" Precision="8" Format="XML">{numbers}</DataItem>'


def test_frames_of_xdmf_keep_points_and_cells_of_their_own(tmp_path):
    plain = np.arange(len(PAD.elements))
    write_xdmf(tmp_path / "all.xdmf", [plain, plain[::-1], plain])
    read = read_series(tmp_path / "all.xdmf", FieldNames(handle="0:zmin,zmax"))
    for frame in range(3):
        np.testing.assert_allclose(read.position[frame], PAD.rest_position + pressed(frame), rtol=1e-6)
        assert read.stress[frame, :, 0].tolist() == (1000 * frame + plain).tolist()
    assert read.times == (0.5, 1.5, 2.5)


def test_one_of_several_series_of_xdmf_is_not_taken_for_all(tmp_path):
    write_xdmf(tmp_path / "all.xdmf", [np.arange(len(PAD.elements))], collections=2)
    with pytest.raises(DatasetError, match="holds 2 series of frames, and one can be read"):
        read_series(tmp_path / "all.xdmf", FieldNames())


@pytest.mark.parametrize(("old", "new"), [('"Temporal"', '"Spatial"'), ('<Time Value="1.5"/>', "")])
def test_a_series_of_xdmf_has_a_grid_and_a_time_for_each_frame(tmp_path, old, new):
    path = tmp_path / "all.xdmf"
    write_xdmf(path, 2 * [np.arange(len(PAD.elements))])
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(DatasetError, match="of the type 'Spatial'; must be 'Temporal'|entry 1 of the series is no"):
        read_series(path, FieldNames())


def test_times_that_do_not_ascend_are_told(tmp_path):
    path = tmp_path / "all.xdmf"
    write_xdmf(path, 3 * [np.arange(len(PAD.elements))])
    path.write_text(path.read_text().replace('"1.5"', '"2.5"'))
    read = read_series(path, FieldNames(handle="0:zmin,zmax"))
    assert read.times is None and "the times of the frames do not ascend (0.5, 2.5, 2.5)" in read.attributes["notes"]


def test_times_that_ascend_by_rounding_and_sets_are_told(tmp_path):
    path = tmp_path / "all.xdmf"
    write_xdmf(path, 3 * [np.arange(len(PAD.elements))])
    text = path.read_text().replace('"1.5"', '"0.5000000001"')
    path.write_text(text.replace("</Topology>", '</Topology><Set Name="low" SetType="Node"/>', 1))
    notes = read_series(path, FieldNames(handle="0:zmin,zmax")).attributes["notes"]
    assert "1 set is not read: low" in notes
    assert "the times of frames 0 and the next differ by rounding alone: is one off?" in notes


def write_frame(path, position, **fields):
    meshio.Mesh(position, [("tetra", CUBE.elements)], fields).write(path)


CUBE = block(1, 1, 1)


def test_parts_of_a_frame_stand_in_the_order_of_their_numbers(tmp_path):
    """Two bodies of the same mesh would change their places where a PVD file lists them in another order."""
    listed = []
    for frame in range(3):
        for part in (0, 1):
            place = CUBE.rest_position + np.array((0, 0, 1.5 - 0.1 * frame)) * part
            write_frame(tmp_path / f"f{frame}_{part}.vtu", place, tool=np.full(8, float(part)))
            listed.append(f'<DataSet timestep="{frame}" part="{part}" file="f{frame}_{part}.vtu"/>')
    listed[2:4] = listed[3], listed[2]
    text = f'<VTKFile type="Collection"><Collection>{"".join(listed)}</Collection></VTKFile>'
    (tmp_path / "all.pvd").write_text(text)
    read = read_series(tmp_path / "all.pvd", FieldNames(obstacle="tool", handle="0:zmin"))
    moved = read.position - read.position[0]
    np.testing.assert_allclose(moved[1, 8:], np.tile((0, 0, -0.1), (8, 1)), atol=1e-6)
    assert not moved[:, :8].any()
    (tmp_path / "all.pvd").write_text(text.replace('"1" part="1"', '"1" part="2"'))
    with pytest.raises(DatasetError, match="lists other parts for one time than for another"):
        read_series(tmp_path / "all.pvd", FieldNames())


@pytest.mark.parametrize("name", ["TimeValue", "TIME", "Time", "time"])
def test_times_in_files_have_no_case(tmp_path, name):
    for file, frame in (("a", 2), ("b", 0), ("c", 1)):
        grid = pyvista.from_meshio(
            meshio.Mesh(CUBE.rest_position * (1, 1, 1 - 0.1 * frame), [("tetra", CUBE.elements)])
        )
        grid.field_data[name] = [0.5 * frame]
        grid.save(tmp_path / f"{file}.vtu")
    read = read_series(tmp_path, FieldNames(handle="0:zmin"))
    assert read.times == (0, 0.5, 1)
    np.testing.assert_allclose(read.position[:, :, 2].max(axis=1), (1, 0.9, 0.8), rtol=1e-6)


def test_a_stress_that_the_first_frame_lacks_is_not_passed_over(tmp_path):
    for frame in range(3):
        fields = {"von_mises": np.full(8, 1.0 * frame)} if frame else {}
        write_frame(tmp_path / f"f{frame}.vtu", CUBE.rest_position * (1, 1, 1 - 0.1 * frame), **fields)
    with pytest.raises(DatasetError, match=r"f1.vtu: holds 'von_mises', which the first frame lacks"):
        read_series(tmp_path, FieldNames(handle="0:zmin"))


@pytest.mark.parametrize("how", ['Endian="Big"', 'Seek="8"', 'Compression="Zlib"'])
def test_binary_numbers_of_xdmf_that_meshio_would_misread_are_refused(tmp_path, monkeypatch, how):
    monkeypatch.chdir(tmp_path)
    meshio.Mesh(CUBE.rest_position, [("tetra", CUBE.elements)]).write("mesh.xdmf", data_format="Binary")
    path = tmp_path / "mesh.xdmf"
    assert len(read_mesh(path).points) == 8
    path.write_text(path.read_text().replace('Format="Binary"', f'Format="Binary" {how}'))
    with pytest.raises(DatasetError, match="binary numbers must be plain ones of this machine"):
        read_mesh(path)


@pytest.mark.parametrize(
    ("old", "new", "cause"),
    [
        ("<Topology ", '<Topology BaseOffset="1" ', r"counts its nodes from 1 \(BaseOffset\)"),
        ("</Grid></Grid>", "</Grid></Grid><Grid/>", "holds a grid beside the series of frames"),
        ("<Topology ", '<Topology Order="3 2 1 0" ', "its cells have an Order of nodes"),
        ("<DataItem ", '<DataItem ItemType="Function" Function="2*$0" ', r"has numbers by the function '2\*\$0'"),
        (
            '<Attribute Name="von_mises"',
            '<Attribute Name="von_mises" Center="Cell"/>' * 2 + '<Attribute Name="x"',
            "twice",
        ),
    ],
)
def test_what_meshio_reads_over_in_xdmf_is_refused(tmp_path, old, new, cause):
    path = tmp_path / "all.xdmf"
    write_xdmf(path, 3 * [np.arange(len(PAD.elements))])
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(DatasetError, match=f"all.xdmf: .*{cause}"):
        read_series(path, FieldNames(handle="0:zmin"))


def test_coordinates_of_med_that_are_not_cartesian_are_refused(tmp_path):
    path = tmp_path / "mesh.med"
    meshio.Mesh(PAD.rest_position, [("tetra", PAD.elements)]).write(path)
    assert len(read_mesh(path).points) == N
    with h5py.File(path, "r+") as file:
        file["ENS_MAA/mesh"].attrs["REP"] = 1
    with pytest.raises(DatasetError, match="mesh.med: the coordinates of mesh are not along x, y and z"):
        read_mesh(path)


@pytest.mark.parametrize("at", [0, 2])
def test_a_field_that_says_what_a_node_is_and_changes_is_told(tmp_path, at):
    for frame in range(3):
        tool = (CUBE.rest_position[:, 2] == (frame == at)).astype(float)
        write_frame(tmp_path / f"f{frame}.vtu", CUBE.rest_position * (1, 1, 1 - 0.1 * frame), tool=tool)
    notes = read_series(tmp_path, FieldNames(obstacle="tool")).attributes["notes"]
    changed = "f1.vtu" if at == 0 else "f2.vtu"
    told = f"the field 'tool' changes in 8 rows of {changed}: the values of the first frame are taken"
    assert notes.endswith(f"{told}; no times tell the 3 frames apart: they count 0, 1, 2, ...")


def test_a_displacement_in_the_plane_moves_no_body_with_a_volume(tmp_path):
    for frame in range(2):
        write_frame(tmp_path / f"f{frame}.vtu", CUBE.rest_position, displacement=np.full((8, 2), 0.1 * frame))
    with pytest.raises(DatasetError, match="f0.vtu: the displacement of a body with a volume has 2 components"):
        read_series(tmp_path, FieldNames(handle="0:zmin"))


@pytest.mark.parametrize("how", ["one field", "two fields"])
@pytest.mark.parametrize(("axes", "right"), [([0, 1, 2], True), ([0, 2, 1], False), ([2, 0, 1], False)])
def test_a_displacement_of_two_components_is_along_x_and_y(tmp_path, axes, right, how):
    """In a mesh that stands upright the two may be x and z."""
    points = np.array([[0.0, 0, 5], [1, 0, 5], [1, 1, 5], [0, 1, 5]])[:, axes]
    for frame in range(2):
        moved = np.outer(points[:, axes.index(0)], [0.0, 0.1 * frame])
        apart = {"displacement_x": moved[:, 0], "displacement_y": moved[:, 1]}
        one = {"displacement": moved} if how == "one field" else apart
        mesh = meshio.Mesh(points, [("triangle", [[0, 1, 2], [0, 2, 3]])], point_data=one)
        mesh.write(tmp_path / f"f{frame}.vtu")
    if right:
        position = read_series(tmp_path, FieldNames()).position[1]
        np.testing.assert_allclose(position - points, np.pad(moved, [(0, 0), (0, 1)]), atol=1e-6)
        return
    with pytest.raises(
        DatasetError, match="for x and y, but the mesh does not lie in a plane of these .z is 0 to 1.: w"
    ):
        read_series(tmp_path, FieldNames())


def test_groups_of_gmsh_2_with_negative_numbers_and_names_of_windows(tmp_path):
    """A negative number says that the elements of a group are turned over."""
    nodes = "\n".join(f"{1 + row} {x} {y} {z}" for row, (x, y, z) in enumerate(CUBE.rest_position.tolist()))
    cells = "\n".join(f"{1 + row} 4 2 -7 1 {' '.join(map(str, 1 + c))}" for row, c in enumerate(CUBE.elements))
    text = '$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$PhysicalNames\n1\n3 7 "Klötze"\n$EndPhysicalNames\n'
    text += f"$Nodes\n8\n{nodes}\n$EndNodes\n$Elements\n{len(CUBE.elements)}\n{cells}\n$EndElements\n"
    for encoding in ("utf-8", "latin-1"):
        (tmp_path / "mesh.msh").write_bytes(text.encode(encoding))
        assert {name: len(group) for name, group in read_mesh(tmp_path / "mesh.msh").groups.items()} == {"Klötze": 8}


def test_what_meshio_misses_in_a_file_is_named(tmp_path):
    """Gmsh writes MED files without families, which meshio needs."""
    path = tmp_path / "mesh.med"
    meshio.Mesh(PAD.rest_position, [("tetra", PAD.elements)]).write(path)
    with h5py.File(path, "r+") as file:
        del file["ENS_MAA"]
    with pytest.raises(DatasetError, match="mesh.med: cannot be read as a mesh: meshio looks for 'ENS_MAA' in it"):
        read_mesh(path)


SIX = ("XX", "YY", "ZZ", "XY", "YZ", "XZ")


@pytest.mark.parametrize(
    ("first", "last", "cause"),
    [
        (SIX, None, "holds one number, in the first frame xx, yy, zz, xy, yz, xz"),
        (None, SIX, "holds xx, yy, zz, xy, yz, xz, in the first frame one number"),
        (SIX, ("XX", "XY", "XZ", "YY", "YZ", "ZZ"), "holds xx, xy, xz, yy, yz, zz, in the first frame xx, yy, zz, xy"),
    ],
)
def test_a_stress_whose_components_change_from_frame_to_frame_is_refused(tmp_path, first, last, cause):
    for frame in range(3):
        grid = pyvista.UnstructuredGrid(
            {10: PAD.elements.astype(int)}, (PAD.rest_position + pressed(frame)).astype(float)
        )
        names = last if frame == 2 else first
        grid.cell_data["s"] = np.full((len(PAD.elements), len(names or "1")), 100.0 * frame)
        for column, name in enumerate(names or ()):
            grid.GetCellData().GetArray("s").SetComponentName(column, name)
        grid.save(tmp_path / f"f_{frame}.vtu")
    with pytest.raises(DatasetError, match=f"f_2.vtu: 's' {cause}"):
        read_series(tmp_path, FieldNames(stress="s", handle="0:zmin"))
    if (first is None) != (last is None):
        told = r"f_2.vtu: the field 's' has (1 component|6 components), in the first frame [61]"
        with pytest.raises(DatasetError, match=told):
            read_series(tmp_path, FieldNames(fields=("s",), handle="0:zmin"))

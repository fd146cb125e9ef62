"""Kinds of files with one frame each: read as series, or refused with what to do."""

import h5py
import meshio
import numpy as np
import pytest
import pyvista
from data_samples import block
from vtkmodules.vtkCommonDataModel import vtkPartitionedDataSet, vtkPartitionedDataSetCollection
from vtkmodules.vtkIOParallelXML import vtkXMLPartitionedDataSetCollectionWriter, vtkXMLPartitionedDataSetWriter

from ast_sim.importers.convert import find_series
from ast_sim.importers.formats.vtk_files import vtk_frames
from ast_sim.importers.mesh_file import read_mesh
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.support.errors import DatasetError

CUBE = block(1, 1, 1)
NAMES = FieldNames(handle="0:zmin")


def pressed(frame):
    return CUBE.rest_position * (1, 1, 1 - 0.1 * frame)


def grid(points):
    return pyvista.from_meshio(meshio.Mesh(points, [("tetra", CUBE.elements)]))


def write_partitions(path, frame):
    one, other = grid(pressed(frame)), grid(CUBE.rest_position + (0, 0, 1.5 - 0.1 * frame))
    if path.suffix == ".vtpd":
        data, writer = vtkPartitionedDataSet(), vtkXMLPartitionedDataSetWriter()
        data.SetPartition(0, one)
        data.SetPartition(1, other)
    else:
        data, writer = vtkPartitionedDataSetCollection(), vtkXMLPartitionedDataSetCollectionWriter()
        data.SetPartition(0, 0, one)
        data.SetPartition(1, 0, other)
    writer.SetInputData(data)
    writer.SetFileName(str(path))
    writer.Write()


def write_structured(path, frame):
    """A cube of 8 cells; a .pvts file lists the .vts file of its one piece."""
    axis = np.arange(3.0) / 2
    x, y, z = np.meshgrid(axis, axis, axis * (1 - 0.1 * frame), indexing="ij")
    pyvista.StructuredGrid(x, y, z).save(path.with_suffix(".vts"))
    if path.suffix == ".pvts":
        points = '<PPoints><PDataArray type="Float64" NumberOfComponents="3"/></PPoints>'
        piece = f'<Piece Extent="0 2 0 2 0 2" Source="{path.stem}.vts"/>'
        inner = f'<PStructuredGrid WholeExtent="0 2 0 2 0 2" GhostLevel="0">{points}{piece}</PStructuredGrid>'
        path.write_text(f'<VTKFile type="PStructuredGrid" version="0.1">{inner}</VTKFile>')


def write_gmsh(path, frame):
    meshio.Mesh(pressed(frame), [("tetra", CUBE.elements)]).write(path, file_format="gmsh")


@pytest.mark.parametrize(
    ("ending", "write", "nodes"),
    [
        ("vtpd", write_partitions, 16),
        ("vtpc", write_partitions, 16),
        ("vts", write_structured, 27),
        ("pvts", write_structured, 27),
        ("msh", write_gmsh, 8),
    ],
)
def test_a_file_for_each_frame_is_read(tmp_path, ending, write, nodes):
    """The folders with the pieces of .vtpd and .vtpc files are no simulations."""
    listed = ""
    for frame in range(3):
        write(tmp_path / f"f_{frame}.{ending}", frame)
        listed += f'<DataSet timestep="{frame}" file="f_{frame}.{ending}"/>'
    assert find_series(tmp_path) == {tmp_path.name: tmp_path}
    of_folder = read_series(tmp_path, NAMES)
    (tmp_path / "all.pvd").write_text(f'<VTKFile type="Collection"><Collection>{listed}</Collection></VTKFile>')
    of_list = read_series(tmp_path / "all.pvd", NAMES)
    for read in (of_folder, of_list):
        np.testing.assert_allclose(np.ptp(read.position[:, read.scene.body == 0, 2], axis=1), (1, 0.9, 0.8), rtol=1e-6)
        assert read.scene.num_nodes == nodes
    assert of_list.times == (0, 1, 2)
    assert "left out" not in of_folder.attributes.get("notes", "")


def test_meshes_of_gmsh_beside_simulations_are_no_frames(tmp_path):
    for frame in range(2):
        write_gmsh(tmp_path / f"part_{frame}.msh", 0)
        (tmp_path / "run").mkdir(exist_ok=True)
        grid(pressed(frame)).save(tmp_path / "run" / f"f_{frame}.vtu")
    assert find_series(tmp_path) == {"run": tmp_path / "run"}


def test_results_that_are_left_out_are_told(tmp_path):
    """Beside frames in a folder, and beside a list of files; not the pieces that a list names."""
    (tmp_path / "sub").mkdir()
    for frame in range(3):
        grid(pressed(frame)).save(tmp_path / f"f_{frame}.vtu")
        grid(pressed(frame)).save(tmp_path / "sub" / f"g_{frame}.vtu")
    grid(pressed(0)).extract_surface(algorithm="dataset_surface").save(tmp_path / "tool.vtp")
    notes = read_series(tmp_path, NAMES).attributes["notes"]
    told = f"2 other files or folders with results in {tmp_path.name} are left out: sub, tool.vtp"
    assert notes == f"{told}; no times tell the 3 frames apart: they count 0, 1, 2, ..."
    listed = "".join(f'<DataSet timestep="{frame}" file="sub/g_{frame}.vtu"/>' for frame in range(3))
    (tmp_path / "g.pvd").write_text(f'<VTKFile type="Collection"><Collection>{listed}</Collection></VTKFile>')
    with pytest.warns(UserWarning, match="4 other files or folders with results in .* are left out: f_0.vtu, f_1.vtu,"):
        assert list(find_series(tmp_path)) == ["g"]


def test_two_simulations_of_one_name_are_refused(tmp_path):
    """ccx2paraview writes job.pvd beside job.frd."""
    for name in ("job.frd", "job.pvd"):
        (tmp_path / name).touch()
    with pytest.raises(DatasetError, match=r"job.pvd: is the simulation 'job', and so is job.frd: move one elsewhere"):
        find_series(tmp_path)


@pytest.mark.parametrize("name", ["mesh.unv", "view.pos", "mesh.key"])
def test_other_kinds_are_refused_with_what_to_do(tmp_path, name):
    (tmp_path / name).write_text("    -1\n")
    with pytest.raises(
        DatasetError, match=f"{name}: .*files of the kind .* are not read; write it as .vtu, .vtk, .msh"
    ):
        read_mesh(tmp_path / name)
    with pytest.raises(DatasetError, match=f"{name}: must be a .pvd or .series file, a folder of files of frames"):
        read_series(tmp_path / name, NAMES)


def test_grids_of_xdmf_are_uniform_where_they_do_not_say(tmp_path):
    def one(frame):
        points = " ".join(map(str, pressed(frame).ravel()))
        cells = " ".join(map(str, CUBE.elements.ravel()))
        of_cells = f'<DataItem Dimensions="{len(CUBE.elements)} 4" Format="XML" NumberType="Int">{cells}</DataItem>'
        of_points = f'<DataItem Dimensions="8 3" Format="XML" NumberType="Float" Precision="8">{points}</DataItem>'
        topology = f'<Topology TopologyType="Tetrahedron" NumberOfElements="{len(CUBE.elements)}">{of_cells}</Topology>'
        return f'<Grid><Time Value="{frame}"/>{topology}<Geometry GeometryType="XYZ">{of_points}</Geometry></Grid>'

    series = "".join(map(one, range(3)))
    series = f'<Domain><Grid GridType="Collection" CollectionType="Temporal">{series}</Grid></Domain>'
    path = tmp_path / "all.xdmf"
    path.write_text(f'<Xdmf Version="3.0">{series}</Xdmf>')
    read = read_series(path, NAMES)
    np.testing.assert_allclose(read.position[:, :, 2].max(axis=1), (1, 0.9, 0.8), rtol=1e-6)
    path.write_text(f'<Xdmf Version="2.2">{series}</Xdmf>')
    np.testing.assert_array_equal(read_series(path, NAMES).position, read.position)
    path.write_text(f'<Xdmf Version="4.0">{series}</Xdmf>')
    with pytest.raises(DatasetError, match="is XDMF of the version 4.0; write a series of version 3"):
        read_series(path, NAMES)


def write_vtkhdf(path, starts):
    """Three steps of one mesh; `starts` are the first rows of the displacements of each step."""
    count = len(CUBE.elements)
    with h5py.File(path, "w") as file:
        root = file.create_group("VTKHDF")
        root.attrs["Version"] = (2, 0)
        root.attrs.create("Type", b"UnstructuredGrid", dtype="S16")
        root["Points"] = CUBE.rest_position
        for name, number in (("Points", 8), ("Cells", count), ("ConnectivityIds", 4 * count)):
            root[f"NumberOf{name}"] = [number]
        root["Types"] = np.full(count, 10, np.uint8)
        root["Connectivity"] = CUBE.elements.ravel().astype(np.int64)
        root["Offsets"] = 4 * np.arange(count + 1)
        root["PointData/displacement"] = np.concatenate([pressed(frame) - pressed(0) for frame in range(3)])
        steps = root.create_group("Steps")
        steps.attrs["NSteps"] = 3
        steps["Values"] = [0.0, 1, 2]
        steps["NumberOfParts"] = [1, 1, 1]
        for name in ("PartOffsets", "PointOffsets"):
            steps[name] = [0, 0, 0]
        for name in ("CellOffsets", "ConnectivityIdOffsets"):
            steps[name] = [[0], [0], [0]]
        steps["PointDataOffsets/displacement"] = starts


def test_offsets_of_vtkhdf_that_mix_steps_are_refused(tmp_path):
    path = tmp_path / "a.vtkhdf"
    write_vtkhdf(path, [0, 8, 16])
    np.testing.assert_allclose(read_series(path, NAMES).position[:, :, 2].max(axis=1), (1, 0.9, 0.8), rtol=1e-6)
    for starts, cause in (
        ([0, 4, 16], "two steps share a part of the rows of 'displacement'"),
        ([0, 8, 8], "the steps use 16 of the 24 rows of 'displacement'"),
    ):
        write_vtkhdf(path, starts)
        with pytest.raises(DatasetError, match=f"a.vtkhdf: .*: {cause}: its offsets are wrong"):
            read_series(path, NAMES)


@pytest.mark.parametrize("ending", ["vtu", "pvtu"])
def test_ghost_cells_are_left_out(tmp_path, ending):
    """Each of two cubes has cells of the other one as ghosts, as programs with several processes write them."""
    names = []
    for piece in range(2):
        points = np.concatenate([CUBE.rest_position + (piece, 0, 0), CUBE.rest_position + (1 - piece, 0, 0)])
        both = np.concatenate([CUBE.elements, CUBE.elements[:2] + 8])
        part = pyvista.from_meshio(meshio.Mesh(points, [("tetra", both)]))
        part.cell_data["vtkGhostType"] = np.array([0] * len(CUBE.elements) + [1, 1], np.uint8)
        names.append(f"piece_{piece}.vtu")
        part.save(tmp_path / names[-1])
    path = tmp_path / names[0]
    if ending == "pvtu":
        path = tmp_path / "all.pvtu"
        points = '<PPoints><PDataArray type="Float64" NumberOfComponents="3"/></PPoints>'
        ghosts = '<PCellData><PDataArray type="UInt8" Name="vtkGhostType"/></PCellData>'
        sources = "".join(f'<Piece Source="{name}"/>' for name in names)
        inner = f'<PUnstructuredGrid GhostLevel="1">{points}{ghosts}{sources}</PUnstructuredGrid>'
        path.write_text(f'<VTKFile type="PUnstructuredGrid" version="0.1">{inner}</VTKFile>')
    mesh = read_mesh(path)
    count = len(names) if ending == "pvtu" else 1
    assert len(mesh.elements) == count * len(CUBE.elements)
    x = mesh.points[mesh.elements]
    volume = np.abs(np.linalg.det(x[:, 1:] - x[:, :1])).sum() / 6
    assert volume == pytest.approx(count)
    assert f"{2 * count} ghost cells are left out" in mesh.notes


def legacy(path, lost):
    """A legacy file as text with the displacement u, without its last letters."""
    rows = ["".join(f"{x:6.3f}" for x in row) for row in CUBE.rest_position]
    cells = ["4 " + " ".join(map(str, row)) for row in CUBE.elements.tolist()]
    lines = ["# vtk DataFile Version 3.0", "x", "ASCII", "DATASET UNSTRUCTURED_GRID", "POINTS 8 double", *rows]
    lines += [f"CELLS {len(cells)} {5 * len(cells)}", *cells, f"CELL_TYPES {len(cells)}", *["10"] * len(cells)]
    lines += ["POINT_DATA 8", "SCALARS u double 3", "LOOKUP_TABLE default", *rows]
    path.write_text("\n".join([*lines, ""])[: -lost or None])


def test_a_legacy_file_that_is_cut_off_is_refused_or_told(tmp_path):
    """Where it ends in a number, VTK took garbage for the numbers that are missing."""
    notes, refused = [], 0
    for lost in range(100):
        legacy(tmp_path / "f.vtk", lost)
        try:
            frame = next(vtk_frames(tmp_path / "f.vtk"))
        except DatasetError as error:
            refused += 1
            assert "Error reading ascii data" in str(error)
        else:
            notes.append(frame.notes)
            np.testing.assert_allclose(frame.point_fields["u"][:, :2], CUBE.rest_position[:, :2])
    told = ["the file ends without a line end: is its last number cut off?"]
    assert notes == [[], *[told] * 5] and refused == 94  # without the line end, and without 1 to 4 letters of 1.000


@pytest.mark.parametrize(
    ("times", "told"),
    [
        (("0,0", "0,25", "0,5", "1,0"), "the frames stand in the order of the numbers in their names, read with their"),
        (("0,00", "0,25", "0,50", "1,00"), ""),
        (("0", "0,5", "0.75", "1e0"), ""),
    ],
)
def test_numbers_in_names_may_have_a_decimal_comma(tmp_path, times, told):
    """As programs write them under Windows in many countries: 0,25 comes before 0,5."""
    for frame, time in enumerate(times):
        grid(pressed(frame)).save(tmp_path / f"result_{time}.vtu")
    read = read_series(tmp_path, NAMES)
    np.testing.assert_allclose(read.position[:, :, 2].max(axis=1), (1, 0.9, 0.8, 0.7), rtol=1e-6)
    no_times = "no times tell the 4 frames apart: they count 0, 1, 2, ..."
    notes = read.attributes["notes"]
    assert notes.startswith(told or no_times) and notes.endswith(no_times) and read.times is None


def test_files_that_a_list_names_with_decimal_commas_are_in_order(tmp_path):
    for frame, time in enumerate(("0,0", "0,25", "0,5")):
        grid(pressed(frame)).save(tmp_path / f"result_{time}.vtu")
    listed = [
        f'<DataSet timestep="{float(time.replace(",", "."))}" file="result_{time}.vtu"/>'
        for time in ("0,0", "0,25", "0,5")
    ]
    (tmp_path / "all.pvd").write_text(
        f'<VTKFile type="Collection"><Collection>{"".join(listed)}</Collection></VTKFile>'
    )
    assert "notes" not in read_series(tmp_path / "all.pvd", NAMES).attributes


MARKED = {
    "a.msh": "gmsh",
    "b.msh": "gmsh22",
    "a.mesh": None,
    "a.bdf": None,
    "a.avs": None,
    "a.vtk": None,
    "a.vtu": None,
    "a.inp": None,
}


@pytest.mark.parametrize("name", MARKED)
def test_texts_may_begin_with_the_mark_of_utf_8(tmp_path, name):
    """Some editors of Windows put it there."""
    options = {} if name in ("a.mesh", "a.bdf", "a.avs", "a.inp") else {"binary": False}
    meshio.Mesh(CUBE.rest_position.astype(float), [("tetra", CUBE.elements)]).write(
        tmp_path / name, MARKED[name], **options
    )
    plain = read_mesh(tmp_path / name)
    (tmp_path / name).write_bytes(b"\xef\xbb\xbf" + (tmp_path / name).read_bytes())
    marked = read_mesh(tmp_path / name)
    assert marked.path == tmp_path / name
    np.testing.assert_array_equal(marked.points, plain.points)
    np.testing.assert_array_equal(marked.elements, plain.elements)


def test_errors_of_a_marked_text_name_the_file(tmp_path):
    (tmp_path / "a.msh").write_bytes(b"\xef\xbb\xbf$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Nodes\n1 2")
    with pytest.raises(DatasetError, match=f"^{tmp_path / 'a.msh'}: "):
        read_mesh(tmp_path / "a.msh")

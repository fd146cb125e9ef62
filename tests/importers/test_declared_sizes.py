"""VTU files whose compressed arrays are larger than the file says."""

import base64
import lzma
import re
import resource
import zlib

import meshio
import numpy as np
import pytest
import pyvista
from data_samples import block
from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter, vtkXMLUnstructuredGridWriter

from ast_sim.importers.mesh_file import read_mesh
from ast_sim.support.errors import DatasetError

SCENE = block(2, 2, 2)
PACKERS = {"zlib": zlib.compress, "lzma": lzma.compress}


def compressed(data: bytes, pack, parts=1) -> tuple[bytes, bytes]:
    """One block, as VTK stores it: the number of blocks, their size, the size of the last, the compressed sizes."""
    packed = b"".join(pack(data) for _ in range(parts))
    return np.array([1, len(data) * parts, len(data) * parts, len(packed)], "<u4").tobytes(), packed


def write(path, compression, **point):
    mesh = meshio.Mesh(SCENE.rest_position, [("tetra", SCENE.elements)], point)
    meshio.write(path, mesh, file_format="vtu", compression=compression)
    return path


def with_array(path, name, head, packed):
    text = path.read_text()
    data = (base64.b64encode(head) + base64.b64encode(packed)).decode()
    changed = re.sub(rf'(<DataArray[^>]*Name="{name}"[^>]*>)[^<]*', rf"\g<1>{data}", text)
    assert changed != text
    path.write_text(changed)


@pytest.mark.parametrize("compression", PACKERS)
@pytest.mark.parametrize("name", ["von_mises", "Points", "connectivity", "types"])
def test_an_array_that_unpacks_to_too_much_is_refused_before_it_is_unpacked(tmp_path, compression, name):
    path = write(tmp_path / "a.vtu", compression, von_mises=np.ones(SCENE.num_nodes))
    assert read_mesh(path).points.shape == (SCENE.num_nodes, 3)
    with_array(path, name, *compressed(bytes(1 << 28), PACKERS[compression]))
    assert path.stat().st_size < 1 << 20
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(DatasetError, match=f"{path}: the array {name} unpacks to more than [0-9]+ bytes, which is all"):
        read_mesh(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # KiB; the array has 262,144


def test_several_streams_in_one_block_are_counted_together(tmp_path):
    path = write(tmp_path / "a.vtu", "lzma", von_mises=np.ones(SCENE.num_nodes))
    with_array(path, "von_mises", *compressed(bytes(200), lzma.compress, parts=2))
    with pytest.raises(DatasetError, match="the array von_mises unpacks to more than 216 bytes"):
        read_mesh(path)


def appended(path, raw: bool, factor: int = 1, same: bool = False):
    """The scene with all arrays in one appended block, as VTK itself writes them; `factor` repeats each array."""
    arrays = {
        "Points": ("Float32", SCENE.rest_position, 3),
        "connectivity": ("Int64", SCENE.elements.astype(np.int64), 1),
        "offsets": ("Int64", 4 * np.arange(1, SCENE.num_elements + 1), 1),
        "types": ("UInt8", np.full(SCENE.num_elements, 10, np.uint8), 1),
    }
    tags, data = {}, b""
    for name, (kind, values, columns) in arrays.items():
        head, packed = compressed(values.tobytes() * factor, zlib.compress)
        offset = 0 if same else len(data)
        tags[name] = (
            f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{columns}" format="appended"'
            f' offset="{offset}"/>'
        )
        data += head + packed if raw else base64.b64encode(head) + base64.b64encode(packed)
    encoding = "raw" if raw else "base64"
    text = (
        '<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian" header_type="UInt32"'
        f' compressor="vtkZLibDataCompressor">\n<UnstructuredGrid><Piece NumberOfPoints="{SCENE.num_nodes}"'
        f' NumberOfCells="{SCENE.num_elements}">\n<Points>{tags.pop("Points")}</Points><Cells>'
        f"{''.join(tags.values())}</Cells></Piece></UnstructuredGrid>\n"
        f'<AppendedData encoding="{encoding}">\n_'
    )
    path.write_bytes(text.encode() + data + b"\n</AppendedData>\n</VTKFile>\n")
    return path


@pytest.mark.parametrize("raw", [True, False])
def test_appended_arrays(tmp_path, raw):
    assert np.array_equal(read_mesh(appended(tmp_path / "a.vtu", raw)).elements, SCENE.elements)
    with pytest.raises(DatasetError, match="the array Points unpacks to more than 324 bytes"):
        read_mesh(appended(tmp_path / "a.vtu", raw, factor=2))
    with pytest.raises(DatasetError, match="the array connectivity shares its data with another array"):
        read_mesh(appended(tmp_path / "a.vtu", raw, same=True))


def written_by_vtk(path, **facts):
    grid = pyvista.from_meshio(meshio.Mesh(SCENE.rest_position, [("tetra", SCENE.elements)]))
    for name, values in facts.items():
        grid.field_data[name] = values
    writer = vtkXMLUnstructuredGridWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(grid)
    assert writer.Write() == 1
    return path


def test_facts_on_the_whole_file_may_be_many(tmp_path):
    path = written_by_vtk(tmp_path / "a.vtu", history=np.random.default_rng(0).normal(size=200_000))
    assert len(read_mesh(path).points) == SCENE.num_nodes


@pytest.mark.parametrize("before", [0, 1, 7, 12, 13])
def test_the_tag_before_the_data_may_stand_anywhere(tmp_path, before):
    """Files are looked through in chunks of a MiB."""
    path = written_by_vtk(tmp_path / "a.vtu")
    data = path.read_bytes()
    fill = (1 << 20) - before - len("<!---->") - data.index(b"<AppendedData")
    path.write_bytes(data.replace(b"<UnstructuredGrid>", b"<UnstructuredGrid><!--" + b"x" * fill + b"-->", 1))
    assert len(read_mesh(path).points) == SCENE.num_nodes


def test_arrays_at_the_end_of_a_file_may_be_short(tmp_path):
    """Strips of triangles have two short arrays, which stand last; they were called damaged."""
    writer = vtkXMLPolyDataWriter()
    writer.SetFileName(str(tmp_path / "a.vtp"))
    writer.SetInputData(pyvista.Cube().triangulate().strip())
    assert writer.Write() == 1
    assert len(read_mesh(tmp_path / "a.vtp").elements) == 12

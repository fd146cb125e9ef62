"""XDMF as PETSc's petsc_gen_xdmf.py and PyLith write it: no version, items beside the grids, times in a list."""

import h5py
import numpy as np
import pytest
from data_samples import block

from ast_sim.importers.frames_in_file import frames_in
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.support.errors import DatasetError

CUBE = block(1, 1, 1)
POINTS = CUBE.rest_position.astype(float)
CELLS = CUBE.elements
PUSH = np.stack([POINTS * (0, 0, -step / 10) for step in range(3)])
HELD = np.repeat((POINTS[:, 2] == 0).astype(float)[None, :, None], 3, axis=0)
HEAD = '<?xml version="1.0" ?>\n<!DOCTYPE Xdmf SYSTEM "Xdmf.dtd" [\n<!ENTITY HeavyData "job.h5">\n]>\n\n<Xdmf>\n'
TIMES = '<Time TimeType="List"><DataItem Format="XML" Dimensions="3">0.0 0.5 2.5\n</DataItem></Time>'


def item(name):
    return f'<DataItem Reference="XML">\n /Xdmf/Domain/DataItem[@Name="{name}"]\n</DataItem>'


def plain(name, shape, place):
    return (
        f'<DataItem Name="{name}" Format="HDF" NumberType="Float" Dimensions="{shape}">&HeavyData;:/{place}</DataItem>'
    )


def slab(start, count, of, place):
    numbers = f'<DataItem Dimensions="3 {len(start)}" Format="XML">{start} {[1] * len(start)} {count}</DataItem>'
    numbers = numbers.translate(str.maketrans("[],", "   "))
    source = f'<DataItem Format="HDF" Dimensions="{of}">&HeavyData;:/{place}</DataItem>'
    shape = " ".join(map(str, count))
    return f'<DataItem ItemType="HyperSlab" Dimensions="{shape}" Type="HyperSlab">{numbers}{source}</DataItem>'


def field(name, step, columns, first=0):
    count = [1, len(POINTS), columns]
    values = slab([step, 0, first], count, "3 8 3", f"vertex_fields/{name.partition('.')[0]}")
    return f'<Attribute Name="{name}" Type="Vector" Center="Node">{values}</Attribute>'


def grid(fields="", points="vertices"):
    topology = f'<Topology TopologyType="Tetrahedron" NumberOfElements="{len(CELLS)}">{item("cells")}</Topology>'
    geometry = f'<Geometry GeometryType="XYZ">{item(points)}</Geometry>'
    return f'<Grid Name="domain" GridType="Uniform">{topology}{geometry}{fields}</Grid>'


def written(folder, content, points=POINTS):
    with h5py.File(folder / "job.h5", "w") as file:
        file["geometry/vertices"], file["viz/topology/cells"] = points, CELLS.astype(float)
        file["vertex_fields/u"], file["vertex_fields/marks"] = PUSH, np.concatenate([HELD, 2 * HELD], axis=2)
    path = folder / "job.xmf"
    items = plain("cells", f"{len(CELLS)} 4", "viz/topology/cells") + plain("vertices", "8 3", "geometry/vertices")
    path.write_text(
        f'{HEAD}<Domain Name="domain">{content if points is not POINTS else items + content}</Domain></Xdmf>'
    )
    return path


def series(times=TIMES):
    steps = "".join(grid(field("u", n, 3) + field("marks.0", n, 1) + field("marks.1", n, 1, 1)) for n in range(3))
    return f'<Grid Name="TimeSeries" GridType="Collection" CollectionType="Temporal">{times}{steps}</Grid>'


def test_a_series_is_a_simulation_with_its_fields_and_times(tmp_path):
    path = written(tmp_path, series())
    frames = list(frames_in(path))
    assert [frame.time for frame in frames] == [0, 0.5, 2.5]
    assert np.array_equal(frames[2].point_fields["u"], PUSH[2])
    assert np.array_equal(frames[1].point_fields["marks.1"].ravel(), 2 * HELD[0].ravel())
    moved = read_series(path, FieldNames(displacement="u", handle="marks.0"))
    assert moved.position == pytest.approx(POINTS + PUSH, abs=1e-6)
    slabs = '<Time TimeType="HyperSlab"><DataItem Format="XML" Dimensions="3">1.0 0.5 3</DataItem></Time>'
    assert [frame.time for frame in frames_in(written(tmp_path, series(slabs)))] == [1, 1.5, 2]


def test_a_mesh_alone_and_flat_points_with_a_column_of_zeros(tmp_path):
    (mesh,) = frames_in(written(tmp_path, grid()))
    assert np.array_equal(mesh.points, POINTS) and np.array_equal(mesh.blocks[0].nodes, CELLS)
    columns = [slab([0, axis], [8, 1], "8 1", "geometry/vertices") for axis in (0, 1)]
    inner = '<DataItem Reference="XML">/Xdmf/Domain/DataItem[@Name="vertices"]/DataItem[@Name="x"]</DataItem>'
    columns = [columns[0].replace("<DataItem ", '<DataItem Name="x" ', 1), columns[1]]
    zeros = f'<DataItem ItemType="Function" Dimensions="8 1" Function="0*$0">{inner}</DataItem>'
    joined = '<DataItem Name="vertices" ItemType="Function" Dimensions="8 3" Function="JOIN($0, $1, $2)">'
    joined = f"{joined}{''.join([*columns, zeros])}</DataItem>"
    cells = plain("cells", f"{len(CELLS)} 4", "viz/topology/cells")
    (flat,) = frames_in(written(tmp_path, cells + joined + grid(), POINTS[:, :2]))
    assert np.array_equal(flat.points, POINTS * (1, 1, 0))


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (series(TIMES.replace("2.5", "")), "lists 2 times for 3 frames"),
        (series(TIMES.replace("2.5", "late")), "the times of a series are no numbers"),
        (series().replace("</Topology>", '</Topology><Time Value="9" />', 1), "some have a Time of their own"),
        (grid(points="corners"), "refers to .*corners.*, which it does not hold"),
        (
            f'<DataItem Name="a" Dimensions="8 3">{item("b")}</DataItem><DataItem Name="b" Dimensions="8 3">{item("a")}'
            f"</DataItem>{grid(points='a')}",
            "refers to itself",
        ),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, content, told):
    path = written(tmp_path, content)
    with pytest.raises(DatasetError, match=told):
        list(frames_in(path))

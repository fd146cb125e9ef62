"""Fields that may be read in two ways: the components of a stress, marks, points of Bezier cells, numbers of files."""

import meshio
import numpy as np
import pytest
import pyvista
from data_samples import block

from ast_sim.importers.mesh_file import read_mesh
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.importers.stress import parse_order, stems_of
from ast_sim.plausibility.motion import in_trajectory
from ast_sim.simulate.shapes.mesh import second_order
from ast_sim.support.errors import ConfigError, DatasetError

CUBE = block(1, 1, 1)
POINTS = CUBE.rest_position.astype(float)
NODES, ELEMENTS = len(POINTS), len(CUBE.elements)
TENSOR = {"xx": 1.0, "yy": 2.0, "zz": 4.0, "xy": 8.0, "yx": 8.0, "yz": 16.0, "zy": 16.0, "xz": 32.0, "zx": 32.0}
IN_SPACE = float(np.sqrt(7 + 3 * (8**2 + 16**2 + 32**2)))
OF_XDMF = ("xx", "xy", "xz", "yy", "yz", "zz")
FULL = ("xx", "xy", "xz", "yx", "yy", "yz", "zx", "zy", "zz")


def pressed(frame):
    return POINTS * (0, 0, -0.1 * frame)


def columns(order, frame):
    return np.tile([frame * TENSOR[component] for component in order], (NODES, 1))


def as_xdmf(folder, order):
    with meshio.xdmf.TimeSeriesWriter(folder / "a.xdmf", data_format="XML") as writer:
        writer.write_points_cells(POINTS, [("tetra", CUBE.elements)])
        for frame in range(3):
            fields = {"displacement": pressed(frame), "s": columns(order, frame)}
            writer.write_data(frame, point_data=fields)
    return folder / "a.xdmf"


FLAT = ("triangle", CUBE.elements[:, :3])
PLANE = ("xx", "yy", "zz", "xy")


def as_vtu(folder, fields, of_cells=None, names="f_{}.vtu", kind=("tetra", CUBE.elements)):
    folder.mkdir(exist_ok=True)
    for frame in range(3):
        points = {"displacement": pressed(frame), **{name: make(frame) for name, make in fields.items()}}
        cells = {name: [make(frame)] for name, make in (of_cells or {}).items()}
        mesh = meshio.Mesh(POINTS, [kind], point_data=points, cell_data=cells)
        mesh.write(folder / names.format(frame))
    return folder


def read(source, **names):
    return read_series(source, FieldNames(handle=names.pop("handle", "0:zmin"), **names))


def notes(trajectory):
    return str(trajectory.attributes.get("notes", ""))


@pytest.mark.parametrize("order", [OF_XDMF, ("xx", "yy", "zz", "xy", "yz", "xz")])
def test_six_components_in_xdmf_need_their_order(tmp_path, order):
    """XDMF's Tensor6 has another order than programs in their arrays, and meshio writes arrays as they are."""
    path = as_xdmf(tmp_path, order)
    with pytest.raises(DatasetError, match=r"a.xdmf: the order of the 6 components of 's' is not certain: XDMF's own"):
        read(path, stress="s")
    assert read(path, stress="s", stress_order=order).stress[2].max() == pytest.approx(2 * IN_SPACE)


def test_nine_components_in_xdmf_need_no_order(tmp_path):
    assert read(as_xdmf(tmp_path, FULL), stress="s").stress[2].max() == pytest.approx(2 * IN_SPACE)


@pytest.mark.parametrize("order", [("xx", "yy", "zz", "xy"), ("xx", "xy", "yx", "yy")])
def test_four_components_of_which_two_are_equal_need_their_order(tmp_path, order):
    source = as_vtu(tmp_path, {"s": lambda frame: columns(order, frame)}, kind=FLAT)
    if order[1] == "xy":
        with pytest.raises(DatasetError, match="the second and the third are equal in all rows, as xy and yx are"):
            read(source, stress="s")
        assert read(source, stress="s", stress_order=order).stress[2].max() == pytest.approx(2 * np.sqrt(3 + 3 * 8**2))
    else:
        assert read(source, stress="s").stress[2].max() == pytest.approx(2 * np.sqrt(7 + 3 * 8**2))


def test_no_stress_across_the_plane_is_no_doubt(tmp_path):
    source = as_vtu(tmp_path, {"s": lambda frame: columns(PLANE, frame) * (1, 0, 0, 1)}, kind=FLAT)
    assert read(source, stress="s").stress[2].max() == pytest.approx(2 * np.sqrt(1 + 3 * 8**2))


def test_four_components_of_a_body_with_a_volume_need_their_order(tmp_path):
    source = as_vtu(tmp_path, {"s": lambda frame: columns(PLANE, frame)})
    with pytest.raises(DatasetError, match="'s' has the components xx, yy, zz, xy, and .* of a body with a volume has"):
        read(source, stress="s")
    assert read(source, stress="s", stress_order=PLANE).stress[2].max() == pytest.approx(2 * np.sqrt(7 + 3 * 8**2))


@pytest.mark.parametrize(("one", "other"), [("xy", "yx"), ("yz", "zy"), ("xz", "zx")])
@pytest.mark.parametrize("how", ["nine columns", "nine fields", "rows in fields", "in the plane"])
def test_a_stress_that_is_not_symmetric_is_refused(tmp_path, one, other, how):
    """The first Piola-Kirchhoff stress is none from which a von Mises stress follows; noise at rest is no reason."""

    def tensor(frame, share):
        values = columns(FULL, frame) + 1e-12 * np.arange(9) * (frame == 0)
        values[3, FULL.index(other)] *= share
        return values

    fields = {
        "nine columns": lambda share: {"P": lambda frame: tensor(frame, share)},
        "nine fields": lambda share: {
            f"P_{part}": lambda frame, at=at: tensor(frame, share)[:, at] for at, part in enumerate(FULL)
        },
        "rows in fields": lambda share: {
            f"P_{axis}": lambda frame, at=at: tensor(frame, share)[:, 3 * at : 3 * at + 3]
            for at, axis in enumerate("xyz")
        },
        "in the plane": lambda share: {"P": lambda frame: tensor(frame, share)[:, [0, 1, 3, 4]]},
    }[how]
    more = {"stress_order": ("xx", "xy", "yx", "yy")} if how == "in the plane" else {}
    assert read(as_vtu(tmp_path, fields(1.0005), kind=FLAT), stress="P", **more).stress[2].max() > 0
    if more and one != "xy":
        return
    with pytest.raises(DatasetError, match=f"'P' is not symmetric: {one} and {other} differ by up to .* in f_2.vtu"):
        read(as_vtu(tmp_path, fields(0.9), kind=FLAT), stress="P", **more)


@pytest.mark.parametrize(("names", "right"), [("SX SXY SXZ SY SYZ SZ", True), ("XX XY XZ YY YZ Z1", False)])
def test_the_names_of_columns_are_their_order_or_refused(tmp_path, names, right):
    for frame in range(3):
        grid = pyvista.from_meshio(meshio.Mesh(POINTS, [("tetra", CUBE.elements)]))
        grid.point_data["displacement"], grid.point_data["s"] = pressed(frame), columns(OF_XDMF, frame)
        for column, name in enumerate(names.split()):
            grid.point_data.GetArray("s").SetComponentName(column, name)
        grid.save(tmp_path / f"f_{frame}.vtu")
    if right:
        assert read(tmp_path, stress="s").stress[2].max() == pytest.approx(2 * IN_SPACE)
        return
    with pytest.raises(DatasetError, match="the columns of 's' are called XX, XY, XZ, YY, YZ, Z1, which is no order"):
        read(tmp_path, stress="s")
    assert read(tmp_path, stress="s", stress_order=OF_XDMF).stress[2].max() == pytest.approx(2 * IN_SPACE)


@pytest.mark.parametrize("text", ["xx,yy,zz,xy", "xx,xy,yx,yy", "xx,xy,xz,yy,yz,zz", ",".join(FULL)])
def test_an_order_has_each_component_once(text):
    order = parse_order(text)
    for wrong in (order[1:], (order[1], *order[1:]), ("ab", *order[1:])):
        with pytest.raises(ConfigError, match="is no order of the components of a stress"):
            parse_order(",".join(wrong))


def test_an_order_in_python_has_components_only(tmp_path):
    source = as_vtu(tmp_path, {"s": lambda frame: columns(OF_XDMF, frame)})
    with pytest.raises(DatasetError, match="a, b, c, d, e, f is no order of the components of 's'"):
        read(source, stress="s", stress_order=tuple("abcdef"))


def of_components(pattern, order=OF_XDMF, axes="xyz"):
    """Fields whose names end with their component, in alphabetical order of neither the names nor the components."""
    place = str.maketrans("xyz", axes)
    return {pattern.format(one.translate(place)): (lambda frame, one=one: columns([one], frame)) for one in order}


@pytest.mark.parametrize(
    ("stress", "pattern", "axes"),
    [
        ("S", "S{}", "123"),
        ("stress", "stress_{}", "xyz"),
        ("stress_", "Stress_{}", "XYZ"),
        ("sigma", "sigma-{}", "xyz"),
    ],
)
@pytest.mark.parametrize("order", [OF_XDMF, OF_XDMF[::-1], FULL])
@pytest.mark.parametrize("at", ["node", "element"])
def test_a_stress_in_fields_of_its_components_is_put_together(tmp_path, stress, pattern, axes, order, at):
    fields = of_components(pattern, order, axes)
    if at == "element":
        fields = {name: (lambda frame, make=make: make(frame)[:ELEMENTS]) for name, make in fields.items()}
    result = read(as_vtu(tmp_path, *((fields,) if at == "node" else ({}, fields))), stress=stress)
    assert result.stress_at == at
    np.testing.assert_allclose(result.stress[:, 0, 0], [0, IN_SPACE, 2 * IN_SPACE], rtol=1e-6)
    listed = "xx, xy, xz, yx, yy, yz, zx, zy, zz" if order == FULL else "xx, yy, zz, xy, yz, xz"
    assert f"is computed from the components {listed} of '{stress}'" in notes(result)


def test_normal_stresses_of_one_letter_are_components(tmp_path):
    fields = {
        name: (lambda frame, one=one: columns([one], frame))
        for name, one in {"SX": "xx", "SY": "yy", "SZ": "zz", "SXY": "xy", "SYZ": "yz", "SXZ": "xz"}.items()
    }
    assert read(as_vtu(tmp_path, fields), stress="S").stress[2].max() == pytest.approx(2 * IN_SPACE)


def test_an_order_takes_components_by_their_names(tmp_path):
    source = as_vtu(tmp_path, of_components("S{}", OF_XDMF, "123"))
    assert read(source, stress="S", stress_order=FULL).stress[2].max() == pytest.approx(2 * IN_SPACE)


def test_components_that_are_missing_or_stand_twice_are_refused(tmp_path):
    part = as_vtu(tmp_path / "part", of_components("s_{}", ("xx", "yy", "zz", "xy", "yz")))
    with pytest.raises(DatasetError, match="of the components of 's', xz are missing; there are s_xx, s_yy, s_zz"):
        read(part, stress="s")
    twice = as_vtu(tmp_path / "twice", of_components("S{}") | of_components("S{}", ("xx",), "123"))
    with pytest.raises(DatasetError, match="the component xx of 'S' is 'Sxx' and 'S11'|is 'S11' and 'Sxx'"):
        read(twice, stress="S")
    pairs = as_vtu(tmp_path / "pairs", of_components("s_{}") | {"s_xy": lambda frame: np.ones((NODES, 2))})
    with pytest.raises(DatasetError, match="the field 's_xy' must have one number in each row"):
        read(pairs, stress="s")
    one = as_vtu(tmp_path / "one", of_components("s_{}"))
    with pytest.raises(DatasetError, match="'s_xy' is one component of a stress: name what all have, 's'"):
        read(one, stress="s_xy")
    with pytest.raises(DatasetError, match="no field 'sig'; .*is named by what these have in common: 's'"):
        read(one, stress="sig")
    assert stems_of(["displacement_x", "displacement_y", "displacement_z", "S_Mises", "max", "fix"]) == []


def test_a_frame_that_lacks_a_component_is_refused(tmp_path):
    source = as_vtu(tmp_path, of_components("s_{}"))
    mesh = meshio.read(source / "f_2.vtu")
    del mesh.point_data["s_yz"]
    mesh.write(source / "f_2.vtu")
    with pytest.raises(DatasetError, match=r"f_2.vtu: of the components of 's', yz are missing"):
        read(source, stress="s")


def test_a_stress_at_points_and_in_cells_is_told(tmp_path):
    at_points = {"von_mises": lambda frame: np.full(NODES, 1.0 * frame)}
    trajectory = read(as_vtu(tmp_path, at_points, {"von_mises": lambda frame: np.full(ELEMENTS, 7.0 * frame)}))
    assert trajectory.stress.max() == 2 and trajectory.stress_at == "node"
    assert "'von_mises' is a field of points and one of cells: the one of points is taken" in notes(trajectory)


@pytest.mark.parametrize(("lowest", "count"), [(-1.0, 2 * NODES // 2), (-0.04, 0), (0.0, 0)])
@pytest.mark.parametrize("at", ["node", "element"])
def test_a_negative_von_mises_stress_is_told(tmp_path, lowest, count, at):
    size = NODES if at == "node" else ELEMENTS
    made = {"von_mises": lambda frame: frame * np.where(np.arange(size) % 2, 1.0, lowest)}
    trajectory = read(as_vtu(tmp_path, made) if at == "node" else as_vtu(tmp_path, {}, made))
    told = [one for one in in_trajectory(trajectory) if one.what == "stresses below zero"]
    assert [one.count for one in told] == ([count * size // NODES] if count else [])
    assert all("the lowest is -2 in frame 2" in str(one) for one in told)


@pytest.mark.parametrize(("unmarked", "told"), [(-1, True), (0, False), (np.nan, False)])
def test_marks_below_zero_are_told(tmp_path, unmarked, told):
    mark = np.where(POINTS[:, 2] == 0, 1, unmarked)
    trajectory = read(as_vtu(tmp_path, {"fix": lambda _: mark}), handle="fix")
    assert trajectory.scene.prescribed.sum() == (NODES if told else NODES // 2)
    assert (
        "the field 'fix' is negative at 4 nodes: they are marked, as all where it is not 0" in notes(trajectory)
    ) == told


@pytest.mark.parametrize(
    ("handle", "obstacle", "told"),
    [
        (POINTS[:, 2] == 0, 0 * POINTS[:, 2], "'tool' marks no node"),
        (0 * POINTS[:, 2], POINTS[:, 2] >= 0, "'fix' marks no node"),
        (POINTS[:, 2] == 0, POINTS[:, 2] >= 0, "4 nodes of 'fix' are in 'tool', too: obstacles, not handles"),
        (POINTS[:, 2] == 0, POINTS.sum(axis=1) == 3, "1 node of 'tool' belongs to a body that deforms, and an obst"),
        (POINTS[:, 2] == 0, POINTS[:, 2] == 1, ""),
    ],
)
def test_marks_that_say_nothing_or_two_things_are_told(tmp_path, handle, obstacle, told):
    source = as_vtu(tmp_path, {"fix": lambda _: 1.0 * handle, "tool": lambda _: 1.0 * obstacle})
    said = notes(read(source, handle="fix", obstacle="tool"))
    assert told in said and ("mark" in said or "'tool'" in said) == bool(told)


@pytest.mark.parametrize("same", [True, False])
def test_a_field_with_the_name_of_a_group_of_other_nodes_is_told(tmp_path, same):
    corners = "1 0 0 0\n2 1 0 0\n3 0 1 0\n4 0 0 1\n5 1 1 1\n"
    marked = range(1, 5) if same else (1, 5)
    for frame in range(2):
        moved = "".join(f"{node} 0 0 {-0.1 * frame * node}\n" for node in range(1, 6))
        marks = "".join(f"{node} 1\n" for node in marked)
        (tmp_path / f"f{frame}.msh").write_text(
            '$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$PhysicalNames\n1\n3 1 "tool"\n$EndPhysicalNames\n'
            f"$Nodes\n5\n{corners}$EndNodes\n$Elements\n2\n1 4 2 1 1 1 2 3 4\n2 4 2 0 1 2 3 4 5\n$EndElements\n"
            f'$NodeData\n1\n"displacement"\n1\n{frame}\n3\n0\n3\n5\n{moved}$EndNodeData\n'
            f'$NodeData\n1\n"tool"\n1\n{frame}\n3\n0\n1\n{len(marked)}\n{marks}$EndNodeData\n'
        )
    result = read(tmp_path, handle="tool")
    assert ("'tool' is a field of points and a group of other nodes: the field is taken" in notes(result)) != same
    assert result.scene.prescribed.sum() == len(marked)


@pytest.mark.parametrize(("kind", "nodes"), [(24, 10), (71, 10), (78, 4)])
def test_points_of_bezier_cells_are_no_nodes(tmp_path, kind, nodes):
    """The curve of an edge passes beside its point in the middle, and fields have no values there."""
    points, elements = second_order(POINTS, CUBE.elements)
    cells = np.column_stack([np.full(len(elements), 10), elements]).ravel()
    pyvista.UnstructuredGrid(cells, np.full(len(elements), kind), points).save(tmp_path / "a.vtu")
    mesh = read_mesh(tmp_path / "a.vtu")
    assert mesh.elements.shape == (ELEMENTS, nodes)
    assert ("6 cells of the kind Bezier tetra10 keep their corners only" in mesh.notes) == (nodes == 4)


@pytest.mark.parametrize("copy", ["f_01.vtu", "f_1.VTU", "f_001.vtu"])
def test_two_files_of_one_number_are_told(tmp_path, copy):
    source = as_vtu(tmp_path, {})
    (source / copy).write_bytes((source / "f_1.vtu").read_bytes())
    assert "have one number: is one a copy of the other?" in notes(read(source))


@pytest.mark.parametrize(("name", "deleted"), [("STATUS", True), ("EROSION_STATUS", True), ("STATUS", False)])
def test_elements_that_a_field_calls_deleted_are_told(tmp_path, name, deleted):
    alive = {name: lambda frame: np.where((np.arange(ELEMENTS) < 2) & deleted & (frame == 2), 0, 1)}
    result = read(as_vtu(tmp_path, {}, alive))
    told = f"the field '{name}' changes in 2 rows of f_2.vtu: are elements deleted? All are kept"
    assert (told in notes(result)) == deleted


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("first", [0, 2])
def test_positions_that_are_named_as_the_displacement_are_refused(tmp_path, moving, first):
    """Such as COORD of Abaqus, or the deflected coordinates of LS-DYNA; the nodes would lie twice as far out."""
    for frame in range(3):
        position = POINTS + pressed(frame + first)
        mesh = meshio.Mesh(position if moving else POINTS, [("tetra", CUBE.elements)])
        mesh.point_data = {"COORD": position + 7.0, "U": pressed(frame + first)}
        mesh.write(tmp_path / f"f_{frame}.vtu")
    with pytest.raises(DatasetError, match="the displacement holds positions: in the first frame it is about the poi"):
        read(tmp_path, displacement="COORD")
    moved = read(tmp_path, displacement="U").position
    np.testing.assert_allclose(moved[2], POINTS + pressed(2 + first), atol=1e-6)


@pytest.mark.parametrize(("unit", "pascals"), [(None, 1), ("MPa", 1e6), ("psi", 6894.757293168)])
def test_the_unit_of_stress_is_the_one_of_moduli_too(tmp_path, unit, pascals):
    made = {"E": 200.0, "nu": 0.3, "Y": 3.0, "E2": 7.0, "von_mises": 5.0}
    source = as_vtu(tmp_path, {}, {name: (lambda _, one=one: np.full(ELEMENTS, one)) for name, one in made.items()})
    names = ("young=E", "poisson=nu", "yield_stress=Y", "E2")
    result = read(source, stress_unit=unit, material=names)
    np.testing.assert_allclose(result.scene.material[0], [200 * pascals, 0.3, 3 * pascals, 7], rtol=1e-6)
    np.testing.assert_allclose(result.stress.max(), 5 * pascals, rtol=1e-6)

"""One mesh as a scene: a plate and a punch made with meshio, every way to say what is prescribed, and every error."""

import subprocess
import sys
from dataclasses import fields, replace

import data_samples
import meshio
import numpy as np
import pytest
from meshes import plate_and_punch

from ast_sim.importers.mesh_file import read_mesh
from ast_sim.importers.scene_mesh import parse_clamp, parse_material, read_scene
from ast_sim.scene import NodeType
from ast_sim.support.errors import ConfigError, DatasetError

NORMAL, OBSTACLE, HANDLE = (int(kind) for kind in NodeType)


MESH = plate_and_punch()
POINTS, TETS = MESH.points, MESH.cells_dict["tetra"]
PLATE = POINTS[:, 2] <= 0.04
PRESCRIBED = {"obstacles": [1], "clamps": ["0:xmin,xmax"]}


def with_fields(point=None, cell=None, tets=TETS, points=POINTS, extra=()):
    cell = {name: [values, *(np.zeros(len(c)) for _, c in extra)] for name, values in (cell or {}).items()}
    return meshio.Mesh(points, [("tetra", tets), *extra], point or {}, cell)


def test_a_plate_and_a_punch():
    found = read_scene(MESH, **PRESCRIBED)
    scene = found.scene
    assert np.array_equal(scene.rest_position, POINTS.astype(np.float32)) and np.array_equal(scene.elements, TETS)
    assert scene.body.tolist() == [0] * 243 + [1] * 27 and scene.material is None
    clamped = PLATE & (np.abs(POINTS[:, 0]) == 0.2)
    assert np.array_equal(scene.node_type, np.where(PLATE, np.where(clamped, HANDLE, NORMAL), OBSTACLE))
    assert found.notes == [] and found.description == [
        "2 bodies, 270 nodes, 816 tetrahedra",
        "body 0: 243 nodes (189 normal, 54 handle), 768 tetrahedra, x -0.2 to 0.2, y -0.2 to 0.2, z 0 to 0.04",
        "body 1: 27 nodes (27 obstacle), 48 tetrahedra, x -0.05 to 0.05, y -0.05 to 0.05, z 0.041 to 0.141",
    ]


@pytest.mark.parametrize("name", ["a.vtu", "a.vtk", "a.msh", "a.inp", "a.xdmf", "a.mesh"])
@pytest.mark.parametrize("path_type", [str, lambda path: path])
def test_files_give_what_the_mesh_gives(tmp_path, name, path_type, capfd):
    meshio.write(tmp_path / name, MESH)
    capfd.readouterr()
    found = read_scene(path_type(tmp_path / name), **PRESCRIBED).scene
    given = read_scene(MESH, **PRESCRIBED).scene
    np.testing.assert_allclose(found.rest_position, given.rest_position, rtol=0, atol=1e-7)
    for array in ("elements", "node_type", "body"):
        assert np.array_equal(getattr(found, array), getattr(given, array)), array
    assert capfd.readouterr() == ("", "")


def test_the_triangles_of_an_stl_file(tmp_path):
    faces = read_scene(MESH, **PRESCRIBED).scene.surface()
    meshio.write(tmp_path / "a.stl", meshio.Mesh(POINTS, {"triangle": faces}), binary=True)
    scene = read_scene(tmp_path / "a.stl", obstacles=[1]).scene
    assert scene.elements.shape == (2 * (64 * 2 + 16 * 4) + 48, 3)
    assert np.array_equal(scene.rest_position[scene.elements], POINTS.astype(np.float32)[faces])
    assert np.bincount(scene.body).tolist() == [2 * 81 + 32, 26]


def test_an_stl_file_in_capitals_and_one_that_is_cut_off(tmp_path):
    faces = read_scene(MESH, **PRESCRIBED).scene.surface()
    meshio.write(tmp_path / "a.stl", meshio.Mesh(POINTS, {"triangle": faces}), binary=False)
    text = (tmp_path / "a.stl").read_text()
    (tmp_path / "b.stl").write_text(text.upper())
    scene = read_scene(tmp_path / "b.stl", obstacles=[1]).scene
    np.testing.assert_allclose(scene.rest_position[scene.elements], POINTS[faces], rtol=1e-6)
    (tmp_path / "b.stl").write_text(text[: len(text) // 2])
    with pytest.raises(DatasetError, match="b.stl: cannot be read as a mesh: it is cut off after"):
        read_scene(tmp_path / "b.stl")


def surface(scene):
    """The triangles of the surface of a scene as text, without the lines of a solid."""
    facet = "facet normal 0 0 0\nouter loop\n{}endloop\nendfacet\n"
    corners = scene.rest_position[scene.surface()]
    return [facet.format("".join(f"vertex {x} {y} {z}\n" for x, y, z in one)) for one in corners.tolist()]


@pytest.mark.parametrize("gap", [0.0, 0.5])
def test_closed_solids_of_an_stl_file_are_bodies(tmp_path, gap):
    """Where they touch, their corners are not joined."""
    cube = data_samples.block(1, 1, 1)
    above = replace(cube, rest_position=cube.rest_position + np.float32([0, 0, 1 + gap]))
    parts = [f"solid {name}\n{''.join(surface(one))}endsolid\n" for name, one in (("low", cube), ("top", above))]
    (tmp_path / "a.stl").write_text("".join(parts))
    mesh = read_mesh(tmp_path / "a.stl")
    assert len(mesh.points) == 16 and len(mesh.elements) == 24 and not mesh.notes
    scene, _ = mesh.scene(None, None)
    assert np.bincount(scene.body).tolist() == [8, 8]


@pytest.mark.parametrize("cut", [1, 6])
def test_patches_of_one_surface_in_an_stl_file_are_one_body(tmp_path, cut):
    facets = surface(data_samples.block(1, 1, 1))
    parts = [f"solid {name}\n{''.join(some)}endsolid\n" for name, some in (("a", facets[:cut]), ("b", facets[cut:]))]
    (tmp_path / "a.stl").write_text("".join(parts))
    mesh = read_mesh(tmp_path / "a.stl")
    assert len(mesh.points) == 8 and len(mesh.elements) == 12


@pytest.mark.parametrize(("away", "told"), [(0.0, False), (1e3, False), (1e6, True), (1e8, True)])
def test_a_mesh_too_far_from_the_origin_for_float32_is_told(away, told):
    cube = data_samples.block(1, 1, 1)
    mesh = meshio.Mesh(cube.rest_position.astype(float) * 0.7 + away, [("tetra", cube.elements)])
    read = read_scene(mesh, clamps=["0:xmin"])
    assert any(one.startswith("rounding to float32 moves points by up to") for one in read.warnings) == told


def test_a_flat_mesh_of_two_columns():
    mesh = meshio.Mesh(np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]), {"triangle": np.array([[0, 1, 2], [0, 2, 3]])})
    scene = read_scene(mesh, clamps=["0:ymin"]).scene
    assert scene.rest_position.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert scene.elements.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert scene.node_type.tolist() == [HANDLE, HANDLE, NORMAL, NORMAL]


def test_higher_order_lower_dimensions_unused_points_and_inverted_elements():
    points = np.concatenate([[[9.0, 9, 9]], POINTS])
    middle = np.zeros((len(TETS), 6), int)  # the unused point 0 stands for the nodes within edges
    tets = TETS + 1
    tets[:3] = tets[:3, [1, 0, 2, 3]]
    cells = [("tetra10", np.concatenate([tets, middle], axis=1)[:700]), ("tetra", tets[700:])]
    cells += [("triangle", tets[:7, :3]), ("line", tets[:5, :2]), ("line", tets[:2, :2])]
    found = read_scene(meshio.Mesh(points, cells), **PRESCRIBED, corners=True)
    assert np.array_equal(found.scene.rest_position, POINTS.astype(np.float32))
    assert np.array_equal(found.scene.elements[3:], TETS[3:])
    assert np.array_equal(np.sort(found.scene.elements[:3]), np.sort(TETS[:3]))
    corners = found.scene.rest_position[found.scene.elements].astype(float)
    np.testing.assert_allclose(np.linalg.det(corners[:768, 1:] - corners[:768, :1]) / 6, 0.05**2 * 0.02 / 6, rtol=1e-4)
    assert found.notes == [
        "7 cells of the kind triangle are left out",
        "7 cells of the kind line are left out",
        "700 cells of the kind tetra10 keep their corners only",
        "3 tetrahedra that were inside out are turned over",
    ]


@pytest.mark.parametrize(
    ("clamp", "inside"),
    [
        ("0:xmin", POINTS[:, 0] == -0.2),
        ("0:ymax", POINTS[:, 1] == 0.2),
        ("0:zmin , ymin", (POINTS[:, 2] == 0) | (POINTS[:, 1] == -0.2)),
        ("0:all", PLATE),
        ("1:zmax", POINTS[:, 2] == POINTS[:, 2].max()),
        ("0:x>0.1", PLATE & (POINTS[:, 0] > 0.1 + 1e-9)),
        ("0:x>=0.1", PLATE & (POINTS[:, 0] > 0.1 - 1e-9)),
        ("0:y<-0.1", PLATE & (POINTS[:, 1] < -0.1 - 1e-9)),
        ("1:z<=0.091", ~PLATE & (POINTS[:, 2] < 0.1)),
        ("0:field=held", PLATE & (np.arange(len(POINTS)) % 3 > 0)),
    ],
)
def test_places_that_are_clamped(clamp, inside):
    mesh = with_fields({"held": np.arange(len(POINTS)) % 3})
    found = read_scene(mesh, clamps=[clamp]).scene.node_type
    assert np.array_equal(found, np.where(inside, HANDLE, NORMAL))


def test_types_from_a_field_and_what_changes_them():
    types = np.where(POINTS[:, 1] == 0.2, HANDLE, NORMAL)
    assert np.array_equal(read_scene(with_fields({"node_type": types})).scene.node_type, types)
    assert np.array_equal(read_scene(with_fields({"t": types}), type_field="t").scene.node_type, types)
    found = read_scene(with_fields({"node_type": types}), obstacles=[1], clamps=["1:all", "0:xmin"]).scene
    clamped = PLATE & ((POINTS[:, 1] == 0.2) | (POINTS[:, 0] == -0.2))
    assert np.array_equal(found.node_type, np.where(PLATE, np.where(clamped, HANDLE, NORMAL), OBSTACLE))


def test_a_clamp_of_an_obstacle_is_told():
    read = read_scene(with_fields(), obstacles=[1], clamps=["1:zmin", "0:xmin"])
    assert [one for one in read.warnings if one.startswith("the clamp '1:zmin'")][0].endswith("moves as a whole")
    assert not any("0:xmin" in one for one in read.warnings)


def test_a_material_by_name_and_a_folder_are_refused_as_such(tmp_path):
    with pytest.raises(
        ConfigError, match="the material of body 0 is of the type dict; it must be a number or numbers, in"
    ):
        read_scene(with_fields(), materials={0: {"young": 2e5, "poisson": 0.3}}, **PRESCRIBED)
    with pytest.raises(DatasetError, match="is a folder: name a file in it"):
        read_scene(tmp_path)
    fields = {"young": np.full(len(TETS), 1.0), "poisson": np.full(len(TETS), 0.7)}
    with pytest.raises(
        DatasetError, match="mesh: poisson of the material is 0.7 in element 0, and must be above -1 and"
    ):
        read_scene(with_fields(cell=fields), material_fields=("young", "poisson"), **PRESCRIBED)


def test_bodies_from_fields():
    of_node, of_element = np.where(PLATE, 5, 2), np.where(np.arange(len(TETS)) < 768, 5, 2)
    for mesh, name in [
        (with_fields({"body": of_node}), None),
        (with_fields({"part": of_node.astype(float)}), "part"),
        (with_fields(cell={"body": of_element}), None),
        (with_fields(cell={"part": of_element}, extra=[("triangle", TETS[:2, :3])]), "part"),
    ]:
        scene = read_scene(mesh, obstacles=[2], body_field=name).scene
        assert np.array_equal(scene.body, of_node)
        assert np.array_equal(scene.node_type, np.where(PLATE, NORMAL, OBSTACLE))
    below = with_fields({"body": np.where(PLATE, 5, -2)})
    with pytest.raises(DatasetError, match="node 243 is of the body -2, but bodies are numbered from 0"):
        read_scene(below, obstacles=[-2])


def test_materials_of_bodies_and_from_fields():
    plate = np.arange(len(TETS)) < 768
    for materials, expected in [
        ({0: (2.0, 0.3), 1: (5, 6)}, np.where(plate[:, None], [2, 0.3], [5, 6])),
        ({0: (2.0, 0.3)}, np.where(plate[:, None], [2, 0.3], [0, 0])),  # the obstacle has none
        ((2.0, 0.3), np.where(plate[:, None], [2, 0.3], [0, 0])),
        (7, np.where(plate[:, None], [7], [0])),
    ]:
        found = read_scene(MESH, **PRESCRIBED, materials=materials).scene.material
        assert found.dtype == np.float32 and np.array_equal(found, expected.astype(np.float32))
    young = np.arange(len(TETS)) + 1.0
    mesh = with_fields(cell={"E": young, "nu": young / 2000})
    found = read_scene(mesh, **PRESCRIBED, material_fields=["nu", "E"]).scene.material
    assert np.array_equal(found, np.stack([young / 2000, young], axis=1).astype(np.float32))
    assert parse_material("1=2e5, 0.3") == (1, (2e5, 0.3))


@pytest.mark.parametrize(
    "text", ["", "0", "x:xmin", "0:", "0:xmid", "0:x", "0:x>", "0:x>a", "0:x>nan", "0:xmin;", "0:"]
)
def test_a_clamp_that_cannot_be_read(text):
    with pytest.raises(ConfigError, match="the clamp .* cannot be read; write BODY:PLACE, for example 0:xmin"):
        parse_clamp(text)


@pytest.mark.parametrize("text", ["", "0", "0=", "a=1", "0=1,", "0=1;2"])
def test_a_material_that_cannot_be_read(text):
    with pytest.raises(ConfigError, match="the material .* cannot be read; write BODY=NUMBERS"):
        parse_material(text)


FLAT = np.array([*TETS[:5], [0, 1, 2, 9]])  # nodes 0, 1, 2 lie in a line
NAN = np.where(np.arange(len(POINTS))[:, None] == 3, np.nan, POINTS)
WRONG = {
    "no body": (MESH, {"obstacles": [2]}, r"there is no body 2; there are: 0 \(243 nodes\), 1 \(27 nodes\)"),
    "no body to clamp": (MESH, {"clamps": ["3:xmin"]}, "there is no body 3"),
    "an empty place": (MESH, {"clamps": ["0:x>0.3"]}, r"no node of body 0 lies in 'x>0.3'; it reaches from \[-0.2"),
    "an empty field": (
        with_fields({"held": ~PLATE}),
        {"clamps": ["0:xmin,field=held"]},
        "no node of body 0 lies in 'field=held'",
    ),
    "no field": (MESH, {"clamps": ["0:field=held"]}, "there is no point field 'held'; there are: none"),
    "no body field": (MESH, {"body_field": "part"}, "there is no point field 'part'"),
    "no type field": (MESH, {"type_field": "t"}, "there is no point field 't'"),
    "an unknown type": (with_fields({"node_type": np.full(270, 2)}), {}, "node 0 has the type 2"),
    "a body in halves": (with_fields(cell={"body": TETS[:, 0] / 2}), {}, "body at element .* must be a whole number"),
    "bodies that share nodes": (
        with_fields(cell={"body": np.arange(len(TETS)) % 2}),
        {},
        "the bodies 0 and 1 share node 0; bodies must not share nodes",
    ),
    "nothing prescribed": (
        MESH,
        {},
        r"mesh: nothing is prescribed: mark a body with obstacles=\[BODY\] \(--obstacle BODY\) or nodes with clamps=",
    ),
    "flat": (with_fields(tets=FLAT), PRESCRIBED, r"element 5 with the nodes \[0, 1, 2, .*\] has no volume; 1 of 6"),
    "flat triangles": (
        meshio.Mesh(POINTS, {"triangle": np.array([[0, 1, 9], [0, 1, 2]])}),
        PRESCRIBED,
        "element 1 .* has no area; 1 of 2",
    ),
    "a node twice": (with_fields(tets=TETS[:, [0, 1, 2, 2]]), {}, "element 0 refers to a node twice"),
    "not finite": (with_fields(points=NAN), {}, "point 3 is not finite"),
    "a missing point": (with_fields(tets=TETS + 1), {}, "tetra .* refers to node 270, but the nodes are 0 to 269"),
    "flat hexahedra": (
        meshio.Mesh(POINTS, {"hexahedron": np.arange(8)[None], "triangle": np.arange(3)[None]}),
        {},
        "mesh: element 0 .* has no volume; 6 of 6",
    ),
    "lines": (meshio.Mesh(POINTS, {"line": np.arange(2)[None]}), {}, "holds line; the elements must be"),
    "points": (meshio.Mesh(POINTS, []), {}, "holds no cells; the elements must be"),
    "material of no body": (MESH, {**PRESCRIBED, "materials": {0: 1, 2: 1}}, "there is no body 2"),
    "a missing material": (
        MESH,
        {"clamps": ["0:xmin"], "materials": {0: 1}},
        r"body 1 has no material; give one for each of the bodies that deform: \[0, 1\]",
    ),
    "different columns": (
        MESH,
        {**PRESCRIBED, "materials": {0: (1, 2), 1: 1}},
        "different numbers of material parameters: {0: 2, 1: 1}",
    ),
    "material twice": (MESH, {**PRESCRIBED, "materials": 1, "material_fields": ["E"]}, "the material is given twice"),
    "no material field": (MESH, {**PRESCRIBED, "material_fields": ["E"]}, "there is no cell field 'E'"),
    "infinite material": (MESH, {**PRESCRIBED, "materials": np.inf}, "material of element 0 is not finite"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_is_named(case):
    mesh, options, message = WRONG[case]
    with pytest.raises((ConfigError, DatasetError), match=message) as error:
        read_scene(mesh, **options)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("absent.vtu", None, "there is no such file"),
        ("a.xyz", b"1", "cannot be read as a mesh: .*xyz"),
        ("a", b"1", "cannot be read as a mesh"),
        ("empty.msh", b"", "cannot be read as a mesh"),
        ("damaged.vtu", b"<VTKFile type='UnstructuredGrid'", "cannot be read as a mesh"),
        ("damaged.inp", b"*NODE\n1, 0.0, x\n", ":2: 'x' is no number"),
        ("damaged.stl", b"solid\nfacet\n", "cannot be read as a mesh|holds no cells"),
    ],
)
def test_a_file_that_cannot_be_read_is_named(tmp_path, name, content, message, capfd):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(DatasetError, match=f"{tmp_path / name}.*({message})") as error:
        read_scene(tmp_path / name)
    assert "\n" not in str(error.value) and capfd.readouterr() == ("", "")


def test_the_mesh_in_memory_is_not_changed():
    mesh = with_fields({"body": np.where(PLATE, 0, 1)}, tets=TETS[:, [1, 0, 2, 3]].copy())
    before = mesh.points.copy(), mesh.cells[0].data.copy()
    scene = read_scene(mesh, **PRESCRIBED).scene
    assert np.array_equal(mesh.points, before[0]) and np.array_equal(mesh.cells[0].data, before[1])
    assert not any(np.shares_memory(getattr(scene, f.name), mesh.points) for f in fields(scene)[:4])


def test_reading_needs_no_torch():
    program = "import ast_sim.importers.scene_mesh, ast_sim.prescribed_motion, sys; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0

"""What is not taken as it stands in the file of a part is told before anything is solved, and kept with the scenes."""

import meshio
import numpy as np
import pytest
from simulate.own_assembly.assemblies import SPEC, box, case_of, write_assembly

from ast_sim import Dataset, cli
from ast_sim.element_topology import surface_triangles
from ast_sim.scene import NodeType
from ast_sim.simulate.own_assembly.parameters import completed
from ast_sim.simulate.own_assembly.part_mesh import part_meshes
from ast_sim.simulate.own_assembly.spec_reader import read_spec
from ast_sim.simulate.shapes.mesh import second_order
from ast_sim.simulate.shapes.part_source import part_source

BLOCK = "block (block.vtu): "


def write_odd(path, kind):
    """The block with something that is mended or left out, and what is said of it."""
    position, elements = box((0, 0, 0), (10, 10, 5), (4, 4, 2))
    cells, count = [("tetra", elements)], len(elements)
    if kind == "turned":
        cells, told = [("tetra", elements[:, [0, 2, 1, 3]])], f"{count} tetrahedra that were inside out are turned over"
    elif kind == "twice":
        cells, told = [("tetra", np.concatenate([elements, elements[:5]]))], "5 elements that stand in the file twice"
    elif kind == "hexahedra":
        corners = np.array([(x, y, z) for z in (0, 5) for x, y in ((0, 0), (10, 0), (10, 10), (0, 10))], float)
        position, cells = corners, [("hexahedron", np.arange(8)[None])]
        told = "1 cell of the kind hexahedron is cut into"
    else:
        cells.append(("triangle", np.array([elements[0, :3]])))
        position = np.concatenate([position, [[5.0, 5, 9]]])
        told = "1 cell of the kind triangle is left out; 1 point of no element is left out"
    meshio.Mesh(position, cells).write(path)
    return told


@pytest.mark.parametrize("kind", ["turned", "twice", "hexahedra", "left out"])
def test_the_notes_of_a_mesh_are_the_notes_of_its_part(tmp_path, kind):
    spec = read_spec(write_assembly(tmp_path))
    told = write_odd(tmp_path / "block.vtu", kind)
    block, punch = part_meshes(spec, completed(spec.parameters, {}))
    (note,) = block.notes
    assert note.startswith(BLOCK) and told in note
    assert not punch.notes


@pytest.mark.parametrize(("share", "straight"), [(0.2, False), (0.3, True), (0.5, True)])
def test_edges_of_a_file_that_become_straight_are_told(tmp_path, share, straight):
    """From a quarter of the edge on, a node off its middle turns a part of its elements over."""
    spec = read_spec(write_assembly(tmp_path, SPEC.replace("order = 1", "order = 2")))
    position, elements = second_order(*box((0, 0, 0), (10, 10, 5), (4, 4, 2)))
    moved = position.copy()
    node = elements[7, 6]
    moved[node] += share * (position[elements[7, 2]] - position[elements[7, 0]])
    meshio.Mesh(moved, [("tetra10", elements)]).write(tmp_path / "block.vtu")
    block, _ = part_meshes(spec, completed(spec.parameters, {}))
    changed = np.flatnonzero((block.cells == node).any(axis=1))
    told = (
        f"{BLOCK}{len(changed)} elements get straight edges: as in the file they would turn a part of an element over"
    )
    assert list(block.notes) == ([told] if straight else [])
    scale = np.ptp(block.position) / np.ptp(position)
    np.testing.assert_allclose(block.position, scale * (position if straight else moved), atol=1e-6 * scale)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("noise", [0, 1e-5, 1e-3, 0.01])
def test_an_end_that_is_flat_to_five_digits_is_held_as_a_whole(tmp_path, noise, order):
    """As after a conversion that rounds; the shortest edge is 2.5 mm."""
    path = write_assembly(tmp_path, SPEC.replace("order = 1", f"order = {order}"))
    position, elements = box((0, 0, 0), (10, 10, 5), (4, 4, 2))
    position += np.random.default_rng(0).uniform(-noise, noise, position.shape)
    meshio.Mesh(position, [("tetra", elements)]).write(tmp_path / "block.vtu")
    scene = case_of(path).scene
    corners = np.unique(scene.elements[scene.body[scene.elements[:, 0]] == 0][:, :4])
    assert (scene.node_type[corners] == NodeType.HANDLE).sum() == 25


def test_generate_tells_them_and_keeps_them_with_the_scenes(tmp_path, capsys):
    path = write_assembly(tmp_path)
    told = write_odd(tmp_path / "block.vtu", "turned")
    out = tmp_path / "d.h5"
    assert cli.main(["generate", "assembly", str(path), "--out", str(out), "--count", "1", "--workers", "1"]) == 0
    assert BLOCK + told in "".join(capsys.readouterr())
    with Dataset(out) as data:
        assert BLOCK + told in data["train"][0].attributes["notes"]


@pytest.mark.parametrize("ending", ["vtu", "stl"])
def test_the_parts_of_pairs_are_told_as_well(tmp_path, ending):
    path = tmp_path / f"part.{ending}"
    told = write_odd(tmp_path / "part.vtu", "left out")
    if ending == "stl":
        corners, cells = box((0, 0, 0), (1, 1, 1), (1, 1, 1))
        triangles = np.concatenate([surface_triangles(corners, cells), [[0, 1, 1]]])
        meshio.Mesh(corners, [("triangle", triangles)]).write(path)
        told = "area"
    with pytest.warns(UserWarning, match=f"^part.{ending}: .*{told}"):
        part_source(path).check()


LIKE_MPA = "{} is {} Pa; moduli are in pascal in every unit of length, and 1 MPa is 1e6"


@pytest.mark.parametrize(
    ("young", "told"),
    [("1.0", "1"), ("999", "999"), ("[0.5, 1.5]", "1"), ("1000", None), ("[1e6, 2e6]", None)],
    ids=["1 MPa", "just below", "drawn", "just not below", "pascal"],
)
@pytest.mark.parametrize("unit", ["mm", "m"])
def test_a_modulus_that_is_meant_in_megapascal_is_told(tmp_path, young, told, unit):
    """The punch is rigid and has none."""
    spec = SPEC.replace("[1e6, 2e6]", young).replace('"mm"', f'"{unit}"')
    attributes = case_of(write_assembly(tmp_path, spec)).attributes
    note = LIKE_MPA.format("block.young", told)
    assert attributes.get("notes", "") == (note if told else "")


def test_each_part_and_each_yield_stress_in_megapascal_is_told(tmp_path):
    soft = SPEC.replace("[1e6, 2e6]", "1.0").replace("rigid = true", "young = 210\npoisson = 0.3")
    moved = soft.replace("translation = [0, 0, '-travel'] }", "where = 'zmax', translation = [0, 0, '-travel'] }")
    notes = case_of(write_assembly(tmp_path, moved)).attributes["notes"]
    assert notes.splitlines() == [LIKE_MPA.format("block.young", 1), LIKE_MPA.format("punch.young", 210)]
    metal = 'young = 2e9\nlaw = "elastoplastic"\nhardening = [[30, 0], [40, 0.1]]'
    notes = case_of(write_assembly(tmp_path, SPEC.replace("young = [1e6, 2e6]", metal))).attributes["notes"]
    assert notes == LIKE_MPA.format("block.hardening", 30)


def test_generate_tells_of_a_modulus_in_megapascal(tmp_path, capsys):
    path = write_assembly(tmp_path, SPEC.replace("[1e6, 2e6]", "1.0"))
    out = tmp_path / "d.h5"
    assert cli.main(["generate", "assembly", str(path), "--out", str(out), "--count", "1", "--workers", "1"]) == 0
    assert LIKE_MPA.format("block.young", 1) in "".join(capsys.readouterr())

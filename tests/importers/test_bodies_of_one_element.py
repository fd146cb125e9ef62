"""Bodies of one element each whose faces lie on each other: two numbers of a deck are two nodes, and a mesh that is cut
all over is joined all the same."""

import meshio
import numpy as np
import pytest
from data_samples import block
from test_jobs import solved

from ast_sim.importers.mesh_file import read_mesh
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.support.errors import DatasetError

CORNERS = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)])


def tower(count):
    """Cubes on each other without a node in common: the lowest is held, the top of each other one goes up by a tenth
    more than the one below it."""
    lines = ["*NODE"]
    lines += [f"{10 * k + n}, {x}, {y}, {z + k}" for k in range(count) for n, (x, y, z) in enumerate(CORNERS, 1)]
    lines += ["*ELEMENT, TYPE=C3D8, ELSET=ALL"]
    lines += [", ".join(map(str, (k + 1, *range(10 * k + 1, 10 * k + 9)))) for k in range(count)]
    lines += ["*MATERIAL, NAME=M", "*ELASTIC", "100., 0.3", "*SOLID SECTION, ELSET=ALL, MATERIAL=M"]
    tops = [f"{10 * k + n}, 3, 3, {0.1 * k}" for k in range(count) for n in (5, 6, 7, 8)]
    flat = [f"{10 * k + n}, 1, 2" for k in range(count) for n in (5, 6, 7, 8)]
    held = [f"{n}, 1, 3" for n in (1, 2, 3, 4)]
    lines += ["*STEP", "*STATIC", "*BOUNDARY", *held, *flat, *tops, "*NODE FILE", "U", "*EL FILE", "S", "*END STEP"]
    return lines


@pytest.mark.parametrize("count", [2, 3, 5])
def test_bodies_of_one_element_come_apart(tmp_path, count):
    job, results = solved(tmp_path, tower(count))
    read = read_series(results, FieldNames(stress_unit="MPa"), deck=job)
    assert len(np.unique(read.scene.body)) == count and read.scene.num_nodes == 8 * count
    up = read.position[-1, :, 2] - read.scene.rest_position[:, 2]
    expected = np.repeat(0.1 * np.arange(count), 8)
    np.testing.assert_allclose(up, expected, atol=1e-5)
    told = f"{8 * (count - 1)} points at places of others have numbers of their own and come apart"
    assert (told in read.attributes.get("notes", "")) == (count > 3)


def test_a_few_elements_of_a_deck_are_bodies(tmp_path):
    """The mesh alone: without frames nothing comes apart."""
    (tmp_path / "a.inp").write_text("\n".join(tower(2)) + "\n")
    mesh = read_mesh(tmp_path / "a.inp")
    assert len(np.unique(mesh.elements)) == 16 and not any("joined" in note for note in mesh.notes)


@pytest.mark.parametrize(("name", "form"), [("a.inp", "abaqus"), ("a.msh", "gmsh22"), ("a.vtu", "vtu")])
def test_a_mesh_that_is_cut_all_over_is_joined(tmp_path, name, form):
    mesh = block(2, 2, 1)
    points = mesh.rest_position[mesh.elements].reshape(-1, 3)
    cells = np.arange(len(points)).reshape(-1, 4)
    meshio.Mesh(points.astype(float), [("tetra", cells)]).write(tmp_path / name, file_format=form)
    read = read_mesh(tmp_path / name)
    assert len(np.unique(read.elements)) == mesh.num_nodes == 18
    assert "96 points at 18 places are joined: each element has points of its own" in read.notes


def test_fields_that_differ_at_points_of_one_place_are_refused_with_the_frames(tmp_path):
    """In the first frame the stress is the same everywhere, 0."""
    mesh = block(2, 2, 1)
    points = mesh.rest_position[mesh.elements].reshape(-1, 3).astype(float)
    cells = np.arange(len(points)).reshape(-1, 4)
    for frame in range(3):
        fields = {"von_mises": np.repeat(np.arange(len(cells)), 4) * 5.0 * frame, "displacement": points * 0.1 * frame}
        meshio.Mesh(points, [("tetra", cells)], fields).write(tmp_path / f"{frame}.vtu")
    refused = r"0.vtu and 2 later frames: each element has points of its own, and the field 'von_mises' differs at"
    with pytest.raises(DatasetError, match=refused):
        read_series(tmp_path, FieldNames())

"""Steps of the views in .msh files of Gmsh are frames; series of .msh and .xdmf files follow the times inside them."""

import subprocess
import sys

import meshio
import numpy as np
import pytest
from data_samples import block

from ast_sim.importers.convert import convert, find_series
from ast_sim.importers.scene_mesh import read_scene
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.support.errors import DatasetError

CUBE = block(1, 1, 1)
NAMES = FieldNames(displacement="u", stress="mises", handle="held")
HELD = (CUBE.rest_position[:, 2] == 0).astype(float)
STEPS = ((0, 0.0, 0.0), (1, 0.5, 0.1), (2, 1.0, 0.3))  # number, time, push
CROWD = [(0, 0.0), (3, 0.3), (1, 0.1), (2, 0.2)]  # number in the name of a file, time inside


def section(kind, name, step, time, values, rows=slice(None)):
    values = np.asarray(values, float).reshape(len(values), -1)
    numbers = np.arange(1, len(values) + 1)[rows]
    lines = [f"{n} " + " ".join(f"{x:.17g}" for x in row) for n, row in zip(numbers, values[rows], strict=True)]
    head = [f"${kind}", "1", f'"{name}"', "1", f"{time:.17g}", "3", str(step), str(values.shape[1]), str(len(lines))]
    return [*head, *lines, f"$End{kind}"]


def moved(push):
    return CUBE.rest_position * (0, 0, -push)


def written(path, *sections):
    points = [f"{n} {x:g} {y:g} {z:g}" for n, (x, y, z) in enumerate(CUBE.rest_position, 1)]
    cells = [f"{n} 4 2 0 1 {' '.join(map(str, row + 1))}" for n, row in enumerate(CUBE.elements, 1)]
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$Nodes", str(len(points)), *points, "$EndNodes"]
    lines += ["$Elements", str(len(cells)), *cells, "$EndElements"]
    path.parent.mkdir(exist_ok=True)
    path.write_text("\n".join([*lines, *(line for one in sections for line in one)]) + "\n")
    return path


def of_step(number, time, push):
    stress = np.full(CUBE.num_elements, 100 * push)
    return [section("NodeData", "u", number, time, moved(push)), section("ElementData", "mises", number, time, stress)]


def marks(number=0, time=0.0):
    return section("NodeData", "held", number, time, HELD)


def test_the_steps_of_a_file_are_frames(tmp_path):
    path = written(tmp_path / "run.msh", marks(), *[one for step in STEPS for one in of_step(*step)])
    read = read_series(path, NAMES)
    assert read.times == (0, 0.5, 1)
    np.testing.assert_allclose(read.position, [CUBE.rest_position + moved(push) for _, _, push in STEPS], atol=1e-7)
    np.testing.assert_allclose(read.stress[:, :, 0], [[100 * push] * CUBE.num_elements for _, _, push in STEPS])
    assert np.array_equal(read.scene.prescribed, HELD == 1)
    assert read_scene(path, clamps=["0:zmin"]).scene.num_nodes == 8


@pytest.mark.parametrize(
    ("steps", "times", "pushes"),
    [
        ([(2, 1.0, 0.3), (0, 0.0, 0.0), (1, 0.5, 0.1)], (0, 0.5, 1), (0, 0.1, 0.3)),
        ([(0, 1.0, 0.3), (0, 0.0, 0.0), (0, 0.5, 0.1)], (0, 0.5, 1), (0, 0.1, 0.3)),
        ([(2, 0.0, 0.3), (0, 0.0, 0.0), (1, 0.0, 0.1)], None, (0, 0.1, 0.3)),
    ],
    ids=["any order", "times alone", "numbers alone"],
)
def test_frames_stand_in_the_order_of_their_times_or_numbers(tmp_path, steps, times, pushes):
    path = written(tmp_path / "run.msh", marks(), *[one for step in steps for one in of_step(*step)])
    read = read_series(path, NAMES)
    assert read.times == times
    np.testing.assert_allclose(read.position, [CUBE.rest_position + moved(push) for push in pushes], atol=1e-7)


def test_a_file_that_gmsh_has_written(tmp_path):
    script = f"""
import gmsh
gmsh.initialize(interruptible=False)
gmsh.option.setNumber("General.Terminal", 0)
gmsh.model.occ.addBox(0, 0, 0, 1, 1, 1)
gmsh.model.occ.synchronize()
gmsh.model.mesh.generate(3)
tags, points, _ = gmsh.model.mesh.getNodes()
view = gmsh.view.add("u")
held = gmsh.view.add("held")
z = points.reshape(-1, 3)[:, 2]
gmsh.view.addModelData(held, 0, gmsh.model.getCurrent(), "NodeData", tags, [[float(x == 0)] for x in z])
for step, time, push in {STEPS}:
    data = [[0.0, 0.0, -push * x] for x in z]
    gmsh.view.addModelData(view, step, gmsh.model.getCurrent(), "NodeData", tags, data, time)
gmsh.option.setNumber("Mesh.Binary", 1)
gmsh.write("run.msh")
gmsh.option.setNumber("PostProcessing.SaveMesh", 0)
gmsh.view.write(view, "run.msh", True)
gmsh.view.write(held, "run.msh", True)
"""
    subprocess.run([sys.executable, "-c", script], cwd=tmp_path, check=True, timeout=100)
    read = read_series(tmp_path / "run.msh", FieldNames(displacement="u", handle="held"))
    assert read.times == (0, 0.5, 1) and 0 < read.scene.prescribed.sum() < read.scene.num_nodes
    for frame, (_, _, push) in enumerate(STEPS):
        lower = read.scene.rest_position * (1, 1, 1 - push)
        np.testing.assert_allclose(read.position[frame], lower, atol=1e-6)


def test_the_parts_of_a_field_are_one_field(tmp_path):
    """As Gmsh writes the partitions of a mesh."""
    parts = [section("NodeData", "u", 1, 1.0, moved(0.2), rows) for rows in (slice(0, 5), slice(4, 8))]
    path = written(tmp_path / "run.msh", marks(), *of_step(0, 0.0, 0.0)[:1], *parts)
    read = read_series(path, FieldNames(displacement="u", handle="held"))
    np.testing.assert_allclose(read.position[1], CUBE.rest_position + moved(0.2), atol=1e-7)


@pytest.mark.parametrize(
    ("sections", "cause"),
    [
        ([*of_step(1, 0.5, 0.1), *of_step(0, 0.0, 0.0)[:1]], "there is no field 'mises'"),
        ([*of_step(0, 0.0, 0.0), *of_step(1, 0.5, 0.1), of_step(2, 1.0, 0.3)[0]], "'u' has 3 steps, .* 'mises' has 2,"),
        ([*of_step(0, 1.0, 0.0), *of_step(1, 0.5, 0.1)], "the steps of 'u' do not ascend with their times"),
        ([*of_step(0, 0.0, 0.0), *of_step(0, 0.0, 0.1)], "'u' has two values for 4 numbers, such as"),
        ([of_step(0, 0.5, 0.1)[0], of_step(0, 1.0, 0.1)[1]], r"its fields are of different times \(0.5, 1\)"),
    ],
    ids=["stress of one step", "fewer steps", "times back", "twice", "two times"],
)
def test_steps_that_do_not_fit_are_refused(tmp_path, sections, cause):
    with pytest.raises(DatasetError, match=f"run.msh: .*{cause}"):
        read_series(written(tmp_path / "run.msh", marks(), *sections), NAMES)


def test_fields_whose_steps_have_other_numbers_are_told_with_these(tmp_path):
    sections = [one for n in (0, 1) for one in (of_step(n, n / 2, n / 10)[0], of_step(n + 1, n / 2, n / 10)[1])]
    cause = "'u' has 2 steps, from step 0 at the time 0 on, 'mises' has 2, from step 1 at 0 on: write all fields at the"
    with pytest.raises(DatasetError, match=cause):
        read_series(written(tmp_path / "run.msh", marks(), *sections), NAMES)


def test_a_field_at_the_nodes_of_elements_is_left_out_by_name(tmp_path):
    moves = [of_step(*step)[0] for step in STEPS]
    stress = [section("ElementNodeData", "mises", number, time, np.ones((6, 5))) for number, time, _ in STEPS]
    path = written(tmp_path / "run.msh", marks(), *moves, *stress)
    left_out = "the field 'mises' has values at the nodes of each element: it is left out"
    read = read_series(path, FieldNames(displacement="u", handle="held"))
    assert read.attributes["notes"].count(left_out) == 1
    with pytest.raises(DatasetError, match=f"there is no field 'mises': {left_out}; there are: "):
        read_series(path, NAMES)


def test_each_file_with_steps_is_a_simulation(tmp_path):
    for name in "ab":
        written(tmp_path / f"{name}.msh", marks(), *[one for step in STEPS for one in of_step(*step)])
    assert list(find_series(tmp_path)) == ["a", "b"]
    with pytest.raises(DatasetError, match="a.msh: holds several frames, and a file of a series must be one"):
        read_series(tmp_path, NAMES)
    listed = "".join(f'<DataSet timestep="{step}" file="{name}.msh"/>' for step, name in enumerate("ab"))
    (tmp_path / "all.pvd").write_text(f'<VTKFile type="Collection"><Collection>{listed}</Collection></VTKFile>')
    with pytest.raises(DatasetError, match="a.msh: holds several frames"):
        read_series(tmp_path / "all.pvd", NAMES)


def test_a_series_of_gmsh_follows_the_times_inside(tmp_path):
    for number, time in CROWD:
        other = {0: 1, 1: 3, 2: 2, 3: 0}[number]
        written(tmp_path / "run" / f"f_{other}.msh", marks(), *of_step(number, time, time))
    read = read_series(tmp_path / "run", NAMES)
    assert read.times == (0, 0.1, 0.2, 0.3)
    np.testing.assert_allclose(read.position[:, :, 2].min(axis=1), 0, atol=1e-7)
    np.testing.assert_allclose(read.position[:, :, 2].max(axis=1), (1, 0.9, 0.8, 0.7), rtol=1e-6)
    assert "the frames stand in the order of the times inside the files" in read.attributes["notes"]


def grid_of(path, push, time=None):
    """A single grid of XDMF, with a time as ParaView's writers of version 2 give it."""
    fields = {"u": moved(push), "held": HELD}
    path.parent.mkdir(exist_ok=True)
    meshio.write(path, meshio.Mesh(CUBE.rest_position, [("tetra", CUBE.elements)], fields), data_format="XML")
    if time is not None:
        text = path.read_text()
        assert text.count("<Geometry") == 1
        path.write_text(text.replace("<Geometry", f'<Time Value="{time}"/><Geometry'))


def test_a_series_of_single_grids_of_xdmf_follows_the_times_inside(tmp_path):
    for number, time in CROWD:
        grid_of(tmp_path / "run" / f"f_{number}.xdmf", push=0.3 - time, time=0.3 - time)
    assert find_series(tmp_path) == {"run": tmp_path / "run"}
    read = read_series(tmp_path / "run", FieldNames(displacement="u", handle="held"))
    np.testing.assert_allclose(read.times, (0, 0.1, 0.2, 0.3), atol=1e-12)
    np.testing.assert_allclose(read.position[:, :, 2].max(axis=1), (1, 0.9, 0.8, 0.7), rtol=1e-6)


def test_single_grids_of_xdmf_without_times_follow_their_numbers(tmp_path):
    for number in (10, 9, 0):
        grid_of(tmp_path / "run" / f"f_{number}.xdmf", push=number / 100)
    counts = convert(
        tmp_path,
        tmp_path / "o.h5",
        names=FieldNames(displacement="u", handle="held"),
        splits={"train": 1},
        progress=False,
    )
    assert counts["train"] == 1
    read = read_series(tmp_path / "run", FieldNames(displacement="u", handle="held"))
    assert read.times is None
    np.testing.assert_allclose(read.position[:, :, 2].max(axis=1), (1, 0.91, 0.9), rtol=1e-6)

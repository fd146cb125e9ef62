"""The error of the mesh itself: the force at half the size, and at twice the size where half would take too long."""

import re

import numpy as np
import pytest
from simulate.own_assembly.assemblies import SPEC, STRIP, box, write_assembly, write_box

from ast_sim.simulate.families import assembly
from ast_sim.simulate.jobs import mesh_error as module
from ast_sim.simulate.jobs.look import look
from ast_sim.simulate.jobs.mesh_error import MeshError, mesh_error
from ast_sim.simulate.own_assembly.parameters import completed
from ast_sim.simulate.own_assembly.spec_reader import read_spec
from ast_sim.support.errors import SimulationError

SCRIPT = """
def block(gmsh):
    gmsh.model.occ.addBox(0, 0, 0, 10, 10, 5)
def punch(gmsh):
    gmsh.model.occ.addBox(3, 3, 5.2, 4, 4, 2)
"""


def solved(path, **given):
    spec = read_spec(path)
    values = completed(spec.parameters, given)
    case = assembly.scene_of(spec, values, None, spec.frames).case
    return spec, case, assembly.in_newton(assembly.solve(case), spec.unit), values


def write_strip(folder, friction=0.0):
    write_box(folder / "strip.vtu", (0, -5, 0), (60, 5, 1), (30, 5, 1))
    write_box(folder / "roller.vtu", (49, -6, 1.2), (51, 6, 4), (2, 6, 2))
    path = folder / "SPEC.toml"
    path.write_text(STRIP.format(settings=f"order = 1\nfriction = {friction}"))
    return path


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_the_force_at_half_the_size_is_the_solvers(tmp_path, friction):
    """A strip of one linear element over its thickness: its force is more than twice the one with two."""
    spec, case, coarse, values = solved(write_strip(tmp_path, friction), down=2)
    found = mesh_error(spec, case, coarse, values, None)
    finer = assembly.resized(spec, values, None, spec.frames, 0.5)
    strips = [one.elements[one.body[one.elements[:, 0]] == 0] for one in (case.scene, finer.scene)]
    assert len(strips[1]) == 8 * len(strips[0])
    assert finer.scene.prescribed[finer.scene.rest_position[:, 0] == 0].all()
    fine = assembly.in_newton(assembly.solve(finer), "mm").attributes["reaction"]
    assert (found.quantity, found.relative) == ("force", 0.5)
    assert found.value == pytest.approx(max(coarse.attributes["reaction"]))
    assert found.other == pytest.approx(max(fine), rel=0.01)
    assert found.off == pytest.approx(coarse.attributes["reaction"][-1] / fine[-1] - 1, rel=0.02)
    assert found.off > 1


def test_a_part_that_is_turned_has_a_torque(tmp_path):
    text = SPEC.replace('fixed = "zmin"', 'fixed = "zmin"\nmove = { where = "zmax", rotation = 30, point = [5, 5, 5] }')
    write_box(tmp_path / "punch.vtu", (3, 3, 9), (7, 7, 11), (2, 2, 2))
    path = write_assembly(tmp_path, text.replace("-travel", "travel"))
    spec, case, coarse, values = solved(path)
    found = mesh_error(spec, case, coarse, values, None)
    fine = assembly.in_newton(assembly.solve(assembly.resized(spec, values, None, 3, 0.5)), "mm")
    assert (found.quantity, found.relative) == ("torque", 0.5)
    assert found.other == pytest.approx(abs(fine.attributes["torque"][-1]), rel=0.01)
    assert re.fullmatch(r"torque \S+ N m, at half the size \S+ N m: this mesh is \S+ % off", str(found))


def test_where_half_would_take_too_long_twice_the_size_is_solved(tmp_path, monkeypatch):
    (tmp_path / "parts.py").write_text(SCRIPT)
    text = SPEC.replace('"block.vtu"', '"parts.py:block"\nsize = 2').replace(
        '"punch.vtu"', '"parts.py:punch"\nsize = 2'
    )
    path = tmp_path / "SPEC.toml"
    path.write_text(text)
    spec, case, coarse, values = solved(path)
    monkeypatch.setattr(module, "MOST_SECONDS", 1e-6)
    found = mesh_error(spec, case, coarse, values, None)
    twice = assembly.in_newton(assembly.solve(assembly.resized(spec, values, None, 3, 2.0)), "mm")
    assert (found.relative, found.other) == (2.0, twice.attributes["reaction"][-1])
    assert re.fullmatch(r"force \S+ N, at twice the size \S+ N: this mesh is about \S+ % off", str(found))


def test_a_mesh_file_has_no_coarser_mesh(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MOST_SECONDS", 1e-6)
    found = look(write_assembly(tmp_path))
    assert found.mesh_error is None and found.status == "complete"
    line = "how far the force .* is not known: at half the size: it would take about .*; at twice the size: the mesh"
    assert re.match(line, found.mesh_line), found.mesh_line


def test_self_contact_and_several_coefficients_of_friction_are_solved_too(tmp_path):
    text = SPEC.replace("poisson = 0.3", "poisson = 0.3\nself_contact = true") + PAIRS
    write_box(tmp_path / "third.vtu", (1, 1, 9), (9, 9, 11), (2, 2, 2))
    spec, case, coarse, values = solved(write_assembly(tmp_path, text), travel=1)
    assert case.contact.frictions(case.scene) == [0.0, 0.2]
    fine = assembly.in_newton(assembly.solve(assembly.resized(spec, values, None, 3, 0.5)), "mm")
    found = mesh_error(spec, case, coarse, values, None)
    assert (found.relative, found.other) == (0.5, pytest.approx(fine.attributes["reaction"][-1], rel=0.01))


PAIRS = """
[parts.third]
file = "third.vtu"
rigid = true
fixed = "all"
[[contact]]
parts = ["block", "punch"]
friction = 0.2
"""


def test_a_scene_without_a_force_says_so(tmp_path):
    spec, case, coarse, values = solved(write_assembly(tmp_path, SPEC.replace("-travel", "travel")))
    with pytest.raises(SimulationError, match="the first scene has no force"):
        mesh_error(spec, case, coarse, values, None)


@pytest.mark.parametrize(
    ("found", "text"),
    [
        (MeshError("force", 8.1, 0.5, 5.7), "force 8.1 N, at half the size 5.7 N: this mesh is 42 % off"),
        (MeshError("force", 5.0, 0.5, 5.01), "force 5 N, at half the size 5.01 N: this mesh is 0.2 % off"),
        (MeshError("force", 3.0, 0.5, 1.0), "force 3 N, at half the size 1 N: this mesh is 200 % off"),
        (MeshError("force", 3.0, 0.5, 0.0), "force 3 N, at half the size 0 N: this mesh is more than 100 % off"),
        (MeshError("force", 3.0, 2.0, 9.0), "force 3 N, at twice the size 9 N: this mesh is more than 100 % off"),
        # The limit is 1 if the force at the size h is 1 + 0.1 h^1.5.
        (
            MeshError("torque", 1.1, 2.0, 1 + 0.1 * 2**1.5),
            "torque 1.1 N m, at twice the size 1.28 N m: this mesh is about 10 % off",
        ),
    ],
)
def test_the_sentence(found, text):
    assert str(found) == text


def test_halves_of_a_file_of_linear_and_of_second_order_elements_keep_their_volume_and_groups(tmp_path):
    for order in (1, 2):
        text = SPEC.replace("order = 1", f"order = {order}").replace('fixed = "zmin"', 'fixed = "group=corner"')
        write_box(tmp_path / "block.inp", (0, 0, 0), (10, 10, 5), (4, 4, 2))
        spec = read_spec(write_assembly(tmp_path, text.replace("block.vtu", "block.inp")))
        values = completed(spec.parameters, {})
        scene = assembly.resized(spec, values, None, 3, 0.5).scene
        block = scene.elements[scene.body[scene.elements[:, 0]] == 0]
        assert block.shape == (8 * len(box((0, 0, 0), (10, 10, 5), (4, 4, 2))[1]), 4 if order == 1 else 10)
        corners = scene.rest_position[block[:, :4]].astype(float)
        assert np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 6 == pytest.approx(500)
        held = (scene.body == 0) & scene.prescribed
        near = (scene.rest_position[:, :2] <= 2.501).all(axis=1) & (scene.body == 0)
        np.testing.assert_array_equal(held, near)

"""Assemblies of second-order tetrahedra: what `order` says, files of meshes, forces of parts that bend."""

import re

import meshio
import numpy as np
import pytest
from simulate.own_assembly.assemblies import SPEC, STRIP, box, write_assembly

from ast_sim.cli import main
from ast_sim.element_topology import MIDDLES
from ast_sim.mechanics.elements.second_order import points_at_rest
from ast_sim.simulate.families import assembly
from ast_sim.simulate.own_assembly.parameters import completed
from ast_sim.simulate.own_assembly.spec_reader import read_spec
from ast_sim.simulate.shapes.mesh import second_order, straightened

DEFAULT = SPEC.replace("order = 1\n", "")
# Gmsh writes its ten nodes in an order of its own: the last two are exchanged.
BALL = """
def ball(gmsh, radius):
    gmsh.model.occ.addSphere(0, 0, radius + 5.3, radius)
"""


def scene_of(path, **given):
    spec = read_spec(path)
    return assembly.scene_of(spec, completed(spec.parameters, given), None, spec.frames)


def test_second_order_is_the_default_and_middles_are_held_where_their_ends_are(tmp_path):
    spec = DEFAULT.replace('fixed = "zmin"', 'fixed = "field=rim"')
    linear = scene_of(write_assembly(tmp_path, spec.replace("frames = 3", "frames = 3\norder = 1"))).case.scene
    scene = scene_of(write_assembly(tmp_path, spec)).case.scene
    assert linear.elements.shape[1] == 4 and scene.elements.shape[1] == 10
    assert scene.num_elements == linear.num_elements
    corners = scene.rest_position[scene.elements]
    np.testing.assert_allclose(corners[:, 4:], corners[:, np.array(MIDDLES)].mean(axis=2), atol=1e-6)
    held = (scene.body == 0) & scene.prescribed
    np.testing.assert_array_equal(held, (scene.body == 0) & (scene.rest_position[:, 0] == 0))


@pytest.mark.parametrize("size", [3.0, 1.5])
def test_middles_lie_on_the_round_surface_unless_that_turns_an_element_over(tmp_path, size):
    (tmp_path / "ball.py").write_text(BALL)
    spec = DEFAULT.replace(
        'file = "punch.vtu"\nrigid = true',
        f'file = "ball.py:ball"\narguments = {{radius = 2}}\nsize = {size}\nrigid = true',
    )
    scene = scene_of(write_assembly(tmp_path, spec)).case.scene
    position, ball = scene.rest_position.astype(float), scene.body == 1
    elements = scene.elements[ball[scene.elements[:, 0]]]
    volume = points_at_rest(position, elements)[0].sum()
    surface = scene.surface()
    radius = np.linalg.norm(position[np.unique(surface[ball[surface[:, 0]]])] - [0, 0, 7.3], axis=1)
    assert radius.max() == pytest.approx(2, abs=1e-5) and (np.abs(radius - 2) < 1e-5).mean() > 0.9
    corners = position[elements[:, :4]]
    straight = np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 6
    whole = 4 / 3 * np.pi * 8
    assert whole - volume < 0.3 * (whole - straight)


def test_edges_that_turn_an_element_over_become_straight():
    position, elements = second_order(*box((0, 0, 0), (2, 2, 2), (2, 2, 2)))
    bent = position.copy()
    bent[elements[5, 6]] += 1.5 * (position[elements[5, 1]] - position[elements[5, 0]])
    assert (points_at_rest(bent, elements)[0] < 0).any()
    np.testing.assert_allclose(straightened(bent, elements), position, atol=1e-12)
    bent = position.copy()
    bent[elements[5, 6]] += 0.3 * (position[elements[5, 2]] - position[elements[5, 0]])  # inside out at a corner alone
    volume, at_rest = (points_at_rest(one, elements)[0] for one in (bent, position))
    assert (volume > 0.3 * at_rest).all()
    np.testing.assert_allclose(straightened(bent, elements), position, atol=1e-12)
    bent = position.copy()
    bent[elements[5, 6]] += 0.05
    np.testing.assert_array_equal(straightened(bent, elements), bent)


@pytest.mark.parametrize("order", ["3", "0", "true", "'second'"])
def test_an_order_is_one_or_two(tmp_path, capsys, order):
    path = write_assembly(tmp_path, SPEC.replace("order = 1", f"order = {order}"))
    assert main(["generate", "assembly", str(path), "--out", str(tmp_path / "a.h5"), "--count", "1"]) == 2
    assert re.search("order is .*; must be 2 .tetrahedra of ten nodes. or 1", capsys.readouterr().err)


def test_the_reaction_of_a_strip_that_bends_is_the_same_as_of_a_beam(tmp_path):
    """Elements of 2 mm, one over the thickness of 1 mm. As a beam 3 E I d / L^3, 0.0400 N; as a plate 10 % more. Linear
    elements of this mesh give nine times as much."""
    for name, (low, high, cells) in {
        "strip": ((0, -5, 0), (60, 5, 1), (30, 5, 1)),
        "roller": ((49, -6, 1.2), (51, 6, 4), (2, 6, 2)),
    }.items():
        position, elements = box(low, high, cells)
        meshio.Mesh(position, {"tetra": elements}).write(tmp_path / f"{name}.vtu")
    forces = {}
    for order in ("order = 1", ""):
        (tmp_path / "SPEC.toml").write_text(STRIP.format(settings=order))
        found = assembly.in_newton(assembly.solve(scene_of(tmp_path / "SPEC.toml", down=2).case), "mm")
        assert found.attributes["status"] == "complete"
        forces[order] = found.attributes["reaction"][-1]
    beam = 3 * 1000 * (10 / 12) * 2 / 50**3
    assert beam == pytest.approx(0.04)
    assert 0.98 * beam < forces[""] < 1.02 * beam / (1 - 0.3**2)
    assert forces["order = 1"] > 8 * beam

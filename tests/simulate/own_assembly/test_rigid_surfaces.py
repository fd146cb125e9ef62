"""Rigid tools given as surfaces: the layer of tetrahedra behind one stays inside the wall in which it stands."""

import igl
import meshio
import numpy as np
import pytest
from simulate.own_assembly.assemblies import case_of, write_box

from ast_sim.importers.shells import find_shells
from ast_sim.simulate.families import assembly
from ast_sim.simulate.own_assembly.rest_check import gap_between
from ast_sim.simulate.shapes.mesh_check import boundary

SPEC = """
unit = "mm"
frames = 5
[parts.pad]
file = "pad.vtu"
young = 1e6
poisson = 0.3
fixed = "zmin"
[parts.tool]
file = "tool.stl"
rigid = true
move = { translation = [0, 0, -8.5] }
"""
SECOND = """
[parts.lid]
file = "lid.vtu"
young = 1e6
poisson = 0.3
fixed = "zmax"
"""


def prism(corners, low, high, cells):
    """A closed surface: a polygon (x, z), extruded along y, with `cells` along each side and along y."""
    sides = [np.linspace(a, b, cells + 1)[:-1] for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    ring, n = np.concatenate(sides), len(np.concatenate(sides))
    y = np.linspace(low, high, cells + 1)
    points = np.concatenate([np.column_stack([ring[:, 0], np.full(n, one), ring[:, 1]]) for one in y])
    rows, following = n * np.arange(cells)[:, None], (np.arange(n) + 1) % n
    a, b = rows + np.arange(n), rows + following
    around = np.concatenate(
        [np.stack([a, a + n, b], -1).reshape(-1, 3), np.stack([b, a + n, b + n], -1).reshape(-1, 3)]
    )
    ends = [(ring[:, 0].mean(), one, ring[:, 1].mean()) for one in (low, high)]
    near = np.stack([np.full(n, len(points)), np.arange(n), following], 1)
    far = np.stack([np.full(n, len(points) + 1), n * cells + following, n * cells + np.arange(n)], 1)
    return np.concatenate([points, ends]), np.concatenate([around, near, far])


BLADE = np.array([[-12, 8], [12, 8], [12, 8.4], [-12, 8.4]], float)
TOOLS = {
    "blade": prism(BLADE, -12, 12, 5),
    "foil": prism(np.array([[-12, 8], [12, 8], [12, 8.01], [-12, 8.01]]), -12, 12, 5),
    "knife": prism(np.array([[0, 8], [1.4, 48], [-1.4, 48]]), -8, 8, 4),
    "pin": prism(np.array([[0.3, 8], [0.3, 38], [-0.3, 38], [-0.3, 8]]), -0.3, 0.3, 1),
    "block": prism(np.array([[-12, 8], [12, 8], [12, 32], [-12, 32]]), -12, 12, 2),
}


def write(folder, tool, spec=SPEC):
    write_box(folder / "pad.vtu", (-12, -12, -10), (12, 12, 0), (4, 4, 2))
    meshio.Mesh(tool[0], {"triangle": tool[1]}).write(folder / "tool.stl")
    (folder / "SPEC.toml").write_text(spec)
    return folder / "SPEC.toml"


@pytest.mark.parametrize("name", TOOLS)
@pytest.mark.parametrize("turned", [False, True])
def test_the_layer_of_a_closed_tool_lies_inside_it(name, turned, tmp_path):
    points, triangles = TOOLS[name]
    case = case_of(write(tmp_path, (points, triangles[:, ::-1] if turned else triangles)))
    tool = np.flatnonzero(case.scene.body == 1)
    position = case.scene.rest_position[tool].astype(float)
    count = len(np.unique(points.round(9), axis=0))
    front, behind = position[:count], position[count : 2 * count]  # the middles of edges follow
    assert np.unique(front.round(5), axis=0) == pytest.approx(np.unique(points.round(5), axis=0), abs=1e-4)
    distance = igl.signed_distance(behind, points, triangles.astype(np.int64))[0]
    assert distance.max() < 0
    if name == "block":  # thick enough for half a mesh width
        assert np.ptp(thickness := np.linalg.norm(front - behind, axis=1)) < 1e-4 < 4 < thickness.min()


def test_a_thin_tool_presses_as_its_tetrahedra_would(tmp_path):
    """The blade of 0.4 mm, 8 mm above the pad, with edges of 4.8 mm: half a mesh width is six times its thickness."""
    spec = SPEC.replace("frames = 5", "frames = 3")
    path = write(tmp_path, TOOLS["blade"], spec)
    case = case_of(path)
    assert gap_between(case, (0, 1)) == pytest.approx(8, rel=1e-3)
    as_surface = assembly.in_newton(assembly.solve(case), "mm")
    write_box(tmp_path / "tool.vtu", (-12, -12, 8), (12, 12, 8.4), (5, 5, 1))
    path.write_text(spec.replace("tool.stl", "tool.vtu"))
    as_solid = assembly.in_newton(assembly.solve(case_of(path)), "mm")
    *before, pressed = as_surface.attributes["reaction"]
    assert before == [0, 0]
    assert pressed == pytest.approx(as_solid.attributes["reaction"][-1], rel=1e-3) and pressed > 10


def test_a_sheet_between_two_parts_leaves_the_gap_behind_it(tmp_path):
    """A sheet that is open at its rim has no thickness; its layer takes 1/200 of the gap to the part behind."""
    points, triangles = TOOLS["blade"]
    flat = triangles[(points[triangles][:, :, 2] == 8).all(axis=1)]
    assert len(flat) == 50
    write_box(tmp_path / "lid.vtu", (-12, -12, 8.5), (12, 12, 18), (4, 4, 2))
    path = write(tmp_path, (points, flat), SPEC.replace("-8.5", "-0.1") + SECOND)
    case = case_of(path)
    assert gap_between(case, (0, 1)) == pytest.approx(7.96, abs=0.005)
    assert gap_between(case, (1, 2)) == pytest.approx(0.5, rel=1e-3)


@pytest.mark.parametrize(("half", "cells"), [(14, 5), (14, 2), (40, 1)])
def test_a_sheet_that_is_wider_than_the_parts_leaves_the_gap_behind_it(tmp_path, half, cells):
    """Its outer nodes, or all of them, have nothing behind them; the layer between them would cut the lid."""
    points, triangles = prism(np.array([[-half, 8], [half, 8], [half, 9], [-half, 9]], float), -half, half, cells)
    flat = triangles[(points[triangles][:, :, 2] == 8).all(axis=1)]
    write_box(tmp_path / "lid.vtu", (-12, -12, 8.5), (12, 12, 18), (4, 4, 2))
    case = case_of(write(tmp_path, (points, flat), SPEC.replace("-8.5", "-0.1") + SECOND))
    gaps = [gap_between(case, pair) for pair in ((0, 1), (1, 2))]
    assert sorted(gaps) == pytest.approx([0.5, 8], abs=0.045) and gaps[0] > 7


def test_a_closed_die_around_a_body_has_its_layer_outside(tmp_path):
    """A closed surface around the body it presses: the layer looks away from the body."""
    from ast_sim.simulate.shapes.parts import rectilinear

    points, elements = rectilinear([np.linspace(-1, 1, 3)] * 3)
    die, _ = rectilinear([np.linspace(-2, 2, 3)] * 3)
    faces = boundary(rectilinear([np.linspace(-2, 2, 3)] * 3)[1]) + len(points)
    shells = find_shells(np.concatenate([points, die]), elements, [faces])
    behind = shells.behind(np.concatenate([points, die]))
    assert np.abs(behind).max(axis=1).min() > 2

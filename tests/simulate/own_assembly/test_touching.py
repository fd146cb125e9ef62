"""Parts that touch at rest: their surfaces are set back by what the contact distance needs, and by no more."""

import subprocess
import sys

import numpy as np
import pytest
from simulate.own_assembly.assemblies import box, case_of, write_box

from ast_sim.mechanics.solid_frames import quasi_static
from ast_sim.simulate.families import assembly
from ast_sim.simulate.own_assembly.rest_check import gap_between
from ast_sim.simulate.own_assembly.touching import set_back
from ast_sim.simulate.shapes.mesh import second_order
from ast_sim.simulate.shapes.parts import quarters
from ast_sim.support.errors import SimulationError

DISTANCE = 0.05
SPEC = """
unit = "mm"
frames = 3
order = 2
contact_distance = 0.05
[parts.low]
file = "LOW"
SIZE
young = 1e6
poisson = 0.3
fixed = "zmin"
[parts.up]
file = "UP"
UPPER
"""
SOFT = "size = 3\nyoung = 2e6\npoisson = 0.3\nmove = { where = 'z>10', translation = [0, 0, -0.3] }"
CAD = """
import gmsh, sys
gmsh.initialize(interruptible=False)
gmsh.option.setNumber("General.Terminal", 0)
occ = gmsh.model.occ
def write(name):
    occ.synchronize()
    if name.endswith("stl"):
        gmsh.option.setNumber("Mesh.MeshSizeMax", 4)
        gmsh.model.mesh.generate(2)
    gmsh.write(name)
    gmsh.clear()
for ending in ("step", "stl"):
    occ.addBox(0, 0, 0, 20, 20, 5)
    write("plate." + ending)
    occ.addBox(4, 5, 5, 10, 9, 6)
    write("box." + ending)
occ.addCylinder(10, 10, 5, 0, 0, 6, 4)
write("standing.step")
occ.addCylinder(2, 10, 9, 16, 0, 0, 4)
write("lying.step")
occ.cut([(3, occ.addBox(0, 0, 0, 20, 20, 8))], [(3, occ.addCylinder(10, 10, -1, 0, 0, 10, 4))])
write("bore.step")
for radius in (4, 4.6):
    occ.addCylinder(10, 10, 0, 0, 0, 12, radius)
    write(f"pin{radius}.step")
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("cad")
    subprocess.run([sys.executable, "-c", CAD], cwd=path, check=True, capture_output=True)
    return path


def pair_of(folder, low, up, upper=SOFT, size="size = 3"):
    path = folder / "SPEC.toml"
    path.write_text(SPEC.replace("LOW", low).replace("UPPER", upper).replace("UP", up).replace("SIZE", size))
    return case_of(path)


def meshes(order, shift=0.0):
    """A plate and a block on it: the block's lower face lies in the middle of the plate's upper one, at z = 5."""
    low, up = box((0, 0, 0), (12, 12, 5), (6, 6, 3)), box((4, 4, 5 + shift), (8, 8, 8), (2, 2, 2))
    return [second_order(*low), second_order(*up)] if order == 2 else [low, up]


@pytest.mark.parametrize("order", [1, 2])
def test_faces_at_one_place_are_set_back_by_half_the_contact_distance_each(order):
    bodies = meshes(order)
    (low, up), (note,) = set_back(bodies, ["low", "up"], (False, False), DISTANCE, "mm")
    (before_low, cells), (before_up, _) = bodies
    half = 1.02 * DISTANCE / 2
    face = (before_low[:, 2] == 5) & (np.abs(before_low[:, :2] - 6) <= 2).all(axis=1)
    assert low[face, 2] == pytest.approx(5 - half, abs=1e-9)
    assert low[face, :2] == pytest.approx(before_low[face, :2], abs=1e-9)
    lower = before_up[:, 2] == 5
    assert up[lower, 2] == pytest.approx(5 + half, abs=1e-9)
    # What does not touch stays: below the face, on the other sides, and beyond the triangles that touch.
    far = (np.abs(before_low[:, :2] - 6) >= 5).any(axis=1) | (before_low[:, 2] < 3)
    assert (low[far] == before_low[far]).all()
    assert (up[before_up[:, 2] > 6.1] == before_up[before_up[:, 2] > 6.1]).all()
    assert (quarters(low, cells) > 0).all()
    assert note == (
        "low and up touch at rest: surfaces are set back by up to 0.026 mm there, so that contact begins at the contact"
        " distance 0.05"
    )


def test_middles_inside_of_a_part_follow_the_ends_of_their_edges():
    bodies = meshes(2)
    (_, up), _ = set_back(bodies, ["low", "up"], (False, False), DISTANCE, "mm")
    before = bodies[1][0]
    inner = np.flatnonzero((np.abs(before[:, :2] - 6) < 1.9).all(axis=1) & (before[:, 2] == 5.75))
    assert len(inner) and up[inner, 2] == pytest.approx(5.75 + 1.02 * DISTANCE / 4, abs=1e-9)


@pytest.mark.parametrize("shift", [0, 0.02])
def test_beside_a_rigid_part_the_other_gives_way_by_all_that_is_missing(shift):
    bodies = meshes(2, shift)
    (low, up), _ = set_back(bodies, ["low", "up"], (False, True), DISTANCE, "mm")
    assert (up == bodies[1][0]).all()
    face = (bodies[0][0][:, 2] == 5) & (np.abs(bodies[0][0][:, :2] - 6) <= 2).all(axis=1)
    assert low[face, 2] == pytest.approx(5 + shift - 1.02 * DISTANCE, abs=1e-9)


@pytest.mark.parametrize("shift", [0.0511, -0.3])
def test_parts_that_are_apart_or_pierce_each_other_stay_to_the_bit(shift):
    bodies = meshes(2, shift)
    after, notes = set_back(bodies, ["low", "up"], (False, False), DISTANCE, "mm")
    assert notes == [] and all((one == body[0]).all() for one, body in zip(after, bodies, strict=True))


@pytest.mark.parametrize(
    ("low", "up"),
    [("plate.step", "box.step"), ("plate.step", "standing.step"), ("plate.step", "lying.step"),
     ("plate.stl", "box.stl"), ("bore.step", "pin4.step")],
)  # fmt: skip
def test_cad_parts_that_touch_begin_at_the_contact_distance(low, up, folder):
    case = pair_of(folder, low, up)
    (note,) = [note for note in case.notes() if "touch at rest" in note]
    assert DISTANCE <= gap_between(case, (0, 1)) <= 1.1 * DISTANCE
    assert (quarters(case.scene.rest_position.astype(float), case.scene.elements) > 0).all()
    assert ("facets overlap" in note) == (up == "pin4.step")


def test_a_rigid_surface_that_touches_stays(folder):
    case = pair_of(folder, "plate.stl", "box.stl", "rigid = true\nmove = { translation = [0, 0, -0.3] }")
    rest, up = case.scene.rest_position, case.scene.body == 1
    assert rest[up, 2].min() == 5 and DISTANCE <= gap_between(case, (0, 1)) <= 1.1 * DISTANCE


def test_a_pin_that_is_thicker_than_its_bore_is_refused_with_a_way_out(folder):
    with pytest.raises(SimulationError, match=r"low and up overlap at rest by .* mm at .*: move one of them by an off"):
        pair_of(folder, "bore.step", "pin4.6.step")


def test_contact_begins_where_parts_touched(tmp_path):
    """A column of 4 x 4 mm on another, pressed by 0.3 mm of 10 mm. Springs in series: 1 and 2 MPa, 5 mm each."""
    write_box(tmp_path / "low.vtu", (0, 0, 0), (4, 4, 5), (2, 2, 2))
    write_box(tmp_path / "up.vtu", (0, 0, 5), (4, 4, 10), (2, 2, 2))
    move = SOFT.replace("size = 3\n", "").replace("z>10", "zmax")
    case = pair_of(tmp_path, "low.vtu", "up.vtu", move, "")
    force = assembly.in_newton(quasi_static(case, assembly.SETTINGS), "mm").attributes["reaction"]
    in_series = 16e-6 * 0.3 / (5 / 1e6 + 5 / 2e6)  # N: area times travel over the compliances of two springs
    assert force[0] == pytest.approx(0, abs=1e-9)
    assert force[1:] == pytest.approx([in_series / 2, in_series], rel=0.1)  # fixed ends stiffen, the distance gives way

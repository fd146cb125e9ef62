"""Jobs of CalculiX whose nodes are moved, whose steps end or whose rest is other than in the common ones."""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from data_samples import block
from test_jobs import solved

from ast_sim.importers.series import FieldNames, read_series
from ast_sim.importers.solved_jobs.job import read_job
from ast_sim.scene import NodeType
from ast_sim.support.errors import DatasetError

CUBE = block(2, 2, 2)
HEIGHT = CUBE.rest_position[:, 2]
NAMES = FieldNames(stress_unit="MPa")
HEAT = ["*CONDUCTIVITY", "50.", "*SPECIFIC HEAT", "4e8", "*DENSITY", "7e-9"]
TURNED = ["*NODE", "998, 1, 1, 2", "999, 1, 1, 2", "*RIGID BODY, NSET=TOP, REF NODE=998, ROT NODE=999"]


def listed(name, chosen):
    return [f"*NSET, NSET={name}", *(str(1 + node) for node in np.flatnonzero(chosen))]


def step(*lines, procedure="*STATIC", output=("S",)):
    head = ["*STEP, NLGEOM", procedure, "0.5, 1.", *lines]
    return [*head, "*NODE FILE", "U", "*EL FILE", ",".join(output), "*END STEP"]


def cube(*steps, model=(), material=()):
    """A cube whose floor is held."""
    nodes = [f"{n}, {x:g}, {y:g}, {z:g}" for n, (x, y, z) in enumerate(CUBE.rest_position, 1)]
    elements = [", ".join(map(str, [n, *(row + 1)])) for n, row in enumerate(CUBE.elements, 1)]
    lines = ["*NODE, NSET=EACH", *nodes, "*ELEMENT, TYPE=C3D4, ELSET=ALL", *elements]
    lines += [*listed("FLOOR", HEIGHT == 0), *listed("TOP", HEIGHT == 2)]
    lines += ["*MATERIAL, NAME=M", "*ELASTIC", "1000., 0.3", *material, "*SOLID SECTION, ELSET=ALL, MATERIAL=M"]
    return [*lines, *model, "*BOUNDARY", "FLOOR, 1, 3", *(line for one in steps for line in one)]


def written(folder, lines):
    path = folder / "job.inp"
    path.write_text("\n".join(lines) + "\n")
    return path


def moved(z, kind=""):
    return [f"*BOUNDARY{kind}", "TOP, 1, 2", f"TOP, 3, 3, {z}"]


def read(job, names=NAMES):
    return read_series(job[1], names, deck=job[0])


def test_values_of_a_global_model_move_nodes(tmp_path):
    whole = read(solved(tmp_path / "whole", cube(step(*moved(-0.1)))))
    (tmp_path / "part").mkdir()
    shutil.copy(tmp_path / "whole" / "job.frd", tmp_path / "part" / "global.frd")
    model = ["*SUBMODEL, TYPE=NODE, INPUT=global.frd", "TOP"]
    driven = step("*BOUNDARY, SUBMODEL, STEP=1", "TOP, 3, 3")
    part = read(solved(tmp_path / "part", cube(driven, model=model)))
    assert np.array_equal(part.scene.node_type == NodeType.HANDLE, (HEIGHT == 0) | (HEIGHT == 2))
    np.testing.assert_allclose(part.position[:, HEIGHT == 2, 2], whole.position[:, HEIGHT == 2, 2], atol=1e-6)


@pytest.mark.parametrize(
    ("boundary", "driven"),
    [(["999, 3, 3, 0.2"], True), (["998, 4, 6", "999, 1, 3"], False), (["998, 3, 3, -0.1", "999, 1, 3"], True)],
    ids=["turned", "turns held, pushed by a load", "moved"],
)
def test_a_rigid_body_that_is_only_turned_is_prescribed(tmp_path, boundary, driven):
    load = [] if driven else ["*CLOAD", "998, 3, -5."]
    result = read(solved(tmp_path, cube(step("*BOUNDARY", *boundary, *load), model=TURNED)))
    top = HEIGHT == 2
    assert (result.scene.node_type[top] == (NodeType.HANDLE if driven else NodeType.NORMAL)).all()
    assert ("the rigid body TOP is prescribed nowhere" in result.attributes["notes"]) != driven
    turned = boundary[0].startswith("999")
    way = result.position[-1, top] - result.scene.rest_position[top]
    assert (np.abs(way).max() > 0.1) == (turned or driven)


@pytest.mark.parametrize(
    ("body", "boundary", "driven"),
    [
        ("ROT NODE=999", ["999, 3, 3, 0.2"], True),
        ("ROT NODE=999", ["FLOOR, 1, 1"], False),
        ("REF NODE=998", ["998, 11, 11, 20."], False),  # its temperature is given
        ("REF NODE=998", ["998, 1, 6"], True),
    ],
)
def test_a_rigid_body_needs_no_reference_node(tmp_path, body, boundary, driven):
    model = [*TURNED[:3], f"*RIGID BODY, NSET=TOP, {body}"]
    job = read_job(written(tmp_path, cube(step("*BOUNDARY", *boundary), model=model)))
    at = np.isin(job.mesh.same_point, 1 + np.flatnonzero(HEIGHT == 2))
    assert at.sum() == 9 and (job.node_type[at] == (NodeType.HANDLE if driven else NodeType.NORMAL)).all()
    assert any("TOP is prescribed nowhere" in note for note in job.mesh.notes) != driven


def test_calculix_puts_a_reference_node_where_a_rigid_body_has_none(tmp_path):
    model = [*TURNED[:3], "*RIGID BODY, NSET=TOP, ROT NODE=999"]
    result = read(solved(tmp_path, cube(step("*BOUNDARY", "999, 3, 3, 0.2"), model=model)))
    top = HEIGHT == 2
    assert (result.scene.node_type[top] == NodeType.HANDLE).all()
    before, after = (np.ptp(frame[top][[0, -1]], axis=0) for frame in (result.scene.rest_position, result.position[-1]))
    turned = np.arctan2(after[1], after[0]) - np.arctan2(before[1], before[0])
    assert turned == pytest.approx(0.2, abs=1e-4) and np.hypot(*after[:2]) == pytest.approx(np.hypot(*before[:2]))


SHEET = [
    *("*NODE", "1, 0., 0., 0.", "2, 1., 0., 0.", "3, 2., 0., 0.", "4, 0., 1., 0.", "5, 1., 1., 0.", "6, 2., 1., 0."),
    *("*ELEMENT, TYPE=S4, ELSET=ALL", "1, 1, 2, 5, 4", "2, 2, 3, 6, 5", "*MATERIAL, NAME=M", "*ELASTIC", "2e5, 0.3"),
    *("*SHELL SECTION, ELSET=ALL, MATERIAL=M", "0.1", "*BOUNDARY", "1, 1, 6", "4, 1, 6", "*STEP", "*STATIC", "1., 1."),
    *("*BOUNDARY", "3, 3, 3, 0.1", "6, 3, 3, 0.1"),
]


def test_shells_need_results_of_their_own_nodes(tmp_path):
    flat = [*SHEET, "*NODE FILE, OUTPUT=2D", "U", "*EL FILE, OUTPUT=2D", "S", "*END STEP"]
    result = read(solved(tmp_path / "flat", flat))
    way = result.position[1] - result.scene.rest_position
    assert way[[2, 5], 2] == pytest.approx(0.1) and 0 < way[1, 2] < 0.1
    assert result.scene.elements.shape == (4, 3) and result.stress.max() > 1e6
    thick = [*SHEET, "*NODE FILE, OUTPUT=3D", "U", "*END STEP"]
    with pytest.raises(DatasetError, match="holds 2 elements of a volume, and job.inp 0: .*OUTPUT=2D"):
        read(solved(tmp_path / "thick", thick))


def test_a_job_that_continues_another_one_is_told(tmp_path):
    path = written(tmp_path, ["*RESTART, READ", *step("*BOUNDARY", "FLOOR, 1, 3")])
    with pytest.raises(DatasetError, match=r"holds no elements, and continues another job \(\*RESTART, READ\)"):
        read_job(path)


@pytest.mark.parametrize("kind", ["CPE3", "CPS3", "CAX3", "CPE4", "CPS4R", "CAX4"])
def test_nodes_in_a_plane_are_held_along_two_axes(tmp_path, kind):
    places = [(x, y) for y in range(3) for x in (1, 2, 3)]
    quads = [(1, 2, 5, 4), (2, 3, 6, 5), (4, 5, 8, 7), (5, 6, 9, 8)]
    cells = quads if "4" in kind else [half for a, b, c, d in quads for half in ((a, b, c), (a, c, d))]
    lines = ["*NODE", *(f"{n}, {x}, {y}, 0." for n, (x, y) in enumerate(places, 1))]
    lines += [
        f"*ELEMENT, TYPE={kind}, ELSET=ALL",
        *(", ".join(map(str, (n, *cell))) for n, cell in enumerate(cells, 1)),
    ]
    lines += ["*MATERIAL, NAME=M", "*ELASTIC", "1000., 0.3", "*SOLID SECTION, ELSET=ALL, MATERIAL=M"]
    lines += ["*NSET, NSET=LOW", "1, 2", "*BOUNDARY", "LOW, 1, 2", "3, 2, 2", "*STEP", "*STATIC", "*BOUNDARY"]
    lines += ["7, 2, 2, -0.1", "8, 2, 2, -0.1", "9, 2, 2, -0.1", "*NODE FILE", "U", "*EL FILE", "S", "*END STEP"]
    result = read(solved(tmp_path, lines))
    assert np.flatnonzero(result.scene.node_type == NodeType.HANDLE).tolist() == [0, 1, 6, 7, 8]
    assert "1 node is held in some directions only" in result.attributes["notes"]  # node 3 slides
    assert result.scene.elements.shape == (8, 3)
    way = result.position[1, 6:] - result.scene.rest_position[6:]
    np.testing.assert_allclose(way[:, 1:], [(-0.1, 0)] * 3, atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "rows", "names", "cause"),
    [
        ("STRESS", [f"{e}, 1, 0, 0, 5., 0, 0, 0" for e in range(1, 49)], NAMES, "give STRESS, so von_mises at rest is"),
        (
            "PLASTIC STRAIN",
            [f"{e}, 1, 0.01, -0.005, -0.005, 0, 0, 0" for e in range(1, 49)],
            replace(NAMES, fields=("PEEQ",)),
            "give PLASTICSTRAIN, so PE at rest is not 0",
        ),
    ],
)
def test_what_is_not_zero_at_rest_is_refused(tmp_path, kind, rows, names, cause):
    model = [f"*INITIAL CONDITIONS, TYPE={kind}", *rows]
    lines = cube(step(*moved(-0.1), output=("S", "PEEQ")), model=model, material=["*PLASTIC", "5., 0.", "6., 1."])
    job = solved(tmp_path, lines)
    with pytest.raises(DatasetError, match=f"job.frd: .INITIAL CONDITIONS of job.inp {cause}"):
        read(job, names)
    without = [line for line in lines if line not in ("*EL FILE", "S,PEEQ")]
    assert read(solved(tmp_path / "u", without)).stress is None  # the displacement is 0 at rest all the same


def test_elements_that_come_or_go_are_refused(tmp_path):
    """In the second step the file of the results has all elements."""
    gone = ["*MODEL CHANGE, TYPE=ELEMENT, REMOVE", "SOME"]
    lines = cube(step(*moved(-0.1)), step(*gone, *moved(-0.15)), model=["*ELSET, ELSET=SOME", "1, 2, 3"])
    with pytest.raises(DatasetError, match=r"job.inp:\d+: \*MODELCHANGE: elements come or go during the job"):
        read(solved(tmp_path, lines))


@pytest.mark.parametrize("procedure", ["*COUPLED TEMPERATURE-DISPLACEMENT", "*UNCOUPLED TEMPERATURE-DISPLACEMENT"])
def test_steps_with_heat_have_an_end(tmp_path, procedure):
    model = ["*INITIAL CONDITIONS, TYPE=TEMPERATURE", "EACH, 20."]
    steps = [step(*moved(z), procedure=procedure) for z in (-0.1, -0.05)]
    job = solved(tmp_path, cube(*steps, model=model, material=HEAT))
    assert "the steps end at 1, 2;" in read(job).attributes["notes"]
    job[0].write_text("0.5, 2.\n".join(job[0].read_text().rsplit("0.5, 1.\n", 1)))
    with pytest.warns(UserWarning, match=r"ends at the time 2, but the steps of job.inp end at 3"):
        read(job)


def test_a_step_begins_at_a_time_of_its_own(tmp_path):
    job = solved(tmp_path, cube(step(*moved(-0.1), procedure="*STATIC, TOTAL TIME AT START=5")))
    result = read(job)
    assert result.times == (0, 5.5, 6) and "the steps end at 6;" in result.attributes["notes"]


def test_a_bolt_is_a_load(tmp_path):
    model = ["*NODE", "900, 0, 0, 9", "*SURFACE, NAME=CUT", "1, S1", "*PRE-TENSION SECTION, SURFACE=CUT, NODE=900"]
    job = solved(tmp_path, cube(step(*moved(-0.1))))
    text = job[0].read_text()
    job[0].write_text(text.replace("*STEP", "\n".join([*model, "0., 0., 1.", "*STEP"]), 1))
    assert (
        "loads are not part of a scene and must be equal in all of them: PRE-TENSIONSECTION"
        in read(job).attributes["notes"]
    )


@pytest.mark.parametrize(("old", "new"), [("  100CL  1", "  100CSET1"), ("  100CL  102", "  100CSET102")])
def test_headers_that_the_reader_does_not_see_are_refused(tmp_path, old, new):
    """It takes displacements of 0 for results that it does not see."""
    job = solved(tmp_path, cube(step(*moved(-0.1))))
    job[1].write_text(job[1].read_text().replace(old, new))
    with pytest.raises(DatasetError, match="job.frd: .*the reader of .frd files does not see its results at the time"):
        read(job)


def test_increments_that_do_not_follow_each_other_in_time_are_refused(tmp_path):
    """A reader that sorts them by time mixes the steps."""
    reset = [step(*moved(z), procedure=f"*STATIC, DIRECT{kind}") for z, kind in ((-0.1, ""), (-0.2, ", TIME RESET"))]
    reset[1][2] = "0.3, 0.9"
    with pytest.raises(
        DatasetError, match=r"the increment at the time 0\.\d stands after the one at 1: let the time go on"
    ):
        read(solved(tmp_path, cube(*reset)))


def test_modes_with_damping_are_no_frames(tmp_path):
    """Their headers do not say that they are modes, and their times are frequencies."""
    frequencies = ["*STEP", "*FREQUENCY, STORAGE=YES", "2", "*END STEP"]
    turning = ["*DLOAD", "ALL, CENTRIF, 1e4, 0., 0., 0., 0., 0., 1.", "*NODE FILE", "U", "*END STEP"]
    modes = ["*STEP", "*COMPLEX FREQUENCY, CORIOLIS", "2", *turning]
    job = solved(tmp_path, cube(frequencies, modes, material=["*DENSITY", "7e-9"]))
    assert re.findall(r"100CL.{49}(..)", job[1].read_text()) == [" 3", " 3"]
    for named, deck in ((NAMES, job[0]), (FieldNames(displacement="DISP"), None)):
        with pytest.raises(DatasetError, match="job.frd: holds modes of vibration, which are no frames of a motion"):
            read_series(job[1], named, deck=deck)


@pytest.mark.parametrize("name", ["DISP", "STRESS"])
def test_a_result_of_an_increment_stands_once(tmp_path, name):
    """Of two a reader takes the last."""
    job = solved(tmp_path, cube(step(*moved(-0.1))))
    results = job[1].read_text()
    first = re.search(rf"(?s)  100CL[^\n]*\n -4  {name} .*?\n -3\n", results)[0]
    job[1].write_text(results.replace(first, first + first.replace("E-02", "E-03")))
    with pytest.raises(DatasetError, match=f"job.frd: holds {name} 2 times for the time 0.5: is it put together of"):
        read(job)


DOWN = [step(*moved(-0.1)), step(*moved(-0.2))]


@pytest.mark.parametrize(
    ("steps", "node", "given"),
    [
        ([step(*moved(-0.1)), step(*moved(-0.3))], 3, "-0.3 along z at the time 2, and it has -0.2"),
        ([step("*BOUNDARY", "TOP, 1, 3"), DOWN[1]], 3, "0 along z at the time 0.5, and it has -0.05"),
        ([step("*BOUNDARY", "5, 1, 3"), DOWN[1]], 5, r"0 along z at the time 0.5, and it has -0.0\d+"),
        ([step("*BOUNDARY", "TOP, 1, 2", "19, 1, 2, 0.05"), DOWN[1]], 19, "0.05 along x at the time 1, and it has 0"),
    ],
)
def test_results_of_another_job_on_the_same_mesh_are_refused(tmp_path, steps, node, given):
    job = solved(tmp_path, cube(*DOWN))
    read(job)
    other = written(tmp_path, cube(*steps))
    cause = (
        f"job.frd: holds results of another job than job.inp: its .BOUNDARY gives node {node} the displacement {given}"
    )
    with pytest.raises(DatasetError, match=cause):
        read((other, job[1]))


@pytest.mark.parametrize(
    ("model", "steps"),
    [
        (["*AMPLITUDE, NAME=A", "0., 0., 1., 0.5"], [step(*moved(-0.1, ", AMPLITUDE=A"))]),
        ([], [DOWN[0], step("*BOUNDARY, FIXED", "TOP, 3, 3")]),
        ([], [DOWN[0], step("*BOUNDARY, OP=NEW", "FLOOR, 1, 3")]),
        ([], [DOWN[0], step("*BOUNDARY, OP=NEW", "FLOOR, 1, 3", "TOP, 1, 2"), step("*BOUNDARY", "TOP, 3, 3")]),
        (["*TRANSFORM, NSET=TOP, TYPE=R", "0., 1., 0., -1., 0., 0."], [step("*BOUNDARY", "TOP, 1, 1, 0.1")]),
        (["*TIME POINTS, NAME=T", "0.3, 0.8"], [[one.replace("FILE", "FILE, TIME POINTS=T") for one in DOWN[0]]]),
        ([], [step(*moved(-0.1), procedure="*DYNAMIC, DIRECT")]),
        ([], [step(*moved(-0.1), procedure="*STATIC, TOTAL TIME AT START=3.")]),
    ],
)
def test_jobs_are_taken_whatever_their_boundary_says(tmp_path, model, steps):
    assert len(read(solved(tmp_path, cube(*steps, model=model, material=["*DENSITY", "7e-9"]))).position) > 1


@pytest.mark.parametrize("quote", ["", '"'])
def test_spaces_and_quotes_in_names_have_no_meaning(tmp_path, quote):
    """CalculiX leaves the spaces of each line out."""
    lines = cube(step("*BOUNDARY", f"{quote}The Top{quote}, 1, 2", f"{quote}TheTop{quote}, 3, 3, -0.1"))
    replaced = {
        "*NSET, NSET=TOP": f"*NSET, NSET={quote}The Top{quote}",
        "*MATERIAL, NAME=M": f"*MATERIAL, NAME={quote}Soft one{quote}",
        "*SOLID SECTION, ELSET=ALL, MATERIAL=M": f"*SOLID SECTION, ELSET=A LL, MATERIAL={quote}SOFTONE{quote}",
    }
    trajectory = read(solved(tmp_path, [replaced.get(line, line) for line in lines]))
    top = trajectory.scene.rest_position[:, 2] == 2
    assert (trajectory.scene.node_type[top] == NodeType.HANDLE).all() and top.sum() == 9
    np.testing.assert_allclose(trajectory.scene.material, [[1e9, 0.3]] * len(trajectory.scene.elements), rtol=1e-6)


# The nodes of the faces of a tetrahedron, as CalculiX counts them.
FACES = ((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0))


def faces(height, first):
    """The faces of the cube at a height; `first` is the number of its first element."""
    flat = [
        (e, f)
        for e, row in enumerate(CUBE.elements)
        for f, face in enumerate(FACES)
        if (HEIGHT[row[list(face)]] == height).all()
    ]
    return [f"{first + element}, S{1 + face}" for element, face in flat]


def upper_cube(gap, *constraint):
    """A second cube over the first, with a gap; its nodes are numbered from 101 on."""
    nodes = [f"{101 + n}, {x:g}, {y:g}, {2 + gap + z:g}" for n, (x, y, z) in enumerate(CUBE.rest_position)]
    elements = [", ".join(map(str, [1001 + n, *(row + 101)])) for n, row in enumerate(CUBE.elements)]
    lines = ["*NODE", *nodes, "*ELEMENT, TYPE=C3D4, ELSET=UP", *elements, "*SOLID SECTION, ELSET=UP, MATERIAL=M"]
    lines += ["*NSET, NSET=LID", *(str(101 + node) for node in np.flatnonzero(HEIGHT == 2))]
    lines += ["*SURFACE, NAME=LOW", *faces(2, 1), "*SURFACE, NAME=NODES, TYPE=NODE"]
    lines += [str(101 + node) for node in np.flatnonzero(HEIGHT == 0)]
    return [*lines, *constraint]


@pytest.mark.parametrize(
    ("constraint", "moved"),
    [
        (["*TIE, NAME=T, POSITION TOLERANCE=0.5", "NODES, LOW"], True),
        (["*TIE, NAME=T, POSITION TOLERANCE=0.5, ADJUST=NO", "NODES, LOW"], False),
        (
            ["*SURFACE INTERACTION, NAME=I", "*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR", "1e4"]
            + ["*CONTACT PAIR, INTERACTION=I, TYPE=NODE TO SURFACE, ADJUST=0.1", "NODES, LOW"],
            True,
        ),
    ],
    ids=["tie", "tie as it is", "contact"],
)
def test_nodes_that_calculix_adjusts_stand_as_in_the_results(tmp_path, constraint, moved):
    press = step("*BOUNDARY", "LID, 1, 2", "LID, 3, 3, -0.1")
    job = solved(tmp_path, cube(press, model=upper_cube(0.05, *constraint)))
    result = read(job)
    low = result.scene.rest_position[27:][HEIGHT == 0, 2]
    np.testing.assert_allclose(low, 2 if moved else 2.05, atol=1e-5)
    np.testing.assert_allclose(result.position[0], result.scene.rest_position, atol=1e-6)
    assert ("9 nodes stand where CalculiX has put them at rest (*" in result.attributes["notes"]) == moved
    if moved:  # without the keyword, the deck is another one
        job[0].write_text(
            job[0].read_text().replace("ADJUST=0.1", "SMALL SLIDING").replace("*TIE,", "*TIE, ADJUST=NO,")
        )
        with pytest.raises(DatasetError, match="holds results of another deck than job.inp: node 101 is off by 0.05"):
            read(job)


def test_many_nodes_elsewhere_are_another_deck_whatever_is_adjusted(tmp_path):
    tie = ["*TIE, NAME=T, POSITION TOLERANCE=0.5", "NODES, LOW"]
    job = solved(tmp_path, cube(step(*moved(-0.1)), model=upper_cube(0.05, *tie)))
    elsewhere = re.sub(r"^(\d+, [^,]+, [^,]+), [^,]+$", r"\1, 9", job[0].read_text(), flags=re.MULTILINE)
    job[0].write_text(elsewhere)
    with pytest.raises(DatasetError, match="holds results of another deck than job.inp"):
        read(job)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (["*CHANGE MATERIAL, NAME=M", "*CHANGE PLASTIC", "60., 0.", "80., 0.5"], "has *CHANGEPLASTIC"),
        (["*CHANGE SOLID SECTION, ELSET=ALL, MATERIAL=OTHER"], "changes the material of 48 elements in a later step"),
    ],
)
def test_a_material_that_changes_in_a_later_step_is_none(tmp_path, change, told):
    """The change is of the material that it names, not of the last one in the deck."""
    model = ["*MATERIAL, NAME=OTHER", "*ELASTIC", "500., 0.2"]
    steps = step(*moved(-0.1)), step(*change, *moved(-0.1))
    result = read(solved(tmp_path, cube(*steps, model=model, material=["*PLASTIC", "30., 0.", "40., 0.5"])))
    assert result.scene.material is None and told in result.attributes["notes"]


def test_displacements_at_the_start_are_no_rest(tmp_path):
    """The frame before the results has none; velocities are told."""

    def job(folder, kind):
        model = [f"*INITIAL CONDITIONS, TYPE={kind}", "TOP, 3, -0.05"]
        wave = step(procedure="*DYNAMIC, DIRECT")
        return solved(tmp_path / folder, cube(wave, model=model, material=["*DENSITY", "1e-9"]))

    with pytest.raises(DatasetError, match="give DISPLACEMENT, so displacement at rest is not 0"):
        read(job("moved", "DISPLACEMENT"))
    assert "nodes move at the start (*INITIAL CONDITIONS)" in read(job("fast", "VELOCITY")).attributes["notes"]


CYLINDER = ["*TRANSFORM, NSET=TOP, TYPE=C", "1., 1., 0., 1., 1., 1."]


@pytest.mark.parametrize(
    ("boundary", "driven"),
    [(["TOP, 1, 1", "TOP, 2, 2, 0.1", "TOP, 3, 3"], True), (["TOP, 1, 2"], False)],
    ids=["turned about the axis", "free along it"],
)
def test_nodes_with_cylindrical_axes_are_moved_and_held_along_these(tmp_path, boundary, driven):
    """*BOUNDARY counts radius, angle and axis there; the results stand along x, y and z."""
    load = [] if driven else ["*CLOAD", "TOP, 3, -1."]
    result = read(solved(tmp_path, cube(step("*BOUNDARY", *boundary, *load), model=CYLINDER)))
    top = HEIGHT == 2
    assert (result.scene.node_type[top] == (NodeType.HANDLE if driven else NodeType.NORMAL)).all()
    assert ("9 nodes are held in some directions only" in result.attributes["notes"]) != driven
    way = (result.position[-1] - result.scene.rest_position)[top]
    radius = (CUBE.rest_position - (1, 1, 0))[top]
    assert np.abs((way * radius)[:, :2].sum(axis=1)).max() < 1e-5  # nothing along the radius
    assert (np.abs(way[:, :2]).max() > 0.05) == driven


def test_the_free_axes_of_a_rigid_body_may_be_its_own(tmp_path):
    own = ["*NSET, NSET=R", "998", "*TRANSFORM, NSET=R, TYPE=R", "0., 1., 0., -1., 0., 0."]
    boundary = ["*BOUNDARY", "998, 2, 3, 0.05", "999, 1, 3"]
    notes = read(solved(tmp_path, cube(step(*boundary), model=[*TURNED, *own]))).attributes["notes"]
    assert "the rigid body TOP is free along x of *TRANSFORM: this motion is taken from the results" in notes
    notes = read(solved(tmp_path, cube(step(*boundary), model=TURNED))).attributes["notes"]
    assert "the rigid body TOP is free along x: this motion" in notes


def test_a_sector_of_a_cyclic_model_is_told(tmp_path):
    job = solved(tmp_path, cube(step(*moved(-0.1))))
    cyclic = "*CYCLIC SYMMETRY MODEL, N=4, TIE=T\n0., 0., 0., 0., 0., 1.\n*STEP"
    job[0].write_text(job[0].read_text().replace("*STEP", cyclic, 1))
    assert "constraints are not read: CYCLICSYMMETRYMODEL; mark nodes" in read(job).attributes["notes"]

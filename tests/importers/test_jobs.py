"""A deck and what CalculiX has made of it become a simulation, without anything written by hand."""

import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from data_samples import block

from ast_sim import Dataset, cli
from ast_sim.importers.convert import convert
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.scene import NodeType
from ast_sim.support.errors import AstSimError, ConfigError, DatasetError

HIGH = 1.01  # the punch stands this high over the floor of the pad, whose height is 1
NAMES = FieldNames(stress_unit="MPa")


def lines_of(scene, first_node, first_element, shift, name):
    """The nodes and elements of a body."""
    nodes = [
        f"{first_node + row}, {x:.9g}, {y:.9g}, {z:.9g}" for row, (x, y, z) in enumerate(scene.rest_position + shift)
    ]
    elements = [
        ", ".join(map(str, [first_element + row, *(first_node + nodes)])) for row, nodes in enumerate(scene.elements)
    ]
    return ["*NODE", *nodes, f"*ELEMENT, TYPE=C3D4, ELSET={name}", *elements]


def deck(pad, punch, steps):
    """A pad whose floor is held, and a rigid punch over it, 1,001 the first of its nodes, 9,001 and 9,002 its reference
    nodes."""
    floor = 1 + np.flatnonzero(pad.rest_position[:, 2] == 0)
    return [
        "*HEADING",
        *lines_of(pad, 1, 1, (0, 0, 0), "PAD"),
        *lines_of(punch, 1001, 1001, (0.5, 0.5, HIGH), "PUNCH"),
        "*NODE, NSET=REFERENCE",
        "9001, 1, 1, 3",
        "9002, 1, 1, 3",
        "*NSET, NSET=FLOOR",
        *map(str, floor),
        "*MATERIAL, NAME=SOFT",
        "*ELASTIC",
        "100., 0.4",
        "*PLASTIC",
        "30., 0.",
        "40., 0.5",
        "*MATERIAL, NAME=STEEL",
        "*ELASTIC",
        "210000., 0.3",
        "*SOLID SECTION, ELSET=PAD, MATERIAL=SOFT",
        "*SOLID SECTION, ELSET=PUNCH, MATERIAL=STEEL",
        "*RIGID BODY, ELSET=PUNCH, REF NODE=9001, ROT NODE=9002",
        "*SURFACE, NAME=TOP",
        *(f"{1 + row}, S{side}" for row, side in faces_at(pad, 1)),
        "*SURFACE, NAME=BELOW",
        *(f"{1001 + row}, S{side}" for row, side in faces_at(punch, 0)),
        "*SURFACE INTERACTION, NAME=HARD",
        "*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR",
        "2000.",
        "*CONTACT PAIR, INTERACTION=HARD, TYPE=SURFACE TO SURFACE",
        "TOP, BELOW",
        "*BOUNDARY",
        "FLOOR, 1, 3",
        "9002, 1, 3",
        *steps,
    ]


def faces_at(scene, height):
    """(element, side) of the faces at a height; CalculiX's sides are 1-2-3, 1-4-2, 2-4-3 and 3-4-1."""
    there = scene.rest_position[scene.elements][:, :, 2] == height
    for element, corners in enumerate(there):
        for side, face in enumerate(((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)), 1):
            if corners[list(face)].all():
                yield element, side


def step(move, period=1.0, op=""):
    return [
        "*STEP, NLGEOM",
        "*STATIC, DIRECT",
        f"{period / 2}, {period}",
        f"*BOUNDARY{op}",
        "9001, 1, 2",
        f"9001, 3, 3, {move}",
        "*NODE FILE",
        "U",
        "*EL FILE",
        "S, PEEQ",
        "*END STEP",
    ]


def solved(folder: Path, lines, name="job"):
    folder.mkdir(exist_ok=True)
    (folder / f"{name}.inp").write_text("\n".join(lines) + "\n")
    done = subprocess.run(["ccx", name], cwd=folder, check=True, capture_output=True, text=True, timeout=100)
    assert "Job finished" in done.stdout
    return folder / f"{name}.inp", folder / f"{name}.frd"


@pytest.fixture(scope="module")
def bodies():
    return block(2, 2, 1), block(1, 1, 1)


@pytest.fixture(scope="module")
def press(bodies, tmp_path_factory):
    """Down by 0.11 in one step of 1 s, up again by half of it in one of 2 s; two increments each."""
    return solved(tmp_path_factory.mktemp("press"), deck(*bodies, [*step(-0.11), *step(-0.06, 2.0)]))


def test_prescribed_nodes_materials_times_and_positions(press, bodies):
    job, results = press
    read = read_series(results, NAMES, deck=job)
    pad, punch = bodies
    scene, split = read.scene, pad.num_nodes
    assert np.array_equal(scene.elements, np.concatenate([pad.elements, punch.elements + split]))
    np.testing.assert_allclose(scene.rest_position[split:], punch.rest_position + (0.5, 0.5, HIGH), atol=1e-6)
    floor = pad.rest_position[:, 2] == 0
    assert np.array_equal(scene.node_type[:split] == NodeType.HANDLE, floor)
    assert (scene.node_type[:split][~floor] == NodeType.NORMAL).all()
    assert (scene.node_type[split:] == NodeType.OBSTACLE).all()
    soft, steel = np.array([1e8, 0.4, 3e7], np.float32), np.array([2.1e11, 0.3, 0], np.float32)
    assert (scene.material[: pad.num_elements] == soft).all() and (scene.material[pad.num_elements :] == steel).all()
    assert read.times == (0.0, 0.5, 1.0, 2.0, 3.0)
    moved = read.position - scene.rest_position
    np.testing.assert_allclose(moved[:, split:, 2].T, [[0, -0.055, -0.11, -0.085, -0.06]] * punch.num_nodes, atol=2e-6)
    assert not moved[0].any() and not moved[:, :split][:, floor].any()
    middle = np.flatnonzero((pad.rest_position == (1, 1, 1)).all(axis=1))[0]
    assert moved[2, middle, 2] == pytest.approx(-0.1, abs=0.02)  # it goes with the punch, apart from the penalty
    assert read.stress_location == "node" and read.stress.shape == (5, scene.num_nodes, 1)
    assert not read.stress[0].any() and 1e6 < read.stress[2].max() < 1e9
    assert "the steps end at 1, 3" in read.attributes["notes"]


def test_fields_are_kept_by_the_names_of_the_deck(bodies, tmp_path):
    lines = deck(*bodies, [*step(-0.11), *step(-0.06, 2.0)])
    lines[lines.index("30., 0.")] = "3., 0."  # so that it yields
    job, results = solved(tmp_path / "soft", lines)
    read = read_series(results, replace(NAMES, fields=("PEEQ", "STRESS=MPa")), deck=job)
    strain = read.fields["PEEQ"]
    assert (strain.location, strain.unit, strain.values.shape) == ("node", "", (5, read.scene.num_nodes, 1))
    assert not strain.values[0].any() and 0.01 < strain.values[2].max() < 1
    assert (strain.values[4].max(axis=0) >= strain.values[2].max(axis=0)).all()  # it never goes back
    assert read.fields["STRESS"].unit == "MPa" and read.fields["STRESS"].values.shape[2] == 6
    with pytest.raises(DatasetError, match=r"holds no field 'CPRESS' \(as CPRESS\); there are: .*DISP"):
        read_series(results, replace(NAMES, fields=("CPRESS",)), deck=job)
    for wrong, told in (("", "it must be a name"), ("a/b", "write NAME or"), ("reaction=N", "write NAME or")):
        with pytest.raises(ConfigError, match=told):
            read_series(results, replace(NAMES, fields=(wrong,)), deck=job)


def test_one_command_makes_a_dataset(press, tmp_path, capsys):
    job, results = press
    command = ["convert", str(job), str(results), "--out", str(tmp_path / "d.h5"), "--shares", "1", "0", "0"]
    assert cli.main(command) == 2
    assert "(--length-unit mm --stress-unit MPa)" in capsys.readouterr().err
    assert cli.main([*command, "--length-unit", "mm", "--stress-unit", "MPa"]) == 0
    told = capsys.readouterr().out
    assert "the columns of the material are young, poisson, yield_stress" in told
    with Dataset(tmp_path / "d.h5") as data:
        assert data.info.length_unit == "mm"
        assert data.info.generator["names"]["stress_unit"] == "MPa"
        assert data.info.generator["material"] == ["young", "poisson", "yield_stress"]
        assert data["train"][0].num_frames == 5


def test_a_folder_of_jobs(press, tmp_path):
    for name in "ab":
        for file in press:
            (tmp_path / f"{name}{file.suffix}").write_bytes(file.read_bytes())
    counts = convert(tmp_path, tmp_path / "d.h5", names=NAMES, length_unit="mm", splits={"train": 0.5, "test": 0.5})
    assert counts == {"train": 1, "valid": 0, "test": 1, "calibration": 0}
    with pytest.raises(ConfigError, match=r"a.inp: a deck does not say its units"):
        convert(tmp_path, tmp_path / "e.h5", splits={"train": 1})


@pytest.mark.parametrize(
    ("young", "unit", "warns"), [(1, "MPa", True), (100, "MPa", False), (2.1, "GPa", False), (1, "Pa", True)]
)
def test_a_modulus_of_about_one_is_doubted(press, tmp_path, young, unit, warns, recwarn):
    job = tmp_path / "job.inp"
    job.write_text(press[0].read_text().replace("100., 0.4", f"{young}, 0.4"))
    names = FieldNames(stress_unit=unit)
    convert(press[1], tmp_path / "d.h5", names=names, deck=job, length_unit="mm", splits={"train": 1}, progress=False)
    told = [str(one.message) for one in recwarn if "Young's modulus is" in str(one.message)]
    assert bool(told) == warns
    assert not warns or f"Young's modulus is 1 {unit}: is this the unit" in told[0]


EDITS = {
    "another node": (
        ("1, 0, 0, 0", "1, 0, 0, 0.5"),
        "holds results of another deck than job.inp: node 1 is off by 0.5",
    ),
    "no set": (("FLOOR, 1, 3", "FLOR, 1, 3"), r"job.inp:\d+: \*BOUNDARY: there is no set of nodes 'FLOR'"),
    "no material": (("MATERIAL=SOFT", "MATERIAL=HARD"), "there is no material 'HARD'"),
    "decimal comma in a motion": (
        ("9001, 3, 3, -0.11", "9001, 3, 3, -0,11"),
        r"'9001, 3, 3, -0,11' has more entries than a target, two directions and a value, and no decimal point",
    ),
    "decimal comma in Poisson's ratio": (("210000., 0.3", "210000, 0,3"), "'210000, 0,3' has more entries"),
    "decimal comma in the yield stress": (("30., 0.", "30,5, 0"), "its first plastic strain is 5, and it must be 0"),
    "displacements along other axes": (
        ("*NODE FILE", "*TRANSFORM, NSET=FLOOR, TYPE=R\n0., 0., 1., 0., 1., 0.\n*NODE FILE, GLOBAL=NO"),
        r"\*NODEFILE: GLOBAL=NO writes displacements along the axes of \*TRANSFORM: leave it out",
    ),
    "perturbation": (
        ("*STEP, NLGEOM", "*STEP, PERTURBATION"),
        r"\*STEP: PERTURBATION gives displacements from the step",
    ),
    "parts": (("*HEADING", "*PART, NAME=A\n*END PART"), "has parts and instances, which CalculiX does not know"),
}


@pytest.mark.parametrize("case", EDITS)
def test_a_deck_that_does_not_fit_is_refused(press, tmp_path, case):
    (old, new), message = EDITS[case]
    text = press[0].read_text()
    assert old in text
    (tmp_path / "job.inp").write_text(text.replace(old, new, 1))
    with pytest.raises(DatasetError, match=message):
        read_series(press[1], NAMES, deck=tmp_path / "job.inp")


def types_of(press, tmp_path, *edits):
    """The types of the nodes, and the notes, after edits of the deck; the results stay."""
    text = press[0].read_text()
    for old, new in edits:
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "job.inp").write_text(text)
    read = read_series(press[1], NAMES, deck=tmp_path / "job.inp")
    return read.scene.node_type, read.attributes["notes"], read


def test_what_is_held_in_some_directions_is_free_with_a_note(press, tmp_path, bodies):
    types, notes, _ = types_of(press, tmp_path, ("FLOOR, 1, 3", "FLOOR, ZSYMM"))
    assert not (types == NodeType.HANDLE).any()
    assert "9 nodes are held in some directions only (symmetry, sliding): they count as free" in notes
    types, notes, _ = types_of(press, tmp_path, ("FLOOR, 1, 3", "FLOOR, ENCASTRE"))
    assert (types == NodeType.HANDLE).sum() == 9 and "some directions" not in notes
    types, _, _ = types_of(
        press, tmp_path, ("FLOOR, 1, 3", "*BOUNDARY, AMPLITUDE=A\nFLOOR, 3, 3, 0.1\n*BOUNDARY")
    )  # it drives
    assert (types == NodeType.HANDLE).sum() == 9


def test_a_rigid_body_that_is_free_in_part_or_wholly(press, tmp_path, bodies):
    punch = slice(bodies[0].num_nodes, None)
    types, notes, _ = types_of(press, tmp_path, ("9002, 1, 3", "9002, 1, 2"))
    assert (types[punch] == NodeType.OBSTACLE).all()
    assert "the rigid body PUNCH is free about z: this motion is taken from the results" in notes
    held = [(f"9001, 3, 3, {z}", "9002, 3, 3") for z in (-0.11, -0.06)]
    types, notes, _ = types_of(press, tmp_path, ("9001, 1, 2\n", ""), *held)
    assert (types[punch] == NodeType.NORMAL).all() and "the rigid body PUNCH is prescribed nowhere" in notes


def test_other_laws_loads_and_constraints_are_told(press, tmp_path, bodies):
    *_, read = types_of(press, tmp_path, ("*ELASTIC\n100., 0.4", "*HYPERELASTIC, NEO HOOKE\n20., 0.01"))
    assert read.scene.material is None
    lacking = f"{bodies[0].num_elements} elements have no isotropic *ELASTIC: no material is taken"
    assert lacking in read.attributes["notes"]
    _, notes, _ = types_of(press, tmp_path, ("*NODE FILE", "*CLOAD\n5, 3, 1.\n*NODE FILE"))
    assert "loads are not part of a scene and must be equal in all of them: CLOAD" in notes
    _, notes, _ = types_of(press, tmp_path, ("*STEP", "*EQUATION\n2\n5, 1, 1., 6, 1, -1.\n*STEP"))
    assert "constraints are not read: EQUATION" in notes


def test_nodes_of_some_steps_only_and_a_job_that_stopped(press, tmp_path):
    _, notes, _ = types_of(press, tmp_path, ("2.0\n*BOUNDARY", "2.0\n*BOUNDARY, OP=NEW"))
    assert "nodes are prescribed in some steps only: they count as prescribed in all" in notes
    with pytest.warns(UserWarning, match=r"ends at the time 3, but the steps of job.inp end at 5"):
        types_of(press, tmp_path, ("1.0, 2.0", "1.0, 4.0"))


def test_results_without_displacements_and_other_files(bodies, press, tmp_path):
    (tmp_path / "a.vtu").touch()
    with pytest.raises(AstSimError, match="beside a deck, results must be a file of CalculiX"):
        convert(tmp_path / "a.vtu", tmp_path / "d.h5", deck=press[0])
    lines = [line for line in deck(*bodies, step(-0.02)) if line not in ("*NODE FILE", "U")]
    job, results = solved(tmp_path / "s", lines)
    with pytest.raises(DatasetError, match="holds no displacement: write U with"):
        read_series(results, NAMES, deck=job)


PARTLY = {
    "*NODE FILE, NSET=FLOOR": "job.frd: 17 nodes have no displacement: write U for all nodes",
    "*NODE OUTPUT, NSET=FLOOR": "job.frd: 17 nodes have no displacement: write U for all nodes",  # binary
    "*EL FILE, NSET=FLOOR": "job.frd: 9 nodes have no von_mises: write S for all elements",
    "*ELEMENT OUTPUT, NSET=FLOOR": "job.frd: 9 nodes have no von_mises: write S for all elements",
    "TIME RESET": "job.frd: two increments have the time 0.5, so their results cannot be told apart",
}


@pytest.mark.parametrize("how", PARTLY)
def test_results_of_some_nodes_or_of_two_increments_in_one_are_refused(bodies, tmp_path, how):
    """Readers give 0 to nodes that a result leaves out, and the results of the last increment of a time."""
    keyword = how.partition(",")[0].replace("ELEMENT", "EL").replace("OUTPUT", "FILE")
    lines = deck(*bodies, [*step(-0.05), *step(-0.02)])
    if how == "TIME RESET":
        lines[-lines[::-1].index("*STATIC, DIRECT") - 1] += ", TIME RESET"
    job, results = solved(tmp_path, [how if line == keyword else line for line in lines])
    with pytest.raises(DatasetError, match=PARTLY[how]):
        read_series(results, NAMES, deck=job)


def test_obstacles_need_no_stress(bodies, tmp_path):
    lines = deck(*bodies, step(-0.05))
    all_of_it = read_series(solved(tmp_path, lines)[1], NAMES, deck=tmp_path / "job.inp")
    few = ["*NSET, NSET=SOFT_NODES, GENERATE", "1, 18", "*MATERIAL, NAME=SOFT"]
    lines[(at := lines.index("*MATERIAL, NAME=SOFT")) : at + 1] = few
    job, results = solved(tmp_path, ["*EL FILE, NSET=SOFT_NODES" if line == "*EL FILE" else line for line in lines])
    read = read_series(results, NAMES, deck=job)
    assert np.array_equal(read.stress[:, :18], all_of_it.stress[:, :18]) and not read.stress[:, 18:].any()
    assert "the stress is NaN at 8 rows of obstacles: it is 0 there" in read.attributes["notes"]


@pytest.mark.parametrize("number", [" 1.00000D-03", "************"])
def test_what_is_no_number_in_results_is_not_0(press, tmp_path, number):
    text = press[1].read_text()
    place = text.index("\n -1", text.index(" -4  DISP")) + len("\n -1") + 10
    path = tmp_path / "job.frd"
    path.write_text(text[:place] + number + text[place + 12 :])
    with pytest.raises(
        DatasetError, match=r"job.frd: cannot be read as results of CalculiX: no number in the line '-1 "
    ):
        read_series(path, NAMES, deck=press[0])


def test_vibrations_are_no_frames(press, tmp_path):
    path = tmp_path / "job.frd"
    path.write_text(press[1].read_text().replace(" -4  STRESS  ", " -4  DISPI   "))
    with pytest.raises(DatasetError, match=r"job.frd: holds DISPI, the displacement of a vibration at a frequency"):
        read_series(path, NAMES, deck=press[0])


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("keyword", ["CREEP", "VISCOELASTIC, TIME=PRONY", "DRUCKER PRAGER"])
def test_a_material_with_another_law_has_no_columns(press, tmp_path, keyword, order):
    text = press[0].read_text()
    lines = ["*ELASTIC\n100., 0.4\n", f"*{keyword}\n1., 2., 3.\n"]
    assert lines[0] in text
    path = tmp_path / "job.inp"
    path.write_text(text.replace(lines[0], "".join(lines[::order])))
    read = read_series(press[1], NAMES, deck=path)
    assert read.scene.material is None
    assert f"has *{keyword.partition(',')[0].replace(' ', '')}; " in read.attributes["notes"]


@pytest.mark.parametrize("directions", ["0, 3", "3, 1"])
def test_directions_that_there_are_not_are_refused(press, tmp_path, directions):
    path = tmp_path / "job.inp"
    path.write_text(press[0].read_text().replace("FLOOR, 1, 3", f"FLOOR, {directions}"))
    with pytest.raises(DatasetError, match=rf"job.inp:\d+: holds the directions {directions.replace(', ', ' to ')}"):
        read_series(press[1], NAMES, deck=path)

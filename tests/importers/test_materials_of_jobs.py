"""Materials of jobs of CalculiX that depend on the temperature, or that have another law than they seem to have."""

import re

import numpy as np
import pytest
from test_jobs import solved
from test_kinds_of_jobs import CUBE, HEIGHT, cube, moved, read, step

from ast_sim.support.errors import DatasetError

TABLE = "*ELASTIC\n1000., 0.3, 20.\n600., 0.4, 120.\n400., 0.4, 220."
YIELDS = ["*PLASTIC", "50., 0., 20.", "80., 0.5, 20.", "30., 0., 120.", "40., 0.5, 120."]


def warm(value, *more, nodes="EACH"):
    return ["*INITIAL CONDITIONS, TYPE=TEMPERATURE", f"{nodes}, {value}", *more]


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    """A cube whose nodes have temperatures, so that CalculiX looks its material up at them."""
    return solved(tmp_path_factory.mktemp("warm"), cube(step(*moved(-0.1)), model=warm("70.")))


def edited(job, folder, elastic="*ELASTIC\n1000., 0.3", plastic=(), conditions=(), steps=()):
    """The job with other materials and conditions in its deck; the results stay."""
    text = job[0].read_text()
    old = "\n".join(warm("70."))
    assert "*ELASTIC\n1000., 0.3" in text and old in text
    text = text.replace("*ELASTIC\n1000., 0.3", "\n".join([elastic, *plastic])).replace(old, "\n".join(conditions))
    path = folder / "job.inp"
    path.write_text(text.replace("*NODE FILE", "\n".join([*steps, "*NODE FILE"])).replace("\n\n", "\n"))
    return read((path, job[1]))


@pytest.mark.parametrize(
    ("value", "young", "poisson", "stress"),
    [(20, 1000, 0.3, 50), (70, 800, 0.35, 40), (170, 500, 0.4, 30), (0, 1000, 0.3, 50), (999, 400, 0.4, 30)],
)
def test_the_one_temperature_of_a_deck_is_where_a_material_is_taken(job, tmp_path, value, young, poisson, stress):
    result = edited(job, tmp_path, TABLE, YIELDS, warm(f"{value}."))
    expected = np.array([young * 1e6, poisson, stress * 1e6], np.float32)
    np.testing.assert_allclose(result.scene.material, np.tile(expected, (len(CUBE.elements), 1)), rtol=1e-6)
    told = "young is 1000 at 20, 600 at 120, 400 at 220; poisson is 0.3 at 20, 0.4 at 120, 0.4 at 220;"
    assert f"the material M depends on the temperature ({told} yield_stress is" in result.attributes["notes"]
    assert f"taken at {value}" in result.attributes["notes"]


def test_calculix_looks_a_material_up_where_the_importer_does(tmp_path):
    """The same stress as with the one line of that temperature."""
    lines = cube(step(*moved(-0.1)), model=warm("70."))
    place = lines.index("1000., 0.3")
    of_table = [*lines[:place], *TABLE.split("\n")[1:], *lines[place + 1 :]]
    of_line = [*lines[:place], "800., 0.35", *lines[place + 1 :]]
    stress = [read(solved(tmp_path / name, some)).stress for name, some in (("a", of_table), ("b", of_line))]
    np.testing.assert_allclose(stress[0], stress[1], rtol=1e-5)


def test_each_body_is_taken_at_its_own_temperature(job, tmp_path):
    low = [1 + node for node in np.flatnonzero(HEIGHT < 2)]
    conditions = warm("120.", *(f"{node}, 20." for node in low))
    notes = edited(job, tmp_path, TABLE, conditions=conditions).attributes["notes"]
    mixed = (HEIGHT[CUBE.elements] == 2).any(axis=1).sum()  # elements with nodes of both temperatures
    assert f"and {mixed} of its elements have none that the deck says and keeps" in notes
    assert f"{mixed} elements have no isotropic *ELASTIC: no material is taken" in notes


STEPS = {
    "nothing says one": ([], []),
    "some nodes have one": (warm("20.", nodes="FLOOR"), []),
    "a step changes it": (warm("20."), ["*TEMPERATURE", "EACH, 90."]),
    "a step changes some": (warm("20."), ["*TEMPERATURE", "FLOOR, 90."]),
    "an amplitude": (warm("20."), ["*TEMPERATURE, AMPLITUDE=A", "EACH, 20."]),
    "another file": (warm("20."), ["*TEMPERATURE, FILE=heat.frd"]),
    "heat is computed": (warm("20."), ["*HEAT TRANSFER", "1., 1."]),
}


@pytest.mark.parametrize("case", STEPS)
def test_without_one_temperature_there_is_no_material(job, tmp_path, case):
    conditions, steps = STEPS[case]
    result = edited(job, tmp_path, TABLE, conditions=conditions, steps=steps)
    assert result.scene.material is None
    assert "say it for all nodes by *INITIAL CONDITIONS, TYPE=TEMPERATURE" in result.attributes["notes"]
    plain = edited(job, tmp_path, conditions=conditions, steps=steps)  # one line holds at all temperatures
    assert (plain.scene.material == np.array([1e9, 0.3], np.float32)).all()
    assert "depends on the temperature" not in plain.attributes["notes"]


def test_a_step_that_repeats_the_temperature_keeps_it(job, tmp_path):
    result = edited(job, tmp_path, TABLE, conditions=warm("120."), steps=["*TEMPERATURE", "EACH, 120."])
    assert (result.scene.material == np.array([6e8, 0.4], np.float32)).all()


OTHER = {
    "fields of elasticity": ("*ELASTIC, DEPENDENCIES=1\n1., 0.3, 20., 1.\n2., 0.3, 20., 2.", [], "DEPENDENCIES=1"),
    "fields of yielding": (
        "*ELASTIC\n1000., 0.3",
        ["*PLASTIC, DEPENDENCIES=1", "50., 0., 20., 1.", "30., 0., 20., 2."],
        r"\*PLASTIC that depends on field variables \(DEPENDENCIES=1\)",
    ),
    "orthotropic": (
        "*ELASTIC, TYPE=ENGINEERING CONSTANTS\n1., 1., 1., 0.3, 0.3, 0.3, 0.4, 0.4\n0.4",
        [],
        r"has \*ELASTIC, TYPE=ENGINEERINGCONSTANTS",
    ),
    "anisotropic": (
        "*ELASTIC, TYPE=ANISO\n" + "1., " * 8 + "\n" + "1., " * 8 + "\n1., 1., 1., 1., 1., 1.",
        [],
        "ANISO",
    ),
    "user's law": ("*ELASTIC\n1000., 0.3", ["*PLASTIC, HARDENING=USER", "5."], "PLASTIC, HARDENING=USER"),
    "rates": (
        "*ELASTIC\n1000., 0.3",
        ["*PLASTIC, RATE=0.", "50., 0.", "*PLASTIC, RATE=10.", "90., 0."],
        r"\*PLASTIC, RATE=",
    ),
    "scaled": ("*ELASTIC\n1000., 0.3", ["*PLASTIC, SCALESTRESS=2.", "50., 0."], "SCALESTRESS="),
    "parameters": (
        "*ELASTIC\n1000., 0.3",
        ["*PLASTIC, HARDENING=COMBINED, DATA TYPE=PARAMETERS", "50., 1., 2., 20.", "30., 1., 2., 90."],
        "several lines of DATA TYPE=PARAMETERS",
    ),
}


@pytest.mark.parametrize("case", OTHER)
def test_what_is_no_isotropic_law_of_the_temperature_alone_has_no_columns(job, tmp_path, case):
    elastic, plastic, told = OTHER[case]
    result = edited(job, tmp_path, elastic, plastic, warm("20."))
    assert result.scene.material is None
    assert re.search(told, result.attributes["notes"])


def test_one_line_with_fields_or_parameters_holds_everywhere(job, tmp_path):
    plastic = ["*PLASTIC, HARDENING=COMBINED, DATA TYPE=PARAMETERS", "50., 7., 2., 20."]
    result = edited(job, tmp_path, "*ELASTIC, DEPENDENCIES=1\n1000., 0.3, 20., 1.", plastic)
    assert (result.scene.material == np.array([1e9, 0.3, 5e7], np.float32)).all()


def test_the_first_stress_of_a_single_table_holds_from_no_strain_on(job, tmp_path):
    result = edited(job, tmp_path, "*ELASTIC\n1000., 0.3", ["*PLASTIC", "50., 0.002", "60., 0.4"])
    assert (result.scene.material == np.array([1e9, 0.3, 5e7], np.float32)).all()


@pytest.mark.parametrize(
    ("elastic", "plastic", "told"),
    [
        ("*ELASTIC\n1000., 0.3\n600., 0.4", [], r"\*ELASTIC: has two lines of the temperature 0"),
        ("*ELASTIC\n1000., 0.3, 20.\n600.", [], r"\*ELASTIC: its data line has fewer than 2 numbers"),
        ("*ELASTIC\n1000., 0.3, 20.\n600, 0,4, 120", [], "'600, 0,4, 120' has more entries than Young's modulus"),
        ("*ELASTIC\n1000., 0.3\n*ELASTIC\n600., 0.4", [], r"\*ELASTIC: stands twice in the material M"),
        ("*ELASTIC\n1000., 0.3", [*YIELDS, *YIELDS], r"\*PLASTIC: stands twice in the material M"),
        ("*ELASTIC\n1000., 0.3", [*YIELDS[:3], "30., 0.1, 120."], "first plastic strain at the temperature 120 is 0.1"),
        ("*ELASTIC\n1000., 0.3\n*MATERIAL, NAME=m", [], r"\*MATERIAL: there are two materials 'm'"),
    ],
)
def test_tables_that_say_two_things_are_refused(job, tmp_path, elastic, plastic, told):
    if elastic.endswith("=m"):
        elastic = "*ELASTIC\n1., 0.3\n*MATERIAL, NAME=m\n*ELASTIC\n1000., 0.3"
    with pytest.raises(DatasetError, match=rf"job.inp:\d+: .*{told}"):
        edited(job, tmp_path, elastic, plastic, warm("20."))

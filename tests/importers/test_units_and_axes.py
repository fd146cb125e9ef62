"""A simulation with another unit of stress, or with two axes exchanged, is told; what varies otherwise is not."""

from dataclasses import replace

import meshio
import numpy as np
import pytest
from data_samples import block
from varied_sets import simulation, turned, varied_set

from ast_sim.importers.convert import convert
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.named_field import NamedField
from ast_sim.plausibility.across import AcrossSimulations
from ast_sim.plausibility.motion import in_trajectory
from ast_sim.support.errors import DatasetError

STRESS = "simulations whose stress is another at the same strain"
MODULUS = "simulations whose stress does not go with their modulus"
DIGITS = "simulations whose Young's modulus may be in another unit"
AXES = "simulations whose axes stand in another order"
STEEL, SOFT = (2.1e11, 0.3), (2.1e5, 0.3)


def told(simulations):
    """(number of the simulation, what looks wrong)."""
    across = AcrossSimulations(dynamic=False)
    alone = [(str(number), one) for number, t in enumerate(simulations) for one in across.beside(str(number), t)]
    return [(int(name), one.what) for name, one in (*alone, *across.all_together())]


def several(count=6, **facts):
    rng = np.random.default_rng(0)
    presses = np.linspace(0.05, 0.1, count)
    return [simulation(rng, (3, 2, 1), press=press, **facts) for press in presses.tolist()]


def with_stress(one, factor):
    return replace(one, stress=one.stress * np.float32(factor))


def with_moduli(one, factors):
    material = (one.scene.material * factors).astype(np.float32)
    return replace(one, scene=replace(one.scene, material=material))


def test_ordinary_sets_are_told_of_nothing():
    for seed in range(40):
        assert told(varied_set(np.random.default_rng(seed))) == [], seed


@pytest.mark.parametrize("at", ["node", "element"])
@pytest.mark.parametrize("factor", [1e-6, 1e-3, 1e3, 1e6, 1 / 6894.757])
def test_a_stress_in_another_unit_is_told(at, factor):
    simulations = several(at=at, columns=False)
    simulations[2] = with_stress(simulations[2], factor)
    assert told(simulations) == [(2, STRESS)]


@pytest.mark.parametrize(("factor", "what"), [(1e-6, MODULUS), (1e-3, STRESS), (1e3, MODULUS), (1e6, MODULUS)])
def test_a_stress_is_measured_by_the_modulus_where_there_is_one(factor, what):
    simulations = several(material=STEEL)
    simulations[0] = with_stress(simulations[0], factor)
    assert told(simulations) == [(0, what)]


def test_a_displacement_in_metres_beside_a_mesh_in_millimetres_is_told():
    """In all simulations alike, each by itself."""
    simulations = [simulation(np.random.default_rng(0), (3, 2, 1), STEEL, press=press) for press in (0.1, 0.2, 0.3)]
    small = [
        replace(one, position=(rest + (one.position.astype(float) - rest) / 1000).astype(np.float32))
        for one in simulations
        for rest in [one.scene.rest_position]
    ]
    assert told(simulations) == []
    assert told(small) == [(row, MODULUS) for row in range(3)]


def test_the_modulus_alone_in_another_unit_is_told_by_the_stress():
    simulations = [simulation(np.random.default_rng(0), (3, 2, 1), (young, 0.3)) for young in (1e9, 2e9, 7e9, 3e10)]
    simulations[3] = with_moduli(simulations[3], (1e-6, 1))
    assert told(simulations) == [(3, MODULUS)]


def test_flat_elements_and_graded_materials_stop_nothing():
    """A dataset that was made otherwise may hold them."""
    simulations = several(material=STEEL)
    rest = simulations[0].scene.rest_position.copy()
    rest[simulations[0].scene.elements[0]] = rest[simulations[0].scene.elements[0][0]]
    simulations[0] = replace(simulations[0], scene=replace(simulations[0].scene, rest_position=rest))
    graded = np.linspace(1, 2, simulations[1].scene.num_elements)[:, None] ** (1, 0)
    simulations[1] = with_moduli(with_stress(simulations[1], 1.4), graded)
    simulations[2] = with_stress(simulations[2], 1e-6)
    assert told(simulations) == [(2, MODULUS)]


def test_other_materials_are_other_stresses():
    """Named by the columns, or yielding; of one unit."""
    rubber, steel = (several(3, material=material) for material in ((1e6, 0.49), STEEL))
    assert told([*rubber, *steel]) == []
    deep = [
        replace(one, position=one.position[-1:], stress=one.stress[-1:])
        for one in several(3, yields=1e-5, cells=(2, 2, 8))
    ]
    assert told([*several(3), *deep]) == []


@pytest.mark.parametrize("factor", [1e-9, 1e-6, 1e-3, 1e3])
def test_a_modulus_with_the_digits_of_the_others_is_told(factor):
    simulations = [replace(one, stress=None, stress_location=None) for one in several(material=STEEL)]
    assert told([*simulations, with_moduli(simulations[1], (factor, 1))]) == [(6, DIGITS)]


def test_moduli_of_other_digits_ratios_or_decades_are_not_told():
    simulations = [replace(one, stress=None, stress_location=None) for one in several(8, material=STEEL)]
    for changed in ((0.9e-6, 1), (1e-6, 1.5), (0.1, 1)):
        assert told([*simulations[:7], with_moduli(simulations[7], changed)]) == []
    decades = [with_moduli(one, (10.0 ** -(row % 4), 1)) for row, one in enumerate(simulations)]
    assert told(decades) == []


def test_the_axes_of_one_mesh_are_told_if_two_are_exchanged():
    simulations = several()
    simulations[0] = turned(simulations[0], lambda points: points[..., [0, 2, 1]])
    assert told(simulations) == [(0, AXES)]
    simulations[0] = turned(several()[0], lambda points: points[..., [1, 2, 0]])  # a turn is no mistake
    assert told(simulations) == []


def test_a_flat_mesh_across_another_axis_is_told():
    flat = [turned(one, lambda points: points * (1, 1, 0)) for one in several(3)]
    plates = [replace(one, scene=replace(one.scene, elements=one.scene.elements[:, :3])) for one in flat]
    plates = [replace(one, stress=None, stress_location=None) for one in plates]
    assert told(plates) == []
    assert told([*plates, turned(plates[0], lambda points: points[..., [0, 2, 1]] * 1.01)]) == [(3, AXES)]


@pytest.mark.parametrize(("share", "count"), [(1e-9, 1), (1e-3, 0), (1.5, 1), (0, 0)])
def test_a_yield_stress_that_cannot_be_one_is_told(share, count):
    one = several(1, material=STEEL)[0]
    material = np.column_stack([one.scene.material, share * one.scene.material[:, 0]]).astype(np.float32)
    one = replace(
        one, scene=replace(one.scene, material=material), attributes={"material": "young, poisson, yield_stress"}
    )
    findings = [finding.what for finding in in_trajectory(one)]
    assert findings.count("elements whose yield stress cannot be one") == count


@pytest.mark.parametrize("at", ["node", "element"])
def test_a_plastic_strain_of_an_elastic_body_is_told(at):
    """A yield stress explains it; so does a material of which Young's modulus is not known."""
    one = several(1, material=STEEL)[0]
    rows = one.scene.num_elements
    strained = np.zeros((one.num_frames, rows if at == "element" else one.scene.num_nodes, 1), np.float32)
    strained[-1, [2, 3] if at == "element" else one.scene.elements[2]] = 1e-3
    one = replace(one, fields={"PEEQ": NamedField(strained, at)})
    what = "elements with a plastic strain, but without a yield stress"
    told = [finding for finding in in_trajectory(one) if finding.what == what]
    assert [(one.count, one.places) for one in told] == [(2, "elements 2, 3") if at == "element" else (1, "element 2")]
    young = one.scene.material[:, 0]
    for limit, count in ((3e8, 0), (0, len(told))):
        material = np.column_stack([one.scene.material, np.full(rows, limit)]).astype(np.float32)
        named = {"material": "young, poisson, yield_stress"}
        metal = replace(one, scene=replace(one.scene, material=material), attributes=named)
        assert [finding.what for finding in in_trajectory(metal)].count(what) == count
    number = replace(one, scene=replace(one.scene, material=young[:, None]), attributes={"material": "number"})
    assert what not in [finding.what for finding in in_trajectory(number)]


def written(folder, order=(0, 1, 2), pascals=1.0, cells=(2, 2, 1), press=0.1):
    folder.mkdir(parents=True)
    mesh = block(*cells)
    for frame in range(4):
        moved = mesh.rest_position * (1, 1, 1 - press * frame)
        stress = {"von_mises": [np.full(mesh.num_elements, 1e6 * press * frame * pascals)]}
        file = folder / f"f{frame}.vtu"
        meshio.Mesh(moved[:, list(order)], [("tetra", mesh.elements)], {}, stress).write(file)


def test_convert_names_the_simulations_and_strict_refuses_them(tmp_path, recwarn):
    for number, name in enumerate("abcdefg"):
        facts = {"order": (0, 2, 1)} if name in "bd" else {"pascals": 1e-6} if name in "ceg" else {}
        written(tmp_path / name, press=0.05 + 0.01 * number, cells=(2, 2 + number % 2, 1), **facts)
    names = FieldNames(handle="0:xmin")
    counts = convert(tmp_path, tmp_path / "o.h5", names=names, splits={"train": 1}, progress=False)
    lines = [str(one.message) for one in recwarn]
    assert counts["train"] == 7
    assert any(f"3 {STRESS}" in line and "in 3 simulations (c, e, g); c: stress divided" in line for line in lines)
    assert any(f"2 {AXES}" in line and "in 2 simulations (b, d); b: all elements" in line for line in lines)
    with pytest.raises(DatasetError, match=f"3 {STRESS}.*2 {AXES}"):
        convert(tmp_path, tmp_path / "p.h5", names=names, splits={"train": 1}, strict=True, progress=False)
    assert not (tmp_path / "p.h5").exists()


@pytest.mark.parametrize(("order", "mirrored"), [((0, 1, 2), 0), ((0, 2, 1), 1), ((1, 2, 0), 0)])
def test_a_simulation_keeps_whether_its_elements_were_inside_out(tmp_path, order, mirrored):
    written(tmp_path / "a", order)
    assert read_series(tmp_path / "a", FieldNames(handle="0:xmin")).attributes.get("mirrored", 0) == mirrored

"""A material is known by the names of its columns, never by their number or order."""

from dataclasses import replace

import numpy as np
import pytest
import toy

from ast_sim import Answer, Dataset, DatasetInfo, DatasetWriter, Effort, Material, Run, example_run, generate, train
from ast_sim.batches.out_of_balance import ElasticTetrahedra
from ast_sim.material import hints
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from ast_sim.mechanics.reaction import Reaction
from ast_sim.support.errors import ConfigError, DatasetError, SimulationError
from ast_sim.training.data_lengths import measure

NUMBERS = (2e5, 0.25)


def trained(folder, names, numbers) -> tuple[Run, Answer]:
    """A run that jumps, of plates with these columns, and its answer to one of them."""
    info = replace(toy.info(), generator={} if names is None else {"material": names})
    with DatasetWriter(folder / "d.h5", info) as writer:
        for split, seed in (("train", 0), ("valid", 1)):
            truth = toy.plate(seed)
            material = np.full((truth.scene.num_elements, len(numbers)), numbers, np.float32)
            writer.add(split, replace(truth, scene=replace(truth.scene, material=material)))
    run = train(folder / "d.h5", folder / "run", model="mgn", model_settings={"hidden": 16, "jumps": True}, steps=1)
    with Dataset(folder / "d.h5") as data:
        return run, run.predict(data["train"][0])


@pytest.mark.parametrize("names", [["thickness", "density"], None, ["young", "poisson", "yield_stress"]])
def test_columns_of_another_meaning_are_no_moduli(tmp_path, names):
    """Their numbers would do for Young's modulus and Poisson's ratio."""
    numbers = NUMBERS if names is None else (*NUMBERS, 1e3)[: len(names)]
    run, answer = trained(tmp_path, names, numbers)
    known = ", ".join(names or ["column 0", "column 1"])
    message = f"the law of the material is not known: it has the columns {known}, but needs Young's modulus"
    with pytest.raises(ConfigError, match=f"scene has no reaction: {message}"):
        answer.reaction()
    with pytest.raises(ConfigError, match=f"newton_steps is 1, but {message}"):
        run.predict(answer.scene, {1: (0, 0, -0.01)}, effort=Effort(0, 1))
    assert "reaction" not in answer.figures()[-1] and run.settings.model.data.columns == tuple(known.split(", "))
    same = ElasticTetrahedra.of(answer.scene, Material()).lame  # all elements have one stiffness
    assert np.array_equal(ElasticTetrahedra.of(answer.scene, run.settings.model.data.material).lame, same)


def test_own_data_have_a_reaction_in_any_order_of_the_columns(tmp_path):
    run, answer = trained(tmp_path, ["poisson", "young"], NUMBERS[::-1])
    force = Reaction(answer.scene, answer.driven, NeoHookean(*np.float32(NUMBERS).astype(float)))
    expected = [force.of(position) for position in answer.position]
    np.testing.assert_allclose(answer.reaction(), expected, rtol=1e-12)
    assert answer.figures()[-1]["reaction"] == pytest.approx(np.linalg.norm(expected[-1])) and np.any(expected[-1])
    exact = run.predict(answer.scene, {1: (0, 0, -0.001)}, frames=[-1], effort=Effort(0, 20))
    assert exact.converged and np.isfinite(exact.reaction()).all()


@pytest.mark.parametrize("names", [["young", "poisson"], ["thickness", "density"], None])
def test_a_saved_answer_keeps_the_names_so_its_run_takes_it(tmp_path, names):
    run, answer = trained(tmp_path, names, NUMBERS)
    answer.save(tmp_path / "answer.h5")
    columns = tuple(names or ("column 0", "column 1"))
    with Dataset(tmp_path / "answer.h5") as saved:
        assert saved.material.columns == run.info.material(2).columns == answer.info.material(2).columns == columns
    with pytest.warns(
        UserWarning, match=r"learned from these scenes \(.*d.h5, split train\): new ones have larger err"
    ):
        run.evaluate(tmp_path / "d.h5", "train", solver_scenes=0)
    assert run.evaluate(tmp_path / "answer.h5", solver_scenes=0).figures.error("displacement").rmse_sequence == 0


def test_runs_that_come_with_the_package_know_the_names():
    states = ("yield_stress", "yield_stress_2", "plastic_strain_2", "yield_stress_3", "plastic_strain_3")
    assert example_run("clip").info.material(7).columns == ("young", "poisson", *states)
    assert example_run("plates").info.material(0) == Material()


def test_plates_have_the_reaction_of_the_solver(tmp_path, monkeypatch):
    """Their constants are recorded, and are no columns."""
    generate("deforming_plate", tmp_path / "d.h5", train=1, nodes=150, frames=3, workers=1, progress=False)
    with Dataset(tmp_path / "d.h5") as data:
        truth = data["train"][0]
    assert truth.scene.material is None
    with pytest.warns(UserWarning, match="in training"):
        answer = example_run("plates").predict(truth, effort=Effort(newton_steps=1), throw=False)
    answer = replace(answer, position=truth.position)  # after Newton steps the force is of the positions, not predicted
    forces = np.linalg.norm(answer.reaction(), axis=1)
    # Young's modulus times an edge times the rounding of positions, 1e6 Pa x 0.05 m x 1e-8 m: 5e-4 N at each of some
    # ten nodes near the tool.
    np.testing.assert_allclose(forces, truth.attributes["reaction"], rtol=1e-3, atol=5e-3)
    assert forces[1] > 100
    monkeypatch.setattr(Reaction, "unseen", property(lambda _: True, lambda *_: None), raising=False)
    with pytest.warns(UserWarning, match="body 1 touches held nodes where no free node shows how hard"):
        answer.reaction()


def test_names_come_from_the_dataset_or_its_family():
    info = replace(toy.info(), generator={"material": ["nu", "E"]})
    assert info.material(2).columns == ("nu", "E") and info.material(2).law is None
    assert toy.info().material(2).columns == ("column 0", "column 1") and toy.info().material(0) == Material()
    assembly = replace(toy.info(), family="assembly")
    assert [assembly.material(width).law for width in (0, 1, 2, 3, 4)] == [
        None,
        None,
        "neo_hookean",
        "neo_hookean",
        None,
    ]
    assert assembly.material(3).columns == ("young", "poisson", "friction")
    for names, told in ((["young"], "young"), ([], "none")):
        wrong: DatasetInfo = replace(toy.info(), generator={"material": names})
        with pytest.raises(DatasetError, match=f"has 2 columns, but generator\\['material'\\] names {told}: give"):
            wrong.material(2)


def test_numbers_by_name():
    values = np.float32([[1, 2], [3, 4]])
    material = Material(("friction", "young"), {"young": 7.0, "poisson": 0.3})
    assert material.numbers("young", values).tolist() == [2, 4] and material.numbers("poisson", values) == 0.3
    with pytest.raises(ConfigError, match="the material has no density; it has friction, young, poisson"):
        material.numbers("density", values)
    with pytest.raises(ConfigError, match="the material has 0 columns, but 2 names: friction, young"):
        material.numbers("young", None)


def test_constants_that_are_not_allowed_have_no_reaction(tmp_path):
    _, answer = trained(tmp_path, ["young", "poisson"], (2e5, -0.1))  # not of the solver
    with pytest.raises(ConfigError, match=r"no reaction: Young's modulus must be positive and Poisson's ratio in \["):
        answer.reaction()
    with pytest.raises(SimulationError):
        answer.law.of_elements(answer.scene)


WRONG = {
    "negative modulus": (
        ["young", "poisson"],
        (-1, 0.3),
        r"young of the material is -1 in element 0, .* above 0 \(pasc",
    ),
    "swapped": (
        ["young", "poisson"],
        (0.3, 2e5),
        "poisson of the material is 200000 in .* above -1 and below 0.5; so in",
    ),
    "no volume change": (
        ["young", "poisson"],
        (2e5, 0.5),
        "poisson of the material is 0.5 in .*: are the columns in the",
    ),
    "negative friction": (
        ["friction"],
        (-0.1,),
        "friction of the material is -0.1 in element 0, and must be at least 0",
    ),
    "a name for two": (["young"], (2e5, 0.3), "has 2 columns, but generator.* names young: give each column one name"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_no_material_has_is_refused_where_it_is_written(tmp_path, wrong):
    names, numbers, message = WRONG[wrong]
    with pytest.raises(DatasetError, match=message):
        trained(tmp_path, names, numbers)
    assert not list(tmp_path.glob("*.h5"))


@pytest.mark.parametrize("use", ["train", "predict"])
def test_what_no_material_has_is_refused_in_trainings_and_predictions(tmp_path, use, monkeypatch):
    if use == "predict":
        run, answer = trained(tmp_path, ["young", "poisson"], NUMBERS)
        material = answer.scene.material * np.float32([-1, 1])
        with pytest.raises(
            DatasetError, match=r"scene: young of the material is -200000 in element 0, and must be above"
        ):
            run.predict(replace(answer.scene, material=material), {1: (0, 0, -0.01)})
        return
    with monkeypatch.context() as lax:  # a file of another writer
        lax.setattr(Material, "require_possible", lambda *_: None)
        with DatasetWriter(tmp_path / "d.h5", replace(toy.info(), generator={"material": ["poisson"]})) as writer:
            truth = toy.plate(0)
            material = np.full((truth.scene.num_elements, 1), 0.7, np.float32)
            writer.add("train", replace(truth, scene=replace(truth.scene, material=material)))
    with pytest.raises(DatasetError, match="train/000000: poisson of the material is 0.7 in element 0"):
        train(tmp_path / "d.h5", tmp_path / "run", steps=1)


def test_rigid_elements_may_have_any_number(tmp_path):
    truth = toy.plate(0)
    rigid = truth.scene.rigid_elements
    material = np.where(rigid[:, None], 0, NUMBERS).astype(np.float32)
    with DatasetWriter(tmp_path / "d.h5", replace(toy.info(), generator={"material": ["young", "poisson"]})) as writer:
        writer.add("train", replace(truth, scene=replace(truth.scene, material=material)))
    assert rigid.any() and writer.counts["train"] == 1


@pytest.mark.parametrize("names", [["E", "nu"], ["Young", "Poisson's ratio"], ["mine", "other"]])
def test_names_that_look_like_others_are_told(tmp_path, names):
    hinted = hints(names)
    assert len(hinted) == (0 if names[0] == "mine" else 2)
    if hinted:
        assert hinted[0].startswith(
            f"the column '{names[0]}' of the material has no meaning here: if it is what 'young'"
        )
        with pytest.warns(UserWarning, match=f"d.h5: the column '{names[0]}' of the material has no meaning here"):
            trained(tmp_path, names, NUMBERS)
    assert hints(["young", "poisson", "friction", "yield_stress_2"]) == []


@pytest.mark.parametrize("names", [{"young": 1}, "young", ["young", "young"], ["young", ""], ["young", 3]])
def test_names_of_columns_are_checked_before_anything_is_written(names):
    with pytest.raises(DatasetError, match=r"d: generator\['material'\] is .*; must be a list with one name for each"):
        replace(toy.info(), generator={"material": names}).check("d")


def test_an_origin_that_json_does_not_hold_is_refused_by_name():
    with pytest.raises(DatasetError, match=r"d: generator\['a'\] is nothing that JSON holds: Object of type object"):
        replace(toy.info(), generator={"program": "x", "a": object()}).check("d")


def test_negative_stress_is_told_of_a_training(tmp_path):
    truth = toy.plate(0)
    with DatasetWriter(tmp_path / "d.h5", toy.info()) as writer:
        writer.add("train", replace(truth, stress=-truth.stress))
    with (
        Dataset(tmp_path / "d.h5") as data,
        pytest.warns(UserWarning, match=r"d.h5: \d+ stresses below zero .*no von M"),
    ):
        measure(data)


def test_a_material_keeps_its_names():
    given = Material(name for name in ("young", "poisson"))
    assert given.columns == ("young", "poisson") and given.law == given.law == "neo_hookean"
    assert hash(given) == hash(Material(["young", "poisson"])) and given == Material(["young", "poisson"])
    assert given.numbers("young", [[1, 0.3]]).tolist() == [1]
    for columns, message in (
        ({"young", "poisson"}, "of the type set, which has no order"),
        (["young", ""], "one line of text"),
        ([1], "must be a text"),
    ):
        with pytest.raises(ConfigError, match=message):
            Material(columns)
    for values in ([1, 0.3], [["a", "b"]]):
        with pytest.raises(ConfigError, match="they must be numbers"):
            given.numbers("young", values)
    for constants, message in (
        ({"young": -1}, r"young of a material is -1; it must be above 0 \(pascal\)"),
        ({"poisson": 0.6}, "poisson of a material is 0.6; it must be above -1 and below 0.5"),
        ({2: 1.0}, "must be a text"),
    ):
        with pytest.raises(ConfigError, match=message):
            Material((), constants)

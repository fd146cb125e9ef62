"""A trade, measured for real: the run that comes with the package and the solver on a small plate."""

import json
import shutil
from pathlib import Path

import pytest
import toy

import ast_sim
from ast_sim.cli import main
from ast_sim.simulate.jobs.fastest_solver import VARIANTS
from ast_sim.support.errors import ConfigError


@pytest.fixture(scope="module")
def plates(tmp_path_factory):
    data = tmp_path_factory.mktemp("plates") / "plates.h5"
    ast_sim.generate("deforming_plate", data, train=0, valid=0, test=1, nodes=200, frames=41, keep=(24,), seed=5)
    return data


def test_efforts_and_variants_are_measured_on_the_same_scene(plates, tmp_path, capsys):
    ast_sim.example_run("plates").save(tmp_path / "plates.ast")
    told = [str(tmp_path / "plates.ast"), str(plates), "--out", str(tmp_path / "pages" / "trade.html")]
    assert main(["trade", *told]) == 0
    assert "10 %: the run: " in capsys.readouterr().out
    by_quantity = json.loads((tmp_path / "pages" / "trade.json").read_text())
    assert list(by_quantity) == ["displacement", "reaction", "stress"]
    figures = by_quantity["displacement"]
    assert [len(figures[side]) for side in ("run", "solver")] == [8, len(VARIANTS)]
    own = next(one for one in figures["solver"] if one["name"] == "own stop test")
    assert own["errors"][0] < 1e-3 and own["seconds"][0] > 0
    (mesh,) = figures["mesh_errors"]  # a plate of 200 nodes is thin, and too stiff
    assert 0.02 < mesh < 0.3
    force, stress = by_quantity["reaction"], by_quantity["stress"]
    for one in (force, stress):
        kept = {way["name"]: way["errors"][0] for way in one["solver"]}
        assert kept["own stop test"] < 2e-3 < 0.02 < min(kept["1/2 nodes"], kept["1/4 nodes"])
        assert kept["1/2 nodes, own stop test, 3 Newton steps"] < 0.02
        assert one["run"][-1]["errors"][0] < 0.02 < one["run"][0]["errors"][0]
        assert 0.02 < one["mesh_errors"][0] < 1.5
    call, *_, newton = figures["run"]
    assert newton["errors"][0] < call["errors"][0] < 0.3
    assert call["command"].endswith("--corrections 0 --newton-steps 0") and figures["scenes"] == ["test/000000"]
    assert figures["origin"]["command"].startswith("ast-sim trade ")
    assert "What an error costs" in (tmp_path / "pages" / "trade.html").read_text()


def test_another_program_is_represented_by_its_seconds(plates):
    trade = ast_sim.trade(ast_sim.example_run("plates"), plates, solver_seconds=95.0)
    assert [one.solver[0].errors for one in trade.by_quantity.values()] == [(0.0,)] * 3
    figures = trade.figures
    (stated,) = figures.solver
    assert (stated.errors, stated.seconds) == ((0.0,), (95.0,))
    rows = figures.rows()
    assert rows[0].verdict == "the run" and rows[0].ratio > 100
    for seconds in (-1, "95"):
        with pytest.raises(ConfigError, match=f"seconds are {seconds!r}; they must be a number above 0"):
            ast_sim.trade(ast_sim.example_run("plates"), plates, solver_seconds=seconds)
    for scenes, must in ((0, "at least 1"), (-1, "at least 1"), (2.5, "a whole number"), ("3", "a whole number")):
        with pytest.raises(ConfigError, match=f"scenes is {scenes!r}; it must be {must}"):
            ast_sim.trade(ast_sim.example_run("plates"), plates, scenes=scenes)


def test_the_force_of_metal_that_yields_is_judged_by_what_the_dataset_holds():
    """No law gives it from positions."""
    clips = Path(__file__).parents[2] / "examples" / "clip" / "test_scenes.h5"
    by_quantity = ast_sim.trade(ast_sim.example_run("clip"), clips, scenes=2, solver_seconds=14.0).by_quantity
    assert list(by_quantity) == ["displacement", "reaction", "stress"]
    assert 1e-4 < max(by_quantity["reaction"].run[0].errors) < 0.1
    assert by_quantity["stress"].no_process == "it needs at least 10 training scenes, and the dataset has 0"


def test_where_our_solver_did_not_make_the_scenes_it_says_so(tmp_path):
    data = toy.write(tmp_path / "toy.h5", (3, 1, 2))
    small = {"hidden": 8, "blocks": 1}
    run = ast_sim.train(data, tmp_path / "run", steps=2, batch_size=2, model="mgn", model_settings=small)
    result = ast_sim.trade(run, data)
    assert result.figures.solver == () and result.figures.invested is None
    assert len(result.figures.scenes) == 2
    assert result.figures.notes[0].startswith("The solver was not run: ") and result.figures.notes[0] in str(result)
    with pytest.raises(ConfigError, match="split valid moves|no scene"):
        ast_sim.trade(run, toy.write(tmp_path / "none.h5", (1, 0, 1)), "valid")


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """Plates, and two models that have learned from them."""
    folder = tmp_path_factory.mktemp("learned")
    data = folder / "plates.h5"
    ast_sim.generate("deforming_plate", data, train=2, valid=1, test=1, nodes=200, frames=41, keep=(24,), seed=5)
    for name, model, settings in (("tokens", "ast", {"hidden": 16, "L_SA": 1}), ("messages", "mgn", {"blocks": 1})):
        ast_sim.train(
            data, folder / name, steps=2, batch_size=2, preset="tiny", model=model, model_settings=settings,
            progress=False,
        )  # fmt: skip
    return data, folder / "tokens", folder / "messages"


def test_another_model_of_the_same_data_stands_beside_the_run(learned, tmp_path, capsys):
    data, run, other = map(str, learned)
    assert main(["trade", run, data, "--beside", other, "--out", str(tmp_path / "trade.html")]) == 0
    assert "; messages: " in capsys.readouterr().out
    by_quantity = json.loads((tmp_path / "trade.json").read_text())
    for figures in by_quantity.values():
        (side,) = figures["others"]
        assert side["name"] == "messages" and figures["rows"][0]["others"].keys() == {"messages"}
        assert [one["name"] for one in side["settings"]] == [one["name"] for one in figures["run"]]
        assert 0 < side["settings"][-1]["errors"][0] < 2e-3  # the solver goes on from its answer, too
        assert all(" messages " in one["command"] for one in side["settings"])
    own, theirs = figures["run"][0], by_quantity["displacement"]["others"][0]["settings"][0]
    assert own["errors"] != theirs["errors"] and own["seconds"] != theirs["seconds"]
    assert "messages" in (tmp_path / "trade.html").read_text()


def test_only_runs_of_the_same_data_stand_beside_each_other(learned, tmp_path):
    data, run, other = learned
    strange = ast_sim.example_run("plates")
    with pytest.raises(ConfigError, match=r"plates.ast has learned from another dataset \(.*h5\) than .*tokens "):
        ast_sim.trade(ast_sim.Run(run), data, beside=[ast_sim.Run(other), strange])
    with pytest.raises(ConfigError, match="two runs are called tokens: rename the run"):
        ast_sim.trade(ast_sim.Run(run), data, beside=[ast_sim.Run(run)])
    process = shutil.copytree(run, tmp_path / "Gaussian process")
    with pytest.raises(ConfigError, match="a Gaussian process is called Gaussian process: rename the run"):
        ast_sim.trade(ast_sim.Run(run), data, beside=[ast_sim.Run(process)])


@pytest.mark.parametrize("split", ["train", "valid"])
def test_scenes_of_the_training_are_known_in_a_copy_of_the_dataset_and_to_a_file_of_the_run(learned, tmp_path, split):
    data, run, _ = learned
    copy = shutil.copy(data, tmp_path / "copy.h5")
    ast_sim.Run(run).save(tmp_path / "run.ast")
    for known in (run, tmp_path / "run.ast"):
        with pytest.raises(ConfigError, match=f"the scenes of {split} have trained or chosen the run"):
            ast_sim.trade(ast_sim.Run(known), copy, split)
        with pytest.raises(ConfigError, match=f"the scenes of {split} have trained or chosen the run"):
            ast_sim.calibrate(ast_sim.Run(known), copy, split)

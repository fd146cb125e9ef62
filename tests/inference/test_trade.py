"""A trade, measured for real: the run that comes with the package and the solver on a small plate."""

import json

import pytest
import toy
from toy import one_thread  # noqa: F401 (used by being imported)

import ast_sim
from ast_sim.cli import main
from ast_sim.simulate.jobs.fastest_solver import VARIANTS
from ast_sim.support.errors import ConfigError


@pytest.fixture(scope="module")
def plates(tmp_path_factory):
    data = tmp_path_factory.mktemp("plates") / "plates.h5"
    ast_sim.generate("deforming_plate", data, train=0, valid=0, test=1, nodes=200, frames=41, keep=(24,), seed=5)
    return data


def test_efforts_and_ways_are_measured_on_the_same_scene(plates, tmp_path, capsys):
    ast_sim.example_run("plates").save(tmp_path / "plates.ast")
    told = [str(tmp_path / "plates.ast"), str(plates), "--out", str(tmp_path / "pages" / "trade.html")]
    assert main(["trade", *told]) == 0
    assert "10 %: run: " in capsys.readouterr().out
    by_quantity = json.loads((tmp_path / "pages" / "trade.json").read_text())
    assert list(by_quantity) == ["displacement", "reaction", "stress"]
    figures = by_quantity["displacement"]
    assert [len(figures[side]) for side in ("run", "solver")] == [5, len(VARIANTS)]
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
    with pytest.raises(ConfigError, match="seconds are -1; they must be above 0"):
        ast_sim.trade(ast_sim.example_run("plates"), plates, solver_seconds=-1)


def test_where_our_solver_did_not_make_the_scenes_it_says_so(tmp_path):
    data = toy.write(tmp_path / "toy.h5", (3, 1, 2))
    small = {"hidden": 8, "blocks": 1}
    run = ast_sim.train(data, tmp_path / "run", steps=2, batch_size=2, model="mgn", model_settings=small)
    result = ast_sim.trade(run, data)
    assert result.figures.solver == () and result.figures.invested is None
    assert len(result.figures.scenes) == 2
    assert str(result).splitlines()[-1].startswith("the solver was not run: ")
    with pytest.raises(ConfigError, match="split valid moves|no scene"):
        ast_sim.trade(run, toy.write(tmp_path / "none.h5", (1, 0, 1)), "valid")

"""The figures of an evaluation are read again as they were written."""

import json
from pathlib import Path

from chosen_figures import evaluation

from ast_sim.figures import Figures

DEMO = Path(__file__).parents[1] / "benchmarks" / "results" / "demo.json"


def test_the_figures_of_the_demo_are_read_again():
    values = json.loads(DEMO.read_text())
    figures = Figures.from_json(values)
    assert json.loads(json.dumps(figures.to_json())) == values
    assert Figures.from_json(figures.to_json()) == figures
    assert (
        figures.error("displacement").rmse_sequence
        == (values["errors"]["displacement"]["model"]["rollout_all"]["normal"]["rmse_sequence"])
    )
    scene, *_ = figures.deepest.scenes
    assert (len(scene.after_calls), len(scene.after_newton_steps)) == (1, 10)
    assert scene.after_newton_steps[-1] == scene.relative_error
    assert scene.solver.variants["own stop test"].seconds == scene.solver.seconds
    assert figures.deepest.solver.scenes == sum(one.solver is not None for one in figures.deepest.scenes)


def test_what_failed_is_read_again():
    figures = evaluation({"a": 1e-3, "b": None})
    again = Figures.from_json(json.loads(json.dumps(figures.to_json())))
    assert again.to_json() == figures.to_json() and again.scenes == figures.scenes
    assert again.scenes[1].error("displacement") is None

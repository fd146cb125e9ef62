"""The study of nested iteration, from end to end on a scene of 100 nodes."""

import json
from dataclasses import replace

import pytest
from chosen_figures import NO_DEEPEST

from ast_sim.figures import DeepestFrame, SolverFigures, VariantFigures
from ast_sim.simulate.jobs.fastest_solver import VARIANTS
from benchmarks.studies import nested
from benchmarks.studies.phrases import settings_tried


def test_a_scene_from_end_to_end(tmp_path, monkeypatch, one_thread):
    plates = nested.Plates("Small plates", 100, "test", 1, frames=5, keep=None, rounds=1, run=True)
    monkeypatch.setattr(nested, "SETS", (plates,))
    monkeypatch.setattr(nested, "RESULTS", tmp_path / "results" / "nested.json")
    monkeypatch.setattr(nested, "PAGE", tmp_path / "nested.md")
    nested.main(["100", "--folder", str(tmp_path)])
    (scene,) = json.loads(nested.RESULTS.read_text())["100"]["measured"]
    assert (
        len(scene["variants"]) == 36
        and len(nested.NESTED) == 20
        and list(scene["answers"]) == [effort.text for effort in nested.EFFORTS]
    )
    assert nested.cheapest(scene, 0.1, nested=True)[1] <= nested.cheapest(scene, 0.1, nested=False)[1]
    with pytest.raises(SystemExit):
        nested.main(["400"])
    text = nested.PAGE.read_text()
    assert "Scenes: 1, of the split test, measured once." in text and text.count("| 0.5 % |") == 1
    assert f"| {nested.EFFORTS[1].text} |" in text


def test_the_cheapest_of_a_scene():
    name = min(nested.NESTED)
    variants = {
        "own stop test": {"seconds": 3.0, "relative_error": 0.0},
        "1/2 nodes": {"seconds": 1.0, "relative_error": 0.08},
        name: {"seconds": 2.0, "relative_error": 0.004},
        "6 linearised steps": {"seconds": None, "relative_error": None},
    }
    scene = {"variants": variants}
    assert nested.cheapest(scene, 0.1, nested=True) == ("1/2 nodes", 1.0)
    assert nested.cheapest(scene, 0.01, nested=True) == (name, 2.0)
    assert nested.cheapest(scene, 0.01, nested=False) == ("own stop test", 3.0)
    assert nested.cheapest({"variants": {"1/2 nodes": variants["1/2 nodes"]}}, 0.01, nested=True) is None
    without, with_nested, ratio, names = nested._compared([scene, scene], [0.01, 0.01])
    assert (without, with_nested, ratio, names) == ("3000 ms", "2000 ms", "1.50 ± 0.00", f"{name}: 2")


def test_the_solver_wins_where_the_run_is_slower_or_not_as_accurate():
    variants = {"own stop test": {"seconds": 0.03, "relative_error": 0.0}}
    answers = {"0": {"seconds": 0.02, "relative_error": 0.04}, "1": {"seconds": 0.04, "relative_error": 0.01}}
    scenes = [{"variants": variants, "answers": answers}, {"variants": variants, "answers": {"0": answers["1"]}}]
    assert nested._run_at(scenes, 0.05) == ("30 ms in 2", 1)
    assert nested._run_at(scenes, 0.02) == ("40 ms in 2", 2)
    assert nested._run_at(scenes, 0.005) == ("none", 2)


def test_a_faster_time_is_kept():
    known = {}
    for seconds in (None, 2.0, 3.0, 1.0, None):
        nested._keep_faster(known, "way", {"seconds": seconds})
    assert known == {"way": {"seconds": pytest.approx(1.0)}}


def test_rows_say_in_how_many_settings_the_solver_was_run():
    def solved(*names):
        solver = SolverFigures(1.0, None, None, dict.fromkeys(names, VariantFigures()))
        frame = DeepestFrame("test/000000", 400, 1, 0.1, 0.01, (0.01,), (), 0.01, None, None, None)
        return replace(NO_DEEPEST, scenes=(replace(frame, solver=solver), frame))

    plain = [variant.name for variant in VARIANTS[:13]]
    every = [variant.name for variant in VARIANTS]
    old = {"A": solved(*plain), "B": solved(*plain)}
    assert settings_tried(old) == "13 settings"
    assert settings_tried({"C": solved(*every)}) == settings_tried({}) == "36 settings, nested iteration among them,"
    assert settings_tried({**old, "C": solved(*every), "D": solved(*every)}) == (
        "13 settings (36, nested iteration among them, for C, D)"
    )

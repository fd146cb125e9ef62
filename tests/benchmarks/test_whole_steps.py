"""Whole steps beside their targets: what a record says, one measurement from end to end, the page."""

import json
import math
from types import SimpleNamespace

import pytest

from ast_sim.simulate.jobs.generate import generate
from ast_sim.support.precisions import PRECISIONS
from benchmarks.steps import __main__ as steps
from benchmarks.steps import newton_worker, scenes, whole_steps
from benchmarks.steps.training_step import Worker
from benchmarks.steps.whole_steps import Place, Record


def test_a_bound_is_kept_or_not():
    assert Record("speed", 2.5, "times", least=2.5).reached and not Record("speed", 2.4, "times", least=2.5).reached
    assert Record("memory", 8.0, "GB", most=8).reached and not Record("memory", 8.1, "GB", most=8).reached
    assert Record("speed", None, "times", least=1.3).to_json() == {
        "what": "speed", "value": None, "unit": "times", "target": "at least 1.3", "reached": False, "note": ""
    }  # fmt: skip


def test_newton_steps_make_records_and_a_page(tmp_path, monkeypatch, capsys):
    told = {"setup": [0.01, 0.02, 0.03], "steps": [[0.05, 0.03], [0.07, 0.01], [0.06, 0.02]]}
    monkeypatch.setattr(whole_steps.newton, "sample", lambda tree, case, *_: told if case.startswith("plate") else None)
    monkeypatch.setattr(steps, "RESULTS", tmp_path / "steps.json")
    monkeypatch.setattr(steps, "PAGE", tmp_path / "steps.md")
    before = whole_steps.NOW  # any folder with a commit
    steps.main(["newton", "--before", str(before), "--json", str(steps.RESULTS)])
    records = json.loads(steps.RESULTS.read_text())["newton"]["records"]
    assert [record["value"] for record in records] == [20.0, 60.0, None]
    page = steps.PAGE.read_text()
    assert "0 of 3 targets are reached." in page
    assert "| a Newton step, plate of 1,302 nodes | 60 ms | at most 15 | **no** | in turn 60, 20 ms |" in page
    assert "none within 600 s" in page
    with pytest.raises(SystemExit):
        steps.main(["nothing", "--before", "."])


def test_a_step_is_timed_on_one_thread_and_on_two_and_in_both_precisions(tmp_path, monkeypatch):
    data = tmp_path / "small.h5"
    generate("deforming_plate", data, train=2, valid=0, test=1, nodes=100, frames=3, progress=False)
    case = scenes.Case("tiny", ["train.batch_size=2"], data, 200, "", "", steps=1, most_repeats=2, every_thread=False)
    monkeypatch.setattr(whole_steps.scenes, "make", lambda *_: case)
    begun = {}  # all presets are one case here, so they share their processes

    def worker(backend, threads, setup, log):
        kind = (backend, threads, *setup.settings)
        begun[kind] = begun.get(kind) or Worker(backend, threads, setup, log)
        return SimpleNamespace(ask=begun[kind].ask, close=lambda: None)

    monkeypatch.setattr(whole_steps, "Worker", worker)
    place = Place(tmp_path, tmp_path, 3)
    for measure, targets in ((whole_steps.threads, [1.6, 1.7, 0.97]), (whole_steps.precision, [1.3, 1, 1, 1])):
        records = list(measure(place))
        assert [record.least for record in records] == targets
        assert all(math.isfinite(record.value) and record.value > 0 for record in records)
    for process in begun.values():
        process.close()
    batch = "train.batch_size=2"
    assert set(begun) == {
        ("c", 1, batch),
        ("c", 2, batch),
        *(("c", 1, batch, f"train.precision={kind}") for kind in PRECISIONS),
    }


def test_a_batch_is_timed_beside_one_scene(tmp_path, monkeypatch):
    monkeypatch.setattr(whole_steps, "TOGETHER", 2)
    data = tmp_path / "plates.h5"
    generate("deforming_plate", data, train=0, valid=0, test=2, nodes=400, frames=3, progress=False)
    alone, each = whole_steps._alone_and_together(data, 2)
    assert len(alone) == len(each) == 2 and min(alone + each) > 0


def test_the_workers_cases_are_those_of_the_records():
    assert {"plate of 1,302 nodes", "two blocks of 26,450 nodes"} <= set(newton_worker.CASES)

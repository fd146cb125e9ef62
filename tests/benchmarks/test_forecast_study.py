"""The study of forecasts, from end to end on plates of 80 nodes."""

import json
import math

import pytest

from ast_sim.number_arrays import percent
from ast_sim.planning.forecast import DAMPING
from benchmarks.studies import forecasts


def test_a_row_from_end_to_end(tmp_path, monkeypatch, one_thread):
    made = {"train": 4, "valid": 1, "test": 0, "nodes": 80, "frames": 5, "keep": (2, 3), "seed": 1}
    few = {"train.batch_size": 2, "train.statistics_pairs": 4, "model.num_tokens": 16}
    monkeypatch.setattr(forecasts, "ROWS", {"few": forecasts.Row("Few plates", "few", "deforming_plate", made, 3, few)})
    monkeypatch.setattr(forecasts, "RESULTS", tmp_path / "results" / "forecasts.json")
    monkeypatch.setattr(forecasts, "PAGE", tmp_path / "forecasts.md")
    forecasts.main(["few", "--folder", str(tmp_path)])
    row = json.loads(forecasts.RESULTS.read_text())["few"]
    best = [trial for trial in row["trials"] if trial["name"] == row["whole"]["name"]]
    first = 1 if "wider" in best[0]["name"] else 3
    assert [trial["steps"] for trial in best] == [first, 3 * first, 9 * first]
    assert row["whole"]["steps"] == 54 * first and row["half"]["scenes"] == 2
    text = forecasts.PAGE.read_text()
    assert "| Few plates | " in text
    power = math.log(best[1]["error"] / best[2]["error"]) / math.log(3)
    error = best[2]["error"] * 6 ** (-DAMPING * power)
    low, high = 0.7 * error, 1.3 * error
    if power > 0:
        assert f"({percent(low, 3)} to {percent(high, 3)})" in text
        assert f"{int(low <= row['whole']['error'] <= high)} of 1 trainings" in text
    else:
        assert "steps: none |" in text and "0 of 0 trainings" in text and "1 training had no forecast" in text


def test_an_error_that_does_not_fall_has_no_forecast():
    errors = [0.1, 0.02, 0.021]
    trials = [{"name": "tiny", "steps": 40 * 3**i, "error": errors[i]} for i in range(3)]
    row = {"title": "Hooks", "trials": trials, "half": trials[2], "whole": {"steps": 2160, "error": 0.002}}
    text = forecasts.page({next(iter(forecasts.ROWS)): row})
    assert "| 2,160 steps: none | 0.2 % |" in text
    assert text.endswith("\n0 of 0 trainings ended within the interval of their forecast. 1 training had no forecast.")


def test_another_row_is_refused():
    with pytest.raises(SystemExit):
        forecasts.main(["none"])

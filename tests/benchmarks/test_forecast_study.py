"""The study of forecasts, from end to end on plates of 80 nodes."""

import json

import pytest
import torch

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
    power = max(0.0, torch.tensor(best[1]["error"] / best[2]["error"]).log().item() / torch.tensor(3.0).log().item())
    assert row["expected"]["error"] == pytest.approx(best[2]["error"] * 6 ** (-DAMPING * power), rel=1e-5)
    text = forecasts.PAGE.read_text()
    assert "| Few plates | " in text
    assert f"{int(row['expected']['low'] <= row['whole']['error'] <= row['expected']['high'])} of 1 trainings" in text
    with pytest.raises(SystemExit):
        forecasts.main(["none"])

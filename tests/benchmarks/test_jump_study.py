"""The study of jumps, from end to end on scenes of 100 nodes."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from ast_sim.inference.effort import DIALS, Effort
from benchmarks.studies import jumps


@pytest.fixture
def small(monkeypatch, tmp_path, one_thread):
    """One row of two training scenes and four steps, and the same row step by step; results in a folder of its own."""
    row = replace(
        jumps.ROWS["plates400"], data="small", nodes=100, frames=5, keep=None, train=2, valid=1, test=2,
        steps=4, solver_scenes=1,
        settings={"mirror": ("x", "y"), "corrections": 1, "batch_size": 2, "statistics_pairs": 4},
    )  # fmt: skip
    walk = replace(
        row, model_settings={"jumps": False}, settings={"batch_size": 2, "statistics_pairs": 4}, solver_scenes=0
    )
    monkeypatch.setattr(jumps, "ROWS", {"small": row, "walk": walk})
    monkeypatch.setattr(jumps, "RESULTS", tmp_path / "results" / "jumps.json")
    monkeypatch.setattr(jumps, "PAGE", tmp_path / "jumps.md")
    return tmp_path


def test_a_row_is_trained_measured_and_shown_and_found_again(small):
    (small / "results").mkdir()
    jumps.main(["--folder", str(small / "data")])
    found = json.loads(jumps.RESULTS.read_text())
    row, walk = found["small"], found["walk"]
    assert len(row["scenes"]) == 2 and row["solver"]["scenes"] == 1 and walk["solver"] is None
    assert len(row["by_calls"]) == 1 + sum(row["effort"][dial] for dial in DIALS)
    dial = {(turned["corrections"], turned["newton_steps"]): turned for turned in row["dial"]}
    assert set(dial) == {(0, 0), (1, 0), (2, 0), (3, 0), *((c, n) for c in (0, 1) for n in (1, 2, 10))}
    assert np.mean(dial[1, 2]["relative_error"]) != np.mean(dial[1, 0]["relative_error"])
    assert row["by_calls"][0] == pytest.approx(np.mean(dial[0, 0]["relative_error"]), rel=1e-6)
    default = dial[row["effort"]["corrections"], row["effort"]["newton_steps"]]
    assert row["relative_error"] == pytest.approx(np.mean(default["relative_error"]), rel=1e-6)
    assert walk["effort"] == asdict(Effort()) and walk["by_calls"] == walk["dial"] == []
    text = jumps.PAGE.read_text()
    assert f"{100 * row['relative_error']:.1f} ±" in text and "times as long" in text and "every frame" in text
    assert text.count("\n## ") == 2 and "Worst: test/" in text
    jumps.main(["walk", "--folder", str(small / "data")])  # nothing is trained again
    assert json.loads(jumps.RESULTS.read_text())["walk"]["relative_error"] == walk["relative_error"]


def test_an_unknown_row_is_named(capsys):
    with pytest.raises(SystemExit):
        jumps.main(["plates401"])
    assert "there is no row plates401" in capsys.readouterr().err

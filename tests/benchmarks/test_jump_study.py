"""The study of jumps, from end to end on scenes of 100 nodes."""

import json
from dataclasses import replace

import numpy as np
import pytest

from ast_sim.inference.effort import Effort
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
    row, walk = (jumps.MeasuredRow.from_json(found[name]) for name in ("small", "walk"))
    assert len(row.deepest.scenes) == 2 and row.deepest.solver.scenes == 1 and walk.deepest.solver is None
    assert len(row.deepest.after_calls) == 1 + row.effort.corrections
    assert len(row.deepest.after_newton_steps) == row.effort.newton_steps
    dial = {turned.effort: turned for turned in row.dial}
    calls = [Effort(corrections) for corrections in range(4)]
    assert set(dial) == {*calls, *(Effort(c, n) for c in (0, 1) for n in (1, 2, 10))}
    assert np.mean(dial[Effort(1, 2)].relative_error) != np.mean(dial[Effort(1)].relative_error)
    assert row.deepest.after_calls[0] == pytest.approx(np.mean(dial[Effort()].relative_error), rel=1e-6)
    assert row.deepest.relative_error == pytest.approx(np.mean(dial[row.effort].relative_error), rel=1e-6)
    assert walk.effort == Effort() and walk.deepest.after_calls == () and walk.dial == []
    text = jumps.PAGE.read_text()
    assert f"{100 * row.deepest.relative_error:.1f} ±" in text and "times as long" in text and "every frame" in text
    calls = [line.split(" | ")[3] for line in text.splitlines() if line.startswith(f"| {row.row.title} | ")]
    assert calls[0].startswith(f"{100 * row.deepest.after_calls[0]:.1f} ± ") and calls[1] == "-"
    assert text.count("\n## ") == 2 and "Worst: test/" in text
    jumps.main(["walk", "--folder", str(small / "data")])  # nothing is trained again
    again = jumps.MeasuredRow.from_json(json.loads(jumps.RESULTS.read_text())["walk"])
    assert again.deepest.relative_error == walk.deepest.relative_error


def test_an_unknown_row_is_named(capsys):
    with pytest.raises(SystemExit):
        jumps.main(["plates401"])
    assert "there is no row plates401" in capsys.readouterr().err

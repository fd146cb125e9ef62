"""The shipped runs are made by one command, here of plates of 100 nodes."""

from dataclasses import replace

import pytest

import ast_sim
from benchmarks.studies import coverage, jumps, shipped


def test_a_run_is_simulated_trained_calibrated_and_saved(tmp_path, monkeypatch, capsys):
    row = replace(
        jumps.ROWS["plates400_long"], data="small", nodes=100, frames=3, keep=None, train=30, valid=1, test=1, steps=4,
        settings={"mirror": ("x", "y"), "corrections": 0, "batch_size": 2, "statistics_pairs": 4},
    )  # fmt: skip
    monkeypatch.setitem(jumps.ROWS, "plates400_long", row)
    small = {"family": "deforming_plate", "nodes": 100, "frames": 3}
    monkeypatch.setitem(coverage.ROWS, "plates", replace(coverage.ROWS["plates"], generate=small, calibration=24))
    monkeypatch.setattr(shipped, "SHIPPED", tmp_path)
    shipped.main(["plates", "--folder", str(tmp_path / "data")])
    assert "plates: bands by " in capsys.readouterr().out
    run = ast_sim.Run(tmp_path / "plates.ast")
    assert run.step == 4 and run.folder.licence == shipped.LICENCE
    assert 19 <= run.calibration.scenes <= 24 and run.calibration.efforts[-1] == ast_sim.Effort.exact()
    with pytest.raises(SystemExit):
        shipped.main(["plate"])

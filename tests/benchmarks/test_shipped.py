"""The shipped runs are made by one command, here of plates of 100 nodes."""

import pytest

import ast_sim
from benchmarks.studies import shipped


def test_a_run_is_simulated_trained_calibrated_and_saved(shipped_plates):
    assert "plates: bands by " in (shipped_plates / "told.txt").read_text()
    run = ast_sim.Run(shipped_plates / "plates.ast")
    assert run.step == 4 and run.folder.licence == shipped.LICENCE
    assert 19 <= run.calibration.scenes <= 24 and run.calibration.efforts[-1] == ast_sim.Effort.exact()
    with pytest.raises(SystemExit):
        shipped.main(["plate"])

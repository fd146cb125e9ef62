"""The study of bands and wanted errors, from end to end on plates of 100 nodes."""

import json
import shutil
import warnings
from dataclasses import replace

import numpy as np
import pytest

import ast_sim
from ast_sim.runs.folder import RunFolder
from benchmarks.studies import coverage

FRESH = 3


@pytest.fixture
def small(monkeypatch, tmp_path, one_thread, few_efforts, shipped_plates):
    """A row of plates whose run had four steps; scenes and run as the shipped run has them, before it was calibrated;
    results in a folder apart."""
    shutil.copytree(shipped_plates / "data", tmp_path / "data")

    def trained(folder):
        run = RunFolder(folder / "run_plates400_long")
        run.mark_best(run.metrics.best())
        return ast_sim.Run(run.path)

    plates = {"family": "deforming_plate", "nodes": 100, "frames": 3}
    row = replace(coverage.ROWS["plates"], run=trained, generate=plates, fresh=FRESH, calibration=24)
    monkeypatch.setitem(coverage.ROWS, "plates", row)
    monkeypatch.setattr(coverage, "RESULTS", tmp_path / "coverage.json")
    monkeypatch.setattr(coverage, "PAGE", tmp_path / "coverage.md")
    return tmp_path


def test_a_run_is_calibrated_and_asked_for_fresh_and_strange_scenes(small):
    coverage.main(["plates", "--folder", str(small / "data")])
    result = json.loads(coverage.RESULTS.read_text())["plates"]
    row = result["rows"][0]
    assert (row["effort"], row["quantity"]) == ("0 corrections", "displacement")
    run = ast_sim.Run(small / "data" / "run_plates400_long")
    with ast_sim.Dataset(small / "data" / "plates_fresh.h5") as data, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        truths = [data["test"][index] for index in range(FRESH)]
        answers = [run.predict(truth, effort=ast_sim.Effort()) for truth in truths]
    held = 0
    for answer, truth in zip(answers, truths, strict=True):
        if answer.bands:
            distance = np.linalg.norm(answer.position - truth.position, axis=-1)[:, ~truth.scene.prescribed]
            held += bool((distance.max(axis=1) <= answer.band()).all())
    assert row["levels"]["0.95"]["held"] == held >= row["levels"]["0.9"]["held"]
    assert row["levels"]["0.95"]["width"] >= row["levels"]["0.9"]["width"] > 0
    told = result["told"]
    assert row["fresh_scenes"] + row["without_band"] == FRESH >= row["fresh_scenes"] + told["fresh scenes"]["told"]
    assert all(counts["told"] <= counts["no_band"] <= counts["questions"] for counts in told.values())
    assert told["fresh scenes"]["questions"] == told["twice the travel"]["questions"] == FRESH
    moved = [2 * np.linalg.norm(truth.position - truth.position[0], axis=2) for truth in truths]
    doubled = [far[:, truth.scene.prescribed].max() for far, truth in zip(moved, truths, strict=True)]
    farther = told["of these: farther than any scene of the training"]
    assert farther["questions"] == sum(far > run.scope.travel[1] for far in doubled) >= farther["outside"] > 0
    least = sum(far > 1.06 * run.calibration.farthest[1] for far in doubled)
    assert told["twice the travel"]["no_band"] >= least > 0
    assert told["held by nothing"]["told"] <= FRESH and told["a beam in place of a plate"]["outside"] == FRESH
    page = coverage.PAGE.read_text()
    assert "## Plates, 400 nodes" in page and f"| displacement | {held} of {row['fresh_scenes']} |" in page

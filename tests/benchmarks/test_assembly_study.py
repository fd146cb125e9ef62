"""The study of own assemblies, from end to end on a block that a punch presses."""

import json
from dataclasses import replace

import pytest
from simulate.own_assembly.assemblies import write_assembly

from benchmarks.studies import assembly


@pytest.fixture
def small(monkeypatch, tmp_path, one_thread):
    """A row of three training scenes and four steps, and one that goes on from its run; results in a folder apart."""
    row = replace(
        assembly.ROWS["bumper"], spec=write_assembly(tmp_path), nodes=100, train=3, valid=1, test=2, steps=4,
        solver_scenes=1, settings={"corrections": 1, "batch_size": 2, "statistics_pairs": 4},
    )  # fmt: skip
    later = replace(row, title="Later", steps=2, settings={"batch_size": 2}, after="small", solver_scenes=0)
    monkeypatch.setattr(assembly, "ROWS", {"small": row, "later": later})
    monkeypatch.setattr(assembly, "RESULTS", tmp_path / "results" / "assembly.json")
    monkeypatch.setattr(assembly, "PAGE", tmp_path / "assembly.md")
    return tmp_path


def test_a_product_is_simulated_learned_and_measured(small):
    (small / "results").mkdir()
    assembly.main(["--folder", str(small / "data")])
    one = assembly.MeasuredProduct.from_json(json.loads(assembly.RESULTS.read_text())["small"])
    scenes = one.deepest.scenes
    assert len(scenes) == len(one.curves) == 2 and one.deepest.solver.scenes == 1
    assert one.deepest.no_solver is None and one.generation_minutes > 0
    assert len(one.solver_curves) == 1 and one.solver_curves[0] > 0
    for curve, scene in zip(one.curves, scenes, strict=True):
        assert curve.frames == 2 and curve.true_reaction > 0.1 and curve.seconds > 0
        assert curve.relative_error == pytest.approx(scene.relative_error, rel=1e-3)  # there is no friction
        assert curve.reaction == pytest.approx(curve.reaction_alone, rel=1e-3)
    alone, together = (line for line in assembly.PAGE.read_text().splitlines() if line.startswith("| Bumper"))
    error = sum(abs(curve.reaction / curve.true_reaction - 1) for curve in one.curves) / 2
    assert f"{100 * error:.2g} %, median" in together and ("questions" in alone or "never" in alone)
    assert json.loads((small / "data" / "run_later_2" / "run.json").read_text())["start"]["step"] in (2, 4)


def test_an_unknown_row_is_named(capsys):
    with pytest.raises(SystemExit):
        assembly.main(["bumpr"])
    assert "there is no row bumpr" in capsys.readouterr().err


def test_the_rows_name_specifications_that_are_there():
    for row in assembly.ROWS.values():
        assert row.spec.is_file()
